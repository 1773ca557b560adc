"""The drive's PDOs (CiA 301, 7.2.2): configuration with its order of steps, and the exchange itself.

A mapping is compiled into a struct codec and a tuple of dictionary entries when the PDO is made valid, so that what is
left for the SYNC is one pack or unpack for each PDO.
"""

import struct
from collections.abc import Callable, Sequence
from enum import IntEnum, unique
from operator import attrgetter
from typing import Any, Final, Protocol

from drivers import objects
from drivers.frame import Frame, data_frame
from drivers.nmt import SYNC_COB_ID
from drivers.object_dictionary import FORMAT
from drivers.pdo import PDO_COB_ID_INVALID, PDO_COB_ID_NO_RTR, PDO_MAX_ENTRIES, MappingEntry
from drivers.sdo import AbortCode
from sim_drive.communication.cob_ids import COB_ID_MASK, EXTENDED_FRAME, is_restricted
from sim_drive.communication.dictionary import Entry, LiveDictionary, WriteHook
from sim_drive.communication.emcy import EmergencyCode, EmergencyProducer, ErrorRegister
from sim_drive.device.axis import Axis, SetPointSource
from sim_drive.logical_axes import in_first_axis

LAST_SYNCHRONOUS_TYPE: Final = 240
SYNCHRONOUS_ON_REQUEST: Final = 252
"""TPDO that is sampled at every SYNC and sent on a remote request."""
EVENT_ON_REQUEST: Final = 253
"""TPDO that is sampled and sent on a remote request."""
EVENT_DRIVEN_TYPES: Final = frozenset({254, 255})
PDO_MAX_BITS: Final = 64

_INHIBIT_UNIT_NS: Final = 100_000
_NS_PER_MS: Final = 1_000_000

_value_of: Final = attrgetter("value")
"""Of a dictionary's entry."""

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


@unique
class _Sub(IntEnum):
    """Sub-indices of the PDO communication parameters."""

    COB_ID = 1
    TRANSMISSION_TYPE = 2
    INHIBIT_TIME = 3
    EVENT_TIMER = 5
    SYNC_START_VALUE = 6


class _Codec(Protocol):
    @property
    def unpack_from(self) -> Callable[[bytes], tuple[Any, ...]]: ...

    @property
    def pack(self) -> Callable[..., bytes]: ...


class _BitCodec:
    """Codec of a mapping with an entry that is not a whole number of bytes, as a BOOLEAN gap; slower than struct."""

    __slots__ = ("_fields", "_length")

    def __init__(self, fields: Sequence[tuple[int, int, bool]], length: int) -> None:
        """``fields``: first bit, bits, and whether signed, of each value."""
        self._fields = tuple(fields)
        self._length = length

    def unpack_from(self, data: bytes) -> tuple[int, ...]:
        word = int.from_bytes(data[: self._length], "little")
        values: list[int] = []
        for start, bits, is_signed in self._fields:
            value = word >> start & ((1 << bits) - 1)
            values.append(value - (1 << bits) if is_signed and value >> (bits - 1) else value)
        return tuple(values)

    def pack(self, *values: int) -> bytes:
        word = 0
        for (start, bits, _), value in zip(self._fields, values, strict=True):
            word |= (value & ((1 << bits) - 1)) << start
        return word.to_bytes(self._length, "little")


def _is_dummy(index: int) -> bool:
    return index < objects.DEVICE_TYPE


def bit_length(entry: Entry) -> int:
    """Length in bits that an entry has in a mapping; a BOOLEAN takes one bit."""
    size = entry.size
    if size is None:
        return 0
    return 1 if FORMAT[entry.data_type] == "?" else size * 8


def compile_mapping(mapped: Sequence[Entry]) -> tuple[tuple[Entry, ...], int, _Codec]:
    """The entries that carry values (dummies do not), the PDO's length in bytes, and the codec for the values."""
    real = tuple(entry for entry in mapped if not _is_dummy(entry.variable.index))
    bits = [bit_length(entry) for entry in mapped]
    length = (sum(bits) + 7) // 8
    if all(n % 8 == 0 for n in bits):
        text = "".join(
            f"{n // 8}x" if _is_dummy(entry.variable.index) else FORMAT[entry.data_type]
            for entry, n in zip(mapped, bits, strict=True)
        )
        return real, length, struct.Struct("<" + text)
    fields: list[tuple[int, int, bool]] = []
    start = 0
    for entry, n in zip(mapped, bits, strict=True):
        if not _is_dummy(entry.variable.index):
            fields.append((start, n, FORMAT[entry.data_type].islower()))
        start += n
    return real, length, _BitCodec(fields, length)


