"""What is looked at in every cycle: the guard's conditions that come from TPDOs, demand and actual values."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gateway.cyclic.axis_channel import LEAP_GAP_CYCLES, RARE_CYCLES, AxisChannel
from gateway.cyclic.free_motion import FreeMotion
from gateway.cyclic.guard import Condition, Guard
from gateway.record.sample import INT32_MAX, Phase
from gateway.units import HALF_RANGE, RANGE_MASK, wrap_counts
from mechanism.deviation import end_effector_miss
from mechanism.slave_law import SlaveLaw

STATUSWORD_STATE_MASK: Final = 0x6F
STATUSWORD_OPERATION_ENABLED: Final = 0x27
SETTLING_CYCLES: Final = 10
"""Cycles for which an axis may stand where its direction turns, or its friction holds it, before it is in motion."""
PUSHED_CYCLES: Final = 80
"""An integrator pushes slowly, and an axis that nobody sees is the faster for it: for so long less is as bad."""
DRIVING_SHARE: Final = 3
"""So many times the torque that must not go unanswered is more than any load that an axis stands under."""
MICROMETRES: Final = 1e6
LEAP_SHARE: Final = 2.0
"""Of the velocity limit: an axis that is so much faster within a single cycle has not moved, its resolver has leapt."""
LEAST_LEAP_COUNTS: Final = 20.0
"""What a coarse resolver's noise shows is no leap."""

_STANDSTILL: Final = Phase.STANDSTILL
_RAMP_UP: Final = Phase.RAMP_UP
_CONTROLLED_STOP: Final = Phase.CONTROLLED_STOP


@dataclass(frozen=True, slots=True)
class AxisLimits:
    """What is guarded of one axis; the following error's limit is the channel's own."""

    velocity_counts_per_cycle: float
    torque_permille: int
    frozen_counts: int
    """Travel of the demand while the actual value stays the same."""
    unanswered_permille: int
    """Change of torque while the actual value stays the same."""
    pushed_permille: int
    """The same, if it lasts for ``PUSHED_CYCLES``."""


NO_LIMITS: Final = AxisLimits(float("inf"), INT32_MAX, INT32_MAX, INT32_MAX, INT32_MAX)
PASSING_CYCLES: Final = 4
"""For so long a slow axis stands on every count; what it does meanwhile is not asked for."""
STILL_CYCLES: Final = (8, 16, 24)
"""So long after its last count an axis' torque is looked at, and the middle one taken for what its standing takes: a
count of the demand, or of the resolver's noise, is a blow to a controller, and may hit one of them."""


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
    harmless_counts: tuple[int, int]
    """Errors of master and slave on the cam itself that cannot exceed either limit: see ``harmless_error`` there."""


class _WatchedAxis:
    """One axis, its limits, and what it was in the cycle before."""

    __slots__ = (
        "actual",
        "axis",
        "driven_counts",
        "driven_way",
        "error",
        "frozen_counts",
        "is_fresh",
        "is_known",
        "nearest",
        "pushed",
        "pushed_cycles",
        "settling",
        "still_cycles",
        "still_torques",
        "target",
        "torque",
        "unanswered",
        "velocity",
    )

    def __init__(self, axis: AxisChannel, limits: AxisLimits) -> None:
        self.axis = axis
        axis.leap_limit = max(LEAP_SHARE * limits.velocity_counts_per_cycle, LEAST_LEAP_COUNTS)
        self.velocity = limits.velocity_counts_per_cycle
        self.torque = limits.torque_permille
        self.frozen_counts = limits.frozen_counts
        self.unanswered = limits.unanswered_permille
        self.pushed = limits.pushed_permille
        self.settling = 0
        """Cycles without movement that say nothing of the resolver yet."""
        self.actual = 0
        self.target = 0
        self.error = 0
        self.nearest = INT32_MAX
        """Counts that the demand has been nearest to the actual value since that changed last."""
        self.still_cycles = 0
        """Cycles since the actual value changed last."""
        self.still_torques = [(0, 0)] * len(STILL_CYCLES)
        """Torque actual value and torque offset then."""
        self.pushed_cycles = 0
        """Cycles in a row with a torque that is too much if it lasts."""
        self.driven_way = 0.0
        """Counts a cycle that it would have by its torque, and how far that would have taken it, while it stands."""
        self.driven_counts = 0.0
        self.is_fresh = False
        """The actual value of the cycle before is known."""
        self.is_known = False
        """That of a cycle shortly before is, and every SYNC since then has been sent."""


