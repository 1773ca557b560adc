"""The figures of a run's report, drawn with matplotlib and no screen; how they look is `gateway.reporting.figure`'s."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final

import numpy as np
from matplotlib.ticker import MaxNLocator, MultipleLocator
from numpy.typing import NDArray

from gateway.record.sample import MISSED_TPDO_MASK
from gateway.reporting.cycle_errors import cycle_errors
from gateway.reporting.figure import (
    Axes,
    Figure,
    Theme,
    headroom,
    legend,
    new_figure,
    over_the_cycle,
    render_png,
    render_svg,
)
from gateway.reporting.paper_reference import TABLE_II, is_reference_machine
from gateway.reporting.run_data import BoolArray, FloatArray, RunData

_GRID_DEG: Final = 1.0
_MAX_OVERLAID: Final = 24
"""More machine cycles than this are drawn as the band between their extremes."""
_MAX_POINTS: Final = 1500
"""A line of more points is thinned to the extremes of as many bins as fit."""


@dataclass(frozen=True, slots=True)
class Plot:
    """A figure of the report: its file name's stem, its title and caption, and how to draw it."""

    stem: str
    title: str
    caption: str
    draw: Callable[[RunData, Theme], Figure]


def to_png(plot: Plot, data: RunData) -> bytes:
    """The figure as PNG, light, 160 dots an inch, its title above it."""
    return render_png(lambda theme: plot.draw(data, theme), plot.title)


def to_svg(plot: Plot, data: RunData) -> str:
    """The figure as an SVG element that takes its colours and font from the page."""
    return render_svg(lambda theme: plot.draw(data, theme), plot.title, plot.stem)


# -- machine cycles laid over each other ---------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Overlay:
    """Some quantity over the machine cycle: each cycle's line, and the mean over all of them on a grid of angles."""

    cycles: tuple[tuple[FloatArray, FloatArray], ...]
    grid_deg: NDArray[np.floating[Any]]
    mean: FloatArray
    low: FloatArray
    high: FloatArray


def overlay(data: RunData, values: FloatArray, mask: BoolArray) -> Overlay:
    """Cut ``values`` (n,) where ``mask`` holds into machine cycles over theta2 demanded."""
    turn = np.floor(data.master_rad / (2 * np.pi)).astype(np.int64)[mask]
    degrees = data.master_deg[mask]
    kept = values[mask]
    if not len(kept):
        empty = np.empty(0)
        return Overlay((), empty, empty, empty, empty)
    turns, counts = np.unique(turn, return_counts=True)
    bins = int(np.clip(counts.max(), 8, 360 / _GRID_DEG))
    slot = np.minimum((degrees * (bins / 360.0)).astype(np.int64), bins - 1)
    number = np.bincount(slot, minlength=bins)
    with np.errstate(invalid="ignore"):
        mean = np.bincount(slot, weights=kept, minlength=bins) / np.where(number, number, np.nan)
    low = np.full(bins, np.inf)
    high = np.full(bins, -np.inf)
    np.minimum.at(low, slot, kept)
    np.maximum.at(high, slot, kept)
    low[number == 0] = np.nan
    high[number == 0] = np.nan
    lines = tuple(_thinned(degrees[turn == t], kept[turn == t]) for t in turns) if len(turns) <= _MAX_OVERLAID else ()
    return Overlay(lines, (np.arange(bins) + 0.5) * (360.0 / bins), mean, low, high)


