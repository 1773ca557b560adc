"""SDO block transfer of the emulated drive, byte by byte (CiA 301, 7.2.4.3.9 to 7.2.4.3.16)."""

import pytest
from drive_bench import MS, Bench

from drivers.sdo_block import crc16
from sim_drive.settings import DriveSettings

TIMED_OUT = "00000405"
UNKNOWN_COMMAND = "01000405"
BLOCK_SIZE = "02000405"
SEQUENCE = "03000405"
CRC = "04000405"
OUT_OF_MEMORY = "05000405"
TOO_LONG = "12000706"
TOO_SHORT = "13000706"
END_CONFIRMED = "A100000000000000"
# "123456789" has the CRC 31C3h, the check value of CRC-16/XMODEM in every catalogue.
FIRST, LAST = "0131323334353637", "8238390000000000"


@pytest.fixture
def bench() -> Bench:
    return Bench(DriveSettings(sdo_block_size=4))


def answers(bench: Bench, request: str) -> list[str]:
    frames = bench.put(0x605, request)
    assert all(frame.startswith("585#") for frame in frames)
    return [frame.removeprefix("585#") for frame in frames]


def is_alive(bench: Bench) -> bool:
    """A whole block download and upload go well."""
    return (
        answers(bench, "C600300109000000") == ["A400300104000000"]
        and answers(bench, FIRST) == []
        and answers(bench, LAST) == ["A202040000000000"]
        and answers(bench, "D5C3310000000000") == [END_CONFIRMED]
        and answers(bench, "A4003001FF000000") == ["80003001" + BLOCK_SIZE]
        and answers(bench, "A40030017F000000") == ["C600300109000000"]
        and answers(bench, "A300000000000000") == [FIRST, LAST]
        and answers(bench, "A2027F0000000000") == ["D5C3310000000000"]
        and answers(bench, "A100000000000000") == []
        and bench.drive.next_wake_ns() is None
    )


def test_crc_is_the_standards():
    assert crc16(b"123456789") == 0x31C3
    assert crc16(b"") == 0
    assert crc16(b"\x00" * 5) == 0
    assert crc16(b"\x01") == 0x1021


def test_download_and_upload_of_nine_bytes(bench: Bench):
    assert is_alive(bench)
    assert bench.read(0x3000, 3) == 1


# -- download ----------------------------------------------------------------------------------------------------------


def test_download_over_several_sub_blocks(bench: Bench):
    assert answers(bench, "C600300123000000") == ["A400300104000000"]  # 35 bytes, 5 segments
    for number in range(1, 4):
        assert answers(bench, f"0{number}" + f"1{number}" * 7) == []
    assert answers(bench, "04" + "14" * 7) == ["A204040000000000"]
    assert answers(bench, "81" + "21" * 7) == ["A201040000000000"]
    data = b"".join(bytes([n]) * 7 for n in (0x11, 0x12, 0x13, 0x14, 0x21))
    assert answers(bench, "C1" + crc16(data).to_bytes(2, "little").hex() + "0000000000") == [END_CONFIRMED]
    assert bench.drive.dictionary.entry(0x3000, 1).value == data


def test_download_without_crc_and_without_size(bench: Bench):
    assert answers(bench, "C000300100000000") == ["A000300104000000"]
    answers(bench, FIRST)
    assert answers(bench, LAST) == ["A202040000000000"]
    assert answers(bench, "D500000000000000") == [END_CONFIRMED]
    assert bench.drive.dictionary.entry(0x3000, 1).value == b"123456789"


def test_download_of_an_integer(bench: Bench):
    assert answers(bench, "C27A600004000000") == ["A07A600004000000"]
    assert answers(bench, "8178563412000000") == ["A201040000000000"]
    assert answers(bench, "CD00000000000000") == [END_CONFIRMED]
    assert bench.read(0x607A) == 0x12345678


def test_lost_segment_is_acknowledged_up_to_the_gap_and_sent_again(bench: Bench):
    answers(bench, "C600300109000000")
    assert answers(bench, LAST) == ["A200040000000000"]  # the first one was lost
    assert answers(bench, FIRST) == []
    assert answers(bench, LAST) == ["A202040000000000"]
    assert answers(bench, "D5C3310000000000") == [END_CONFIRMED]


