"""Reads an EDS file (CiA 306) into an object dictionary; the parsing itself is that of the ``canopen`` package."""

import configparser
import io
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

import canopen
from canopen.objectdictionary import ODArray, ODVariable

from drivers.errors import EdsError
from drivers.nmt import MAX_NODE_ID
from drivers.object_dictionary import (
    Access,
    DataType,
    ObjectCode,
    ObjectDictionary,
    Value,
    Variable,
    encode,
    size_of,
)

MAX_EDS_BYTES: Final = 4 << 20

_SIGNED: Final = frozenset({DataType.INTEGER8, DataType.INTEGER16, DataType.INTEGER32, DataType.INTEGER64})
_FLOATS: Final = frozenset({DataType.REAL32, DataType.REAL64})
_PARSE_ERRORS: Final = (configparser.Error, ValueError, KeyError, TypeError, AttributeError, IndexError, OverflowError)
"""What ``canopen.import_od`` is known to let through on a file that is no EDS, or a damaged one."""


class _NamedText(io.StringIO):
    """Text that tells ``canopen.import_od`` its format, which that function takes from a file name."""

    name = "dictionary.eds"


def load_eds(path: Path | str, node_id: int) -> ObjectDictionary:
    """The object dictionary that the EDS file at ``path`` describes, ``$NODEID`` being ``node_id``.

    Limits, access, default values and the PDO mapping flag are taken over. Dummy types that the file allows
    (``DummyUsage``) become variables at their data type's index. A data type that this project has no codec for is
    taken as DOMAIN, so as bytes.

    Raises:
        EdsError: the file is missing, too large, no EDS, or contradicts itself; one sentence with the file's name.
        ValueError: ``node_id`` is not 1 to 127.
    """
    return describe_any_node(path)(node_id)


def describe_any_node(
    path: Path | str, change: Callable[[str], str] | None = None
) -> Callable[[int], ObjectDictionary]:
    """Read the EDS file at ``path`` once, to make of it the object dictionary of any node id, as ``load_eds`` does.

    ``change`` makes the text of another EDS of the file's. What is given raises as ``load_eds`` does. Raises EdsError
    if the file cannot be read or changed.
    """
    text = read_eds_text(path)
    if change is not None:
        try:
            text = change(text)
        except _PARSE_ERRORS as error:
            raise EdsError(f"{path}: not a readable EDS file: {' '.join(str(error).split())}") from None
    return lambda node_id: _describe(path, text, node_id)


def read_eds_text(path: Path | str) -> str:
    """The text of an EDS file. Raises EdsError: it is missing, too large or no EDS; one sentence with its name."""
    text = _read(Path(path))
    if "[DeviceInfo]" not in text:
        raise EdsError(f"{path}: not an EDS file: it has no section DeviceInfo")
    return text


def _describe(path: Path | str, text: str, node_id: int) -> ObjectDictionary:
    if not 1 <= node_id <= MAX_NODE_ID:
        raise ValueError(f"node_id must be 1 to {MAX_NODE_ID}, not {node_id}")
    try:
        parsed: Any = canopen.import_od(_NamedText(text), node_id)
        variables = [_convert(variable) for variable in _each_variable(parsed)]
        codes = {index: _object_code(parsed[index]) for index in parsed}
        names = {index: str(parsed[index].name) for index in parsed}
    except _PARSE_ERRORS as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise EdsError(f"{path}: not a readable EDS file: {reason}") from None
    if not variables:
        raise EdsError(f"{path}: not an EDS file: it describes no object")
    return ObjectDictionary(variables, codes, names)


def _read(path: Path) -> str:
    try:
        with path.open("rb") as file:
            raw = file.read(MAX_EDS_BYTES + 1)
    except OSError as error:
        raise EdsError(f"{path}: cannot be read: {error.strerror or error}") from None
    if len(raw) > MAX_EDS_BYTES:
        raise EdsError(f"{path}: larger than {MAX_EDS_BYTES} bytes, which no EDS file is")
    if b"\0" in raw:
        raise EdsError(f"{path}: not an EDS file: it is not text")
    # CiA 306 says ASCII; vendors write their umlauts in it all the same.
    return raw.decode("utf-8-sig", errors="replace")


def _each_variable(parsed: Any) -> Iterator[Any]:
    for index in parsed:
        entry = parsed[index]
        if isinstance(entry, ODVariable):
            yield entry
        else:
            yield from entry.subindices.values()


def _object_code(entry: Any) -> ObjectCode:
    if isinstance(entry, ODVariable):
        return ObjectCode.DOMAIN if entry.data_type == DataType.DOMAIN else ObjectCode.VARIABLE
    return ObjectCode.ARRAY if isinstance(entry, ODArray) else ObjectCode.RECORD


def _convert(source: Any) -> Variable:
    place = f"{source.index:04X}h:{source.subindex:02X}"
    try:
        data_type = DataType(source.data_type or 0)
    except ValueError:
        data_type = DataType.DOMAIN
    try:
        access = Access(source.access_type)
    except ValueError:
        raise ValueError(f"object {place} has the unknown access type {source.access_type!r}") from None
    default = _default(source, data_type, place)
    return Variable(
        index=source.index,
        subindex=source.subindex,
        name=str(source.name),
        data_type=data_type,
        access=access,
        default=default,
        low_limit=source.min,
        high_limit=source.max,
        # A dummy entry stands for nothing but its length, and is there to be mapped.
        is_pdo_mappable=bool(source.pdo_mappable) or source.index in FIXED_LENGTH_TYPES,
    )


FIXED_LENGTH_TYPES: Final = frozenset(data_type for data_type in DataType if size_of(data_type) is not None)
"""Data types that a dummy entry may have; a dummy entry's index is its data type (CiA 301, 7.4.7.1)."""


def _default(source: Any, data_type: DataType, place: str) -> Value:
    given: Any = source.default
    size = size_of(data_type)
    if size is None:
        if isinstance(given, str):
            return given.encode("ascii", errors="replace")
        return given if isinstance(given, bytes) else b""
    if given is None or isinstance(given, (str, bytes)):
        written = getattr(source, "default_raw", None)
        if written:
            raise ValueError(f"object {place} has the default value {written!r}, which is no number")
        return 0
    value = float(given) if data_type in _FLOATS else int(given)
    if data_type in _SIGNED and isinstance(value, int) and value >= 1 << (8 * size - 1):
        # CiA 306 allows a negative number to be written as its two's complement.
        value -= 1 << (8 * size)
    try:
        encode(data_type, value)
    except struct.error:
        raise ValueError(f"object {place}: its default value {given} does not fit {data_type.name}") from None
    return value