def compile_encoder(entries: Sequence[Entry], pack: Callable[..., bytes]) -> Callable[[], bytes]:
    """What packs the values that the entries have by then; most PDOs carry no more than three."""
    if len(entries) == 1:
        (only,) = entries
        return lambda: pack(only.value)
    if len(entries) == 2:
        first, second = entries
        return lambda: pack(first.value, second.value)
    if len(entries) == 3:
        first, second, third = entries
        return lambda: pack(first.value, second.value, third.value)
    values = tuple(entries)
    return lambda: pack(*map(_value_of, values))


class _Pdo:
    """What receive and transmit PDOs have in common: parameters, mapping, and the order in which they may change."""

    __slots__ = (
        "_dictionary",
        "_is_receive",
        "_mapping",
        "_on_change",
        "cob_id",
        "cob_id_entry",
        "entries",
        "is_valid",
        "length",
        "transmission_type",
        "type_entry",
    )

    def __init__(
        self, dictionary: LiveDictionary, communication: int, mapping: int, on_change: Callable[[int], None]
    ) -> None:
        self._dictionary = dictionary
        self._is_receive = communication < objects.TPDO_COMMUNICATION
        self._on_change = on_change
        self.cob_id_entry = dictionary.entry(communication, _Sub.COB_ID)
        self.type_entry = dictionary.entry(communication, _Sub.TRANSMISSION_TYPE)
        self._mapping = [dictionary.entry(mapping, n) for n in range(PDO_MAX_ENTRIES + 1)]
        self.transmission_type = 0
        """As CiA 301, table 72."""
        self.cob_id = 0
        self.is_valid = False
        self.entries: tuple[Entry, ...] = ()
        self.length = 0
        self.cob_id_entry.on_write = self._on_cob_id
        self.type_entry.on_write = self._on_type
        self._mapping[0].on_write = self._on_count
        for entry in self._mapping[1:]:
            entry.on_write = self._on_entry

    def restore(self, now_ns: int) -> None:
        """Take over what the dictionary holds."""
        self._compile(self.cob_id_entry.value, now_ns)

    def _compile(self, cob_id: int, now_ns: int) -> None:
        mapped = self._mapped(self._mapping[0].value)
        self.cob_id = cob_id & COB_ID_MASK
        self.is_valid = not cob_id & PDO_COB_ID_INVALID and not isinstance(mapped, AbortCode)
        if self.is_valid and not isinstance(mapped, AbortCode):
            self.entries, self.length, codec = compile_mapping(mapped)
            self._take_codec(codec)
        self._restart(now_ns)

    def _restart(self, now_ns: int) -> None:
        self.transmission_type = self.type_entry.value
        self._start(now_ns)

    def _take_codec(self, codec: _Codec) -> None:
        raise NotImplementedError

    def _start(self, now_ns: int) -> None:
        raise NotImplementedError

    def _mapped(self, count: int) -> list[Entry] | AbortCode:
        """The first ``count`` mapped entries, or why they cannot be mapped."""
        mapped: list[Entry] = []
        for holder in self._mapping[1 : count + 1]:
            found = self._find(holder.value)
            if isinstance(found, AbortCode):
                return found
            mapped.append(found)
        if sum(bit_length(entry) for entry in mapped) > PDO_MAX_BITS:
            return AbortCode.PDO_LENGTH_EXCEEDED
        return mapped

    def _find(self, word: int) -> Entry | AbortCode:
        wanted = MappingEntry.from_word(word)
        entry = self._dictionary.get(wanted.index, wanted.subindex)
        if _is_dummy(wanted.index):
            is_mappable = self._is_receive and entry is not None and wanted.index > 0
            if not is_mappable or entry is None:
                return AbortCode.OBJECT_DOES_NOT_EXIST if entry is None else AbortCode.NOT_PDO_MAPPABLE
        elif entry is None:
            found = self._dictionary.find(wanted.index, wanted.subindex)
            return found if isinstance(found, AbortCode) else AbortCode.OBJECT_DOES_NOT_EXIST
        elif not entry.variable.is_pdo_mappable or not (entry.is_writable if self._is_receive else entry.is_readable):
            return AbortCode.NOT_PDO_MAPPABLE
        return entry if bit_length(entry) == wanted.bit_length else AbortCode.NOT_PDO_MAPPABLE

    # -- the order of CiA 301, 7.5.2.36: invalid, count 0, entries, count n, valid ---------------------------------

    def _on_cob_id(self, value: int, now_ns: int) -> AbortCode | None:
        stays_valid = self.is_valid and not value & PDO_COB_ID_INVALID
        if value & EXTENDED_FRAME or (stays_valid and value & COB_ID_MASK != self.cob_id):
            return AbortCode.VALUE_RANGE_EXCEEDED
        if not value & PDO_COB_ID_INVALID:
            if is_restricted(value & COB_ID_MASK) or value & COB_ID_MASK == SYNC_COB_ID:
                return AbortCode.VALUE_RANGE_EXCEEDED
            mapped = self._mapped(self._mapping[0].value)
            if isinstance(mapped, AbortCode):
                return mapped
        self.cob_id_entry.value = value
        self._compile(value, now_ns)
        self._on_change(now_ns)
        return None

    def _is_type(self, value: int) -> bool:
        if value in (SYNCHRONOUS_ON_REQUEST, EVENT_ON_REQUEST):
            return not self._is_receive
        return value <= LAST_SYNCHRONOUS_TYPE or value in EVENT_DRIVEN_TYPES

    def _on_type(self, value: int, now_ns: int) -> AbortCode | None:
        if not self._is_type(value):
            return AbortCode.VALUE_RANGE_EXCEEDED
        self.type_entry.value = value
        self._restart(now_ns)
        self._on_change(now_ns)
        return None

    def _on_count(self, value: int, now_ns: int) -> AbortCode | None:
        if self.is_valid:
            return AbortCode.UNSUPPORTED_ACCESS
        if value > PDO_MAX_ENTRIES:
            return AbortCode.VALUE_TOO_HIGH
        mapped = self._mapped(value)
        return mapped if isinstance(mapped, AbortCode) else None

    def _on_entry(self, value: int, now_ns: int) -> AbortCode | None:
        if self.is_valid or self._mapping[0].value:
            return AbortCode.UNSUPPORTED_ACCESS
        if not value:
            return None
        found = self._find(value)
        return found if isinstance(found, AbortCode) else None


