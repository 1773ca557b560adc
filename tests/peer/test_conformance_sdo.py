"""Conformance of the emulated drive's SDO server (CiA 301, 7.2.4), rows 4 to 10: every byte written out by hand."""

import binascii

import pytest
from conformance_bench import Bus

TOGGLE = 0x05030000
TIMED_OUT = 0x05040000
UNKNOWN_COMMAND = 0x05040001
INVALID_BLOCK_SIZE = 0x05040002
INVALID_SEQUENCE_NUMBER = 0x05040003
CRC_ERROR = 0x05040004
WRITE_ONLY = 0x06010001
READ_ONLY = 0x06010002
NO_OBJECT = 0x06020000
WRONG_LENGTH = 0x06070010
TOO_LONG = 0x06070012
TOO_SHORT = 0x06070013
NO_SUBINDEX = 0x06090011
RANGE = 0x06090030
TOO_HIGH = 0x06090031
TOO_LOW = 0x06090032

DEVICE_TYPE = ("4000100000000000", "4300100092010200")


@pytest.fixture
def bus() -> Bus:
    return Bus()


def code_of(answer: str) -> int:
    assert answer[:2] == "80", answer
    return int.from_bytes(bytes.fromhex(answer[8:]), "little")


def is_alive(bus: Bus) -> bool:
    return bus.sdo(DEVICE_TYPE[0]) == DEVICE_TYPE[1]


# What a server may be in the midst of, and the answers on the way there.
MIDST = {
    "nothing": [],
    "segmented upload": [("4008100000000000", "4108100009000000")],
    "segmented download": [
        ("2100300109000000", "6000300100000000"),
        ("0031323334353637", "2000000000000000"),
    ],
    "block upload": [
        ("2100300109000000", "6000300100000000"),
        ("0031323334353637", "2000000000000000"),
        ("1B38390000000000", "3000000000000000"),
        ("A40030017F000000", "C600300109000000"),
    ],
}


# -- row 4 -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("midst", MIDST)
@pytest.mark.parametrize("command", ["E0", "E1", "F7", "FF"])
def test_row_04_unknown_command_specifier_is_refused_at_any_time(bus: Bus, midst: str, command: str):
    for request, answer in MIDST[midst]:
        assert bus.sdo(request) == answer
    answer = bus.sdo(command + "00100000000000")
    assert code_of(answer) == UNKNOWN_COMMAND
    assert is_alive(bus)
    # The transfer under way is over: none of the services that go on with one is served.
    assert code_of(bus.sdo("6000000000000000")) == UNKNOWN_COMMAND
    assert code_of(bus.sdo("0000000000000000")) == UNKNOWN_COMMAND


@pytest.mark.parametrize(
    "request_", ["0031323334353637", "6000000000000000", "A27F7F0000000000", "A300000000000000", "C1C4310000000000"]
)
def test_row_04_and_08_a_service_without_its_initiate_is_unknown(bus: Bus, request_: str):
    assert code_of(bus.sdo(request_)) == UNKNOWN_COMMAND
    assert is_alive(bus)


# -- row 5 -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("place", "code"),
    [
        ("092000", NO_OBJECT),
        ("FF5F00", NO_OBJECT),
        ("FFFF00", NO_OBJECT),
        ("050000", NO_OBJECT),  # the type UNSIGNED8: a dummy for RPDO mappings, no object to a client
        ("000000", NO_OBJECT),
        ("001001", NO_SUBINDEX),  # 1000h is a VAR
        ("416001", NO_SUBINDEX),  # so is 6041h
        ("4160FF", NO_SUBINDEX),
        ("171001", NO_SUBINDEX),
        ("181005", NO_SUBINDEX),  # 1018h is a record of 4
        ("001404", NO_SUBINDEX),  # 1400h:04 is reserved, between entries that are there
        ("7D6003", NO_SUBINDEX),  # 607Dh is an array of 2
    ],
)
@pytest.mark.parametrize(
    "form",
    ["40{}00000000", "23{}00000000", "2F{}00000000", "21{}04000000", "20{}00000000", "A4{}7F000000", "C6{}04000000"]
)  # fmt: skip
def test_row_05_existence_of_index_and_subindex(bus: Bus, place: str, code: int, form: str):
    assert bus.abort(form.format(place)) == code
    assert is_alive(bus)


