"""The object dictionary as a description: which objects there are, their types, access and limits, and their codecs.

Values live elsewhere (in the emulated drive); this module says what they may be and how they look on the bus.
"""

import struct
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from enum import Enum, IntEnum
from typing import Final

Value = int | float | bytes


class DataType(IntEnum):
    """CiA 301 data type indices."""

    BOOLEAN = 0x01
    INTEGER8 = 0x02
    INTEGER16 = 0x03
    INTEGER32 = 0x04
    UNSIGNED8 = 0x05
    UNSIGNED16 = 0x06
    UNSIGNED32 = 0x07
    REAL32 = 0x08
    VISIBLE_STRING = 0x09
    OCTET_STRING = 0x0A
    DOMAIN = 0x0F
    REAL64 = 0x11
    INTEGER64 = 0x15
    UNSIGNED64 = 0x1B


FORMAT: Final[Mapping[DataType, str]] = {
    DataType.BOOLEAN: "?",
    DataType.INTEGER8: "b",
    DataType.INTEGER16: "h",
    DataType.INTEGER32: "i",
    DataType.UNSIGNED8: "B",
    DataType.UNSIGNED16: "H",
    DataType.UNSIGNED32: "I",
    DataType.REAL32: "f",
    DataType.REAL64: "d",
    DataType.INTEGER64: "q",
    DataType.UNSIGNED64: "Q",
}
"""struct format characters of the types of fixed length; little-endian and unpadded on the bus."""

_CODEC: Final = {data_type: struct.Struct("<" + character) for data_type, character in FORMAT.items()}


class Access(Enum):
    """Access attribute of an object, with the EDS spelling as its value."""

    READ_ONLY = "ro"
    WRITE_ONLY = "wo"
    READ_WRITE = "rw"
    READ_WRITE_PROCESS_INPUT = "rwr"
    READ_WRITE_PROCESS_OUTPUT = "rww"
    CONSTANT = "const"

    @property
    def is_readable(self) -> bool:
        """Whether an SDO client may read the object."""
        return self is not Access.WRITE_ONLY

    @property
    def is_writable(self) -> bool:
        """Whether an SDO client may write the object."""
        return self not in {Access.READ_ONLY, Access.CONSTANT}


class ObjectCode(IntEnum):
    """CiA 301 object codes that are used here."""

    DOMAIN = 0x02
    VARIABLE = 0x07
    ARRAY = 0x08
    RECORD = 0x09


def size_of(data_type: DataType) -> int | None:
    """Bytes of a value of this type on the bus, None where the type has no fixed length."""
    codec = _CODEC.get(data_type)
    return codec.size if codec else None


def encode(data_type: DataType, value: Value) -> bytes:
    """``value`` as little-endian bytes; raises ``struct.error`` if it does not fit the type."""
    codec = _CODEC.get(data_type)
    if codec is None:
        if not isinstance(value, bytes):
            raise struct.error(f"{data_type.name} takes bytes, not {type(value).__name__}")
        return value
    return codec.pack(value)


def decode(data_type: DataType, data: bytes) -> Value:
    """Value of ``data``; raises ``struct.error`` if the length is not the type's."""
    codec = _CODEC.get(data_type)
    return data if codec is None else codec.unpack(data)[0]


@dataclass(frozen=True, slots=True)
class Variable:
    """One entry that SDO or PDO can reach: an object of code VAR, or one sub-index of an array or record."""

    index: int
    subindex: int
    name: str
    data_type: DataType
    access: Access
    default: Value = 0
    low_limit: int | float | None = None
    high_limit: int | float | None = None
    is_pdo_mappable: bool = False

    @property
    def size(self) -> int | None:
        """Bytes on the bus, None for strings and domains."""
        return size_of(self.data_type)


class ObjectDictionary:
    """What objects a device has. Immutable after construction."""

    __slots__ = ("_codes", "_names", "_variables")

    def __init__(
        self, variables: Iterable[Variable], codes: Mapping[int, ObjectCode], names: Mapping[int, str] | None = None
    ) -> None:
        self._variables = {(v.index, v.subindex): v for v in variables}
        self._codes = dict(codes)
        self._names = dict(names or {})

    def __contains__(self, index: int) -> bool:
        return index in self._codes

    def __iter__(self) -> Iterator[Variable]:
        return iter(self._variables.values())

    def __len__(self) -> int:
        return len(self._variables)

    def get(self, index: int, subindex: int) -> Variable | None:
        """The variable at this place, or None."""
        return self._variables.get((index, subindex))

    def object_code(self, index: int) -> ObjectCode:
        """VAR, ARRAY, RECORD or DOMAIN; raises KeyError for an index that does not exist."""
        return self._codes[index]

    def name(self, index: int) -> str:
        """Name of the object as the EDS gives it."""
        return self._names.get(index, "")
