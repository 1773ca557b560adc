"""How every figure of a report looks: themes, PNG and SVG output without a screen, and what the panels share.

A figure is drawn from a theme. The page's theme consists of marker colours that become CSS variables, so that one SVG
reads on a light and on a dark page; the PNG theme is plain light.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass
from io import BytesIO, StringIO
from typing import Any, Final

import matplotlib
import matplotlib.figure
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.ticker import MultipleLocator

# matplotlib's own annotations are partial, so its objects are untyped here.
Figure = Any
Axes = Any
_mpl: Any = matplotlib


@dataclass(frozen=True, slots=True)
class Theme:
    """Colours of a figure."""

    ink: str
    muted: str
    grid: str
    cv: str
    servo: str
    path: str
    bad: str
    paper: str


PNG_THEME: Final = Theme(
    ink="#1c2430",
    muted="#5b6675",
    grid="#dfe4ea",
    cv="#0b7a75",
    servo="#c2500a",
    path="#4053c8",
    bad="#c21f3a",
    paper="#ffffff",
)
_PAGE_COLOURS: Final = {
    "ink": "#010101",
    "muted": "#020202",
    "grid": "#030303",
    "cv": "#040404",
    "servo": "#050505",
    "path": "#060606",
    "bad": "#070707",
    "paper": "#080808",
}
PAGE_THEME: Final = Theme(**_PAGE_COLOURS)


Draw = Callable[[Theme], Figure]


def render_png(draw: Draw, title: str) -> bytes:
    """The figure as PNG, light, 160 dots an inch, its title above it."""
    with _mpl.rc_context(figure_style(PNG_THEME)):
        figure = draw(PNG_THEME)
        figure.suptitle(title, x=0.01, ha="left", fontsize=12, fontweight="bold", color=PNG_THEME.ink)
        FigureCanvasAgg(figure)
        stream = BytesIO()
        figure.savefig(stream, format="png", dpi=160, metadata={"Software": None})
    return stream.getvalue()


def render_svg(draw: Draw, title: str, stem: str) -> str:
    """The figure as an SVG element that takes its colours and font from the page; ``stem`` makes its ids its own."""
    with _mpl.rc_context(figure_style(PAGE_THEME)):
        figure = draw(PAGE_THEME)
        FigureCanvasSVG(figure)
        stream = StringIO()
        nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
        figure.savefig(stream, format="svg", transparent=True, metadata=nothing)
    svg = stream.getvalue()
    svg = svg[svg.index("<svg") :]
    # A hundredth of a point is finer than any screen, and halves the page; what stands between the tags is for reading.
    svg = re.sub(r"<[^>]*>", lambda tag: re.sub(r"(\d\.\d\d)\d+", r"\1", tag[0]), svg)
    for name, marker in _PAGE_COLOURS.items():
        svg = svg.replace(marker, f"var(--{name})")
    # One page holds several figures: their ids must differ.
    svg = re.sub(r'(id="|url\(#|xlink:href="#)', lambda found: f"{found[1]}{stem}-", svg)
    svg = re.sub(r"'DejaVu Sans'[^;\"]*", "var(--font)", svg)
    size = re.compile(r'(<svg[^>]*?) width="[^"]*"([^>]*?)', re.DOTALL)
    svg = size.sub(r"\1\2", svg, count=1)
    svg = re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", svg, count=1, flags=re.DOTALL)
    return svg.replace("<svg", f'<svg role="img" aria-label="{title}"', 1)


def figure_style(theme: Theme) -> dict[str, Any]:
    """matplotlib's settings for a theme."""
    return {
        "font.family": "DejaVu Sans",
        "font.size": 9.5,
        "svg.fonttype": "none",
        "svg.hashsalt": "drive-gateway",
        "axes.edgecolor": theme.muted,
        "axes.labelcolor": theme.ink,
        "axes.titlecolor": theme.ink,
        "axes.titlesize": 10,
        "axes.titlelocation": "left",
        "axes.linewidth": 0.7,
        "axes.grid": True,
        "axes.axisbelow": True,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.unicode_minus": True,
        "grid.color": theme.grid,
        "grid.linewidth": 0.7,
        "text.color": theme.ink,
        "xtick.color": theme.muted,
        "ytick.color": theme.muted,
        "xtick.labelcolor": theme.muted,
        "ytick.labelcolor": theme.muted,
        "xtick.major.width": 0.7,
        "ytick.major.width": 0.7,
        "legend.frameon": False,
        "legend.fontsize": 9,
        "lines.linewidth": 1.6,
        "lines.solid_capstyle": "round",
        "figure.facecolor": theme.paper,
        "axes.facecolor": "none",
        "path.simplify_threshold": 0.4,
    }


def new_figure(width: float, height: float) -> Figure:
    """An empty figure of so many inches."""
    return matplotlib.figure.Figure(figsize=(width, height), layout="constrained")


def over_the_cycle(axes: Axes) -> None:
    """The machine cycle as the horizontal axis."""
    axes.set_xlim(0, 360)
    axes.xaxis.set_major_locator(MultipleLocator(45))
    axes.set_xlabel("θ2 demanded, within the machine cycle (deg)")


def legend(axes: Axes, theme: Theme, **keywords: Any) -> None:
    """A legend, where there is anything to name."""
    if axes.get_legend_handles_labels()[1]:
        shown = axes.legend(labelcolor=theme.ink, **keywords)
        for handle in shown.legend_handles:
            if handle.get_alpha() is not None:
                handle.set_alpha(0.7)  # a single faint line is not to be seen


def headroom(axes: Axes) -> None:
    """Room for the legend above the lines, and never a range of less than two units."""
    low, high = axes.get_ylim()
    if high - low < 2.0:
        middle = (high + low) / 2
        low, high = middle - 1.0, middle + 1.0
    axes.set_ylim(low, high + 0.18 * (high - low))
