"""Heartbeat producer (1017h) and consumer (1016h) of the drive (CiA 301, 7.2.8.2.2)."""

from collections.abc import Callable, Sequence
from typing import Final

from drivers.frame import Frame
from drivers.nmt import HEARTBEAT_BASE, MAX_NODE_ID, NmtState
from drivers.objects import CONSUMER_HEARTBEAT_TIME, PRODUCER_HEARTBEAT_TIME
from drivers.sdo import AbortCode
from sim_drive.communication.dictionary import Entry, LiveDictionary

NS_PER_MS: Final = 1_000_000


class HeartbeatProducer:
    """Sends the node's NMT state every 1017h milliseconds; 0 sends none."""

    __slots__ = ("_cob_id", "_due_ns", "_outbox", "_period_ns", "_time")

    def __init__(self, node_id: int, dictionary: LiveDictionary, outbox: list[Frame]) -> None:
        self._cob_id = HEARTBEAT_BASE + node_id
        self._outbox = outbox
        self._period_ns = 0
        self._due_ns: int | None = None
        self._time = dictionary.entry(PRODUCER_HEARTBEAT_TIME)
        self._time.on_write = self._on_time

    def set_node_id(self, node_id: int) -> None:
        """Send under another node id from now on."""
        self._cob_id = HEARTBEAT_BASE + node_id

    def restore(self, now_ns: int) -> None:
        """Begin anew with the period that 1017h holds."""
        self._on_time(self._time.value, now_ns)

    def next_wake_ns(self) -> int | None:
        """When the next heartbeat is due."""
        return self._due_ns

    def wake(self, now_ns: int, state: NmtState) -> None:
        """Send a heartbeat if it is due."""
        if self._due_ns is None or now_ns < self._due_ns:
            return
        self._outbox.append(Frame(self._cob_id, bytes((state,))))
        # A host that was away for long gets one heartbeat, not a burst of old ones.
        self._due_ns += (now_ns - self._due_ns) // self._period_ns * self._period_ns + self._period_ns

    def send_boot_up(self) -> None:
        """Tell that initialisation is over."""
        self._outbox.append(Frame(self._cob_id, bytes((NmtState.BOOT_UP,))))

    def _on_time(self, value: int, now_ns: int) -> AbortCode | None:
        # The period starts at once, with the first heartbeat at its end.
        self._period_ns = value * NS_PER_MS
        self._due_ns = now_ns + self._period_ns if value else None
        return None


class _Guard:
    __slots__ = ("deadline_ns", "entry", "is_lost", "node_id", "timeout_ns")

    def __init__(self, entry: Entry) -> None:
        self.entry = entry
        self.node_id = 0
        self.timeout_ns = 0
        self.deadline_ns: int | None = None
        self.is_lost = False


class HeartbeatConsumer:
    """Watches the nodes that 1016h names, each from its first heartbeat on.

    A boot-up message of a node that was being watched counts as its loss: whatever was commanding us has forgotten it.
    """

    __slots__ = ("_guards", "_on_change", "_on_subscription")

    def __init__(
        self,
        dictionary: LiveDictionary,
        on_change: Callable[[bool, int], None],
        on_subscription: Callable[[], None],
    ) -> None:
        """``on_change(is_lost, now_ns)``: a watched node has fallen silent, or all of them are back.

        ``on_subscription()``: the set of ``node_ids`` has changed.
        """
        self._on_change = on_change
        self._on_subscription = on_subscription
        self._guards: list[_Guard] = []
        number = 1
        while (entry := dictionary.get(CONSUMER_HEARTBEAT_TIME, number)) is not None:
            guard = _Guard(entry)
            entry.on_write = self._writer(guard)
            self._guards.append(guard)
            number += 1

    @property
    def node_ids(self) -> Sequence[int]:
        """Nodes that are watched."""
        return [guard.node_id for guard in self._guards if guard.timeout_ns]

    @property
    def has_lost(self) -> bool:
        """Whether a watched node has fallen silent, and is not back."""
        return any(guard.is_lost for guard in self._guards)

    def restore(self) -> None:
        """Begin anew with what 1016h holds; no node has been heard of."""
        for guard in self._guards:
            self._configure(guard, guard.entry.value)
        self._on_subscription()

    def next_wake_ns(self) -> int | None:
        """When the next watched node will be missed."""
        due: int | None = None
        for guard in self._guards:
            deadline_ns = guard.deadline_ns
            if deadline_ns is not None and (due is None or deadline_ns < due):
                due = deadline_ns
        return due

    def wake(self, now_ns: int) -> None:
        """Notice the nodes that have fallen silent."""
        for guard in self._guards:
            if guard.deadline_ns is not None and now_ns >= guard.deadline_ns:
                self._lose(guard, now_ns)

    def receive(self, node_id: int, data: bytes, now_ns: int) -> None:
        """Take a heartbeat of a node."""
        if len(data) != 1:
            return
        for guard in self._guards:
            if guard.node_id != node_id or not guard.timeout_ns:
                continue
            if data[0] == NmtState.BOOT_UP:
                if guard.deadline_ns is not None:
                    self._lose(guard, now_ns)
                continue
            guard.deadline_ns = now_ns + guard.timeout_ns
            if guard.is_lost:
                guard.is_lost = False
                if not self.has_lost:
                    self._on_change(False, now_ns)

    def _lose(self, guard: _Guard, now_ns: int) -> None:
        guard.deadline_ns = None
        guard.is_lost = True
        self._on_change(True, now_ns)

    def _configure(self, guard: _Guard, value: int) -> None:
        guard.node_id = value >> 16 & 0xFF
        guard.timeout_ns = (value & 0xFFFF) * NS_PER_MS if guard.node_id else 0
        guard.deadline_ns = None
        guard.is_lost = False

    def _writer(self, guard: _Guard) -> Callable[[int, int], AbortCode | None]:
        def write(value: int, now_ns: int) -> AbortCode | None:
            node_id = value >> 16 & 0xFF
            if value >> 24 or (value & 0xFFFF and node_id > MAX_NODE_ID):
                return AbortCode.VALUE_RANGE_EXCEEDED
            if value & 0xFFFF and any(
                other is not guard and other.timeout_ns and other.node_id == node_id for other in self._guards
            ):
                return AbortCode.PARAMETER_INCOMPATIBLE
            was_lost = guard.is_lost
            self._configure(guard, value)
            if was_lost and not self.has_lost:
                self._on_change(False, now_ns)
            self._on_subscription()
            return None

        return write
