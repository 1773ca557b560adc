"""Several logical axes in one node (CiA 402-1): where an axis has its objects and PDOs, and the EDS of such a node.

Axis n has the profile objects of the first one 800h (n - 1) further on, its PDOs 64 (n - 1) numbers further on, and,
as this drive has it, its manufacturer's objects 100h (n - 1) further on.
"""

import configparser
import io
import re
from collections.abc import Iterator
from typing import Final

from drivers import objects
from drivers.pdo import MappingEntry

MAX_AXES: Final = 8
"""As many as there are profile areas between 6000h and 9FFFh."""
PDO_STEP: Final = 64
"""PDO numbers that an axis has for itself."""

_PROFILE_STEP: Final = 0x800
_MANUFACTURER_STEP: Final = 0x100
_PROFILE: Final = objects.STANDARDISED_PROFILE_AREA
_MANUFACTURER: Final = range(objects.PROFILE_SLOT, objects.PROFILE_SLOT + MAX_AXES * _MANUFACTURER_STEP)
_PDO_KINDS: Final = (
    objects.RPDO_COMMUNICATION,
    objects.RPDO_MAPPING,
    objects.TPDO_COMMUNICATION,
    objects.TPDO_MAPPING,
)
_PDO_MAPPINGS: Final = (objects.RPDO_MAPPING, objects.TPDO_MAPPING)
_SEVERAL_AXES: Final = 0xFFFF0000
"""Additional information of 1000h: a multiple device module."""
_PROFILE_NUMBER: Final = 0xFFFF
_NO_PDO: Final = "0x80000000"
"""CiA 301 predefines COB-IDs of the first four PDOs alone."""
_COB_ID: Final = 1
_OBJECT_LISTS: Final = {"MandatoryObjects", "OptionalObjects", "ManufacturerObjects"}
_SECTION: Final = re.compile(r"([0-9A-F]{4})((?:sub[0-9A-F]{1,2})?)")


def of_axis(index: int, number: int) -> int:
    """Where axis ``number`` (1 to 8) has the object that the first one has at ``index``; the node's own stay."""
    if index in _PROFILE:
        return index + _PROFILE_STEP * (number - 1)
    if index in range(_MANUFACTURER.start, _MANUFACTURER.start + _MANUFACTURER_STEP) and index != objects.TIME_OF_DAY:
        return index + _MANUFACTURER_STEP * (number - 1)
    return index


def in_first_axis(index: int) -> int:
    """Where the first axis has the object that some axis has at ``index``."""
    if index in _PROFILE:
        return _PROFILE.start + (index - _PROFILE.start) % _PROFILE_STEP
    if index in _MANUFACTURER:
        return _MANUFACTURER.start + (index - _MANUFACTURER.start) % _MANUFACTURER_STEP
    return index


def eds_of_axes(text: str, axes: int) -> str:
    """The EDS of a node of ``axes`` logical axes (1 to 8), each like that of the node that the EDS ``text`` describes.

    PDOs of further axes carry the axis' own objects, and are not valid until they are given a COB-ID.
    """
    if axes == 1:
        return text
    source = configparser.ConfigParser(interpolation=None, delimiters=("=",), comment_prefixes=(";",))
    source.optionxform = str  # type: ignore[method-assign,assignment]
    source.read_string(text)
    device_type = source[f"{objects.DEVICE_TYPE:04X}"]
    made = configparser.ConfigParser(interpolation=None, delimiters=("=",))
    made.optionxform = str  # type: ignore[method-assign,assignment]
    for name in source.sections():
        if name not in _OBJECT_LISTS:
            made[name] = dict(source[name])
            continue
        indices = sorted({index for value in _listed(source[name]) for index in _indices(value, axes)})
        listed = {str(place): f"0x{index:04X}" for place, index in enumerate(indices, start=1)}
        made[name] = {"SupportedObjects": str(len(indices)), **listed}
    made[f"{objects.DEVICE_TYPE:04X}"]["DefaultValue"] = (
        f"0x{_SEVERAL_AXES | int(device_type['DefaultValue'], 0) & _PROFILE_NUMBER:08X}"
    )
    for kind in ("NrOfRXPDO", "NrOfTXPDO"):
        made["DeviceInfo"][kind] = str(int(source["DeviceInfo"][kind]) * axes)
    for number in range(2, axes + 1):
        for name in source.sections():
            match = _SECTION.fullmatch(name)
            if match is not None and (index := int(match[1], 16)) != _place_of(index, number):
                made[f"{_place_of(index, number):04X}{match[2]}"] = _section_of(source[name], index, match[2], number)
    written = io.StringIO()
    made.write(written, space_around_delimiters=False)
    return written.getvalue()


def _listed(section: configparser.SectionProxy) -> Iterator[int]:
    return (int(value, 0) for key, value in section.items() if key.isdecimal())


def _indices(index: int, axes: int) -> set[int]:
    return {_place_of(index, number) for number in range(1, axes + 1)}


def _pdo_kind(index: int) -> int | None:
    return next((first for first in _PDO_KINDS if first <= index < first + PDO_STEP), None)


def _place_of(index: int, number: int) -> int:
    """As ``of_axis``, for the objects of PDOs too."""
    return of_axis(index, number) if _pdo_kind(index) is None else index + PDO_STEP * (number - 1)


def _section_of(section: configparser.SectionProxy, index: int, sub: str, number: int) -> dict[str, str]:
    """The section of axis ``number`` that corresponds to one of the first axis."""
    made = dict(section)
    made["ParameterName"] = f"Axis {number} {section['ParameterName']}"
    kind = _pdo_kind(index)
    subindex = int(sub.removeprefix("sub") or "0", 16)
    if kind in _PDO_MAPPINGS and subindex:
        word = MappingEntry.from_word(int(section["DefaultValue"], 0))
        moved = MappingEntry(of_axis(word.index, number), word.subindex, word.bit_length)
        made["DefaultValue"] = f"0x{moved.word:08X}"
    elif kind is not None and kind not in _PDO_MAPPINGS and subindex == _COB_ID:
        made["DefaultValue"] = _NO_PDO
    return made
