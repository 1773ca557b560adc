"""The virtual-time host: it runs cores against each other on an emulated CAN bus, as fast as the processor allows.

A run is a pure function of the nodes, the faults and the seed: no clock is read, so two runs give the same frames at
the same nanosecond.
"""

import heapq
import itertools
import random
from collections import deque
from collections.abc import Callable, Sequence
from typing import Final, Protocol

from drivers.errors import DriveError
from drivers.frame import WORST_CASE_BITS, Frame
from drivers.node import Event, Node

MAX_WAKES_PER_INSTANT: Final = 10_000
"""How often one node may be woken while the time stands still, before that is taken for a fault of the node."""

_NEVER: Final = 1 << 63
_ATTEMPTS: Final = range(MAX_WAKES_PER_INSTANT)


class LivelockError(DriveError):
    """A node keeps asking for a wake that is already due, so that time cannot go on.

    Attributes: ``node_index``, ``now_ns`` (where time stands) and ``next_wake_ns`` (what the node asks for).
    """

    def __init__(self, node_index: int, node: Node, now_ns: int, next_wake_ns: int, wakes: int) -> None:
        super().__init__(
            f"node {node_index} ({type(node).__name__}) still asks to be woken at {next_wake_ns} ns "
            f"after {wakes} wakes at {now_ns} ns"
        )
        self.node_index = node_index
        self.now_ns = now_ns
        self.next_wake_ns = next_wake_ns


class BusFaults(Protocol):
    """What may go wrong with a frame on the emulated bus; asked once for each frame, at the end of its transmission."""

    def delays_ns(self, sender: int, frame: Frame, now_ns: int, source: random.Random) -> Sequence[int]:
        """Give one delay (ns, not negative) for each time the frame is to be delivered.

        ``(0,)`` delivers it as usual, ``()`` loses it, ``(0, 0)`` doubles it, ``(250_000,)`` makes it 250 us late. The
        wire time is taken once in every case. All chance must come from ``source``, so that the seed decides it.
        """
        ...