def test_what_follows_a_gap_is_dropped_until_it_comes_again(bench: Bench):
    answers(bench, "C000300100000000")
    assert answers(bench, "0111111111111111") == []
    assert answers(bench, "03FFFFFFFFFFFFFF") == []  # the second one was lost
    assert answers(bench, "04EEEEEEEEEEEEEE") == ["A201040000000000"]
    assert answers(bench, "0122222222222222") == []
    assert answers(bench, "8233333333333333") == ["A202040000000000"]
    assert answers(bench, "C100000000000000") == [END_CONFIRMED]
    assert bench.drive.dictionary.entry(0x3000, 1).value == b"\x11" * 7 + b"\x22" * 7 + b"\x33" * 7


def test_lost_end_of_a_sub_block_is_noticed_by_the_silence(bench: Bench):
    answers(bench, "C600300109000000")
    answers(bench, FIRST)
    assert bench.run(499 * MS) == []
    assert bench.run(1 * MS) == ["585#A201040000000000"]
    assert answers(bench, "8138390000000000") == ["A201040000000000"]
    assert answers(bench, "D5C3310000000000") == [END_CONFIRMED]


def test_silence_between_sub_blocks_is_left_to_the_time_out(bench: Bench):
    answers(bench, "C600300109000000")
    assert bench.run(999 * MS) == []
    assert bench.run(1 * MS) == ["585#80003001" + TIMED_OUT]
    assert is_alive(bench)


def test_silence_after_the_help_ends_in_a_time_out(bench: Bench):
    answers(bench, "C600300109000000")
    answers(bench, FIRST)
    assert bench.run(999 * MS) == ["585#A201040000000000"]
    assert bench.run(1 * MS) == ["585#80003001" + TIMED_OUT]
    assert bench.run(3000 * MS) == []
    assert is_alive(bench)


def test_segments_that_come_twice_do_no_harm(bench: Bench):
    answers(bench, "C600300109000000")
    assert answers(bench, FIRST) == []
    assert answers(bench, FIRST) == []
    assert answers(bench, LAST) == ["A202040000000000"]
    assert answers(bench, LAST) == []  # 82h would be an abort but for what came before
    assert answers(bench, "D5C3310000000000") == [END_CONFIRMED]


def test_last_segment_of_a_sub_block_that_comes_twice_does_not_end_the_next(bench: Bench):
    answers(bench, "C000300100000000")
    for number in range(1, 4):
        answers(bench, f"0{number}" + "00" * 7)
    assert answers(bench, "0444444444444444") == ["A204040000000000"]
    assert answers(bench, "0444444444444444") == []
    assert answers(bench, "8155555555555555") == ["A201040000000000"]


def test_sub_blocks_of_one_segment():
    bench = Bench(DriveSettings(sdo_block_size=1))
    assert answers(bench, "C200300115000000") == ["A000300101000000"]
    assert answers(bench, "01" + "00" * 7) == ["A201010000000000"]
    assert answers(bench, "01" + "00" * 7) == ["A201010000000000"]  # the same again is the next one here
    assert answers(bench, "81" + "00" * 7) == ["A201010000000000"]
    assert answers(bench, "C100000000000000") == [END_CONFIRMED]
    assert bench.drive.dictionary.entry(0x3000, 1).value == bytes(21)


@pytest.mark.parametrize("segment", ["0031323334353637", "0531323334353637", "7F31323334353637", "8531323334353637"])
def test_impossible_sequence_numbers_are_refused(bench: Bench, segment: str):
    answers(bench, "C600300109000000")
    assert answers(bench, segment) == ["80003001" + SEQUENCE]
    assert is_alive(bench)


def test_wrong_crc_is_refused_and_changes_nothing(bench: Bench):
    assert is_alive(bench)
    answers(bench, "C600300109000000")
    answers(bench, "01" + "AA" * 7)
    answers(bench, LAST)
    assert answers(bench, "D5C3310000000000") == ["80003001" + CRC]
    assert bench.drive.dictionary.entry(0x3000, 1).value == b"123456789"
    assert is_alive(bench)


@pytest.mark.parametrize(
    ("end", "code"),
    [
        ("D1C3310000000000", TOO_LONG),  # 10 bytes
        ("D9C3310000000000", TOO_SHORT),  # 8 bytes
    ],
)
def test_received_length_is_held_against_the_declared_one(bench: Bench, end: str, code: str):
    answers(bench, "C600300109000000")
    answers(bench, FIRST)
    answers(bench, LAST)
    assert answers(bench, end) == ["80003001" + code]
    assert is_alive(bench)


def test_more_segments_than_declared_are_stopped_under_way(bench: Bench):
    answers(bench, "C200300109000000")
    assert answers(bench, "01" + "00" * 7) == []
    assert answers(bench, "02" + "00" * 7) == []
    assert answers(bench, "03" + "00" * 7) == ["80003001" + TOO_LONG]
    assert is_alive(bench)


