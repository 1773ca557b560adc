"""The last machine cycle of each tuning as the paper's Figure 3.5 has it: servo demand, actual position and errors."""

from collections.abc import Sequence
from typing import Final

import numpy as np

from gateway.reporting import paper_reference as paper
from gateway.reporting.figure import Axes, Figure, Theme, headroom, legend, new_figure, over_the_cycle, render_png
from gateway.reporting.paper_figures import ServoTicks

_MASTER: Final = 0
_SLAVE: Final = 1


def plot_reproduction(runs: Sequence[tuple[str, ServoTicks, slice]]) -> bytes:
    """A PNG with a column for each (title, ticks, one revolution of them): servo position, and both axes' errors."""

    def draw(theme: Theme) -> Figure:
        figure = new_figure(5.4 * len(runs), 6.0)
        panels = figure.subplots(2, len(runs), sharex=True, sharey="row", squeeze=False, height_ratios=(1, 1.25))
        for (title, ticks, cycle), (position, error) in zip(runs, panels.T, strict=True):
            degrees = (ticks.revolutions[cycle] - np.floor(ticks.revolutions[cycle][0] + 0.5)) * 360.0
            position.plot(degrees, ticks.counts[cycle, _SLAVE], color=theme.servo, label="actual")
            demand = ticks.demand_counts[cycle, _SLAVE]
            position.plot(degrees, demand, color=theme.ink, lw=1.1, ls=(0, (5, 3)), label="demand")
            position.set_title(title)
            _levels(error, theme)
            error.plot(degrees, ticks.errors[cycle, _SLAVE], color=theme.servo, label="servo")
            error.plot(degrees, ticks.errors[cycle, _MASTER], color=theme.cv, label="CV")
            over_the_cycle(error)
        panels[0, 0].set_ylabel("servo position (counts)")
        panels[1, 0].set_ylabel("following error (counts)")
        for axes in (panels[0, 0], panels[1, 0]):
            headroom(axes)
            legend(axes, theme, loc="upper left", ncols=3)
        return figure

    return render_png(draw, "Steady machine cycle at 60 rpm")


def _levels(axes: Axes, theme: Theme) -> None:
    """The paper's extreme errors."""
    for level, name, at_deg in (
        (paper.SERVO_ERROR_EXTREME_COUNTS, "the paper's servo error, −115", 4),
        (paper.CV_ERROR_EXTREME_COUNTS, "the paper's CV error, 19", 210),
    ):
        axes.axhline(level, color=theme.muted, lw=0.8, ls=":")
        axes.annotate(name, (at_deg, level), color=theme.muted, fontsize=8, va="bottom")
