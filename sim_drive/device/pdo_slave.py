"""What receive and transmit PDOs of the drive share (CiA 301, 7.2.2): parameters, mapping, the order of their steps.

The exchange itself is in `receive_pdo` and `transmit_pdo`. A mapping is compiled when the PDO is made valid.
"""

from collections.abc import Callable
from enum import IntEnum, unique
from typing import Final

from drivers import objects
from drivers.nmt import SYNC_COB_ID
from drivers.pdo import PDO_COB_ID_INVALID, PDO_MAX_ENTRIES, MappingEntry
from drivers.sdo import AbortCode
from sim_drive.communication.cob_ids import COB_ID_MASK, EXTENDED_FRAME, is_restricted
from sim_drive.communication.dictionary import Entry, LiveDictionary
from sim_drive.device.pdo_mapping import Codec, bit_length, compile_mapping, is_dummy

LAST_SYNCHRONOUS_TYPE: Final = 240
SYNCHRONOUS_ON_REQUEST: Final = 252
"""TPDO that is sampled at every SYNC and sent on a remote request."""
EVENT_ON_REQUEST: Final = 253
"""TPDO that is sampled and sent on a remote request."""
EVENT_DRIVEN_TYPES: Final = frozenset({254, 255})
PDO_MAX_BITS: Final = 64

NS_PER_MS: Final = 1_000_000


@unique
class PdoSub(IntEnum):
    """Sub-indices of the PDO communication parameters."""

    COB_ID = 1
    TRANSMISSION_TYPE = 2
    INHIBIT_TIME = 3
    EVENT_TIMER = 5
    SYNC_START_VALUE = 6


class SlavePdo:
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
        self.cob_id_entry = dictionary.entry(communication, PdoSub.COB_ID)
        self.type_entry = dictionary.entry(communication, PdoSub.TRANSMISSION_TYPE)
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

    def _take_codec(self, codec: Codec) -> None:
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
        if is_dummy(wanted.index):
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
