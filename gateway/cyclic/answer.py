"""Whether an axis answers: moves as its target does, and as the torque that it gives should move it."""

from collections.abc import Sequence
from typing import Final

from gateway.cyclic.axis_channel import AxisChannel, AxisLimits
from gateway.cyclic.free_motion import FreeMotion
from gateway.cyclic.guard import Condition, Guard
from gateway.record.sample import INT32_MAX
from gateway.units import wrap_counts

SETTLING_CYCLES: Final = 10
"""Cycles for which an axis may stand where its direction turns, or its friction holds it, before it is in motion."""
PUSHED_CYCLES: Final = 80
"""An integrator pushes slowly, and an axis that nobody sees is the faster for it: for so long less is as bad."""
DRIVING_SHARE: Final = 3
"""So many times the torque that must not go unanswered is more than any load that an axis stands under."""
LATE_CYCLES: Final = 20
"""A drive whose demands come late has them all the same after so long, or has to be stopped."""
PASSING_CYCLES: Final = 4
"""For so long a slow axis stands on every count; what it does meanwhile is not asked for."""
STILL_CYCLES: Final = (8, 16, 24)
"""So long after its last count an axis' torque is looked at, and the middle one taken for what its standing takes: a
count of the demand, or of the resolver's noise, is a blow to a controller, and may hit one of them."""