# -- row 6 -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("place", ["001000", "416000", "646000", "181001", "081000", "026500"])
@pytest.mark.parametrize(
    "form",
    ["23{}00000000", "2F{}00000000", "22{}00000000", "21{}04000000", "20{}00000000", "C6{}04000000", "C0{}00000000"]
)  # fmt: skip
def test_row_06_read_only_is_refused_at_the_initiate(bus: Bus, place: str, form: str):
    """Of all three transfers; before a word about the length."""
    assert bus.abort(form.format(place)) == READ_ONLY
    assert is_alive(bus)


@pytest.mark.parametrize("place", ["C46005", "C46006"])
@pytest.mark.parametrize("form", ["40{}00000000", "A4{}7F000000"])
def test_row_06_write_only_is_refused_at_the_initiate(bus: Bus, place: str, form: str):
    """60C4h:05 and :06, size of data record and buffer clear, are write only."""
    assert bus.abort(form.format(place)) == WRITE_ONLY
    assert is_alive(bus)


# -- row 7 -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("request_", "code"),
    [
        ("2F17100064000000", TOO_SHORT),  # 1 byte for an UNSIGNED16
        ("2717100064000000", TOO_LONG),  # 3
        ("2317100064000000", TOO_LONG),  # 4
        ("2B60600008000000", TOO_LONG),  # 2 for an INTEGER8
        ("2B7A600008000000", TOO_SHORT),  # 2 for an INTEGER32
        ("277A600008000000", TOO_SHORT),
        ("2117100001000000", TOO_SHORT),  # declared by a segmented initiate
        ("2117100003000000", TOO_LONG),
        ("21171000FFFFFFFF", TOO_LONG),
        ("2117100000000000", TOO_SHORT),
        ("C217100001000000", TOO_SHORT),  # and by that of a block download
        ("C217100003000000", TOO_LONG),
    ],
)
def test_row_07_length_declared_and_wrong(bus: Bus, request_: str, code: int):
    bus.done("2B171000E8030000")
    assert bus.abort(request_) in {code, WRONG_LENGTH}
    assert bus.sdo("4017100000000000") == "4B171000E8030000"


@pytest.mark.parametrize(
    ("requests", "code"),
    [
        (["2117100002000000", "0D64000000000000"], {TOO_SHORT, WRONG_LENGTH}),  # declared 2, received 1
        (["2117100002000000", "0964000000000000"], {TOO_LONG, WRONG_LENGTH}),  # declared 2, received 3
        (["2017100000000000", "0D64000000000000"], {TOO_SHORT, WRONG_LENGTH}),  # nothing declared
        (["2017100000000000", "0964000000000000"], {TOO_LONG, WRONG_LENGTH}),
    ],
)
def test_row_07_length_received_and_wrong(bus: Bus, requests: list[str], code: set[int]):
    bus.done("2B171000E8030000")
    assert bus.sdo(requests[0]) == "6017100000000000"
    assert bus.abort_of_transfer(requests[1], "171000") in code
    assert bus.sdo("4017100000000000") == "4B171000E8030000"


def test_row_07_expedited_without_a_size_takes_the_objects_own(bus: Bus):
    # e = 1, s = 0: what lies behind the object's own bytes is not looked at.
    assert bus.sdo("22171000E803A5A5") == "6017100000000000"
    assert bus.sdo("4017100000000000") == "4B171000E8030000"
    assert bus.sdo("227A600078563412") == "607A600000000000"
    assert bus.sdo("407A600000000000") == "437A600078563412"
    assert bus.sdo("22606000085A5A5A") == "6060600000000000"
    assert bus.sdo("4060600000000000") == "4F60600008000000"


