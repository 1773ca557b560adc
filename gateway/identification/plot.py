"""The fit as a picture: measured torque, what the identified model says, and what is left, over the master's angle."""

from typing import Final

import numpy as np

from gateway.identification.fit import Identification
from gateway.reporting.figure import Figure, Theme, new_figure, render_png

_SIZE_INCHES: Final = (10.5, 6.5)


def fit_png(result: Identification, axis_names: tuple[str, ...]) -> bytes:
    """A PNG; axes are master and slave."""
    return render_png(lambda theme: _draw(result, axis_names, theme), "Torque: measured and of the identified model")


def _draw(result: Identification, axis_names: tuple[str, ...], theme: Theme) -> Figure:
    figure = new_figure(*_SIZE_INCHES)
    degrees = np.degrees(np.mod(result.theta2_rad, 2.0 * np.pi))
    panels = figure.subplots(2, 2, sharex=True, height_ratios=(3, 1))
    for axis, name in enumerate(axis_names):
        measured, predicted = result.measured_Nm[:, axis], result.predicted_Nm[:, axis]
        above, below = panels[0, axis], panels[1, axis]
        colour = (theme.cv, theme.servo)[axis]
        above.plot(degrees, measured, ".", markersize=3.5, color=theme.muted, label="measured, smoothed")
        above.plot(degrees, predicted, ".", markersize=1.2, color=colour, label="identified model")
        above.set_title(f"axis {name}: {result.residual_rms_Nm[axis] * 1e3:.1f} mN m RMS are left")
        above.legend(loc="best", markerscale=4.0)
        below.plot(degrees, (measured - predicted) * 1e3, ".", markersize=1.2, color=theme.bad)
        below.set_xlabel("theta2, deg")
        below.set_xlim(0.0, 360.0)
    panels[0, 0].set_ylabel("torque, N m")
    panels[1, 0].set_ylabel("left, mN m")
    return figure
