"""What is looked at in every cycle: the guard's conditions that come from TPDOs, demand and actual values.

Here: who is silent, and how the axes move. Whether an axis that stands should move is asked in `answer`, how far the
linkage is from its cam in `cam_window`.
"""

from collections.abc import Sequence
from typing import Final

from gateway.cyclic.answer import AnswerWatch
from gateway.cyclic.axis_channel import LEAP_GAP_CYCLES, NO_LIMITS, RARE_CYCLES, AxisChannel, AxisLimits
from gateway.cyclic.cam_window import CamWindow
from gateway.cyclic.free_motion import FreeMotion
from gateway.cyclic.guard import Condition, Guard
from gateway.record.sample import Phase
from gateway.units import HALF_RANGE, RANGE_MASK, wrap_counts

STATUSWORD_STATE_MASK: Final = 0x6F
STATUSWORD_OPERATION_ENABLED: Final = 0x27
LEAP_SHARE: Final = 2.0
"""Of the velocity limit: an axis that is so much faster within a single cycle has not moved, its resolver has leapt."""
LEAST_LEAP_COUNTS: Final = 20.0
"""What a coarse resolver's noise shows is no leap."""

_STANDSTILL: Final = Phase.STANDSTILL
_RAMP_UP: Final = Phase.RAMP_UP
_CONTROLLED_STOP: Final = Phase.CONTROLLED_STOP


class _WatchedAxis:
    """One axis, its limits, and what it was in the cycle before."""

    __slots__ = (
        "actual",
        "answer",
        "axis",
        "error",
        "is_fresh",
        "is_known",
        "number",
        "target",
        "torque",
        "velocity",
    )

    def __init__(self, number: int, axis: AxisChannel, limits: AxisLimits, answer: AnswerWatch) -> None:
        self.number = number
        self.axis = axis
        self.answer = answer
        axis.leap_limit = max(LEAP_SHARE * limits.velocity_counts_per_cycle, LEAST_LEAP_COUNTS)
        self.velocity = limits.velocity_counts_per_cycle
        self.torque = limits.torque_permille
        self.actual = 0
        self.target = 0
        self.error = 0
        self.is_fresh = False
        """The actual value of the cycle before is known."""
        self.is_known = False
        """That of a cycle shortly before is, and every SYNC since then has been sent."""


