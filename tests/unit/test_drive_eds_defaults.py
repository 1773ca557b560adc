"""The EDS and the drive tell the same, entry by entry: by SDO after a reset, the file being read by no code of ours."""

import configparser
import re
import struct
from pathlib import Path

import pytest
from drive_bench import Bench

EDS = Path(__file__).resolve().parents[2] / "config" / "eds" / "sim_drive.eds"
NODE = 5
NO_DATA, NO_SUBINDEX, NO_OBJECT, WRITE_ONLY = 0x08000024, 0x06090011, 0x06020000, 0x06010001
FORMATS = {1: "?", 2: "b", 3: "h", 4: "i", 5: "B", 6: "H", 7: "I", 8: "f"}
VISIBLE_STRING, DOMAIN = 9, 15

LIVE = {
    # Switch on disabled, voltage enabled, remote: what the state machine has come to by itself.
    (0x6041, 0): struct.pack("<H", 0x0250),
}
Place = tuple[int, int]


def read_eds() -> dict[Place, configparser.SectionProxy]:
    parser = configparser.ConfigParser(interpolation=None)
    parser.optionxform = str  # pyright: ignore[reportAttributeAccessIssue]
    parser.read(EDS)
    entries: dict[Place, configparser.SectionProxy] = {}
    for name in parser.sections():
        match = re.fullmatch(r"([0-9A-F]{4})(?:sub([0-9A-F]{1,2}))?", name)
        if match is not None and "DataType" in parser[name]:
            entries[int(match[1], 16), int(match[2] or "0", 16)] = parser[name]
    return entries


ENTRIES = read_eds()


def default(entry: configparser.SectionProxy) -> bytes:
    """Its bytes on the bus."""
    data_type = int(entry["DataType"], 0)
    text = entry.get("DefaultValue", "0")
    if data_type == VISIBLE_STRING:
        return text.encode()
    parts = [NODE if part.strip() == "$NODEID" else int(part, 0) for part in text.split("+")]
    return struct.pack("<" + FORMATS[data_type], sum(parts))


def upload(bench: Bench, place: Place) -> bytes | int:
    """Bytes of an upload, or its abort code."""
    answer = bytes.fromhex(bench.sdo("40" + struct.pack("<HBI", *place, 0).hex()))
    assert answer[1:4] == struct.pack("<HB", *place)
    if answer[0] == 0x80:
        return int.from_bytes(answer[4:], "little")
    if answer[0] & 0x02:
        return answer[4 : 8 - (answer[0] >> 2 & 3)]
    data = b""
    for number in range(10_000):
        segment = bytes.fromhex(bench.sdo(("60", "70")[number % 2] + "00" * 7))
        data += segment[1 : 8 - (segment[0] >> 1 & 7)]
        if segment[0] & 1:
            return data
    raise AssertionError("the upload does not end")


def differences(bench: Bench) -> list[str]:
    wrong: list[str] = []
    for place, entry in ENTRIES.items():
        expected: bytes | int
        if entry["AccessType"] == "wo":
            expected = WRITE_ONLY
        elif int(entry["DataType"], 0) == DOMAIN or (place[0] == 0x1003 and place[1]):
            expected = NO_DATA
        else:
            expected = LIVE.get(place, default(entry))
        answer = upload(bench, place)
        if answer != expected:
            wrong.append(f"{place[0]:04X}h:{place[1]:02X} {entry['ParameterName']}: {answer!r}, not {expected!r}")
    return wrong


def test_there_is_something_to_compare():
    assert len(ENTRIES) > 250
    assert default(ENTRIES[0x1800, 1]) == bytes.fromhex("85010040")
    assert default(ENTRIES[0x60C2, 2]) == b"\xfd"


def test_every_default_is_what_the_drive_answers_after_power_on():
    bench = Bench()
    assert differences(bench) == []


@pytest.mark.parametrize("command", [0x81, 0x82])
def test_every_default_is_what_the_drive_answers_after_a_reset(command: int):
    """After writing something else wherever that goes."""
    bench = Bench()
    written = 0
    for (index, subindex), entry in ENTRIES.items():
        data_type = int(entry["DataType"], 0)
        if "w" not in entry["AccessType"] or data_type not in FORMATS or index in (0x1010, 0x1011):
            continue
        if command == 0x82 and index >= 0x2000:
            continue
        value = int.from_bytes(default(entry), "little")
        size = struct.calcsize(FORMATS[data_type])
        written += any(
            bench.write(index, subindex, other, size) == 0 for other in (value ^ 1, value + 1, 2, 0x80000000)
        )
    assert written > 40
    assert len(differences(bench)) > 40
    bench.nmt(command)
    bench.tick()
    bench.tick()
    assert differences(bench) == []


def test_every_subindex_that_is_not_there_is_refused_as_such():
    bench = Bench()
    wrong: list[str] = []
    for index in sorted({index for index, _ in ENTRIES}):
        for subindex in range(256):
            if (index, subindex) not in ENTRIES:
                answer = upload(bench, (index, subindex))
                if answer != NO_SUBINDEX:
                    wrong.append(f"{index:04X}h:{subindex:02X}: {answer!r}")
                if bench.write(index, subindex, 0, 1) != NO_SUBINDEX:
                    wrong.append(f"{index:04X}h:{subindex:02X} is written")
    assert wrong == []


def test_every_object_that_is_not_there_is_refused_as_such():
    bench = Bench()
    there = {index for index, _ in ENTRIES}
    for index in [*range(0x1200), 0x1A04, 0x1F80, 0x2000, 0x3004, 0x5FFF, 0x6000, 0x9FFF, 0xFFFF]:
        if index not in there:
            assert upload(bench, (index, 0)) == NO_OBJECT, f"{index:04X}h"


def test_highest_subindex_is_the_highest_subindex():
    for index in sorted({index for index, subindex in ENTRIES if subindex}):
        highest = max(subindex for other, subindex in ENTRIES if other == index)
        # The error history and the mappings tell how much of them is in use instead.
        if index != 0x1003 and index >> 8 not in (0x16, 0x1A):
            assert int(ENTRIES[index, 0]["DefaultValue"], 0) == highest, f"{index:04X}h"