class ReceivePdo(_Pdo):
    """An RPDO: its data act at once, or wait for the SYNC. With an event timer it is missed if it does not come."""

    __slots__ = (
        "_axes",
        "_emergency",
        "_event_entry",
        "_steps",
        "_unpack",
        "deadline_ns",
        "event_ns",
        "is_late",
        "is_synchronous",
        "pending",
    )

    def __init__(
        self,
        number: int,
        dictionary: LiveDictionary,
        axes: Sequence[Axis],
        emergency: EmergencyProducer,
        on_change: Callable[[int], None],
    ) -> None:
        """``number``, from 1, is the PDO's; it may map objects of any of ``axes``."""
        communication = objects.RPDO_COMMUNICATION + number - 1
        super().__init__(dictionary, communication, objects.RPDO_MAPPING + number - 1, on_change)
        self._axes = axes
        self._emergency = emergency
        self._event_entry = dictionary.entry(communication, _Sub.EVENT_TIMER)
        self._event_entry.on_write = self._on_event_timer
        self.event_ns = 0
        """How long it may fail to come, from the first time on that it has; 0: for ever."""
        self.deadline_ns: int | None = None
        self.is_late = False
        self._unpack: Callable[[bytes], tuple[Any, ...]] = _unpack_nothing
        self._steps: tuple[tuple[Entry, WriteHook | None, bool], ...] = ()
        self.is_synchronous = False
        self.pending: bytes | None = None
        """Data that wait for the next SYNC."""

    def _take_codec(self, codec: _Codec) -> None:
        self._unpack = codec.unpack_from
        self._steps = tuple((entry, entry.on_write, entry.is_unlimited) for entry in self.entries)

    def _start(self, now_ns: int) -> None:
        self.is_synchronous = self.transmission_type <= LAST_SYNCHRONOUS_TYPE
        self.event_ns = self._event_entry.value * _NS_PER_MS
        self.is_late = False
        self.forget()

    def forget(self) -> None:
        """The node has changed its state: nothing waits for a SYNC, and nothing is missed before it has come again."""
        self.pending = None
        self.deadline_ns = None

    def note_arrival(self, data: bytes, now_ns: int) -> None:
        """Start the event timer anew; what is too short to be used is no arrival."""
        if len(data) >= self.length:
            self.is_late = False
            self.deadline_ns = now_ns + self.event_ns

    def _on_event_timer(self, value: int, now_ns: int) -> AbortCode | None:
        self.event_ns = value * _NS_PER_MS
        self.deadline_ns = None
        self.is_late = False
        self._on_change(now_ns)
        return None

    def receive(self, data: bytes, now_ns: int) -> None:
        """Take the PDO's data; too short is refused, too long is used as far as mapped (CiA 301, 7.2.2.5.1)."""
        if len(data) != self.length:
            self._take_wrong_length(data, now_ns)
            if len(data) < self.length:
                return
        elif self._emergency.has_errors:
            self._emergency.end_cause(EmergencyCode.PDO_TOO_SHORT, now_ns)
            self._emergency.end_cause(EmergencyCode.PDO_TOO_LONG, now_ns)
        if self.is_synchronous:
            self.pending = data
        else:
            for axis in self._axes:
                axis.source = SetPointSource.EVENT_PDO
            self.apply(data, now_ns)
            for axis in self._axes:
                axis.source = SetPointSource.SDO

    def _take_wrong_length(self, data: bytes, now_ns: int) -> None:
        code = EmergencyCode.PDO_TOO_SHORT if len(data) < self.length else EmergencyCode.PDO_TOO_LONG
        self._emergency.raise_error(code, ErrorRegister.COMMUNICATION, now_ns, is_fault=False, persists=False)

    def apply(self, data: bytes, now_ns: int) -> None:
        """Write the mapped objects, in the order of the mapping; what its object refuses is left as it was."""
        unpack = self._unpack
        for (entry, on_write, is_unlimited), value in zip(self._steps, unpack(data)):  # noqa: B905 - as mapped
            if not is_unlimited:
                entry.store(value, now_ns)
            elif on_write is None or on_write(value, now_ns) is None:
                entry.value = value