class CycleWatch:
    """Compares every cycle with the guard's limits: plain arithmetic, nothing is made unless something is wrong."""

    __slots__ = ("_all_axes", "_are_loads_carried", "_cam", "_free_motion", "_guard", "_watched")

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
        self._watched = tuple(_WatchedAxis(axis, limit) for axis, limit in zip(axes, limits, strict=True))
        self._cam = cam
        self._free_motion = free_motion
        self._are_loads_carried = False
        self._all_axes = (1 << len(axes)) - 1
        if cam is not None:
            # The first call loads the machine code, which must not happen within a cycle.
            end_effector_miss(cam.geometry, cam.closure, 0.0, 0.0, 0.0, 0.0)

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
                self._check_axis(number, watched, targets[number], offset, velocities, is_at_rest, now_ns)
            elif followers >> number & 1:
                self._check_follower(number, watched, targets[number], now_ns)
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
            self._check_cam(cam, master.error, slave.error, master_position, now_ns)

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
            watched.settling = SETTLING_CYCLES

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
        number: int,
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
            self._check_drive(number, watched, now_ns)
            self._check_velocity(number, watched, target, moved, now_ns)
            if self._check_answer(number, watched, target, moved, now_ns):
                if self._free_motion is not None:
                    # The offsets are the cam's, and have to come in first.
                    foreseen = None if is_at_rest or not self._is_plain() else torque_offset
                    self._drive(self._free_motion, number, watched, foreseen, velocities)
                self._check_push(number, watched, torque_offset, now_ns)
        else:
            watched.nearest = INT32_MAX
            watched.still_cycles = 0

    def _check_follower(self, number: int, watched: _WatchedAxis, target: int, now_ns: int) -> None:
        """A resolver that dies in a stop is as bad as in a run.

        Torques have nothing to be compared with there, but what drives an axis towards a target far away moves it.
        """
        axis, guard = watched.axis, self._guard
        moved = wrap_counts(axis.actual - watched.actual)
        if self._check_answer(number, watched, target, moved, now_ns):
            error, limit = wrap_counts(target - axis.actual), DRIVING_SHARE * watched.unanswered
            torque = axis.torque if error > 0 else -axis.torque
            if abs(error) > watched.frozen_counts and torque > limit:
                guard.hold(Condition.UNANSWERED_TORQUE, number, axis.torque, limit, now_ns)
            elif not guard.is_quiet:
                guard.clear(Condition.UNANSWERED_TORQUE, number)

    def _check_drive(self, number: int, watched: _WatchedAxis, now_ns: int) -> None:
        guard, axis = self._guard, watched.axis
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

    def _check_velocity(self, number: int, watched: _WatchedAxis, target: int, moved: int, now_ns: int) -> None:
        """A leap of the resolver counts until it goes back."""
        guard, axis = self._guard, watched.axis
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

    def _check_answer(self, number: int, watched: _WatchedAxis, target: int, moved: int, now_ns: int) -> bool:
        """Whether an axis that is asked to move shows anything of it; returns whether it stands on one count."""
        guard = self._guard
        if not watched.is_fresh or moved or (not guard.is_quiet and guard.is_holding(Condition.MISSED_DEADLINE, 0)):
            # A drive that has had no new target stands, whatever its resolver shows.
            watched.nearest = INT32_MAX
            watched.still_cycles = 0
            if not guard.is_quiet:
                guard.clear(Condition.FROZEN_ACTUAL, number)
                guard.clear(Condition.UNANSWERED_TORQUE, number)
            return False
        if watched.settling:
            watched.settling -= 1
            return False
        actual = watched.axis.actual
        if target != watched.target:
            # A demand that comes back to an axis that stands, as after an overshoot, asks nothing of it.
            watched.nearest = min(watched.nearest, abs(wrap_counts(watched.target - actual)))
        travelled = abs(wrap_counts(target - actual)) - watched.nearest
        if travelled > watched.frozen_counts:
            guard.hold(Condition.FROZEN_ACTUAL, number, travelled, watched.frozen_counts, now_ns)
        return True

    @staticmethod
    def _drive(
        model: FreeMotion, number: int, watched: _WatchedAxis, foreseen: int | None, velocities: Sequence[float]
    ) -> None:
        """One more cycle of the way that an axis that stands would have gone."""
        if watched.still_cycles < PASSING_CYCLES:
            watched.driven_way = watched.driven_counts = 0.0
            return
        way = model.acceleration(number, watched.axis.torque, foreseen, velocities)
        # What its friction holds again has to be set in motion anew.
        watched.driven_way = watched.driven_way + way if way else 0.0
        watched.driven_counts += watched.driven_way

    def _check_push(self, number: int, watched: _WatchedAxis, torque_offset: int, now_ns: int) -> None:
        """Whether an axis that stands on one count is pushed more and more, or should be far away by the model."""
        guard, torque = self._guard, watched.axis.torque
        watched.still_cycles += 1
        if self._free_motion is not None and abs(watched.driven_counts) > watched.frozen_counts:
            unforeseen, slack = torque - torque_offset, self._free_motion.slack_permille[number]
            guard.hold(Condition.UNANSWERED_TORQUE, number, unforeseen, slack, now_ns)
            return
        still = watched.still_torques
        if watched.still_cycles <= STILL_CYCLES[-1]:
            watched.pushed_cycles = 0
            if watched.still_cycles in STILL_CYCLES:
                still[STILL_CYCLES.index(watched.still_cycles)] = torque, torque_offset
                if watched.still_cycles == STILL_CYCLES[-1]:
                    still.sort()
            return
        still_torque, still_offset = still[len(still) // 2]
        pushed = torque - still_torque
        # Neither a load that the offset foresees is a push, nor an offset that takes a load over from the controller.
        unforeseen = pushed - (torque_offset - still_offset)
        push = min(abs(pushed), abs(unforeseen))
        limit = watched.unanswered
        watched.pushed_cycles = watched.pushed_cycles + 1 if push > watched.pushed else 0
        if watched.pushed_cycles > PUSHED_CYCLES:
            limit = watched.pushed
        if push > limit and self._is_plain():
            guard.hold(Condition.UNANSWERED_TORQUE, number, push, limit, now_ns)
        elif not guard.is_quiet:
            guard.clear(Condition.UNANSWERED_TORQUE, number)

    def _is_plain(self) -> bool:
        """A slave that is moved apart from its cam is held against loads that nobody foresees."""
        return self._cam is None or self._cam.law.is_plain

    def _check_cam(
        self, cam: CamWindow, master_error: int, slave_error: int, master_position: float, now_ns: int
    ) -> None:
        guard, law = self._guard, cam.law
        master_scale, slave_scale = cam.rad_per_count
        error2, error5 = master_error * master_scale, slave_error * slave_scale
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
