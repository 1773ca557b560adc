"""The emulated drive's object dictionary in operation: a value behind every entry, and the checks of CiA 301 before it.

Access by SDO answers with an abort code instead of raising: a client's mistake is daily business for a server. The
cycle keeps hold of ``Entry`` objects and reads ``value`` directly.
"""

import struct
from collections.abc import Callable, Iterator
from typing import Any, Final

from drivers.object_dictionary import Access, DataType, ObjectDictionary, Value, Variable, decode, encode
from drivers.objects import DEVICE_TYPE
from drivers.sdo import AbortCode

WriteHook = Callable[[int, int], AbortCode | None]
"""Called with the new value and the time before the value is stored; an abort code refuses it.

Only entries of integer types have write hooks, and domains (see ``DomainHook``).
"""
ReadHook = Callable[[int], Value]
"""Called with the time, gives the live value; for entries whose ``value`` is not kept up to date all the time."""
DomainHook = Callable[[bytes, int], AbortCode | None]

DEFAULT_CAPACITY: Final = 255
"""Bytes that a string may take if nothing else is said."""


class Entry:
    """One value of the dictionary. ``value`` may be read and written directly by the drive itself."""

    __slots__ = (
        "access",
        "capacity",
        "data_type",
        "default",
        "high_limit",
        "is_readable",
        "is_writable",
        "low_limit",
        "on_domain",
        "on_read",
        "on_write",
        "size",
        "value",
        "variable",
    )

    def __init__(self, variable: Variable) -> None:
        self.variable: Final = variable
        self.data_type: DataType = variable.data_type
        self.access: Access = variable.access
        self.is_readable = variable.access.is_readable
        self.is_writable = variable.access.is_writable
        self.size = variable.size
        self.capacity = self.size if self.size is not None else DEFAULT_CAPACITY
        """Bytes it takes at most; only a string or a domain may hold fewer."""
        self.default: Value = variable.default
        self.low_limit = variable.low_limit
        self.high_limit = variable.high_limit
        self.on_write: WriteHook | None = None
        self.on_domain: DomainHook | None = None
        self.on_read: ReadHook | None = None
        self.value: Any = variable.default
        """Of the kind that ``data_type`` says. Not checked: the cycle reads and writes it at full speed."""

    @property
    def is_unlimited(self) -> bool:
        """Whether ``store`` asks nobody but the hook before it keeps an integer."""
        return self.low_limit is None and self.high_limit is None

    def store(self, value: Value, now_ns: int) -> AbortCode | None:
        """Check ``value`` against the limits, offer it to the hook, and keep it; the abort code if it was refused."""
        if isinstance(value, bytes):
            if self.on_domain is not None:
                refusal = self.on_domain(value, now_ns)
                if refusal is not None:
                    return refusal
            self.value = value
            return None
        if self.low_limit is not None and value < self.low_limit:
            return AbortCode.VALUE_TOO_LOW
        if self.high_limit is not None and value > self.high_limit:
            return AbortCode.VALUE_TOO_HIGH
        if self.on_write is not None:
            refusal = self.on_write(int(value), now_ns)
            if refusal is not None:
                return refusal
        self.value = value
        return None

    def load(self, now_ns: int) -> Value:
        """The value as of ``now_ns``."""
        return self.value if self.on_read is None else self.on_read(now_ns)