class TransmitPdo(_Pdo):
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
        self._inhibit_entry = dictionary.entry(communication, _Sub.INHIBIT_TIME)
        self._event_entry = dictionary.entry(communication, _Sub.EVENT_TIMER)
        self._start_entry = dictionary.entry(communication, _Sub.SYNC_START_VALUE)
        self._inhibit_entry.on_write = self._on_inhibit_time
        self._start_entry.on_write = self._on_start_value
        self._event_entry.on_write = self._on_event_timer
        self._encode: Callable[[], bytes] = _encode_nothing
        self._sources: tuple[Entry, ...] = ()
        self._last_sources: list[Any] = []
        self._inhibit_ns = 0
        self._event_ns = 0
        self._sync_count = 0
        self._is_pending = False
        self._sampled: bytes | None = None
        self.has_started = False
        """The SYNC whose counter is the start value has come, since the node became operational."""
        self.is_event_driven = False
        self.due_ns: int | None = None
        """When the event timer sends it, or the inhibit time lets it be sent."""
        self.inhibited_until_ns = 0

    def _take_codec(self, codec: _Codec) -> None:
        self._encode = compile_encoder(self.entries, codec.pack)
        self._sources = tuple(entry for entry in self.entries if in_first_axis(entry.variable.index) not in _MEASURED)

    def _start(self, now_ns: int) -> None:
        self.is_event_driven = self.transmission_type in EVENT_DRIVEN_TYPES
        self._inhibit_ns = self._inhibit_entry.value * _INHIBIT_UNIT_NS
        self._event_ns = self._event_entry.value * _NS_PER_MS
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
        self._outbox.append(data_frame(self.cob_id, encode()))

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
            self._outbox.append(data_frame(self.cob_id, self._sampled))

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
        sources = list(map(_value_of, self._sources))
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
        self._event_ns = value * _NS_PER_MS
        self._schedule(now_ns)
        self._on_change(now_ns)
        return None


def _unpack_nothing(data: bytes) -> tuple[Any, ...]:
    return ()


def _encode_nothing() -> bytes:
    return b""
