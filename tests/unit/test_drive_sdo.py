"""SDO server of the emulated drive, byte by byte (CiA 301, 7.2.4.3)."""

import pytest
from drive_bench import MS, Bench

TOGGLE = "00000305"
TIMED_OUT = "00000405"
UNKNOWN_COMMAND = "01000405"
OUT_OF_MEMORY = "05000405"
WRITE_ONLY = "01000106"
READ_ONLY = "02000106"
NO_OBJECT = "00000206"
TOO_LONG = "12000706"
TOO_SHORT = "13000706"
NO_SUBINDEX = "11000906"
RANGE = "30000906"
TOO_HIGH = "31000906"
TOO_LOW = "32000906"
NO_DATA = "24000008"


@pytest.fixture
def bench() -> Bench:
    return Bench()


# -- expedited ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("request_", "response"),
    [
        ("4000100000000000", "4300100092010200"),  # UNSIGNED32
        ("4017100000000000", "4B17100000000000"),  # UNSIGNED16
        ("4001100000000000", "4F01100000000000"),  # UNSIGNED8
        ("40C2600200000000", "4FC26002FD000000"),  # INTEGER8 -3
        ("4018100100000000", "43181001D2040000"),  # vendor id
        ("4018100000000000", "4F18100004000000"),  # highest sub-index
        ("4000140100000000", "4300140105020000"),  # $NODEID + 200h
    ],
)
def test_expedited_upload(bench: Bench, request_: str, response: str):
    assert bench.sdo(request_) == response


def test_expedited_download_reads_back(bench: Bench):
    assert bench.sdo("237A600078563412") == "607A600000000000"
    assert bench.sdo("407A600000000000") == "437A600078563412"
    assert bench.sdo("2B17100064000000") == "6017100000000000"
    assert bench.sdo("4017100000000000") == "4B17100064000000"


def test_download_without_size_takes_the_objects_own(bench: Bench):
    assert bench.sdo("2217100064000000") == "6017100000000000"
    assert bench.sdo("4017100000000000") == "4B17100064000000"


@pytest.mark.parametrize(
    ("request_", "abort"),
    [
        ("4009200000000000", "80092000" + NO_OBJECT),
        ("2309200000000000", "80092000" + NO_OBJECT),
        ("4005000000000000", "80050000" + NO_OBJECT),  # a dummy entry is there for mapping alone
        ("4018100500000000", "80181005" + NO_SUBINDEX),
        ("4041600100000000", "80416001" + NO_SUBINDEX),  # of a VAR too
        ("2341600100000000", "80416001" + NO_SUBINDEX),
        ("2B41600000000000", "80416000" + READ_ONLY),
        ("2108100010000000", "80081000" + READ_ONLY),  # segmented: refused at the initiate too
        ("2317100064000000", "80171000" + TOO_LONG),
        ("2F17100064000000", "80171000" + TOO_SHORT),
        ("2117100005000000", "80171000" + TOO_LONG),  # segmented, declared
        ("2117100001000000", "80171000" + TOO_SHORT),
        ("2B5A600009000000", "805A6000" + TOO_HIGH),
        ("2B5A6000FFFF0000", "805A6000" + TOO_LOW),
        ("2F60600002000000", "80606000" + RANGE),  # velocity mode (vl) is not there
        ("4003100100000000", "80031001" + NO_DATA),  # no error in the history yet
        ("4000300100000000", "80003001" + NO_DATA),  # empty slot
    ],
)
def test_refusals(bench: Bench, request_: str, abort: str):
    assert bench.sdo(request_) == abort
    assert bench.sdo("4000100000000000") == "4300100092010200"


def test_write_only_object_is_not_read(bench: Bench):
    entry = bench.drive.dictionary.entry(0x3012)
    entry.is_readable = False
    assert bench.sdo("4012300000000000") == "80123000" + WRITE_ONLY


def test_refused_value_leaves_the_object_as_it_was(bench: Bench):
    bench.must(0x6060, 0, 8, 1)
    bench.tick()
    assert bench.write(0x6060, 0, 2, 1) == 0x06090030
    bench.tick()
    assert bench.read(0x6060) == 8
    assert bench.read(0x6061) == 8


# -- segmented ---------------------------------------------------------------------------------------------------------


def test_segmented_upload(bench: Bench):
    assert bench.sdo("4008100000000000") == "4108100009000000"  # "sim-drive", 9 bytes
    assert bench.sdo("6000000000000000") == "0073696D2D647269"
    assert bench.sdo("7000000000000000") == "1B76650000000000"  # 5 bytes unused, last
    assert bench.sdo("6000000000000000") == "80081000" + UNKNOWN_COMMAND


def test_segmented_download_and_upload_of_a_domain(bench: Bench):
    assert bench.sdo("2100300109000000") == "6000300100000000"
    assert bench.sdo("0001020304050607") == "2000000000000000"
    assert bench.sdo("1B08090000000000") == "3000000000000000"
    assert bench.sdo("4000300100000000") == "4100300109000000"
    assert bench.sdo("6000000000000000") == "0001020304050607"
    assert bench.sdo("7000000000000000") == "1B08090000000000"


