"""Converts the time of day at which a frame arrived to the monotonic clock that the hosts run on."""

import time
from collections.abc import Callable
from typing import Final

_SLACK_NS: Final = 1_000_000
"""A stamp may be this much older than the last look into the empty queue: it is taken before the frame is queued."""


class ArrivalClock:
    """Turns time-of-day stamps of received frames into ``time.monotonic_ns`` instants.

    Only the age of the frame is taken from the time of day, so that a step of that clock between frames does no harm.
    A stamp that cannot be true (from the future, from before the queue was last seen empty, or of a clock that is not
    the time of day at all) is replaced by the present.
    """

    __slots__ = ("_empty_ns", "_monotonic_ns", "_now_ns", "_offset_ns", "_time_of_day_ns")

    def __init__(
        self,
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
        time_of_day_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        """``monotonic_ns`` and ``time_of_day_ns`` read the two clocks."""
        self._monotonic_ns = monotonic_ns
        self._time_of_day_ns = time_of_day_ns
        self._empty_ns = self._now_ns = monotonic_ns()
        self._offset_ns = 0

    def queue_is_empty(self, at_ns: int | None = None) -> None:
        """Note that no frame was waiting at ``at_ns``, or is now, so that none can turn up that arrived earlier."""
        self._empty_ns = self._monotonic_ns() if at_ns is None else at_ns

    def look(self) -> None:
        """Read both clocks: ``arrival_ns`` converts by this reading until the next one."""
        self._now_ns = now_ns = self._monotonic_ns()
        self._offset_ns = now_ns - self._time_of_day_ns()

    def arrival_ns(self, stamp_ns: int) -> int:
        """Monotonic instant of the arrival that ``stamp_ns`` (time of day) marks."""
        arrival_ns = stamp_ns + self._offset_ns
        if self._empty_ns - _SLACK_NS <= arrival_ns <= self._now_ns:
            return arrival_ns
        return self._now_ns