class AnswerWatch:
    """Of one axis: what it does while its actual value stays on one count."""

    __slots__ = (
        "_axis",
        "_driven_counts",
        "_driven_way",
        "_free_motion",
        "_frozen_counts",
        "_guard",
        "_late_cycles",
        "_nearest",
        "_number",
        "_pushed",
        "_pushed_cycles",
        "_settling",
        "_still_cycles",
        "_still_torques",
        "_unanswered",
        "is_standing",
    )

    def __init__(
        self, guard: Guard, number: int, axis: AxisChannel, limits: AxisLimits, free_motion: FreeMotion | None
    ) -> None:
        """``free_motion``: of a machine whose model is good enough to say what an axis would do."""
        self._guard = guard
        self._number = number
        self._axis = axis
        self._free_motion = free_motion
        self._frozen_counts = limits.frozen_counts
        self._unanswered = limits.unanswered_permille
        self._pushed = limits.pushed_permille
        self.is_standing = False
        """It has been found on the same count since ``has_moved``."""
        self._settling = 0
        """Cycles without movement that say nothing of the resolver yet."""
        self._nearest = INT32_MAX
        """Counts that the demand has been nearest to the actual value since that changed last."""
        self._still_cycles = 0
        """Cycles since the actual value changed last."""
        self._late_cycles = 0
        """Cycles of them in which its demand came too late."""
        self._still_torques = [(0, 0)] * len(STILL_CYCLES)
        """Torque actual value and torque offset then."""
        self._pushed_cycles = 0
        """Cycles in a row with a torque that is too much if it lasts."""
        self._driven_way = 0.0
        """Counts a cycle that it would have by its torque, and how far that would have taken it, while it stands."""
        self._driven_counts = 0.0

    def has_moved(self) -> None:
        """Its actual value has changed, or nobody knows whether it has."""
        self.is_standing = False
        self._late_cycles = 0
        self._begin_anew()

    def let_settle(self) -> None:
        """It has been left without a demand, and has to be set in motion anew: until then it may stand."""
        self._settling = SETTLING_CYCLES

    def stands(self, target: int, target_before: int, has_moved: bool, now_ns: int) -> bool:
        """Look at a cycle's target (counts); returns whether the axis stands on one count, and that says something."""
        guard, number = self._guard, self._number
        if has_moved:
            self.has_moved()
            if not guard.is_quiet:
                guard.clear(Condition.FROZEN_ACTUAL, number)
                guard.clear(Condition.UNANSWERED_TORQUE, number)
            return False
        if not guard.is_quiet and guard.is_holding(Condition.MISSED_DEADLINE, 0):
            self._late_cycles += 1
            if self._late_cycles <= LATE_CYCLES:
                # A drive that has had no new target stands, whatever its resolver shows; but not if it drives.
                self.is_standing = True
                self._begin_anew()
                guard.clear(Condition.FROZEN_ACTUAL, number)
                self.check_drive_to(target, now_ns)
                return False
        elif target == target_before:
            self._late_cycles = 0
        if self._settling:
            self._settling -= 1
            return False
        self.is_standing = True
        actual = self._axis.actual
        if target != target_before:
            # A demand that comes back to an axis that stands, as after an overshoot, asks nothing of it.
            self._nearest = min(self._nearest, abs(wrap_counts(target_before - actual)))
        travelled = abs(wrap_counts(target - actual)) - self._nearest
        if travelled > self._frozen_counts:
            guard.hold(Condition.FROZEN_ACTUAL, number, travelled, self._frozen_counts, now_ns)
        return True

    def _begin_anew(self) -> None:
        """What it has stood until now does not count."""
        self._nearest = INT32_MAX
        self._still_cycles = 0

    def check_torque(
        self, torque_offset: int, is_foreseen: bool, is_push_told: bool, velocities: Sequence[float], now_ns: int
    ) -> None:
        """Of an axis that ``stands``: whether it is pushed more and more, or should be far away by the model.

        ``torque_offset`` (per mille) is the one in force; ``is_foreseen``: it foresees the load. ``is_push_told``: no
        load changes but those that it foresees. ``velocities`` (rad/s) are the demand's.
        """
        guard, number, torque = self._guard, self._number, self._axis.torque
        model = self._free_motion
        if model is not None:
            self._drive(model, torque_offset if is_foreseen else None, velocities)
        self._still_cycles += 1
        if model is not None and abs(self._driven_counts) > self._frozen_counts:
            unforeseen, slack = torque - torque_offset, model.slack_permille[number]
            guard.hold(Condition.UNANSWERED_TORQUE, number, unforeseen, slack, now_ns)
            return
        still = self._still_torques
        if self._still_cycles <= STILL_CYCLES[-1]:
            self._pushed_cycles = 0
            if self._still_cycles in STILL_CYCLES:
                still[STILL_CYCLES.index(self._still_cycles)] = torque, torque_offset
                if self._still_cycles == STILL_CYCLES[-1]:
                    still.sort()
            return
        still_torque, still_offset = still[len(still) // 2]
        pushed = torque - still_torque
        # Neither a load that the offset foresees is a push, nor an offset that takes a load over from the controller.
        unforeseen = pushed - (torque_offset - still_offset)
        push = min(abs(pushed), abs(unforeseen))
        limit = self._unanswered
        self._pushed_cycles = self._pushed_cycles + 1 if push > self._pushed else 0
        if self._pushed_cycles > PUSHED_CYCLES:
            limit = self._pushed
        if push > limit and is_push_told:
            guard.hold(Condition.UNANSWERED_TORQUE, number, push, limit, now_ns)
        elif not guard.is_quiet:
            guard.clear(Condition.UNANSWERED_TORQUE, number)

    def check_drive_to(self, target: int, now_ns: int) -> None:
        """Of an axis that stands in a stop, or has been told late where to go: torques have nothing to be compared with
        there, but what drives it towards a target far away moves it.
        """
        guard, number, axis = self._guard, self._number, self._axis
        error, limit = wrap_counts(target - axis.actual), DRIVING_SHARE * self._unanswered
        torque = axis.torque if error > 0 else -axis.torque
        if abs(error) > self._frozen_counts and torque > limit:
            guard.hold(Condition.UNANSWERED_TORQUE, number, axis.torque, limit, now_ns)
        elif not guard.is_quiet:
            guard.clear(Condition.UNANSWERED_TORQUE, number)

    def _drive(self, model: FreeMotion, foreseen: int | None, velocities: Sequence[float]) -> None:
        """One more cycle of the way that an axis that stands would have gone."""
        if self._still_cycles < PASSING_CYCLES:
            self._driven_way = self._driven_counts = 0.0
            return
        way = model.acceleration(self._number, self._axis.torque, foreseen, velocities)
        # What its friction holds again has to be set in motion anew.
        self._driven_way = self._driven_way + way if way else 0.0
        self._driven_counts += self._driven_way