def test_row_07_the_right_length_is_taken_in_every_form(bus: Bus):
    assert bus.sdo("2117100002000000") == "6017100000000000"
    assert bus.sdo("0BE8030000000000") == "2000000000000000"
    assert bus.sdo("4017100000000000") == "4B171000E8030000"
    assert bus.sdo("2017100000000000") == "6017100000000000"
    assert bus.sdo("0BF4010000000000") == "2000000000000000"
    assert bus.sdo("4017100000000000") == "4B171000F4010000"


# -- row 8 -------------------------------------------------------------------------------------------------------------


def test_row_08_toggle_of_the_first_and_of_later_download_segments(bus: Bus):
    for segments, wrong in (([], "1031323334353637"), (["0031323334353637"], "0138393A3B3C3D3E")):
        assert bus.sdo("2100300115000000") == "6000300100000000"
        for segment in segments:
            assert bus.sdo(segment) == "2000000000000000"
        assert bus.abort_of_transfer(wrong, "003001") == TOGGLE
        assert code_of(bus.sdo("1031323334353637")) == UNKNOWN_COMMAND
        assert is_alive(bus)


def test_row_08_toggle_of_upload_segments(bus: Bus):
    assert bus.sdo("4008100000000000") == "4108100009000000"
    assert bus.abort_of_transfer("7000000000000000", "081000") == TOGGLE
    assert bus.sdo("4008100000000000") == "4108100009000000"
    assert bus.sdo("6000000000000000") == "0073696D2D647269"  # "sim-dri"
    assert bus.abort_of_transfer("6000000000000000", "081000") == TOGGLE
    assert bus.sdo("4008100000000000") == "4108100009000000"
    assert bus.sdo("6000000000000000") == "0073696D2D647269"
    assert bus.sdo("7000000000000000") == "1B76650000000000"  # "ve", 5 bytes unused, last


@pytest.mark.parametrize("midst", [name for name in MIDST if name != "nothing"])
def test_row_08_a_new_initiate_cancels_what_was_under_way(bus: Bus, midst: str):
    for request, answer in MIDST[midst]:
        assert bus.sdo(request) == answer
    assert is_alive(bus)
    assert code_of(bus.sdo("1B38390000000000")) == UNKNOWN_COMMAND
    assert code_of(bus.sdo("6000000000000000")) == UNKNOWN_COMMAND
    assert bus.sdo("2100300102000000") == "6000300100000000"
    assert bus.sdo("0BA1A20000000000") == "2000000000000000"
    assert bus.sdo("4000300100000000") == "4B003001A1A20000"


@pytest.mark.parametrize("midst", MIDST)
def test_row_08_a_clients_abort_frees_the_server_without_an_answer(bus: Bus, midst: str):
    for request, answer in MIDST[midst]:
        assert bus.sdo(request) == answer
    assert bus.sdo("8000300100000408") == ""
    assert code_of(bus.sdo("6000000000000000")) == UNKNOWN_COMMAND
    assert is_alive(bus)


def test_row_08_a_stalled_transfer_is_aborted_by_the_servers_timer(bus: Bus):
    for name, steps in MIDST.items():
        for request, answer in steps:
            assert bus.sdo(request) == answer
        sent = bus.run(10_000)
        place = "081000" if name == "segmented upload" else "003001"
        assert sent == ([] if name == "nothing" else [f"585#80{place}00000405"]), name
        assert is_alive(bus)
    assert bus.sdo("C600300109000000")[:8] == "A4003001"
    assert bus.sdo("0131323334353637") == ""
    # It may help the client on by an acknowledgement before it gives up.
    sent = bus.run(10_000)
    assert sent[-1] == "585#8000300100000405"
    assert set(sent[:-1]) <= {"585#A2017F0000000000"}
    assert is_alive(bus)


def test_row_08_a_transfer_that_goes_on_slowly_is_not_aborted(bus: Bus):
    assert bus.sdo("210030010E000000") == "6000300100000000"
    assert bus.run(500) == []
    assert bus.sdo("0031323334353637") == "2000000000000000"
    assert bus.run(500) == []
    assert bus.sdo("1138393A3B3C3D3E") == "3000000000000000"


# -- row 9 -------------------------------------------------------------------------------------------------------------

