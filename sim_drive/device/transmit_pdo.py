"""The drive's TPDOs (CiA 301, 7.2.2): sent at SYNCs, on events with inhibit and event time, or on remote requests."""

from collections.abc import Callable, Sequence
from typing import Any, Final

from drivers import objects
from drivers.frame import Frame
from drivers.pdo import PDO_COB_ID_NO_RTR
from drivers.sdo import AbortCode
from sim_drive.communication.dictionary import Entry, LiveDictionary
from sim_drive.device.axis import Axis
from sim_drive.device.pdo_mapping import Codec, compile_encoder
from sim_drive.device.pdo_slave import EVENT_DRIVEN_TYPES, NS_PER_MS, SYNCHRONOUS_ON_REQUEST, PdoSub, SlavePdo
from sim_drive.logical_axes import in_first_axis

_INHIBIT_UNIT_NS: Final = 100_000

_MEASURED: Final = frozenset(
    {
        objects.POSITION_DEMAND_VALUE,
        objects.POSITION_ACTUAL_VALUE,
        objects.VELOCITY_ACTUAL_VALUE,
        objects.TORQUE_ACTUAL_VALUE,
        objects.FOLLOWING_ERROR_ACTUAL_VALUE,
    }
)
"""Objects whose change is no event: an encoder that jitters by a count must not flood the bus."""