@pytest.mark.parametrize(
    ("request_", "abort"),
    [
        ("C209200004000000", "8009200000000206"),  # no such object
        ("C218100504000000", "8018100511000906"),  # no such sub-index
        ("C241600002000000", "8041600002000106"),  # read only
        ("C217100004000000", "80171000" + TOO_LONG),
        ("C217100001000000", "80171000" + TOO_SHORT),
        ("C200300101000100", "80003001" + OUT_OF_MEMORY),
        ("A009200004000000", "8009200000000206"),
        ("A018100504000000", "8018100511000906"),
        ("A000300104000000", "8000300124000008"),  # an empty slot
        ("A400100000000000", "80001000" + BLOCK_SIZE),
        ("A400100080000000", "80001000" + BLOCK_SIZE),
    ],
)
def test_refusals_at_the_initiate(bench: Bench, request_: str, abort: str):
    assert answers(bench, request_) == [abort]
    assert is_alive(bench)


def test_value_out_of_range_is_refused_at_the_end(bench: Bench):
    answers(bench, "C25A600002000000")
    answers(bench, "8109000000000000")
    assert answers(bench, "D500000000000000") == ["805A600031000906"]
    assert is_alive(bench)


def test_unknown_size_ends_at_the_objects_capacity(bench: Bench):
    answers(bench, "C017100000000000")
    answers(bench, "01" + "00" * 7)
    assert answers(bench, "02" + "00" * 7) == ["80171000" + TOO_LONG]
    assert is_alive(bench)


def test_clients_abort_frees_the_server_in_every_phase(bench: Bench):
    openings = (
        ["C600300109000000"],
        ["C600300109000000", FIRST],
        ["C600300109000000", FIRST, LAST],
        ["A40010007F000000"],
        ["A40010007F000000", "A300000000000000"],
        ["A40010007F000000", "A300000000000000", "A2017F0000000000"],
    )
    for opening in openings:
        for request in opening:
            answers(bench, request)
        assert bench.drive.next_wake_ns() is not None
        assert answers(bench, "8000300100000008") == []
        assert bench.drive.next_wake_ns() is None
        assert is_alive(bench)


def test_new_initiate_replaces_a_transfer_that_is_between_sub_blocks_of_an_upload(bench: Bench):
    answers(bench, "A40010007F000000")
    answers(bench, "A300000000000000")
    assert answers(bench, "4000100000000000") == ["4300100092010200"]
    assert answers(bench, "A2017F0000000000")[0][8:] == UNKNOWN_COMMAND
    answers(bench, "C600300109000000")
    answers(bench, FIRST)
    answers(bench, LAST)
    assert answers(bench, "4000100000000000") == ["4300100092010200"]
    assert answers(bench, "D5C3310000000000")[0][8:] == UNKNOWN_COMMAND


@pytest.mark.parametrize("request_", ["A100000000000000", "A2017F0000000000", "A300000000000000", "C100000000000000"])
def test_steps_without_an_initiate_are_refused(bench: Bench, request_: str):
    assert answers(bench, request_)[0][8:] == UNKNOWN_COMMAND
    assert is_alive(bench)


@pytest.mark.parametrize(
    ("opening", "wrong"),
    [
        ([], "A2007F0000000000"),
        ([], "A100000000000000"),
        (["A300000000000000"], "A300000000000000"),
        (["A300000000000000"], "A100000000000000"),
        (["A300000000000000", "A2017F0000000000"], "A2017F0000000000"),
        (["A300000000000000", "A2017F0000000000"], "A300000000000000"),
    ],
)
def test_steps_in_the_wrong_order_are_refused(bench: Bench, opening: list[str], wrong: str):
    answers(bench, "A40010007F000000")
    for request in opening:
        answers(bench, request)
    assert answers(bench, wrong) == ["80001000" + UNKNOWN_COMMAND]
    assert is_alive(bench)


# -- upload ------------------------------------------------------------------------------------------------------------


@pytest.fixture
def loaded(bench: Bench) -> Bench:
    """30 bytes in slot 1: 5 segments, the last one with 2 bytes."""
    assert bench.download(0x3000, 1, bytes(range(30))) == 0
    return bench


SEGMENTS = [bytes(range(start, min(start + 7, 30))).ljust(7, b"\0").hex().upper() for start in range(0, 30, 7)]
END_OF_30 = "D5" + crc16(bytes(range(30))).to_bytes(2, "little").hex().upper() + "0000000000"