# "123456789" in blocks: its CRC-16 (CCITT, from 0) is 31C3h, as every table of check values has it.
NINE_SEGMENTS = ("0131323334353637", "8238390000000000")
NINE_END = "D5C3310000000000"  # 5 bytes of the last segment are padding
NINE_STARTED = "A40030017F000000"
ENDED = "A100000000000000"


def round_trip(bus: Bus) -> None:
    """A whole block download, read back by a segmented upload and by a block upload."""
    assert bus.sdo("C600300109000000") == NINE_STARTED
    assert bus.sdo(NINE_SEGMENTS[0]) == ""
    assert bus.sdo(NINE_SEGMENTS[1]) == "A2027F0000000000"
    assert bus.sdo(NINE_END) == ENDED
    assert bus.sdo("4000300100000000") == "4100300109000000"
    assert bus.sdo("6000000000000000") == "0031323334353637"
    assert bus.sdo("7000000000000000") == "1B38390000000000"
    assert bus.sdo("A40030017F000000") == "C600300109000000"
    assert bus.send("605#A300000000000000") == ["585#0131323334353637", "585#8238390000000000"]
    assert bus.sdo("A2027F0000000000") == "D5C3310000000000"
    assert bus.sdo("A100000000000000") == ""


def test_row_09_block_download_and_upload(bus: Bus):
    round_trip(bus)
    round_trip(bus)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 6, 7])
def test_row_09_padding_of_the_last_segment(bus: Bus, count: int):
    """8 to 14 bytes: of the last segment 1 to 7 are used."""
    data = bytes(range(0x41, 0x48 + count))
    crc = binascii.crc_hqx(data, 0)
    assert bus.sdo(f"C6003001{len(data):02X}000000") == NINE_STARTED
    assert bus.sdo("0141424344454647") == ""
    assert bus.sdo("82" + data[7:].hex().ljust(14, "0")) == "A2027F0000000000"
    assert bus.sdo(f"{0xC1 | (7 - count) << 2:02X}{crc & 0xFF:02X}{crc >> 8:02X}0000000000") == ENDED
    expected = {8: "4100300108000000", 14: "410030010E000000"}
    assert bus.sdo("4000300100000000") == expected.get(len(data), f"41003001{len(data):02X}000000")
    assert bus.sdo("6000000000000000") == "0041424344454647"
    assert bus.sdo("7000000000000000")[2:] == data[7:].hex().upper().ljust(14, "0")


@pytest.mark.parametrize("crc", ["C331", "C431", "0000", "FFFF"])
def test_row_09_wrong_crc(bus: Bus, crc: str):
    assert bus.sdo("C600300109000000") == NINE_STARTED
    bus.sdo(NINE_SEGMENTS[0])
    bus.sdo(NINE_SEGMENTS[1])
    answer = bus.sdo("D5" + crc + "0000000000")
    if crc == "C331":  # the low byte comes first
        assert answer == ENDED
    else:
        assert answer == "8000300104000405"
    round_trip(bus)


def test_row_09_without_crc_none_is_looked_at(bus: Bus):
    assert bus.sdo("C200300109000000") == "A00030017F000000"
    bus.sdo(NINE_SEGMENTS[0])
    assert bus.sdo(NINE_SEGMENTS[1]) == "A2027F0000000000"
    assert bus.sdo("D5FFFF0000000000") == ENDED
    assert bus.sdo("4000300100000000") == "4100300109000000"


def test_row_09_a_lost_segment_is_sent_again(bus: Bus):
    """7 bytes arrive, 7 are lost, 2 arrive and end the sub-block: the last good one is acknowledged."""
    data = b"abcdefgABCDEFGxy"
    crc = binascii.crc_hqx(data, 0)
    assert bus.sdo("C600300110000000") == NINE_STARTED
    assert bus.sdo("0161626364656667") == ""
    assert bus.sdo("8378790000000000") == "A2017F0000000000"
    # From the segment after it, numbered from 1 again.
    assert bus.sdo("0141424344454647") == ""
    assert bus.sdo("8278790000000000") == "A2027F0000000000"
    assert bus.sdo(f"D5{crc & 0xFF:02X}{crc >> 8:02X}0000000000") == ENDED
    assert bus.sdo("4000300100000000") == "4100300110000000"
    assert bus.sdo("6000000000000000") == "0061626364656667"
    assert bus.sdo("7000000000000000") == "1041424344454647"
    assert bus.sdo("6000000000000000") == "0B78790000000000"


