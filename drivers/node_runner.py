"""Runs one core by a clock: what every real-time host shares, whatever the frames come through."""

import logging
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from drivers.frame import Frame
from drivers.node import Event, Node
from drivers.virtual_time import MAX_WAKES_PER_INSTANT, LivelockError

MAX_WAKES_PER_CALL: Final = 1000
"""Wakes that one ``advance`` makes good at most, so that a host that has fallen behind still looks at its bus."""
MAX_CATCH_UP_NS: Final = 1_000_000_000
"""A wake that ``advance`` finds later than this is given the present instead: the time in between has been lost."""
MAX_BACKLOG_FRAMES: Final = 64
"""Frames kept while the bus takes none; older ones are dropped, they would only tell of the past."""
LATENESS_WARNING_NS: Final = 100_000_000
"""From this lateness of a wake on, the log says once that the machine does not keep up."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class RunStatistics:
    """What a run amounted to."""

    wakes: int
    frames_received: int
    frames_sent: int
    frames_dropped: int
    """Frames that the bus did not take in time, oldest first."""
    max_wake_lateness_ns: int
    """Greatest time between the instant a wake was due and the one at which the host came to it."""


class NodeRunner:
    """Hands one core its wakes and frames in the order of their times, and what it sends to ``transmit``.

    Every wake is given the instant at which it was due, even if the host comes to it late, so that a periodic core
    keeps its phase and misses none, up to ``MAX_CATCH_UP_NS``. A frame is given its arrival; wakes that were due before
    it come first. (At the same nanosecond the frame comes first, as in virtual time.) Time never runs backwards: what
    is older than the last instant handed out, or than ``start_ns``, is given that one.
    """

    def __init__(
        self,
        node: Node,
        transmit: Callable[[Frame], bool],
        start_ns: int,
        on_event: Callable[[Event], None] | None = None,
        on_wake: Callable[[int, int], None] | None = None,
    ) -> None:
        """Begin at ``start_ns``; frames that the core already wants to send go out at once.

        ``transmit`` returns False for a frame that the bus has no room for; it is offered again later. ``on_event``
        gets the core's events; ``on_wake(due_ns, now_ns)`` is called after each wake, with the instant the core was
        given and the one at which the host came to it.
        """
        self._node = node
        self._transmit = transmit
        self._on_event = on_event
        self._on_wake = on_wake
        self._time_ns = start_ns
        self._stalled_wakes = 0
        self._backlog: deque[Frame] = deque(maxlen=MAX_BACKLOG_FRAMES)
        self._wakes = 0
        self._frames_received = 0
        self._frames_sent = 0
        self._frames_dropped = 0
        self._max_lateness_ns = 0
        self._next_wake_ns: int | None = None
        self._settle()

    @property
    def next_wake_ns(self) -> int | None:
        """When ``advance`` is next needed; None while the core waits for frames alone."""
        return self._next_wake_ns

    @property
    def has_backlog(self) -> bool:
        """Whether frames wait because the bus had no room for them; ``flush`` offers them again."""
        return bool(self._backlog)

    @property
    def statistics(self) -> RunStatistics:
        """The figures so far."""
        return RunStatistics(
            wakes=self._wakes,
            frames_received=self._frames_received,
            frames_sent=self._frames_sent,
            frames_dropped=self._frames_dropped,
            max_wake_lateness_ns=self._max_lateness_ns,
        )

    def advance(self, now_ns: int) -> None:
        """Make the wakes due up to and including ``now_ns``, at most ``MAX_WAKES_PER_CALL`` of them.

        Raises:
            LivelockError: the core does not let the time go on.
        """
        due_ns = self._next_wake_ns
        if due_ns is None or due_ns > now_ns:
            return
        lateness_ns = now_ns - max(due_ns, self._time_ns)
        if lateness_ns > MAX_CATCH_UP_NS:
            self._note_lateness(lateness_ns)
            due_ns = now_ns
        for _ in range(MAX_WAKES_PER_CALL):
            self._wake(due_ns, now_ns)
            due_ns = self._next_wake_ns
            if due_ns is None or due_ns > now_ns:
                return

    def deliver(self, frame: Frame, arrival_ns: int, now_ns: int | None = None) -> None:
        """Hand over ``frame`` that arrived at ``arrival_ns``, after the wakes that were due before it.

        ``now_ns`` is the present, where the caller knows it; the lateness of those wakes is measured against it.

        Raises:
            LivelockError: the core does not let the time go on.
        """
        due_ns = self._next_wake_ns
        while due_ns is not None and due_ns < arrival_ns:
            self._wake(due_ns, arrival_ns if now_ns is None or now_ns < arrival_ns else now_ns)
            due_ns = self._next_wake_ns
        if arrival_ns > self._time_ns:
            self._time_ns = arrival_ns
        self._frames_received += 1
        self._node.receive(frame, self._time_ns)
        self._settle()

    def flush(self) -> None:
        """Offer the bus the frames that it had no room for."""
        backlog = self._backlog
        while backlog and self._transmit(backlog[0]):
            backlog.popleft()
            self._frames_sent += 1

    def _wake(self, due_ns: int, now_ns: int) -> None:
        if now_ns - due_ns > self._max_lateness_ns:
            self._note_lateness(now_ns - max(due_ns, self._time_ns))
        if due_ns > self._time_ns:
            self._time_ns = due_ns
            self._stalled_wakes = 0
        else:
            self._stalled_wakes += 1
            if self._stalled_wakes > MAX_WAKES_PER_INSTANT:
                raise LivelockError(0, self._node, self._time_ns, due_ns, self._stalled_wakes)
        self._wakes += 1
        self._node.wake(self._time_ns)
        if self._on_wake is not None:
            self._on_wake(self._time_ns, now_ns)
        self._settle()

    def _note_lateness(self, lateness_ns: int) -> None:
        if lateness_ns >= LATENESS_WARNING_NS > self._max_lateness_ns:
            _log.warning("%.0f ms behind real time; is this machine too slow, or too busy?", lateness_ns * 1e-6)
        self._max_lateness_ns = max(lateness_ns, self._max_lateness_ns)

    def _settle(self) -> None:
        frames = self._node.take_frames()
        if frames:
            self._send(frames)
        if self._on_event is not None:
            for event in self._node.take_events():
                self._on_event(event)
        self._next_wake_ns = self._node.next_wake_ns()

    def _send(self, frames: list[Frame]) -> None:
        if self._backlog:
            self.flush()
        for frame in frames:
            if not self._backlog and self._transmit(frame):
                self._frames_sent += 1
            else:
                if len(self._backlog) == MAX_BACKLOG_FRAMES:
                    self._frames_dropped += 1
                self._backlog.append(frame)