class LiveDictionary:
    """Values over an ObjectDictionary, with access by SDO and by the drive itself."""

    __slots__ = ("_entries", "description", "refusals")

    def __init__(self, description: ObjectDictionary) -> None:
        self.description = description
        self._entries: Final = {(v.index, v.subindex): Entry(v) for v in description}
        self.refusals: dict[tuple[int, int | None], AbortCode] = {}
        """Objects to which an SDO client gets no access, and the code that tells him; sub-index None: all of them."""

    def __iter__(self) -> Iterator[Entry]:
        return iter(self._entries.values())

    def redescribe(self, description: ObjectDictionary) -> None:
        """Take over the defaults of the same device under another node id; those that do not depend on it stay.

        The values change with the next ``restore_defaults``.
        """
        before = self.description
        self.description = description
        for variable in description:
            old = before.get(variable.index, variable.subindex)
            if old is not None and old.default != variable.default:
                self._entries[variable.index, variable.subindex].default = variable.default

    def entry(self, index: int, subindex: int = 0) -> Entry:
        """The entry at this place; raises KeyError if the description does not have it."""
        try:
            return self._entries[index, subindex]
        except KeyError:
            raise KeyError(f"the dictionary has no object {index:04X}h:{subindex:02X}, which the drive needs") from None

    def get(self, index: int, subindex: int) -> Entry | None:
        """The entry at this place, or None."""
        return self._entries.get((index, subindex))

    def find(self, index: int, subindex: int) -> Entry | AbortCode:
        """The entry at this place for an SDO client, or why there is none (CiA 301, table 22).

        A sub-index that a VAR object does not have is its own error too. Dummy entries are there for PDO mapping alone.
        """
        if self.refusals:
            refusal = self.refusals.get((index, subindex), self.refusals.get((index, None)))
            if refusal is not None:
                return refusal
        entry = self._entries.get((index, subindex))
        if entry is not None and index >= DEVICE_TYPE:
            return entry
        if index in self.description and index >= DEVICE_TYPE:
            return AbortCode.SUBINDEX_DOES_NOT_EXIST
        return AbortCode.OBJECT_DOES_NOT_EXIST

    def find_readable(self, index: int, subindex: int) -> Entry | AbortCode:
        """The entry for an upload, or the abort code that refuses it."""
        entry = self.find(index, subindex)
        if isinstance(entry, Entry) and not entry.is_readable:
            return AbortCode.WRITE_ONLY
        return entry

    def find_writable(self, index: int, subindex: int, size: int | None) -> Entry | AbortCode:
        """The entry for a download of ``size`` bytes (None: not told), or the abort code that refuses it."""
        entry = self.find(index, subindex)
        if not isinstance(entry, Entry):
            return entry
        if not entry.is_writable:
            return AbortCode.READ_ONLY
        refusal = None if size is None else check_size(entry, size)
        return entry if refusal is None else refusal

    def read(self, index: int, subindex: int, now_ns: int) -> bytes | AbortCode:
        """The bytes of an entry for an SDO client, or the abort code."""
        entry = self.find_readable(index, subindex)
        return read_bytes(entry, now_ns) if isinstance(entry, Entry) else entry

    def write(self, index: int, subindex: int, data: bytes, now_ns: int) -> AbortCode | None:
        """Write the bytes that an SDO client has sent; None when done, or the abort code."""
        entry = self.find_writable(index, subindex, len(data))
        return write_bytes(entry, data, now_ns) if isinstance(entry, Entry) else entry

    def restore_defaults(self, first_index: int, last_index: int) -> None:
        """Set every entry in this range of indices to its default, without asking the hooks."""
        for (index, _), entry in self._entries.items():
            if first_index <= index <= last_index:
                entry.value = entry.default


def check_size(entry: Entry, size: int) -> AbortCode | None:
    """The abort code for a download of ``size`` bytes to ``entry``, None if it may be."""
    if size > entry.capacity:
        is_memory = entry.data_type is DataType.DOMAIN
        return AbortCode.OUT_OF_MEMORY if is_memory else AbortCode.LENGTH_TOO_HIGH
    if entry.size is not None and size < entry.size:
        return AbortCode.LENGTH_TOO_LOW
    return None


def read_bytes(entry: Entry, now_ns: int) -> bytes | AbortCode:
    """The bytes of a readable entry; an empty one has no data to give."""
    value = entry.load(now_ns)
    if isinstance(value, AbortCode):
        return value
    data = encode(entry.data_type, value)
    return data if data else AbortCode.NO_DATA_AVAILABLE


def write_bytes(entry: Entry, data: bytes, now_ns: int) -> AbortCode | None:
    """Store ``data`` in a writable entry; None when done, or the abort code."""
    refusal = check_size(entry, len(data))
    if refusal is not None:
        return refusal
    try:
        value = decode(entry.data_type, data)
    except struct.error:
        return AbortCode.LENGTH_MISMATCH
    return entry.store(value, now_ns)