def test_row_09_the_first_segment_lost_is_acknowledged_with_0(bus: Bus):
    assert bus.sdo("C600300109000000") == NINE_STARTED
    assert bus.sdo(NINE_SEGMENTS[1]) == "A2007F0000000000"
    assert bus.sdo(NINE_SEGMENTS[0]) == ""
    assert bus.sdo(NINE_SEGMENTS[1]) == "A2027F0000000000"
    assert bus.sdo(NINE_END) == ENDED


def test_row_09_a_full_sub_block_of_127_is_acknowledged(bus: Bus):
    data = bytes(n % 251 for n in range(127 * 7 + 3))
    crc = binascii.crc_hqx(data, 0)
    assert bus.sdo("C60030017C030000") == NINE_STARTED  # 892 bytes
    for number in range(1, 128):
        part = data[7 * number - 7 : 7 * number].hex()
        assert bus.sdo(f"{number:02X}{part}") == ("A27F7F0000000000" if number == 127 else "")
    assert bus.sdo("81" + data[889:].hex() + "00000000") == "A2017F0000000000"
    assert bus.sdo(f"D1{crc & 0xFF:02X}{crc >> 8:02X}0000000000") == ENDED
    # Up again in sub-blocks of 100.
    assert bus.sdo("A400300164000000") == "C60030017C030000"
    frames = bus.send("605#A300000000000000")
    assert [frame[:6] for frame in frames] == [f"585#{n:02X}"[:6] for n in range(1, 101)]
    assert "".join(frame[6:] for frame in frames) == data[:700].hex().upper()
    # 40 of them are said to be good: the rest comes again.
    frames = bus.send("605#A228640000000000")
    assert frames[0] == "585#01" + data[280:287].hex().upper()
    assert [frame[4:6] for frame in frames] == [f"{n:02X}" for n in range(1, 88)] + ["D8"]  # 88th, the last
    assert bus.sdo("A258640000000000") == f"D1{crc & 0xFF:02X}{crc >> 8:02X}0000000000"
    assert bus.sdo("A100000000000000") == ""


@pytest.mark.parametrize("size", ["00", "80", "FF"])
def test_row_09_block_size_is_1_to_127(bus: Bus, size: str):
    round_trip(bus)
    assert bus.abort(f"A4003001{size}000000") == INVALID_BLOCK_SIZE
    round_trip(bus)
    assert bus.sdo("A40030017F000000") == "C600300109000000"
    bus.send("605#A300000000000000")
    assert bus.abort_of_transfer(f"A201{size}0000000000", "003001") == INVALID_BLOCK_SIZE
    round_trip(bus)


def test_row_09_sequence_numbers_that_cannot_be(bus: Bus):
    round_trip(bus)
    # The client acknowledges more than it was sent.
    assert bus.sdo("A40030017F000000") == "C600300109000000"
    assert len(bus.send("605#A300000000000000")) == 2
    assert bus.abort_of_transfer("A2037F0000000000", "003001") == INVALID_SEQUENCE_NUMBER
    round_trip(bus)
    # A segment has a number from 1 on: 00h is not a segment, and 80h within a sub-block an abort.
    assert bus.sdo("C600300109000000") == NINE_STARTED
    assert bus.sdo(NINE_SEGMENTS[0]) == ""
    assert bus.abort_of_transfer("0038390000000000", "003001") == INVALID_SEQUENCE_NUMBER
    round_trip(bus)


