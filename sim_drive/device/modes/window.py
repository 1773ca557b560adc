"""A window around a target in which a value has to stay for a while."""

from typing import Final

from sim_drive.communication.dictionary import Entry

_NS_PER_MS: Final = 1_000_000


class Window:
    """``is_met`` after a deviation has been within the window (an object) for its time (an object in ms)."""

    __slots__ = ("_since_ns", "_span_ms", "_width", "is_met")

    def __init__(self, width: Entry, span_ms: Entry) -> None:
        self._width = width
        self._span_ms = span_ms
        self._since_ns: int | None = None
        self.is_met = False

    def reset(self) -> None:
        """Forget how long it has been met."""
        self._since_ns = None
        self.is_met = False

    def update(self, deviation: float, now_ns: int) -> bool:
        """Take the deviation of a servo tick; whether ``is_met`` has changed."""
        if not -self._width.value <= deviation <= self._width.value:
            has_changed = self.is_met
            self.reset()
            return has_changed
        if self._since_ns is None:
            self._since_ns = now_ns
        if self.is_met or now_ns - self._since_ns < self._span_ms.value * _NS_PER_MS:
            return False
        self.is_met = True
        return True
