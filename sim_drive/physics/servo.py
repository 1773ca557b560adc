"""The position controller inside a drive: eq (5) of the paper, scaled by eq (6), at 1024 Hz.

Everything is in the drive's own units: positions and errors in counts, gains as integers over 256, the output in units
of a 12-bit converter that spans +-10 V, that is 10/2048 V a unit.
"""

from collections.abc import Sequence
from enum import IntEnum, unique
from math import floor, inf
from typing import Final

SERVO_RATE_HZ: Final = 1024
"""Sample rate of the controller: the velocities the paper quotes are multiples of it."""
GAIN_SCALE: Final = 256
"""Gains are integers over this (eq 6)."""
VOLT_PER_UNIT: Final = 10.0 / 2048.0
"""Volts of one unit of the 12-bit output (eq 6)."""
OUTPUT_MINIMUM: Final = -2048
OUTPUT_MAXIMUM: Final = 2047


@unique
class DemandResolution(IntEnum):
    """In what resolution the demand enters eq (5).

    Every mode rounds the demand to counts in the error, so that a stationary axis has an error of whole counts, as the
    paper's controller had. They differ in the demand difference that K_F multiplies: between two interpolated targets
    the demand moves by fractions of a count, and the difference of *rounded* demands jumps by a whole count from one
    sample to the next. With K_F of a hundred units a count that is noise of a fifth of a newton metre that the drive
    makes itself; see ``UNROUNDED_DIFFERENCE``.
    """

    COUNTS = 0
    """Rounded throughout, eq (5) to the letter."""
    UNROUNDED_DIFFERENCE = 1
    """Rounded in the error, unrounded in the difference: the default."""
    UNROUNDED = 2
    """Not rounded anywhere: what a drive with a finer internal position does."""


class ServoLoop:
    """Position controller of one axis, with memory; one ``update`` a servo period.

    Eq (5): V = K_P e_i + K_I sum(e) + K_D (e_i - e_(i-1)) - K_V (p_i - p_(i-1)) + K_F (d_i - d_(i-1)), each term times
    10/2048/256 volts (eq 6). The velocity is a difference over one sample. The output is rounded to the converter's
    units and limited to -2048..2047. The sum is only continued while the output is within its limits, or while the
    error leads it back (conditional integration); it holds integers as long as the demand is rounded.
    """

    __slots__ = (
        "_demand_before",
        "_error_before",
        "_error_sum",
        "_position_before",
        "_round_difference",
        "_round_error",
        "demand_resolution",
        "error_counts",
        "output_units",
    )

    def __init__(self, demand_resolution: DemandResolution = DemandResolution.UNROUNDED_DIFFERENCE) -> None:
        self.demand_resolution = demand_resolution
        self._round_error = demand_resolution is not DemandResolution.UNROUNDED
        self._round_difference = demand_resolution is DemandResolution.COUNTS
        self.error_counts: float = 0.0
        """Demand minus actual of the last update, in counts."""
        self.output_units: int = 0
        """Converter output of the last update, in units of 10/2048 V."""
        self._error_sum = 0.0
        self._error_before = 0.0
        self._position_before = 0
        self._demand_before = 0.0

    def reset(self, demand_counts: float, actual_counts: int) -> None:
        """Forget the past as of now: no sum, and no jump in any difference (a bumpless start).

        Call it when the axis is enabled. The first output is then K_P times the standing error, which a drive that
        enables with its demand at its actual position has at 0.
        """
        demand = float(floor(demand_counts + 0.5)) if self._round_error else demand_counts
        self.error_counts = demand - actual_counts
        self.output_units = 0
        self._error_sum = 0.0
        self._error_before = self.error_counts
        self._position_before = actual_counts
        self._demand_before = demand if self._round_difference else demand_counts

    def update(
        self,
        demand_counts: float,
        actual_counts: int,
        gains: Sequence[int],
        torque_offset_Nm: float,
        torque_per_volt: float,
        torque_limit_Nm: float = inf,
        negative_torque_limit_Nm: float | None = None,
        velocity_offset_counts_per_s: float = 0.0,
    ) -> float:
        """Torque command for the coming servo period, in N m.

        ``gains`` are K_P, K_I, K_D, K_V, K_F as integers over 256. ``torque_offset_Nm`` is added at the converter's
        input: it shares the 12 bits and the limits with the controller. ``torque_per_volt`` (N m / V) is the
        amplifier's. ``torque_limit_Nm`` and ``negative_torque_limit_Nm`` (both positive numbers; None: the same)
        narrow the output's limits to whole units within them. ``velocity_offset_counts_per_s`` is added to the demand
        difference that K_F multiplies.
        """
        gain_p, gain_i, gain_d, gain_v, gain_f = gains
        demand = float(floor(demand_counts + 0.5)) if self._round_error else demand_counts
        demand_fed = demand if self._round_difference else demand_counts
        error = demand - actual_counts
        error_sum = self._error_sum + error
        wanted = (
            gain_p * error
            + gain_i * error_sum
            + gain_d * (error - self._error_before)
            - gain_v * (actual_counts - self._position_before)
            + gain_f * (demand_fed - self._demand_before + velocity_offset_counts_per_s / SERVO_RATE_HZ)
        ) / GAIN_SCALE + torque_offset_Nm / (torque_per_volt * VOLT_PER_UNIT)
        maximum = OUTPUT_MAXIMUM
        minimum = OUTPUT_MINIMUM
        limit = torque_limit_Nm / (torque_per_volt * VOLT_PER_UNIT)
        if limit < -OUTPUT_MINIMUM:
            maximum = floor(limit)
        if negative_torque_limit_Nm is not None:
            limit = negative_torque_limit_Nm / (torque_per_volt * VOLT_PER_UNIT)
        if limit < -OUTPUT_MINIMUM:
            minimum = -floor(limit)
        if wanted >= maximum:
            output = maximum
            if error < 0.0:
                self._error_sum = error_sum
        elif wanted <= minimum:
            output = minimum
            if error > 0.0:
                self._error_sum = error_sum
        else:
            output = floor(wanted + 0.5)
            self._error_sum = error_sum
        self.error_counts = error
        self._error_before = error
        self._position_before = actual_counts
        self._demand_before = demand_fed
        self.output_units = output
        return output * VOLT_PER_UNIT * torque_per_volt