class VirtualBus:
    """Nodes on one CAN bus in virtual time.

    The order of things, which makes a run reproducible:

    - A frame occupies the bus for its worst-case stuffed length at ``bit_rate``, interframe space included, and reaches
      all nodes but its sender, in node order, at the end of that time.
    - When the bus is free, the frame with the lowest COB-ID among the nodes' oldest waiting frames goes next (a data
      frame before a remote frame of the same COB-ID, then the lower node index). A node's own frames keep their order.
    - At one instant come first the frame that ends then, then late frames (by their age), then the wakes due, in node
      order, and last the arbitration; so all frames handed out at one instant take part in it together.
    - A wake asked for in the past is due now: time never runs backwards.

    Nodes may be changed from outside between two runs: every run begins by asking all of them for frames and wakes.
    From within ``on_event`` or ``condition``, call ``refresh`` afterwards.
    """

    __slots__ = (
        "_earliest_wake_ns",
        "_ended",
        "_faults",
        "_frame_end_ns",
        "_late",
        "_late_count",
        "_listeners",
        "_now_ns",
        "_numbered_queues",
        "_on_event",
        "_on_wire",
        "_queues",
        "_sender",
        "_sleepers",
        "_source",
        "_trace",
        "_wakes",
        "_wire_ns",
        "bit_rate",
        "nodes",
    )

    def __init__(
        self,
        nodes: Sequence[Node],
        bit_rate: int,
        seed: int = 0,
        trace: Callable[[int, Frame], None] | None = None,
        faults: BusFaults | None = None,
        start_ns: int = 0,
        on_event: Callable[[int, Event], None] | None = None,
    ) -> None:
        """Put ``nodes`` on a bus of ``bit_rate`` bit/s at ``start_ns``.

        ``trace(now_ns, frame)`` sees every delivery (a lost frame never, a doubled one twice) before the nodes do;
        ``on_event(node_index, event)`` gets the events of the nodes. Without ``on_event`` the events stay in the nodes,
        for a caller who asks them himself.

        Raises:
            ValueError: ``bit_rate`` is not positive.
        """
        if bit_rate <= 0:
            raise ValueError(f"bit_rate must be positive, not {bit_rate}")
        self.nodes: Final = tuple(nodes)
        self.bit_rate: Final = bit_rate
        self._wire_ns: Final = tuple(-(-bits * 1_000_000_000 // bit_rate) for bits in WORST_CASE_BITS)
        self._trace = trace
        self._faults = faults
        self._source = random.Random(seed)  # noqa: S311 - reproducible on purpose
        self._on_event = on_event
        self._now_ns = start_ns
        self._ended = [0] * len(WORST_CASE_BITS)
        """Frames that have ended on the wire, by their bytes of data."""
        self._wakes: list[int] = [_NEVER] * (len(self.nodes) + 1)
        """When each node wants to be woken; the last entry stands there for a bus without nodes."""
        self._earliest_wake_ns = _NEVER
        self._queues: Final = tuple(deque[Frame]() for _ in self.nodes)
        self._numbered_queues: Final = tuple(enumerate(self._queues))
        self._on_wire: Frame | None = None
        self._sender = 0
        self._frame_end_ns = _NEVER
        self._late: list[tuple[int, int, int, Frame]] = []
        self._late_count: Final = itertools.count()
        # Bound methods looked up once: delivering a frame is most of what a run does.
        self._listeners: Final = tuple(
            tuple(
                (node.receive, (index, node.take_frames, node.next_wake_ns, node.take_events, self._queues[index]))
                for index, node in enumerate(self.nodes)
                if index != sender
            )
            for sender in range(len(self.nodes))
        )
        self._sleepers: Final = tuple((index, node.wake, node.next_wake_ns) for index, node in enumerate(self.nodes))

    @property
    def now_ns(self) -> int:
        """The virtual time."""
        return self._now_ns

    @property
    def busy_ns(self) -> int:
        """Time the bus has spent on frames that have ended; over the elapsed time it is the bus load."""
        return sum(count * wire_ns for count, wire_ns in zip(self._ended, self._wire_ns, strict=True))

    @property
    def frame_count(self) -> int:
        """Frames that have ended on the wire, lost ones included."""
        return sum(self._ended)

    def refresh(self) -> None:
        """Ask every node for its frames, events and next wake, after something outside the bus has changed one."""
        for index in range(len(self.nodes)):
            self._settle(index)
        self._earliest_wake_ns = min(self._wakes)

    def run_until(self, time_ns: int) -> None:
        """Run until ``time_ns`` inclusive; what is due at that very instant is done.

        Raises:
            ValueError: ``time_ns`` is in the past.
            LivelockError: a node does not let the time go on.
        """
        self._run(time_ns, None)

    def run_while(self, condition: Callable[[], bool], limit_ns: int) -> bool:
        """Run while ``condition()`` holds, at most until the instant ``limit_ns``; it is asked before every instant.

        Returns True when the condition ended the run, False when the limit did.

        Raises:
            ValueError: ``limit_ns`` is in the past.
            LivelockError: a node does not let the time go on.
        """
        return self._run(limit_ns, condition)

    def _run(self, limit_ns: int, condition: Callable[[], bool] | None) -> bool:  # noqa: C901 - one loop, for speed
        if limit_ns < self._now_ns:
            raise ValueError(f"time cannot run back from {self._now_ns} ns to {limit_ns} ns")
        self.refresh()
        late = self._late
        queues = self._numbered_queues
        wire_ns = self._wire_ns
        now_ns = self._now_ns
        sender = self._sender
        ended = self._ended
        deliver = self._deliver if self._faults is None else self._deliver_at_fault
        frame = self._on_wire
        length = 0 if frame is None else len(frame.data)
        frame_end_ns = self._frame_end_ns
        if frame is None and any(self._queues):
            # The wire is free and frames wait: as if a frame ended now, so that the first instant arbitrates.
            frame_end_ns = now_ns
        try:
            while condition is None or condition():
                next_ns = self._earliest_wake_ns
                if frame_end_ns < next_ns:
                    next_ns = frame_end_ns
                if late and late[0][0] < next_ns:
                    next_ns = late[0][0]
                if next_ns > limit_ns:
                    self._now_ns = limit_ns
                    return False
                if next_ns > now_ns:
                    self._now_ns = now_ns = next_ns
                if frame_end_ns == next_ns:
                    frame_end_ns = _NEVER
                    if frame is not None:
                        heard, frame = frame, None
                        ended[length] += 1
                        deliver(sender, heard, now_ns)
                if late:
                    self._deliver_late(now_ns)
                if self._earliest_wake_ns <= now_ns:
                    self._wake_due(now_ns)
                if frame is None:
                    # Arbitration: the lowest COB-ID among the oldest waiting frames wins, data before remote frames.
                    best = _NEVER
                    for index, queue in queues:
                        if queue:
                            cob_id, _, is_remote = queue[0]
                            priority = cob_id * 2 + is_remote
                            if priority < best:
                                best = priority
                                sender = index
                    if best != _NEVER:
                        frame = self._queues[sender].popleft()
                        _, data, _ = frame
                        length = len(data)
                        frame_end_ns = now_ns + wire_ns[length]
        finally:
            self._sender = sender
            self._on_wire = frame
            self._frame_end_ns = frame_end_ns
        return True

    def _deliver_at_fault(self, sender: int, frame: Frame, now_ns: int) -> None:
        """Do with a frame that has left the wire what the faults say."""
        delays_ns = (0,) if self._faults is None else self._faults.delays_ns(sender, frame, now_ns, self._source)
        for delay_ns in delays_ns:
            if delay_ns <= 0:
                self._deliver(sender, frame, now_ns)
            else:
                heapq.heappush(self._late, (now_ns + delay_ns, next(self._late_count), sender, frame))

    def _deliver_late(self, now_ns: int) -> None:
        late = self._late
        while late and late[0][0] <= now_ns:
            _, _, sender, frame = heapq.heappop(late)
            self._deliver(sender, frame, now_ns)

    def _deliver(self, sender: int, frame: Frame, now_ns: int) -> None:
        if self._trace is not None:
            self._trace(now_ns, frame)
        wakes = self._wakes
        on_event = self._on_event
        for receive, questions in self._listeners[sender]:
            if receive(frame, now_ns) is False:
                continue
            index, take_frames, next_wake_ns, take_events, queue = questions
            frames = take_frames()
            if frames:
                queue.extend(frames)
            wake_ns = next_wake_ns()
            if wake_ns is None:
                wake_ns = _NEVER
            if wake_ns != wakes[index]:
                wakes[index] = wake_ns
                self._earliest_wake_ns = min(wakes)
            if on_event is not None:
                for event in take_events():
                    on_event(index, event)

    def _wake_due(self, now_ns: int) -> None:
        """Wake the nodes that are due, in their order, each until it wants nothing more at this instant."""
        wakes = self._wakes
        for index, wake, next_wake_ns in self._sleepers:
            if wakes[index] > now_ns:
                continue
            for _ in _ATTEMPTS:
                if wake(now_ns) is False:
                    wake_ns = next_wake_ns()
                    wakes[index] = _NEVER if wake_ns is None else wake_ns
                else:
                    self._settle(index)
                if wakes[index] > now_ns:
                    break
            else:
                raise LivelockError(index, self.nodes[index], now_ns, wakes[index], MAX_WAKES_PER_INSTANT)
        self._earliest_wake_ns = min(wakes)

    def _settle(self, index: int) -> None:
        """Take what a node has to send and to tell, and when it wants to be woken."""
        node = self.nodes[index]
        frames = node.take_frames()
        if frames:
            self._queues[index].extend(frames)
        wake_ns = node.next_wake_ns()
        self._wakes[index] = _NEVER if wake_ns is None else wake_ns
        if self._on_event is not None:
            for event in node.take_events():
                self._on_event(index, event)
