"""Which events of a run a report shows: what ended it always, of the rest a few of each, and how many are left out."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from config.guard_section import Reaction
from gateway.cyclic.guard import WISHES
from gateway.record.lateness import LATE_KINDS

EventData = Mapping[str, Any]

MOST_SHOWN: Final = 200
MOST_DECISIVE: Final = 1000
"""Of events that are always shown; of more than these the first and the last half."""
LEAST_OTHERS: Final = 50
"""Places for the other events, however many decisive ones there are."""
_ALWAYS: Final = frozenset({"failure", "recovery", "end", "recorder_lost"})
_WEIGHTS: Final[Mapping[str, int]] = {
    **dict.fromkeys(
        ("guard", "guard_missing", "emergency", "heartbeat_lost", "controller", "boot_up", "step", "order", "warning"),
        1,
    ),
    **dict.fromkeys(("guard", "guard_missing", "emergency", "heartbeat_lost", "controller"), 1),
    **dict.fromkeys(("boot_up", "step", "order", "warning"), 1),
    **dict.fromkeys(("nmt_state", "learning", "bus", "realtime"), 2),
    "late": 4,
}
_OTHER_WEIGHT: Final = 3
_WISHES: Final = frozenset(condition.value for condition in WISHES)
_GROUPED_BY: Final = ("kind", "condition", "axis", "node_id", "object")


@dataclass(frozen=True, slots=True)
class EventChoice:
    """The events to show, in their order, and how many of each kind are not among them."""

    shown: tuple[EventData, ...]
    left_out: Mapping[str, int]

    def left_out_text(self) -> str:
        """How many were left out, the most frequent kind first; empty where none was."""
        return ", ".join(f"{count} {kind.replace('_', ' ')}" for kind, count in self.left_out.items())


@dataclass(frozen=True, slots=True)
class DecisiveEvent:
    """An event that has stopped the run, ended it, or says what became of the machine."""

    at_s: float
    """Since the recording's time 0."""
    kind: str
    text: str
    is_alarming: bool


def is_decisive(event: EventData) -> bool:
    """Whether the event has stopped the run, ended it, or says what became of the machine."""
    kind = event.get("kind")
    # A recording that does not name the reaction may have been stopped by it.
    if kind == "guard":
        return event.get("reaction") != Reaction.WARN.value
    return kind in _ALWAYS or _is_quick_stop(event)


def _is_quick_stop(event: EventData) -> bool:
    """A quick stop that an operator asks for has no trip of the guard before it."""
    return event.get("kind") == "step" and event.get("text") == "quick stop"


def is_alarming(event: EventData) -> bool:
    """Whether something has gone wrong: a stop that nobody wished for, a failure, an axis that is not ready."""
    kind = event.get("kind")
    if kind in ("end", "recovery"):
        return event.get("is_ready") is False
    return is_decisive(event) and event.get("condition") not in _WISHES and not _is_quick_stop(event)


def choose_events(events: Sequence[EventData], most: int = MOST_SHOWN) -> EventChoice:
    """The ``most`` events that matter most; late demands, which have an account of their own, are no candidates.

    Every decisive event is shown (up to ``MOST_DECISIVE``). Of the others the weightier kinds come first, and of a kind
    that repeats itself its beginning and its end, so that few are never hidden by many.
    """
    candidates = [event for event in events if event.get("kind") not in LATE_KINDS]
    decisive = [number for number, event in enumerate(candidates) if is_decisive(event)]
    if len(decisive) > MOST_DECISIVE:
        half = MOST_DECISIVE // 2
        decisive = [*decisive[:half], *decisive[-half:]]
    chosen = set(decisive)
    others = [number for number, event in enumerate(candidates) if not is_decisive(event)]
    chosen.update(_by_weight(candidates, others)[: max(most - len(decisive), LEAST_OTHERS)])
    left_out = Counter(
        str(event.get("kind", "without a kind")) for number, event in enumerate(candidates) if number not in chosen
    )
    return EventChoice(tuple(candidates[number] for number in sorted(chosen)), dict(left_out.most_common()))


def _by_weight(events: Sequence[EventData], numbers: Sequence[int]) -> list[int]:
    """``numbers`` of events, those to be shown rather first."""
    groups = {number: tuple(events[number].get(key) for key in _GROUPED_BY) for number in numbers}
    sizes = Counter(groups.values())
    seen: Counter[tuple[Any, ...]] = Counter()
    order: list[tuple[int, int, int]] = []
    for number, group in groups.items():
        place = seen[group]
        seen[group] += 1
        weight = _WEIGHTS.get(str(events[number].get("kind")), _OTHER_WEIGHT)
        order.append((weight, min(place, sizes[group] - 1 - place), number))
    return [number for _, _, number in sorted(order)]


def decisive_events(events: Sequence[EventData], start_ns: int) -> tuple[DecisiveEvent, ...]:
    """Those among the events that a report shows; ``start_ns`` is the recording's time 0."""
    return tuple(
        DecisiveEvent(
            round((int(event["at_ns"]) - start_ns) / 1e9, 6),
            str(event["kind"]),
            str(event.get("text", "")),
            is_alarming(event),
        )
        for event in choose_events(events).shown
        if is_decisive(event)
    )


def event_counts(events: Sequence[EventData]) -> dict[str, int]:
    """How many events of each kind there are, the most frequent first."""
    return dict(Counter(str(event.get("kind", "")) for event in events).most_common())
