"""What a run tells its user while it goes on: one line an event, and a count where the same comes again and again."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

from config.guard_section import Reaction

SPAN_NS: Final = 10_000_000_000
"""Lines are counted over so long, by the clock of the run."""
MOST_LINES: Final = 3
"""Of one sort in ``SPAN_NS``; what is more is counted, and told in a line when the time is over."""
HOLD_NS: Final = 1_000_000_000
"""A failure is told when the run goes on for so long after it; else it is what the run ends with, and told there."""
_UNLIMITED: Final = frozenset({"recovery", "recorder_lost", "learning", "order"})
_STYLES: Final[Mapping[str, str]] = {
    "guard": "yellow",
    "guard_missing": "yellow",
    "emergency": "yellow",
    "heartbeat_lost": "yellow",
    "boot_up": "yellow",
    "nmt_state": "yellow",
    "controller": "yellow",
    "warning": "yellow",
    "recorder_lost": "bold yellow",
    "recovery": "bold",
    "order": "",
    "learning": "",
}
"""Kinds of events that are told, and how they look."""
_EXPECTED: Final = frozenset({"boot_up", "nmt_state"})
"""Part of every commissioning and of every good end, and news only while the machine is to move."""
_NEWS_FROM: Final = frozenset({"moving", "approaching the cam"})
_NEWS_UNTIL: Final = "done"
_TOLD_STEPS: Final = frozenset({"quick stop", "recovering the axes"})
"""Steps that only a run has that does not go as it should."""
_SORTED_BY: Final = ("kind", "condition", "axis", "node_id", "object", "reaction")

Print = Callable[[str, str], None]
"""``print(text, style)``, a line on the terminal."""


@dataclass(slots=True)
class _Sort:
    """Events of one sort since ``since_ns``."""

    since_ns: int
    told: int = 0
    held_back: int = 0
    last_text: str = ""


class EventLines:
    """Prints the events of one run as they come; ``tick`` in between, and ``close`` at its end."""

    def __init__(self, print_line: Print, *, with_steps: bool = False) -> None:
        """``with_steps``: tell the session's steps too, where no progress bar does."""
        self._print = print_line
        self._with_steps = with_steps
        self._sorts: dict[tuple[Any, ...], _Sort] = {}
        self._failures: list[tuple[int, str]] = []
        self.now_ns = 0
        """How far the run has come, by its events and ``tick``."""
        self._is_in_motion = False

    def tell(self, event: Mapping[str, Any]) -> None:
        """An event has come, as the run's log has it: ``kind``, ``text``, ``at_ns`` and more."""
        kind, text = str(event.get("kind")), str(event.get("text"))
        self.tick(int(event.get("at_ns", self.now_ns)))
        if kind == "step":
            self._is_in_motion = text in _NEWS_FROM or (self._is_in_motion and text != _NEWS_UNTIL)
            if text in _TOLD_STEPS:
                self._print(f"  {text}", "bold yellow")
            elif self._with_steps:
                self._print(text, "dim")
        elif kind == "failure":
            self._failures.append((self.now_ns, text))
        elif kind == "realtime" and not event.get("is_on"):
            self._print(f"  {text}", "dim")
        elif kind in _UNLIMITED:
            self._print(f"  {text}", "bold red" if event.get("is_ready") is False else _STYLES[kind])
        elif kind in _STYLES:
            self._tell_sparingly(tuple(event.get(key) for key in _SORTED_BY), text, self._style(event, kind))

    def _style(self, event: Mapping[str, Any], kind: str) -> str:
        if kind in _EXPECTED and not self._is_in_motion:
            return "dim"
        if kind == "guard" and event.get("reaction", Reaction.WARN.value) != Reaction.WARN.value:
            return "bold yellow"
        return _STYLES[kind]

    def _tell_sparingly(self, key: tuple[Any, ...], text: str, style: str) -> None:
        sort = self._sorts.setdefault(key, _Sort(self.now_ns))
        if sort.told < MOST_LINES:
            sort.told += 1
            self._print(f"  {text}", style)
        else:
            sort.held_back += 1
            sort.last_text = text

    def tick(self, now_ns: int) -> None:
        """The run has come to ``now_ns``: tell what was held back and is due."""
        self.now_ns = max(now_ns, self.now_ns)
        over = [key for key, sort in self._sorts.items() if self.now_ns - sort.since_ns >= SPAN_NS]
        for key in over:
            self._tell_count(self._sorts.pop(key))
        due = [text for at_ns, text in self._failures if self.now_ns - at_ns >= HOLD_NS]
        self._failures = [(at_ns, text) for at_ns, text in self._failures if self.now_ns - at_ns < HOLD_NS]
        for text in due:
            self._print(f"  {text}", "bold red")

    def close(self) -> None:
        """The run is over: tell the counts that are left; a failure that has just come is its end, and told as such."""
        for sort in self._sorts.values():
            self._tell_count(sort)
        self._sorts.clear()
        self._failures.clear()

    def _tell_count(self, sort: _Sort) -> None:
        if sort.held_back:
            self._print(f"  and {sort.held_back} more like this, the last: {sort.last_text}", "yellow")