class CycleWatch:
    """Compares every cycle with the guard's limits: plain arithmetic, nothing is made unless something is wrong."""

    __slots__ = ("_all_axes", "_are_loads_carried", "_cam", "_guard", "_watched")

    def __init__(
        self,
        guard: Guard,
        axes: Sequence[AxisChannel],
        limits: Sequence[AxisLimits] = (),
        cam: CamWindow | None = None,
        free_motion: FreeMotion | None = None,
    ) -> None:
        """``limits``: one an axis, none at all where left out; ``cam``: of a machine of two axes, master first.

        ``free_motion``: of a machine whose model is good enough to say what an axis would do.
        """
        self._guard = guard
        limits = tuple(limits) or (NO_LIMITS,) * len(axes)
        self._watched = tuple(
            _WatchedAxis(number, axis, limit, AnswerWatch(guard, number, axis, limit, free_motion))
            for number, (axis, limit) in enumerate(zip(axes, limits, strict=True))
        )
        self._cam = cam
        self._are_loads_carried = False
        self._all_axes = (1 << len(axes)) - 1

    def check(
        self,
        awaited: int,
        targets: Sequence[int],
        torque_offsets: Sequence[int],
        velocities: Sequence[float],
        master_position: float,
        phase: Phase,
        is_enabled: bool,
        followers: int,
        now_ns: int,
    ) -> None:
        """One cycle. ``awaited``: bit n, the TPDO of axis n is missing.

        ``targets`` (counts), ``torque_offsets`` (per mille), ``velocities`` (rad/s), ``master_position`` (rad) and
        ``phase`` are those in force at its SYNC; ``is_enabled``: all drives are meant to be in Operation enabled;
        ``followers``: bit n, axis n still follows its targets in a stop in which they are not.
        """
        guard = self._guard
        if awaited:
            self._check_missing(awaited, now_ns)
        elif not guard.is_quiet:
            guard.clear(Condition.BUS_OFF, 0)
        is_at_rest = phase is _STANDSTILL and self._are_loads_carried
        for number, watched in enumerate(self._watched):
            if awaited >> number & 1:
                continue
            axis = watched.axis
            axis.silent_cycles = 0
            if axis.rare_cycles:
                axis.rare_cycles -= 1
            if not guard.is_quiet:
                guard.clear(Condition.MISSED_TPDO, number)
                guard.clear(Condition.AXIS_SILENT, number)
            if is_enabled:
                offset = torque_offsets[number]
                self._check_axis(watched, targets[number], offset, velocities, is_at_rest, now_ns)
            elif followers >> number & 1:
                self._check_follower(watched, targets[number], now_ns)
            else:
                watched.is_fresh = watched.is_known = False
                continue
            watched.actual = watched.axis.actual
            watched.target = targets[number]
            watched.is_fresh = watched.is_known = True
        cam = self._cam
        if cam is not None and is_enabled and not awaited and _RAMP_UP <= phase <= _CONTROLLED_STOP:
            master, slave = self._watched
            master_bound, slave_bound = cam.harmless_counts
            if (
                guard.is_quiet
                and cam.law.is_plain
                and -master_bound <= master.error <= master_bound
                and -slave_bound <= slave.error <= slave_bound
            ):
                return
            cam.check(guard, master.error, slave.error, master_position, now_ns)

    def begin(self) -> None:
        """All axes are held where they stand: whatever their resolvers show there is right."""
        self._are_loads_carried = False
        for watched in self._watched:
            watched.axis.leapt = 0

    def trust_loads(self) -> None:
        """All brakes are open: an axis that stands holds its load, by its torque."""
        self._are_loads_carried = True

    def let_settle(self) -> None:
        """All axes have been left without a demand, and have to be set in motion anew: until then they may stand."""
        for watched in self._watched:
            watched.answer.let_settle()

    def forget(self) -> None:
        """SYNCs have not been sent: what an axis has gone meanwhile is not a cycle's way."""
        for watched in self._watched:
            watched.is_fresh = watched.is_known = False

    def note_silence(self, awaited: int) -> None:
        """One cycle of which only this counts: whose TPDO is missing (bits as for ``check``)."""
        for number, watched in enumerate(self._watched):
            watched.axis.silent_cycles = watched.axis.silent_cycles + 1 if awaited >> number & 1 else 0

    def _check_missing(self, awaited: int, now_ns: int) -> None:
        guard = self._guard
        is_nobody_here = awaited == self._all_axes
        for number, watched in enumerate(self._watched):
            if awaited >> number & 1:
                watched.axis.silent_cycles += 1
                watched.axis.rare_cycles = RARE_CYCLES
                watched.is_fresh = False
                if watched.axis.silent_cycles > LEAP_GAP_CYCLES:
                    watched.is_known = False
                guard.hold_cycles(Condition.MISSED_TPDO, number, now_ns)
                if not is_nobody_here:
                    guard.hold_cycles(Condition.AXIS_SILENT, number, now_ns)
        if is_nobody_here:
            guard.hold_cycles(Condition.BUS_OFF, 0, now_ns)
        else:
            guard.clear(Condition.BUS_OFF, 0)

    def _check_axis(
        self,
        watched: _WatchedAxis,
        target: int,
        torque_offset: int,
        velocities: Sequence[float],
        is_at_rest: bool,
        now_ns: int,
    ) -> None:
        axis = watched.axis
        actual, torque = axis.actual, axis.torque
        watched.error = error = (target - actual + HALF_RANGE & RANGE_MASK) - HALF_RANGE
        moved = (actual - watched.actual + HALF_RANGE & RANGE_MASK) - HALF_RANGE
        limit, bound, velocity = axis.following_error_limit, watched.torque, watched.velocity
        if not (
            moved
            and watched.is_fresh
            and self._guard.is_quiet
            and axis.statusword & STATUSWORD_STATE_MASK == STATUSWORD_OPERATION_ENABLED
            and -limit <= error <= limit
            and -bound <= torque <= bound
            and -velocity <= moved <= velocity
        ):
            self._check_drive(watched, now_ns)
            self._check_velocity(watched, target, moved, now_ns)
            if self._stands(watched, target, moved, now_ns):
                # A slave that is moved apart from its cam is held against loads that nobody foresees.
                is_plain = self._cam is None or self._cam.law.is_plain
                is_foreseen = is_plain and not is_at_rest
                watched.answer.check_torque(torque_offset, is_foreseen, is_plain, velocities, now_ns)
        elif watched.answer.is_standing:
            watched.answer.has_moved()

    def _check_follower(self, watched: _WatchedAxis, target: int, now_ns: int) -> None:
        """A resolver that dies in a stop is as bad as in a run."""
        moved = wrap_counts(watched.axis.actual - watched.actual)
        if self._stands(watched, target, moved, now_ns):
            watched.answer.check_drive_to(target, now_ns)

    @staticmethod
    def _stands(watched: _WatchedAxis, target: int, moved: int, now_ns: int) -> bool:
        has_moved = moved != 0 or not watched.is_fresh
        return watched.answer.stands(target, watched.target, has_moved, now_ns)

    def _check_drive(self, watched: _WatchedAxis, now_ns: int) -> None:
        guard, axis, number = self._guard, watched.axis, watched.number
        if axis.statusword & STATUSWORD_STATE_MASK != STATUSWORD_OPERATION_ENABLED:
            guard.hold(Condition.DRIVE_FAULT, number, axis.statusword, 0, now_ns)
        elif not guard.is_quiet:
            guard.clear(Condition.DRIVE_FAULT, number)
        limit = axis.following_error_limit
        if not -limit <= watched.error <= limit:
            guard.hold(Condition.FOLLOWING_ERROR, number, watched.error, limit, now_ns)
        elif not guard.is_quiet:
            guard.clear(Condition.FOLLOWING_ERROR, number)
        bound = watched.torque
        if not -bound <= axis.torque <= bound:
            guard.hold(Condition.TORQUE, number, axis.torque, bound, now_ns)
        elif not guard.is_quiet:
            guard.clear(Condition.TORQUE, number)

    def _check_velocity(self, watched: _WatchedAxis, target: int, moved: int, now_ns: int) -> None:
        """A leap of the resolver counts until it goes back."""
        guard, axis, number = self._guard, watched.axis, watched.number
        if not (moved or axis.leapt):
            if not guard.is_quiet and watched.is_fresh:
                guard.clear(Condition.VELOCITY, number)
            return
        if not watched.is_known:
            return
        axis.sees_leap(moved, wrap_counts(target - watched.target))
        bound = watched.velocity
        if watched.is_fresh and not -bound <= moved <= bound:
            guard.hold(Condition.VELOCITY, number, moved, int(bound), now_ns)
        elif 2.0 * abs(axis.leapt) > axis.leap_limit:
            guard.hold(Condition.VELOCITY, number, axis.leapt, int(bound), now_ns)
        else:
            # What is left of leaps that have gone back is how well the way meanwhile was known.
            axis.leapt = 0
            if not guard.is_quiet:
                guard.clear(Condition.VELOCITY, number)
