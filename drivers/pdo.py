"""PDO mapping: which objects a PDO carries, and the codec that follows from it."""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from drivers.object_dictionary import FORMAT, DataType, size_of

PDO_COB_ID_INVALID: Final = 1 << 31
"""Bit 31 of a PDO's COB-ID entry: the PDO does not exist (CiA 301, 7.5.2.35)."""
PDO_COB_ID_NO_RTR: Final = 1 << 30
"""Bit 30: no remote request is allowed on this PDO."""
PDO_MAX_ENTRIES: Final = 8
SYNCHRONOUS_EVERY_SYNC: Final = 1
TPDO_BASE: Final = (0x180, 0x280, 0x380, 0x480)
RPDO_BASE: Final = (0x200, 0x300, 0x400, 0x500)


@dataclass(frozen=True, slots=True)
class MappingEntry:
    """One mapped object: index, sub-index and length in bits, as 1600h and 1A00h hold them."""

    index: int
    subindex: int
    bit_length: int

    @property
    def word(self) -> int:
        """The entry as the UNSIGNED32 that goes into the mapping object."""
        return self.index << 16 | self.subindex << 8 | self.bit_length

    @classmethod
    def from_word(cls, word: int) -> "MappingEntry":
        """The entry that a mapping object's UNSIGNED32 means."""
        return cls(word >> 16, word >> 8 & 0xFF, word & 0xFF)


class PdoLayout:
    """Packs and unpacks one PDO whose mapped objects have these types, in order."""

    __slots__ = ("codec", "length", "pack", "unpack_from")

    def __init__(self, types: Sequence[DataType]) -> None:
        if any(size_of(t) is None for t in types):
            raise ValueError("a PDO maps types of fixed length only")
        self.codec = struct.Struct("<" + "".join(FORMAT[t] for t in types))
        self.length = self.codec.size
        if self.length > 8:
            raise ValueError(f"a PDO carries 8 bytes at most, these objects take {self.length}")
        self.pack = self.codec.pack
        self.unpack_from = self.codec.unpack_from
