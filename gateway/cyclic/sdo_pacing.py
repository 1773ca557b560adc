"""Keeps SDO within its share of the bus while the cycle runs."""

from collections import deque
from typing import Final

from drivers.frame import Frame
from drivers.nmt import MAX_NODE_ID
from drivers.sdo import SDO_REQUEST_BASE


class SdoPacing:
    """Lets no more SDO requests go in a cycle than the bus budget has reserved, each with its response.

    A reserve of one frame is a request every other cycle. Everything else passes at once.
    """

    __slots__ = ("_cycle", "_cycles_apart", "_left", "_requests_a_cycle", "waiting")

    def __init__(self, frames_a_cycle: int) -> None:
        self._requests_a_cycle: Final = max(1, frames_a_cycle // 2)
        self._cycles_apart: Final = 1 if frames_a_cycle > 1 else 2
        self.waiting: Final[deque[Frame]] = deque()
        """Requests that wait for a later cycle."""
        self._cycle = -10
        self._left = 0

    def forget(self) -> None:
        """Drop what waits: nobody can be asked any more."""
        self.waiting.clear()

    def release(self, frames: list[Frame], cycle: int | None) -> list[Frame]:
        """What may go now: of ``frames``, and of what was held back before; ``cycle`` None: no cycle runs."""
        if cycle is None:
            held = list(self.waiting)
            self.waiting.clear()
            return held + frames
        passed: list[Frame] = []
        for frame in frames:
            is_request = SDO_REQUEST_BASE < frame.cob_id <= SDO_REQUEST_BASE + MAX_NODE_ID
            (self.waiting if is_request else passed).append(frame)
        if not self._cycle <= cycle < self._cycle + self._cycles_apart:
            self._cycle, self._left = cycle, self._requests_a_cycle
        while self.waiting and self._left:
            self._left -= 1
            passed.append(self.waiting.popleft())
        return passed