def test_upload_over_several_sub_blocks_of_changing_size(loaded: Bench):
    assert answers(loaded, "A400300102000000") == ["C60030011E000000"]
    assert answers(loaded, "A300000000000000") == ["01" + SEGMENTS[0], "02" + SEGMENTS[1]]
    assert answers(loaded, "A202010000000000") == ["01" + SEGMENTS[2]]
    assert answers(loaded, "A2017F0000000000") == ["01" + SEGMENTS[3], "82" + SEGMENTS[4]]
    assert answers(loaded, "A2027F0000000000") == [END_OF_30]
    assert answers(loaded, "A100000000000000") == []


def test_upload_without_crc_ends_without_one(loaded: Bench):
    assert answers(loaded, "A00030017F000000") == ["C20030011E000000"]
    answers(loaded, "A300000000000000")
    assert answers(loaded, "A2057F0000000000") == ["D500000000000000"]


def test_upload_is_resumed_after_the_last_good_segment(loaded: Bench):
    answers(loaded, "A400300105000000")
    answers(loaded, "A300000000000000")
    assert answers(loaded, "A203050000000000") == ["01" + SEGMENTS[3], "82" + SEGMENTS[4]]
    assert answers(loaded, "A200050000000000") == ["01" + SEGMENTS[3], "82" + SEGMENTS[4]]
    assert answers(loaded, "A201050000000000") == ["81" + SEGMENTS[4]]
    assert answers(loaded, "A201050000000000") == [END_OF_30]


@pytest.mark.parametrize(
    ("acknowledgement", "code"),
    [
        ("A203020000000000", SEQUENCE),
        ("A202000000000000", BLOCK_SIZE),
        ("A202800000000000", BLOCK_SIZE),
    ],
)
def test_impossible_acknowledgements_are_refused(loaded: Bench, acknowledgement: str, code: str):
    answers(loaded, "A400300102000000")
    answers(loaded, "A300000000000000")
    assert answers(loaded, acknowledgement) == ["80003001" + code]
    assert is_alive(loaded)


@pytest.mark.parametrize(
    "opening", [[], ["A300000000000000"], ["A300000000000000", "A205050000000000"]], ids=["start", "data", "end"]
)
def test_upload_times_out_in_every_phase(loaded: Bench, opening: list[str]):
    answers(loaded, "A400300105000000")
    for request in opening:
        answers(loaded, request)
    assert loaded.run(999 * MS) == []
    assert loaded.run(1 * MS) == ["585#80003001" + TIMED_OUT]
    assert is_alive(loaded)


def test_protocol_is_switched_for_what_is_small_enough(loaded: Bench):
    assert answers(loaded, "A00010007F040000") == ["4300100092010200"]  # 4 bytes, threshold 4
    assert answers(loaded, "A40010007F030000") == ["C600100004000000"]
    assert answers(loaded, "A40030017F1E0000") == ["410030011E000000"]  # 30 bytes, threshold 30
    assert answers(loaded, "6000000000000000") == ["00" + SEGMENTS[0]]
    assert answers(loaded, "A40030017F1D0000") == ["C60030011E000000"]


def test_stopping_the_node_ends_a_block_transfer(loaded: Bench):
    answers(loaded, "C600300109000000")
    loaded.nmt(0x02)
    loaded.nmt(0x80)
    assert answers(loaded, FIRST)[0][8:] == UNKNOWN_COMMAND
    assert is_alive(loaded)


def test_whole_slot_by_blocks():
    bench = Bench()
    image = bytes(n * n % 251 for n in range(65536))
    segments = [image[start : start + 7] for start in range(0, 65536, 7)]
    assert len(segments) == 9363  # 73 sub-blocks of 127 segments, and 92 segments
    assert answers(bench, "C600300100000100") == ["A40030017F000000"]
    for number, segment in enumerate(segments):
        place = number % 127 + 1
        is_last = number == 9362
        response = answers(bench, bytes((place | is_last << 7,)).hex() + segment.ljust(7, b"\0").hex())
        assert response == ([f"A2{place:02X}7F0000000000"] if is_last or place == 127 else [])
    # 65536 is 9362 * 7 + 2
    assert answers(bench, "D5" + crc16(image).to_bytes(2, "little").hex() + "0000000000") == [END_CONFIRMED]
    assert bench.drive.dictionary.entry(0x3000, 1).value == image
    assert answers(bench, "C600300101000100") == ["80003001" + OUT_OF_MEMORY]


@pytest.mark.parametrize("block_size", [0, 128])
def test_block_size_of_the_drive_is_checked(block_size: int):
    with pytest.raises(ValueError, match="block_size"):
        Bench(DriveSettings(sdo_block_size=block_size))
