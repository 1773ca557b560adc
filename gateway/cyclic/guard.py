"""What the cycle watches, and what it does about it: one table of conditions, each with one reaction."""

from dataclasses import dataclass
from enum import Enum
from typing import Final

from config.guard_section import ConditionSection, GuardSection, Reaction, StopSection
from drivers.node import Event


class Condition(Enum):
    """Guarded conditions; the values are the keys of the configuration's guard section, where they are explained."""

    FOLLOWING_ERROR = "following_error"
    CAM_WINDOW = "cam_window"
    VELOCITY = "velocity"
    TORQUE = "torque"
    END_EFFECTOR_ERROR = "end_effector_error"
    FROZEN_ACTUAL = "frozen_actual"
    UNANSWERED_TORQUE = "unanswered_torque"
    MISSED_TPDO = "missed_tpdo"
    AXIS_SILENT = "axis_silent"
    MISSED_DEADLINE = "missed_deadline"
    EMERGENCY = "emergency"
    EMERGENCY_WARNING = "emergency_warning"
    DRIVE_FAULT = "drive_fault"
    HEARTBEAT_LOST = "heartbeat_lost"
    BUS_OFF = "bus_off"
    SYNC_LOST = "sync_lost"
    OPERATOR_STOP = "operator_stop"
    SIGINT = "sigint"
    SIGTERM = "sigterm"


OF_THE_MACHINE: Final = frozenset(
    {
        Condition.CAM_WINDOW,
        Condition.END_EFFECTOR_ERROR,
        Condition.MISSED_DEADLINE,
        Condition.BUS_OFF,
        Condition.SYNC_LOST,
        Condition.OPERATOR_STOP,
        Condition.SIGINT,
        Condition.SIGTERM,
    }
)
"""Conditions that are not one axis'."""


class StopReason(Enum):
    """Why a run ended; ``stopped_by`` of the report."""

    COMPLETED = "completed"
    OPERATOR = "operator"
    FOLLOWING_ERROR = "following_error"
    CAM_WINDOW = "cam_window"
    VELOCITY = "velocity"
    TORQUE = "torque"
    END_EFFECTOR_ERROR = "end_effector_error"
    FROZEN_ACTUAL = "frozen_actual"
    UNANSWERED_TORQUE = "unanswered_torque"
    MISSED_TPDO = "missed_tpdo"
    AXIS_SILENT = "axis_silent"
    MISSED_DEADLINE = "missed_deadline"
    EMERGENCY = "emergency"
    EMERGENCY_WARNING = "emergency_warning"
    DRIVE_FAULT = "drive_fault"
    HEARTBEAT_LOST = "heartbeat_lost"
    BUS_OFF = "bus_off"
    SYNC_LOST = "sync_lost"
    COMMISSIONING = "commissioning"
    BUS_LOST = "bus_lost"


WISHES: Final = frozenset({Condition.OPERATOR_STOP, Condition.SIGINT, Condition.SIGTERM})
"""Somebody's wish to stop, which is no failure."""

REASON_OF: Final = {
    condition: StopReason.OPERATOR if condition in WISHES else StopReason(condition.value) for condition in Condition
}

STRENGTH: Final = {reaction: strength for strength, reaction in enumerate(Reaction)}
"""A stronger reaction replaces a weaker one, never the other way round."""


@dataclass(frozen=True, slots=True)
class GuardTripped(Event):
    """A guarded condition has held for its persistence.

    ``axis`` is the axis' name, empty where the condition is not one axis'. ``value`` and ``limit`` are in the
    condition's own unit: counts for following error, cam window and frozen actual value, counts a cycle for the
    velocity, per mille of rated torque for torque and unanswered torque, micrometres for the end effector, cycles (in a
    row) for whatever is missed, ms for the heartbeat; the emergency error code or the statusword, with limit 0, for
    what has none. Bus-off has limit 0 where the own controller has told it, else the cycles without any drive's frame.
    """

    condition: Condition
    axis: str
    value: int
    limit: int
    reaction: Reaction


def persistence_cycles(rule: object) -> int:
    """For how many cycles in a row a condition of the configuration's guard section must hold; an event: once."""
    return rule.persistence_cycles if isinstance(rule, ConditionSection) else 1


class Guard:
    """Counts how long conditions hold; one counter for each condition and axis."""

    def __init__(self, section: GuardSection, axis_names: tuple[str, ...]) -> None:
        rules: dict[Condition, ConditionSection | StopSection] = {
            condition: getattr(section, condition.value) for condition in Condition
        }
        self._persistence = {condition: persistence_cycles(rule) for condition, rule in rules.items()}
        self._reaction = {condition: rule.reaction for condition, rule in rules.items()}
        self._warning_codes = section.emergency_warning.codes
        self._axis_names = axis_names
        self._counts = {condition: [0] * len(axis_names) for condition in Condition}
        self.is_quiet = True
        """No counter stands above zero: ``clear`` would change nothing."""
        self.reaction: Reaction | None = None
        """The strongest reaction that has been called for so far, warnings apart."""
        self.disabled = 0
        """Bit n: axis n is to lose its torque at once."""
        self.stopped_by: StopReason | None = None
        """The first condition that called for more than a warning."""
        self.tripped: list[GuardTripped] = []
        """Every trip, the first of each condition and axis; the caller takes them away."""
        self._told: set[tuple[Condition, int]] = set()

    def emergency_condition(self, code: int) -> Condition:
        """Which condition an EMCY with this error code is."""
        return Condition.EMERGENCY_WARNING if code in self._warning_codes else Condition.EMERGENCY

    def is_holding(self, condition: Condition, axis: int) -> bool:
        """Whether the condition held when it was looked at last, for however few cycles."""
        return self._counts[condition][axis] > 0

    def clear(self, condition: Condition, axis: int) -> None:
        """The condition does not hold in this cycle."""
        counts = self._counts[condition]
        if counts[axis]:
            counts[axis] = 0
            self.is_quiet = not any(map(any, self._counts.values()))

    def hold_cycles(self, condition: Condition, axis: int, now_ns: int) -> None:
        """``hold`` for a condition that has no value but for how many cycles it has held."""
        cycles = self._persistence[condition]
        self.hold(condition, axis, cycles, cycles, now_ns)

    def trip(self, condition: Condition, axis: int, value: int, limit: int, now_ns: int) -> None:
        """``hold`` for what is certain at once, however long the condition would otherwise have to last."""
        counts = self._counts[condition]
        counts[axis] = max(counts[axis], self._persistence[condition] - 1)
        self.hold(condition, axis, value, limit, now_ns)

    def hold(self, condition: Condition, axis: int, value: int, limit: int, now_ns: int) -> None:
        """The condition holds in this cycle; ``axis`` 0 is used where it is not one axis'."""
        counts = self._counts[condition]
        self.is_quiet = False
        counts[axis] += 1
        if counts[axis] != self._persistence[condition]:
            return
        reaction = self._reaction[condition]
        is_of_axis = condition not in OF_THE_MACHINE
        if (condition, axis) not in self._told:
            self._told.add((condition, axis))
            name = self._axis_names[axis] if is_of_axis else ""
            self.tripped.append(GuardTripped(now_ns, condition, name, value, limit, reaction))
        if reaction is Reaction.WARN:
            return
        if reaction is Reaction.DISABLE:
            self.disabled |= 1 << axis if is_of_axis else (1 << len(self._axis_names)) - 1
        if self.stopped_by is None:
            self.stopped_by = REASON_OF[condition]
        if self.reaction is None or STRENGTH[reaction] > STRENGTH[self.reaction]:
            self.reaction = reaction
