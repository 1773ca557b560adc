"""What the cycle watches, and what it does about it: one table of conditions, each with one reaction."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum

from config.schema import ConditionSection, GuardSection, Reaction
from drivers.node import Event


class Condition(Enum):
    """Guarded conditions; the values are the keys of the configuration's guard section."""

    FOLLOWING_ERROR = "following_error"
    MISSED_TPDO = "missed_tpdo"
    MISSED_DEADLINE = "missed_deadline"
    EMERGENCY = "emergency"
    DRIVE_FAULT = "drive_fault"
    HEARTBEAT_LOST = "heartbeat_lost"


class StopReason(Enum):
    """Why a run ended; ``stopped_by`` of the report."""

    COMPLETED = "completed"
    OPERATOR = "operator"
    FOLLOWING_ERROR = "following_error"
    MISSED_TPDO = "missed_tpdo"
    MISSED_DEADLINE = "missed_deadline"
    EMERGENCY = "emergency"
    DRIVE_FAULT = "drive_fault"
    HEARTBEAT_LOST = "heartbeat_lost"
    COMMISSIONING = "commissioning"
    BUS_LOST = "bus_lost"


STRENGTH = {Reaction.WARN: 0, Reaction.CONTROLLED_STOP: 1, Reaction.QUICK_STOP: 2}
"""A stronger reaction replaces a weaker one, never the other way round."""


@dataclass(frozen=True, slots=True)
class GuardTripped(Event):
    """A guarded condition has held for its persistence.

    ``axis`` is the axis' name, empty where the condition is not one axis'. ``value`` and ``limit`` are in the
    condition's own unit: counts for the following error, cycles in a row for missed TPDOs and deadlines, ms for the
    heartbeat; the emergency error code or the statusword, with limit 0, for what has none.
    """

    condition: Condition
    axis: str
    value: int
    limit: int
    reaction: Reaction


class Guard:
    """Counts how long conditions hold; one counter for each condition and axis."""

    def __init__(self, section: GuardSection, axis_names: tuple[str, ...]) -> None:
        rules: Mapping[Condition, ConditionSection] = {
            condition: getattr(section, condition.value) for condition in Condition
        }
        self._persistence = {condition: rule.persistence_cycles for condition, rule in rules.items()}
        self._reaction = {condition: rule.reaction for condition, rule in rules.items()}
        self._axis_names = axis_names
        self._counts = {condition: [0] * len(axis_names) for condition in Condition}
        self.is_quiet = True
        """No counter stands above zero: ``clear`` would change nothing."""
        self.reaction: Reaction | None = None
        """The strongest reaction that has been called for so far, warnings apart."""
        self.stopped_by: StopReason | None = None
        """The first condition that called for more than a warning."""
        self.tripped: list[GuardTripped] = []
        """Every trip, the first of each condition and axis; the caller takes them away."""
        self._told: set[tuple[Condition, int]] = set()

    def persistence(self, condition: Condition) -> int:
        """Cycles in a row that a condition must hold."""
        return self._persistence[condition]

    def clear(self, condition: Condition, axis: int) -> None:
        """The condition does not hold in this cycle."""
        counts = self._counts[condition]
        if counts[axis]:
            counts[axis] = 0
            self.is_quiet = not any(map(any, self._counts.values()))

    def hold(self, condition: Condition, axis: int, value: int, limit: int, now_ns: int) -> None:
        """The condition holds in this cycle; ``axis`` 0 is used where it is not one axis'."""
        counts = self._counts[condition]
        self.is_quiet = False
        counts[axis] += 1
        if counts[axis] != self._persistence[condition]:
            return
        reaction = self._reaction[condition]
        if (condition, axis) not in self._told:
            self._told.add((condition, axis))
            name = "" if condition is Condition.MISSED_DEADLINE else self._axis_names[axis]
            self.tripped.append(GuardTripped(now_ns, condition, name, value, limit, reaction))
        if reaction is Reaction.WARN:
            return
        if self.stopped_by is None:
            self.stopped_by = StopReason(condition.value)
        if self.reaction is None or STRENGTH[reaction] > STRENGTH[self.reaction]:
            self.reaction = reaction