def _thinned(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """At most ``_MAX_POINTS`` points that keep the extremes."""
    if len(x) <= _MAX_POINTS:
        return x, y
    edges: list[int] = np.linspace(0, len(x), _MAX_POINTS // 2 + 1).astype(np.int64).tolist()
    kept: list[int] = []
    for first, last in pairwise(edges):
        part = y[first:last]
        kept.extend(sorted({first + int(part.argmin()), first + int(part.argmax())}))
    return x[kept], y[kept]


def _draw_overlay(axes: Axes, lines: Overlay, colour: str, label: str) -> None:
    count = len(lines.cycles)
    for i, (x, y) in enumerate(lines.cycles):
        axes.plot(x, y, color=colour, lw=0.7, alpha=0.3, label=f"{label}, each cycle" if i == 0 and count > 1 else None)
    if not count and len(lines.grid_deg):
        axes.fill_between(
            lines.grid_deg, lines.low, lines.high, color=colour, alpha=0.25, lw=0, label=f"{label}, all cycles"
        )
    axes.plot(lines.grid_deg, lines.mean, color=colour, lw=1.7, label=f"{label}, mean")


def _degrees_beside(axes: Axes, data: RunData, axis: int, theme: Theme) -> None:
    scale = 360.0 / data.constants.axes[axis].counts_per_revolution

    def degrees(counts: FloatArray) -> FloatArray:
        return counts * scale

    def counts(degrees: FloatArray) -> FloatArray:
        return degrees / scale

    beside = axes.secondary_yaxis("right", functions=(degrees, counts))
    beside.set_ylabel("deg", color=theme.ink)
    beside.spines["right"].set_visible(False)
    beside.yaxis.set_major_locator(MaxNLocator(5))


def _error_panel(axes: Axes, data: RunData, axis: int, theme: Theme, colour: str) -> None:
    mask = data.is_steady & data.is_valid[:, axis]
    axes.axhline(0, color=theme.muted, lw=0.8)
    _draw_overlay(axes, overlay(data, data.error_counts[:, axis], mask), colour, "error")
    axes.set_ylabel("demand − actual (counts)")
    over_the_cycle(axes)
    _degrees_beside(axes, data, axis, theme)
    headroom(axes)
    legend(axes, theme, loc="upper right", ncols=2)


# -- the figures ---------------------------------------------------------------------------------------------------


def _servo(data: RunData, theme: Theme) -> Figure:
    axis = data.constants.slave_axis
    name = data.constants.axes[axis].name
    figure = new_figure(8.6, 5.6)
    top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(1.15, 1))
    mask = data.is_steady & data.is_valid[:, axis]
    counts = data.samples["position_actual"][:, axis].astype(np.float64)
    actual = overlay(data, counts, mask)
    demand = overlay(data, data.samples["position_demand"][:, axis].astype(np.float64), data.is_steady)
    _draw_overlay(top, actual, theme.servo, "actual")
    top.plot(demand.grid_deg, demand.mean, color=theme.ink, lw=1.1, ls=(0, (5, 3)), label="demand")
    top.set_ylabel(f"position of {name} (counts)")
    _degrees_beside(top, data, axis, theme)
    headroom(top)
    legend(top, theme, loc="upper left", ncols=3)
    _error_panel(bottom, data, axis, theme, theme.servo)
    return figure


def _cv(data: RunData, theme: Theme) -> Figure:
    figure = new_figure(8.6, 3.2)
    _error_panel(figure.subplots(), data, data.constants.master_axis, theme, theme.cv)
    return figure


def _path(data: RunData, theme: Theme) -> Figure:
    figure = new_figure(8.6, 4.2)
    left, right = figure.subplots(1, 2, width_ratios=(1.15, 1))
    desired, actual = data.desired_mm, data.actual_mm
    if desired is None or actual is None:
        return figure
    mask = data.is_steady & data.is_valid.all(axis=1) & np.isfinite(actual).all(axis=1)
    for i, cycle in enumerate(_cycles(data, mask)):
        if i >= _MAX_OVERLAID:
            break
        left.plot(
            actual[cycle, 0],
            actual[cycle, 1],
            color=theme.path,
            lw=0.9,
            alpha=0.45,
            label="actual, each cycle" if i == 0 else None,
        )
    shown = next(iter(_cycles(data, mask)), None)
    if shown is not None:
        left.plot(*desired[shown].T, color=theme.ink, lw=1.1, ls=(0, (5, 3)), label="desired")
    if is_reference_machine(data.constants.mechanism):
        wanted = np.array([p.desired_mm for p in TABLE_II])
        measured = np.array([p.measured_mm for p in TABLE_II])
        left.plot(*wanted.T, "o", ms=7, mfc="none", mec=theme.ink, label="paper, desired")
        left.plot(*measured.T, "x", ms=6.5, mew=1.6, color=theme.bad, label="paper, measured")
    left.set_aspect("equal", adjustable="datalim")
    left.set_xlabel("x (mm)")
    left.set_ylabel("y (mm)")
    left.set_title("path of the end effector")
    legend(left, theme, loc="lower right", fontsize=8.5)
    distance = np.hypot(*(actual - desired).T)
    _draw_overlay(right, overlay(data, distance, mask), theme.path, "distance")
    right.set_ylabel("distance from the desired point (mm)")
    right.set_title("error over the cycle")
    over_the_cycle(right)
    right.set_xlabel("θ2 demanded (deg)")
    right.xaxis.set_major_locator(MultipleLocator(90))
    right.set_ylim(bottom=0)
    right.set_ylim(0, right.get_ylim()[1] * 1.2 or 1.0)
    legend(right, theme, loc="upper right")
    return figure


def _cycles(data: RunData, mask: BoolArray) -> Iterator[NDArray[np.intp]]:
    """Indices of the samples of each machine cycle, from its start to its end."""
    turn = np.floor(data.master_rad / (2 * np.pi)).astype(np.int64)
    indices = np.flatnonzero(mask)
    for number in np.unique(turn[indices]):
        yield indices[turn[indices] == number]


def _torque(data: RunData, theme: Theme) -> Figure:
    figure = new_figure(8.6, 4.4)
    panels = np.atleast_1d(figure.subplots(len(data.constants.axes), 1, sharex=True))
    for axis, axes in enumerate(panels):
        constants = data.constants.axes[axis]
        colour = theme.cv if axis == data.constants.master_axis else theme.servo
        mask = data.is_steady & data.is_valid[:, axis]
        axes.axhline(0, color=theme.muted, lw=0.8)
        _draw_overlay(axes, overlay(data, data.torque_nm[:, axis], mask), colour, "actual")
        offset = data.samples["torque_offset"][:, axis] * constants.rated_torque_nm / 1000.0
        if np.any(offset):
            fed = overlay(data, offset, data.is_steady)
            axes.plot(fed.grid_deg, fed.mean, color=theme.ink, lw=1.1, ls=(0, (5, 3)), label="feed-forward sent")
        axes.set_ylabel(f"{constants.name} (N m)")
        over_the_cycle(axes)
        if axis < len(panels) - 1:
            axes.set_xlabel("")
        low, high = axes.get_ylim()
        axes.set_ylim(low, high + 0.25 * (high - low))
        legend(axes, theme, loc="upper right", ncols=3)
    return figure


def _timing(data: RunData, theme: Theme) -> Figure:
    samples = data.samples
    figure = new_figure(8.6, 5.2)
    period_ns = data.constants.period_s * 1e9
    has_period, loop_ns = samples["sync_period_ns"] > 0, samples["loop_cpu_ns"]
    has_tpdos = (samples["flags"] & MISSED_TPDO_MASK) == 0
    panels = figure.subplots(2, 3, sharey=True).ravel()
    quantities = (
        ("SYNC period − cycle (µs)", (samples["sync_period_ns"][has_period] - period_ns) / 1e3),
        ("wake-up lateness (µs)", samples["wake_lateness_ns"] / 1e3),
        ("last RPDO before next SYNC (µs)", samples["rpdo_lead_ns"] / 1e3),
        ("last TPDO after SYNC (µs)", samples["tpdo_arrival_ns"][has_tpdos] / 1e3),
        ("processor time of the loop (µs)", loop_ns[loop_ns > 0] / 1e3),
    )
    panels[-1].set_axis_off()
    for axes, (label, values) in zip(panels, quantities, strict=False):
        _histogram(axes, values, theme.path)
        axes.set_xlabel(label)
    panels[2].axvline(0, color=theme.bad, lw=1.2, ls=(0, (4, 2)))
    panels[2].annotate(
        "deadline",
        (0, 0.97),
        xycoords=("data", "axes fraction"),
        xytext=(4, 0),
        textcoords="offset points",
        va="top",
        color=theme.bad,
        fontsize=8.5,
    )
    for axes in panels[::3]:
        axes.set_ylabel("cycles")
    return figure


def _histogram(axes: Axes, values: FloatArray, colour: str) -> None:
    axes.set_yscale("log")
    if not len(values):
        return
    low, high = float(values.min()), float(values.max())
    if high - low < 2.0:
        low, high = low - 1.0, high + 1.0
    counts, edges = np.histogram(values, bins=60, range=(low, high))
    axes.stairs(counts, edges, fill=True, color=colour, alpha=0.85)
    axes.set_ylim(bottom=0.7)
    axes.xaxis.set_major_locator(MaxNLocator(4))


def _run(data: RunData, theme: Theme) -> Figure:
    figure = new_figure(8.6, 4.6)
    speed, errors = figure.subplots(2, 1, sharex=True, height_ratios=(1, 1.3))
    shown = np.flatnonzero(data.is_following)
    seconds = (data.samples["sync_ns"] - (data.samples["sync_ns"][shown[0]] if len(shown) else 0)) / 1e9
    rpm = data.samples["master_velocity"] * 60.0 / (2 * np.pi)
    speed.plot(*_thinned(seconds[shown], rpm[shown]), color=theme.ink, lw=1.4)
    steady = np.flatnonzero(data.is_steady)
    if len(steady):
        for axes in (speed, errors):
            axes.axvspan(seconds[steady[0]], seconds[steady[-1]], color=theme.muted, alpha=0.1, lw=0)
        speed.annotate(
            "constant speed: the main figures are of this span",
            (seconds[steady[0]], 0.06),
            xycoords=("data", "axes fraction"),
            xytext=(5, 0),
            textcoords="offset points",
            color=theme.muted,
            fontsize=8.5,
        )
    speed.set_ylabel("master speed (rpm)")
    speed.set_ylim(bottom=min(0.0, speed.get_ylim()[0]))
    errors.axhline(0, color=theme.muted, lw=0.8)
    for axis in (data.constants.slave_axis, data.constants.master_axis):
        colour = theme.cv if axis == data.constants.master_axis else theme.servo
        usable = shown[data.is_valid[shown, axis]]
        line = _thinned(seconds[usable], data.error_counts[usable, axis])
        errors.plot(*line, color=colour, lw=0.9, label=data.constants.axes[axis].name)
    flagged = shown[data.samples["flags"][shown] != 0]
    if len(flagged):
        errors.plot(
            seconds[flagged],
            np.zeros(len(flagged)),
            "|",
            color=theme.bad,
            ms=9,
            label="TPDO or deadline missed, or overrun",
        )
    errors.set_ylabel("demand − actual (counts)")
    errors.set_xlabel("time since the start of the motion (s)")
    headroom(errors)
    legend(errors, theme, loc="upper right", ncols=3)
    return figure


def _by_cycle(data: RunData, theme: Theme) -> Figure:
    figure = new_figure(8.6, 3.2)
    axes = figure.subplots()
    errors = cycle_errors(data)
    numbers = np.arange(1, errors.count + 1, dtype=np.float64)
    for axis in (data.constants.slave_axis, data.constants.master_axis):
        colour = theme.cv if axis == data.constants.master_axis else theme.servo
        name = data.constants.axes[axis].name
        style = "-" if errors.count > _MAX_OVERLAID else "o-"
        axes.plot(numbers, errors.peak[:, axis], style, color=colour, lw=1.2, ms=4, label=f"{name}, greatest")
        axes.plot(numbers, errors.rms[:, axis], color=colour, lw=1.2, ls=(0, (5, 3)), label=f"{name}, RMS")
    axes.set_xlabel("machine cycle at constant speed")
    axes.set_ylabel("following error (counts)")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_ylim(0, axes.get_ylim()[1] * 1.25 or 1.0)
    legend(axes, theme, loc="upper right", ncols=4)
    return figure


def plots_of(data: RunData) -> tuple[Plot, ...]:
    """The figures that this run's data allow, in the order of the report."""
    servo = data.constants.axes[data.constants.slave_axis].name
    cv = data.constants.axes[data.constants.master_axis].name
    reference = is_reference_machine(data.constants.mechanism)

    def figure(number: str) -> str:
        return f" The paper's figure {number}." if reference else ""

    path = Plot(
        "path",
        "End effector",
        "Desired path, and the path that follows from both actual positions." + figure("3.3"),
        _path,
    )
    return (
        Plot(
            "servo",
            f"Servo axis ({servo}) over the machine cycle",
            "Demand, actual position and following error at constant master speed." + figure("3.5"),
            _servo,
        ),
        Plot(
            "cv",
            f"CV axis ({cv}) over the machine cycle",
            "Following error at constant master speed." + figure("3.6"),
            _cv,
        ),
        *((path,) if data.constants.mechanism is not None else ()),
        Plot("torque", "Torque over the machine cycle", "Actual torque as the drives report it.", _torque),
        Plot(
            "cycles",
            "Following error by machine cycle",
            "Each whole revolution at constant master speed: what learning takes away from one to the next.",
            _by_cycle,
        ),
        Plot(
            "run",
            "The whole run",
            "Master speed and following errors while the axes follow the cam, ramps and controlled stops included; "
            "red marks are cycles in which a TPDO or a deadline was missed.",
            _run,
        ),
        Plot(
            "timing",
            "Timing of the cycle",
            "Every recorded cycle, on a logarithmic scale, so that a single late one shows.",
            _timing,
        ),
    )