def test_row_09_a_round_trip_after_every_abort(bus: Bus):
    assert bus.sdo("C600300109000000") == NINE_STARTED
    assert bus.sdo("8000300100000405") == ""
    round_trip(bus)
    assert bus.sdo("C600300109000000") == NINE_STARTED
    bus.sdo(NINE_SEGMENTS[0])
    assert bus.sdo("8000300100000405") == ""
    round_trip(bus)
    assert bus.sdo("C600300109000000") == NINE_STARTED
    sent = bus.run(10_000)
    assert sent[-1] == "585#8000300100000405"
    round_trip(bus)
    # Declared 10, received 9.
    assert bus.sdo("C60030010A000000") == NINE_STARTED
    bus.sdo(NINE_SEGMENTS[0])
    bus.sdo(NINE_SEGMENTS[1])
    assert bus.abort_of_transfer(NINE_END, "003001") in {TOO_SHORT, WRONG_LENGTH}
    round_trip(bus)


def test_row_09_block_transfer_of_a_number(bus: Bus):
    """607Ah has 4 bytes: no object is too small for it."""
    crc = binascii.crc_hqx(bytes.fromhex("78563412"), 0)
    assert bus.sdo("C67A600004000000") == "A47A60007F000000"
    assert bus.sdo("8178563412000000") == "A2017F0000000000"
    assert bus.sdo(f"CD{crc & 0xFF:02X}{crc >> 8:02X}0000000000") == ENDED
    assert bus.sdo("407A600000000000") == "437A600078563412"
    assert bus.sdo("A47A60007F000000") == "C67A600004000000"
    assert bus.send("605#A300000000000000") == ["585#8178563412000000"]
    assert bus.sdo("A2017F0000000000") == f"CD{crc & 0xFF:02X}{crc >> 8:02X}0000000000"
    assert bus.sdo("A100000000000000") == ""


def test_row_09_protocol_switch_threshold(bus: Bus):
    """At most as long as byte 5 says, and the server answers as to an ordinary upload."""
    assert bus.sdo("A47A60007F040000") == "437A600000000000"
    assert bus.sdo("A47A60007F030000") == "C67A600004000000"
    assert bus.sdo("807A600000000008") == ""
    assert is_alive(bus)


# -- row 10 ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("request_", "codes"),
    [
        ("2B5A600009000000", {RANGE, TOO_HIGH}),  # quick stop option 9 is reserved
        ("2B5A6000FF7F0000", {RANGE, TOO_HIGH}),
        ("2B5E600003800000", {RANGE, TOO_LOW}),
        ("2F03100001000000", {RANGE, TOO_HIGH}),  # the error history takes 0 alone
        ("2F001402F1000000", {RANGE}),  # transmission types 241 to 253 are reserved in an RPDO
        ("2F001402FC000000", {RANGE}),
        ("2F001802F5000000", {RANGE}),
        ("2F19100001000000", {RANGE, TOO_LOW}),  # counter overflow 1 is reserved
        ("2F191000F1000000", {RANGE, TOO_HIGH}),
        ("2F98600064000000", {RANGE, TOO_HIGH}),  # homing method 100 is reserved
        ("23051000800000C0", {RANGE, 0x08000022}),  # this device does not generate SYNCs
        ("23161001010000FF", {RANGE, 0x06040043, TOO_HIGH}),  # reserved bits of the consumer heartbeat time
    ],
)
def test_row_10_values_out_of_range(bus: Bus, request_: str, codes: set[int]):
    place = request_[2:8]
    before = bus.sdo("40" + place + "00000000")
    assert bus.abort(request_) in codes
    assert bus.sdo("40" + place + "00000000") == before


@pytest.mark.parametrize("mode", ["05", "0B", "7F", "80", "E0"])
@pytest.mark.parametrize("enabled", [False, True])
def test_row_10_a_mode_that_is_not_there_is_never_displayed(bus: Bus, mode: str, enabled: bool):
    bus.done("2F60600008000000")
    bus.run(3)
    if enabled:
        bus.enable()
    assert bus.sdo("4061600000000000") == "4F61600008000000"
    answer = bus.sdo("2F606000" + mode + "000000")
    assert answer == "6060600000000000" or code_of(answer) in {RANGE, TOO_HIGH, TOO_LOW}
    bus.run(20)
    assert bus.sdo("4061600000000000") == "4F61600008000000"
    assert bus.statusword & 0x6F == (0x27 if enabled else 0x40)