def test_segmented_download_of_a_short_object(bench: Bench):
    assert bench.sdo("217A600004000000") == "607A600000000000"
    assert bench.sdo("0778563412000000") == "2000000000000000"
    assert bench.read(0x607A) == 0x12345678


def test_segmented_download_of_unknown_size(bench: Bench):
    assert bench.sdo("207A600000000000") == "607A600000000000"
    assert bench.sdo("0778563412000000") == "2000000000000000"
    assert bench.read(0x607A) == 0x12345678
    assert bench.sdo("207A600000000000") == "607A600000000000"
    assert bench.sdo("0978563412000000") == "807A6000" + TOO_SHORT  # 3 bytes for an INTEGER32


def test_received_length_is_held_against_the_declared_one(bench: Bench):
    bench.sdo("2100300109000000")
    bench.sdo("0001020304050607")
    assert bench.sdo("1908090A00000000") == "80003001" + TOO_LONG
    bench.sdo("2100300109000000")
    bench.sdo("0001020304050607")
    assert bench.sdo("1D08000000000000") == "80003001" + TOO_SHORT
    assert bench.sdo("4000300100000000") == "80003001" + NO_DATA


def test_toggle_bit_must_alternate(bench: Bench):
    bench.sdo("2100300109000000")
    assert bench.sdo("1001020304050607") == "80003001" + TOGGLE
    assert bench.sdo("1001020304050607") == "80003001" + UNKNOWN_COMMAND
    bench.sdo("4008100000000000")
    assert bench.sdo("7000000000000000") == "80081000" + TOGGLE
    bench.sdo("4008100000000000")
    bench.sdo("6000000000000000")
    assert bench.sdo("6000000000000000") == "80081000" + TOGGLE


def test_segments_without_initiate_are_refused(bench: Bench):
    assert bench.sdo("0001020304050607")[8:] == UNKNOWN_COMMAND
    assert bench.sdo("6000000000000000")[8:] == UNKNOWN_COMMAND


def test_a_segment_of_the_wrong_direction_ends_the_transfer(bench: Bench):
    bench.sdo("4008100000000000")
    assert bench.sdo("0001020304050607") == "80081000" + UNKNOWN_COMMAND
    assert bench.sdo("6000000000000000") == "80081000" + UNKNOWN_COMMAND


@pytest.mark.parametrize("command", ["E0", "FF"])
def test_unknown_commands_are_refused_at_any_time(bench: Bench, command: str):
    assert bench.sdo(command + "00300100000000")[8:] == UNKNOWN_COMMAND
    bench.sdo("4008100000000000")
    assert bench.sdo(command + "00300100000000")[8:] == UNKNOWN_COMMAND
    assert bench.sdo("6000000000000000")[8:] == UNKNOWN_COMMAND  # the transfer is over


def test_new_initiate_replaces_the_old_transfer(bench: Bench):
    bench.sdo("2100300109000000")
    bench.sdo("0001020304050607")
    assert bench.sdo("4000100000000000") == "4300100092010200"
    assert bench.sdo("1B08090000000000")[8:] == UNKNOWN_COMMAND


def test_clients_abort_frees_the_server_silently(bench: Bench):
    bench.sdo("2100300109000000")
    assert bench.sdo("8000300100000008") == ""
    assert bench.sdo("0001020304050607")[8:] == UNKNOWN_COMMAND


def test_stalled_transfer_times_out_once(bench: Bench):
    bench.sdo("2100300109000000")
    assert bench.run(600 * MS) == []
    bench.sdo("0001020304050607")  # starts the time anew
    assert bench.run(999 * MS) == []
    assert bench.run(1 * MS) == ["585#80003001" + TIMED_OUT]
    assert bench.run(3000 * MS) == []
    assert bench.drive.next_wake_ns() is None


def test_slot_takes_64_kibibytes_and_no_more(bench: Bench):
    assert bench.sdo("2100300101000100") == "80003001" + OUT_OF_MEMORY  # 65537 declared
    assert bench.sdo("2000300100000000") == "6000300100000000"  # size not told
    code = ""
    for segment in range(9363):  # 9362 segments are 65534 bytes, the next one is too much
        code = bench.sdo(("00" if segment % 2 == 0 else "10") + "55" * 7)
    assert code == "80003001" + OUT_OF_MEMORY
    assert bench.download(0x3000, 1, bytes(65536)) == 0
    assert bench.read(0x3000, 3) == 1


@pytest.mark.parametrize("data", ["", "40", "40001000000000"])
def test_a_frame_of_another_length_is_no_request(bench: Bench, data: str):
    assert bench.put(0x605, data) == []


def test_other_nodes_requests_pass_by(bench: Bench):
    assert bench.put(0x606, "4000100000000000") == []
    assert bench.put(0x585, "4000100000000000") == []