class TransmitPdo(SlavePdo):
    """A TPDO: sent at SYNCs, on events with inhibit and event time, or on remote requests."""

    __slots__ = (
        "_axes",
        "_encode",
        "_event_entry",
        "_event_ns",
        "_inhibit_entry",
        "_inhibit_ns",
        "_is_pending",
        "_last_sources",
        "_outbox",
        "_sampled",
        "_sources",
        "_start_entry",
        "_sync_count",
        "due_ns",
        "has_started",
        "inhibited_until_ns",
        "is_event_driven",
    )

    def __init__(
        self,
        number: int,
        dictionary: LiveDictionary,
        axes: Sequence[Axis],
        outbox: list[Frame],
        on_change: Callable[[int], None],
    ) -> None:
        """``number``, from 1, is the PDO's; it may map objects of any of ``axes``."""
        communication = objects.TPDO_COMMUNICATION + number - 1
        super().__init__(dictionary, communication, objects.TPDO_MAPPING + number - 1, on_change)
        self._axes = axes
        self._outbox = outbox
        self._inhibit_entry = dictionary.entry(communication, PdoSub.INHIBIT_TIME)
        self._event_entry = dictionary.entry(communication, PdoSub.EVENT_TIMER)
        self._start_entry = dictionary.entry(communication, PdoSub.SYNC_START_VALUE)
        self._inhibit_entry.on_write = self._on_inhibit_time
        self._start_entry.on_write = self._on_start_value
        self._event_entry.on_write = self._on_event_timer
        self._encode: Callable[[], Frame] = _encode_nothing
        self._sources: tuple[Entry, ...] = ()
        self._last_sources: list[Any] = []
        self._inhibit_ns = 0
        self._event_ns = 0
        self._sync_count = 0
        self._is_pending = False
        self._sampled: Frame | None = None
        self.has_started = False
        """The SYNC whose counter is the start value has come, since the node became operational."""
        self.is_event_driven = False
        self.due_ns: int | None = None
        """When the event timer sends it, or the inhibit time lets it be sent."""
        self.inhibited_until_ns = 0

    def _take_codec(self, codec: Codec) -> None:
        self._encode = compile_encoder(self.entries, codec.pack, self.cob_id)
        self._sources = tuple(entry for entry in self.entries if in_first_axis(entry.variable.index) not in _MEASURED)

    def _start(self, now_ns: int) -> None:
        self.is_event_driven = self.transmission_type in EVENT_DRIVEN_TYPES
        self._inhibit_ns = self._inhibit_entry.value * _INHIBIT_UNIT_NS
        self._event_ns = self._event_entry.value * NS_PER_MS
        self._sync_count = 0
        self._is_pending = False
        self._sampled = None
        self.has_started = False
        self.inhibited_until_ns = 0
        self._schedule(now_ns)

    @property
    def is_synchronous(self) -> bool:
        """Whether a SYNC has it sent or sampled."""
        return self.transmission_type <= SYNCHRONOUS_ON_REQUEST

    @property
    def sync_start_value(self) -> int:
        """Counter of the SYNC that is the first one for this PDO; 0: any."""
        return self._start_entry.value

    @property
    def is_sent_on_request(self) -> bool:
        """Whether a remote frame has it sent: bit 30 of its COB-ID allows it, and it is not bound to SYNCs."""
        return not self.cob_id_entry.value & PDO_COB_ID_NO_RTR and self.transmission_type >= SYNCHRONOUS_ON_REQUEST

    def begin(self, now_ns: int) -> None:
        """The node has become operational: an event-driven PDO is sent once, the counting of SYNCs begins."""
        self._start(now_ns)
        self._last_sources = []

    def send(self, now_ns: int) -> None:
        """Send the PDO with the values as they are."""
        encode = self._encode
        self._outbox.append(encode())

    @property
    def sync_sender(self) -> Callable[[int], None]:
        """What it does at a SYNC, as long as its transmission type stays."""
        return self.send if self.transmission_type == 1 else self.on_sync

    def on_sync(self, now_ns: int) -> None:
        """Send at this SYNC if its transmission type says so: 0 after an event, n at every n-th."""
        transmission_type = self.transmission_type
        if transmission_type == 0:
            if self._has_changed():
                self.send(now_ns)
        elif transmission_type == SYNCHRONOUS_ON_REQUEST:
            self._sampled = self._encode()
        else:
            self._sync_count += 1
            if self._sync_count >= transmission_type:
                self._sync_count = 0
                self.send(now_ns)

    def on_request(self, now_ns: int) -> None:
        """Answer a remote frame: type 252 with the sample of the last SYNC (there may be none yet), others afresh."""
        if self.transmission_type != SYNCHRONOUS_ON_REQUEST:
            self._sample(now_ns)
            self.send(now_ns)
        elif self._sampled is not None:
            self._outbox.append(self._sampled)

    def poll(self, now_ns: int) -> bool:
        """Event-driven: send if something has changed; gives whether ``due_ns`` may have changed."""
        if self._is_pending or not self._has_changed():
            return False
        self._is_pending = True
        self._schedule(now_ns)
        self.wake(now_ns)
        return True

    def wake(self, now_ns: int) -> None:
        """Send what the timers have let go."""
        if self.due_ns is None or now_ns < self.due_ns:
            return
        self._sample(now_ns)
        self.send(now_ns)
        self._is_pending = False
        self.inhibited_until_ns = now_ns + self._inhibit_ns
        self._schedule(now_ns)

    def _sample(self, now_ns: int) -> None:
        for axis in self._axes:
            axis.sample(now_ns)

    def _schedule(self, now_ns: int) -> None:
        if self._is_pending:
            self.due_ns = max(now_ns, self.inhibited_until_ns)
        elif self._event_ns and self.is_event_driven and self.is_valid:
            self.due_ns = max(now_ns + self._event_ns, self.inhibited_until_ns)
        else:
            self.due_ns = None

    def _has_changed(self) -> bool:
        sources = [entry.value for entry in self._sources]
        if sources == self._last_sources:
            return False
        self._last_sources = sources
        return True

    def _on_start_value(self, value: int, now_ns: int) -> AbortCode | None:
        return AbortCode.VALUE_RANGE_EXCEEDED if self.is_valid else None

    def _on_inhibit_time(self, value: int, now_ns: int) -> AbortCode | None:
        if self.is_valid:
            return AbortCode.VALUE_RANGE_EXCEEDED
        self._inhibit_ns = value * _INHIBIT_UNIT_NS
        return None

    def _on_event_timer(self, value: int, now_ns: int) -> AbortCode | None:
        self._event_ns = value * NS_PER_MS
        self._schedule(now_ns)
        self._on_change(now_ns)
        return None


def _encode_nothing() -> Frame:
    return Frame(0)
