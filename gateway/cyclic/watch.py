"""What is looked at in every cycle: the guard's conditions that come from TPDOs, demand and actual values."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gateway.cyclic.axis_channel import AxisChannel
from gateway.cyclic.guard import Condition, Guard
from gateway.record.sample import INT32_MAX, Phase
from gateway.units import HALF_RANGE, RANGE_MASK
from mechanism.deviation import end_effector_miss
from mechanism.slave_law import SlaveLaw

STATUSWORD_STATE_MASK: Final = 0x6F
STATUSWORD_OPERATION_ENABLED: Final = 0x27
MICROMETRES: Final = 1e6

_RAMP_UP: Final = Phase.RAMP_UP
_CONTROLLED_STOP: Final = Phase.CONTROLLED_STOP


@dataclass(frozen=True, slots=True)
class AxisLimits:
    """What is guarded of one axis; the following error's limit is the channel's own."""

    velocity_counts_per_cycle: float
    torque_permille: int
    frozen_counts: int
    """Travel of the demand while the actual value stays the same."""


NO_LIMITS: Final = AxisLimits(float("inf"), INT32_MAX, INT32_MAX)


@dataclass(frozen=True, slots=True, eq=False)
class CamWindow:
    """The linkage as `mechanism.deviation` takes it, where its slave is to be, and how far it may be from there."""

    geometry: NDArray[np.float64]
    closure: int
    law: SlaveLaw
    rad_per_count: tuple[float, float]
    """Master, slave."""
    window_rad: float
    end_effector_m: float


class CycleWatch:
    """Compares every cycle with the guard's limits: plain arithmetic, nothing is made unless something is wrong."""

    __slots__ = ("_actuals", "_all_axes", "_axes", "_cam", "_guard", "_is_fresh", "_limits", "_targets", "_travels")

    def __init__(
        self,
        guard: Guard,
        axes: Sequence[AxisChannel],
        limits: Sequence[AxisLimits] = (),
        cam: CamWindow | None = None,
    ) -> None:
        """``limits``: one an axis, none at all where left out; ``cam``: of a machine of two axes, master first."""
        self._guard = guard
        self._axes = tuple(axes)
        self._limits = tuple(limits) or (NO_LIMITS,) * len(self._axes)
        self._cam = cam
        self._all_axes = (1 << len(self._axes)) - 1
        self._actuals = [0] * len(self._axes)
        self._targets = [0] * len(self._axes)
        self._travels = [0] * len(self._axes)
        self._is_fresh = [False] * len(self._axes)
        """Whether the actual value of the cycle before is known."""
        if cam is not None:
            # The first call loads the machine code, which must not happen within a cycle.
            end_effector_miss(cam.geometry, cam.closure, 0.0, 0.0, 0.0, 0.0)

    def check(
        self, awaited: int, targets: Sequence[int], master_position: float, phase: Phase, is_enabled: bool, now_ns: int
    ) -> None:
        """One cycle. ``awaited``: bit n, the TPDO of axis n is missing; ``targets`` (counts), ``master_position`` (rad)
        and ``phase`` are those in force at its SYNC; ``is_enabled``: all drives are meant to be in Operation enabled.
        """
        guard = self._guard
        if awaited:
            self._check_missing(awaited, now_ns)
        elif not guard.is_quiet:
            guard.clear(Condition.BUS_OFF, 0)
        for number, axis in enumerate(self._axes):
            if awaited >> number & 1:
                continue
            axis.silent_cycles = 0
            if not guard.is_quiet:
                guard.clear(Condition.MISSED_TPDO, number)
                guard.clear(Condition.AXIS_SILENT, number)
            if is_enabled:
                self._check_drive(number, axis, targets[number], now_ns)
                self._check_motion(number, axis, targets[number], now_ns)
            else:
                self._is_fresh[number] = False
        cam = self._cam
        if cam is not None and is_enabled and not awaited and _RAMP_UP <= phase <= _CONTROLLED_STOP:
            self._check_cam(cam, targets, master_position, now_ns)

    def note_silence(self, awaited: int) -> None:
        """One cycle of which only this counts: whose TPDO is missing (bits as for ``check``)."""
        for number, axis in enumerate(self._axes):
            axis.silent_cycles = axis.silent_cycles + 1 if awaited >> number & 1 else 0

    def _check_missing(self, awaited: int, now_ns: int) -> None:
        guard = self._guard
        is_nobody_here = awaited == self._all_axes
        for number, axis in enumerate(self._axes):
            if awaited >> number & 1:
                axis.silent_cycles += 1
                self._is_fresh[number] = False
                guard.hold_cycles(Condition.MISSED_TPDO, number, now_ns)
                if not is_nobody_here:
                    guard.hold_cycles(Condition.AXIS_SILENT, number, now_ns)
        if is_nobody_here:
            guard.hold_cycles(Condition.BUS_OFF, 0, now_ns)
        else:
            guard.clear(Condition.BUS_OFF, 0)

    def _check_drive(self, number: int, axis: AxisChannel, target: int, now_ns: int) -> None:
        guard = self._guard
        if axis.statusword & STATUSWORD_STATE_MASK != STATUSWORD_OPERATION_ENABLED:
            guard.hold(Condition.DRIVE_FAULT, number, axis.statusword, 0, now_ns)
        elif not guard.is_quiet:
            guard.clear(Condition.DRIVE_FAULT, number)
        error = (target - axis.actual + HALF_RANGE & RANGE_MASK) - HALF_RANGE
        limit = axis.following_error_limit
        if not -limit <= error <= limit:
            guard.hold(Condition.FOLLOWING_ERROR, number, error, limit, now_ns)
        elif not guard.is_quiet:
            guard.clear(Condition.FOLLOWING_ERROR, number)
        bound = self._limits[number].torque_permille
        if not -bound <= axis.torque <= bound:
            guard.hold(Condition.TORQUE, number, axis.torque, bound, now_ns)
        elif not guard.is_quiet:
            guard.clear(Condition.TORQUE, number)

    def _check_motion(self, number: int, axis: AxisChannel, target: int, now_ns: int) -> None:
        guard, limits = self._guard, self._limits[number]
        actual = axis.actual
        moved = (actual - self._actuals[number] + HALF_RANGE & RANGE_MASK) - HALF_RANGE
        travel = (target - self._targets[number] + HALF_RANGE & RANGE_MASK) - HALF_RANGE
        self._actuals[number] = actual
        self._targets[number] = target
        if not self._is_fresh[number]:
            self._is_fresh[number] = True
            self._travels[number] = 0
            return
        bound = limits.velocity_counts_per_cycle
        if not -bound <= moved <= bound:
            guard.hold(Condition.VELOCITY, number, moved, int(bound), now_ns)
        elif not guard.is_quiet:
            guard.clear(Condition.VELOCITY, number)
        if moved or (not guard.is_quiet and guard.is_holding(Condition.MISSED_DEADLINE, 0)):
            # A drive that has had no new target stands, whatever its resolver shows.
            self._travels[number] = 0
            if not guard.is_quiet:
                guard.clear(Condition.FROZEN_ACTUAL, number)
            return
        travelled = self._travels[number] + (travel if travel > 0 else -travel)
        self._travels[number] = travelled
        if travelled > limits.frozen_counts:
            guard.hold(Condition.FROZEN_ACTUAL, number, travelled, limits.frozen_counts, now_ns)

    def _check_cam(self, cam: CamWindow, targets: Sequence[int], master_position: float, now_ns: int) -> None:
        guard = self._guard
        (master, slave), (master_scale, slave_scale) = self._axes, cam.rad_per_count
        error2 = ((targets[0] - master.actual + HALF_RANGE & RANGE_MASK) - HALF_RANGE) * master_scale
        error5 = ((targets[1] - slave.actual + HALF_RANGE & RANGE_MASK) - HALF_RANGE) * slave_scale
        law = cam.law
        theta5 = law.at(master_position)[0]
        miss = end_effector_miss(cam.geometry, cam.closure, master_position, theta5, error2, error5)
        window = theta5 - error5 - law.at(master_position - error2)[0]
        if not -cam.window_rad <= window <= cam.window_rad:
            guard.hold(
                Condition.CAM_WINDOW, 0, _counts(window, slave_scale), _counts(cam.window_rad, slave_scale), now_ns
            )
        elif not guard.is_quiet:
            guard.clear(Condition.CAM_WINDOW, 0)
        if not miss <= cam.end_effector_m:
            guard.hold(
                Condition.END_EFFECTOR_ERROR,
                0,
                _counts(miss, 1.0 / MICROMETRES),
                _counts(cam.end_effector_m, 1.0 / MICROMETRES),
                now_ns,
            )
        elif not guard.is_quiet:
            guard.clear(Condition.END_EFFECTOR_ERROR, 0)


def _counts(value: float, unit: float) -> int:
    """``value`` in units, as an integer that any event can carry; a linkage that does not close is infinitely far."""
    return min(round(abs(value) / unit), INT32_MAX) if value == value else INT32_MAX
