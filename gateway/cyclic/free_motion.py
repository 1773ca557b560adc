"""How an axis that stands would move under its torque, by the model, if nothing but its load and friction held it."""

from collections.abc import Sequence
from math import copysign, isfinite, tau
from typing import Final

from config.guard_section import FRICTION_SLACK
from gateway.cyclic.axis_channel import AxisChannel
from mechanism.dynamics import DynamicsParameters, mass_matrix_and_bias
from mechanism.five_bar import Closure

LOAD_SHARE: Final = 0.3
"""Of a load by which the model may be wrong."""


class FreeMotion:
    """Of the two axes of a five-bar; see the module."""

    __slots__ = (
        "_axes",
        "_closure",
        "_count_rad",
        "_cycle_s",
        "_friction_Nm",
        "_permille_Nm",
        "_values",
        "slack_permille",
    )

    def __init__(
        self, axes: Sequence[AxisChannel], parameters: DynamicsParameters, closure: Closure, cycle_s: float
    ) -> None:
        """``axes``: master, slave."""
        master, slave = axes
        self._axes = master, slave
        self._values = parameters.to_array()
        self._closure = int(closure)
        self._friction_Nm = tuple(FRICTION_SLACK * dry for dry in parameters.coulomb_N_m)
        self._permille_Nm = tuple(axis.units.rated_torque / 1000.0 for axis in axes)
        self._count_rad = tuple(tau / axis.units.counts_per_revolution for axis in axes)
        self._cycle_s = cycle_s
        self.slack_permille = tuple(
            axis.units.permille(slack) for axis, slack in zip(axes, self._friction_Nm, strict=True)
        )
        """What an axis is held against without moving, whatever it has to hold."""
        # The first call loads the machine code, which must not happen within a cycle.
        self.acceleration(0, 1000, 0)

    def acceleration(
        self, number: int, torque: int, torque_offset: int | None, velocities: Sequence[float] = (0.0, 0.0)
    ) -> float:
        """Counts per cycle^2 of axis ``number`` under ``torque``, 0 where that holds it, or may.

        What the torque offset foresees is no drive, nor is what the axis holds at rest, whichever explains more:
        offsets come in by and by, but know of accelerations. None: nothing is foreseen, and only the load counts. In
        per mille of rated torque; ``velocities`` are the demand's (rad/s): the other axis' loads this one.
        """
        unit, slack = self._permille_Nm[number], self._friction_Nm[number]
        foreseen = 0.0 if torque_offset is None else unit * torque_offset
        unforeseen = unit * torque - foreseen
        if torque_offset is not None and -slack <= unforeseen <= slack:
            return 0.0
        theta2, theta5 = (axis.units.angle(axis.actual - axis.leapt) for axis in self._axes)
        omega2, omega5 = (velocities[0], 0.0) if number else (0.0, velocities[1])
        m11, _, m22, h1, h2 = mass_matrix_and_bias(self._values, theta2, theta5, omega2, omega5, self._closure)
        inertia, load = (m22, h2) if number else (m11, h1)
        unheld = unit * torque - load
        if torque_offset is None:
            unforeseen = unheld
        if not isfinite(load) or unheld * unforeseen <= 0.0:
            return 0.0
        driving = min(abs(unheld), abs(unforeseen)) - slack - LOAD_SHARE * max(abs(load), abs(foreseen))
        if driving <= 0.0:
            return 0.0
        return copysign(driving, unheld) / inertia / self._count_rad[number] * self._cycle_s * self._cycle_s
