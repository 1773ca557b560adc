"""A PDO's mapping, compiled: what is left for the SYNC is one pack or unpack for each PDO."""

import struct
from collections.abc import Callable, Sequence
from typing import Any, Protocol

from drivers import objects
from drivers.frame import Frame, new_frame
from drivers.object_dictionary import FORMAT
from sim_drive.communication.dictionary import Entry


class Codec(Protocol):
    """Between the values of a mapping and the bytes of its PDO; a ``struct.Struct`` is one."""

    @property
    def unpack_from(self) -> Callable[[bytes], tuple[Any, ...]]: ...

    @property
    def pack(self) -> Callable[..., bytes]: ...


class BitCodec:
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


def is_dummy(index: int) -> bool:
    """Whether an entry of a mapping is a gap: a data type in the place of an object."""
    return index < objects.DEVICE_TYPE


def bit_length(entry: Entry) -> int:
    """Length in bits that an entry has in a mapping; a BOOLEAN takes one bit."""
    size = entry.size
    if size is None:
        return 0
    return 1 if FORMAT[entry.data_type] == "?" else size * 8


def compile_mapping(mapped: Sequence[Entry]) -> tuple[tuple[Entry, ...], int, Codec]:
    """The entries that carry values (dummies do not), the PDO's length in bytes, and the codec for the values."""
    real = tuple(entry for entry in mapped if not is_dummy(entry.variable.index))
    bits = [bit_length(entry) for entry in mapped]
    length = (sum(bits) + 7) // 8
    if all(n % 8 == 0 for n in bits):
        text = "".join(
            f"{n // 8}x" if is_dummy(entry.variable.index) else FORMAT[entry.data_type]
            for entry, n in zip(mapped, bits, strict=True)
        )
        return real, length, struct.Struct("<" + text)
    fields: list[tuple[int, int, bool]] = []
    start = 0
    for entry, n in zip(mapped, bits, strict=True):
        if not is_dummy(entry.variable.index):
            fields.append((start, n, FORMAT[entry.data_type].islower()))
        start += n
    return real, length, BitCodec(fields, length)


def compile_encoder(entries: Sequence[Entry], pack: Callable[..., bytes], cob_id: int) -> Callable[[], Frame]:
    """What makes a PDO's frame of the values that the entries have by then; most PDOs carry no more than three."""
    if len(entries) == 1:
        (only,) = entries
        return lambda: new_frame(Frame, (cob_id, pack(only.value), False))
    if len(entries) == 2:
        first, second = entries
        return lambda: new_frame(Frame, (cob_id, pack(first.value, second.value), False))
    if len(entries) == 3:
        first, second, third = entries
        return lambda: new_frame(Frame, (cob_id, pack(first.value, second.value, third.value), False))
    mapped = tuple(entries)
    return lambda: Frame(cob_id, pack(*[entry.value for entry in mapped]))
