"""LSS slave of the emulated drive, byte by byte (CiA 305)."""

import pytest
from drive_bench import MS, Bench, decode_bench_image, described

from drivers.nmt import NmtState
from sim_drive.communication.parameters import MemoryParameterStore, ParameterStoreError, StoredParameters
from sim_drive.device.drive import UNCONFIGURED_NODE_ID, BitTimingActivated, Drive, NodeIdChanged
from sim_drive.settings import DriveIdentity, DriveSettings

IDENTITY = DriveIdentity(0x000004D2, 0x00001024, 0x00010000, 0xCAFE0007)
VENDOR, PRODUCT, REVISION, SERIAL = "D2040000", "24100000", "00000100", "0700FECA"


class LssBench(Bench):
    def __init__(self, node_id: int = 5, store: object | None = None, can_change: bool = True) -> None:
        super().__init__(boot=False)
        self.drive = Drive(
            node_id,
            described(5),
            DriveSettings(identity=IDENTITY),
            decode_bench_image,
            store,
            described if can_change else None,
        )
        self.drive.wake(0)
        self.boot_frames = self.sent()

    def lss(self, request: str) -> str:
        """The answer's data to a request that may be shorter than its 8 bytes; "" for none."""
        frames = self.put(0x7E5, request.ljust(16, "0"))
        assert all(frame.startswith("7E4#") for frame in frames)
        assert len(frames) <= 1
        return frames[0].removeprefix("7E4#") if frames else ""

    def configure(self) -> None:
        assert self.lss("0401") == ""

    def refuses(self, request: str) -> bool:
        return self.lss(request) == ""


@pytest.fixture
def bench() -> LssBench:
    return LssBench()


@pytest.fixture
def new() -> LssBench:
    """A node without a node id."""
    return LssBench(UNCONFIGURED_NODE_ID)


# -- states ------------------------------------------------------------------------------------------------------------


def test_configuration_services_are_there_in_configuration_state_alone(bench: LssBench):
    requests = ("1106", "130002", "17", "5A", "5B", "5C", "5D", "5E")
    assert all(bench.refuses(request) for request in requests)
    bench.configure()
    assert not any(bench.refuses(request) for request in requests)
    bench.lss("0400")
    assert all(bench.refuses(request) for request in requests)


def test_selection_by_identity(bench: LssBench):
    assert bench.lss("40" + VENDOR) == ""
    assert bench.lss("41" + PRODUCT) == ""
    assert bench.lss("42" + REVISION) == ""
    assert bench.lss("43" + SERIAL) == "4400000000000000"
    assert bench.lss("5E") == "5E05000000000000"


@pytest.mark.parametrize(
    "requests",
    [
        ["40" + VENDOR, "41" + PRODUCT, "42" + REVISION, "430700FECB"],
        ["40D2040001", "41" + PRODUCT, "42" + REVISION, "43" + SERIAL],
        ["40" + VENDOR, "42" + REVISION, "41" + PRODUCT, "43" + SERIAL],
        ["41" + PRODUCT, "42" + REVISION, "43" + SERIAL],
        ["43" + SERIAL],
    ],
)
def test_selection_of_another_or_out_of_order(bench: LssBench, requests: list[str]):
    assert all(bench.refuses(request) for request in requests)
    assert bench.refuses("5E")


def test_selection_may_begin_anew(bench: LssBench):
    for request in ("40" + VENDOR, "41" + PRODUCT, "40" + VENDOR, "41" + PRODUCT, "42" + REVISION):
        bench.lss(request)
    assert bench.lss("43" + SERIAL) == "4400000000000000"


@pytest.mark.parametrize("data", ["", "04", "0401", "04010000000000"])
def test_other_lengths_are_no_requests(bench: LssBench, data: str):
    assert bench.put(0x7E5, data) == []
    assert bench.refuses("5E")


@pytest.mark.parametrize("command", ["00", "01", "44", "45", "4F", "50", "52", "5F", "FF"])
def test_unknown_services_are_ignored(bench: LssBench, command: str):
    bench.configure()
    assert bench.refuses(command)
    assert bench.lss("0402") == ""  # nor is there a third state
    assert bench.lss("5E") == "5E05000000000000"


def test_lss_works_in_stopped_and_ends_with_a_reset(bench: LssBench):
    bench.nmt(0x02)
    bench.configure()
    assert bench.lss("5E") == "5E05000000000000"
    bench.nmt(0x82)
    assert bench.refuses("5E")


# -- inquiry and identification ----------------------------------------------------------------------------------------


def test_inquiry(bench: LssBench):
    bench.configure()
    assert bench.lss("5A") == "5A" + VENDOR + "000000"
    assert bench.lss("5B") == "5B" + PRODUCT + "000000"
    assert bench.lss("5C") == "5C" + REVISION + "000000"
    assert bench.lss("5D") == "5D" + SERIAL + "000000"
    assert bench.lss("5E") == "5E05000000000000"


def identify(bench: LssBench, revisions: tuple[int, int], serials: tuple[int, int]) -> list[str]:
    numbers = [number.to_bytes(4, "little").hex() for number in (*revisions, *serials)]
    requests = ["46" + VENDOR, "47" + PRODUCT, *(f"{0x48 + n:02X}{number}" for n, number in enumerate(numbers))]
    return [answer for answer in map(bench.lss, requests) if answer]


def test_identification_by_ranges(bench: LssBench):
    own, every = 0xCAFE0007, (0, 0xFFFFFFFF)
    assert identify(bench, every, every) == ["4F00000000000000"]
    assert identify(bench, (0x10000, 0x10000), (own, own)) == ["4F00000000000000"]
    for revisions, serials in (
        ((0x10001, 0x20000), every),
        ((0, 0xFFFF), every),
        (every, (own + 1, 0xFFFFFFFF)),
        (every, (0, own - 1)),
    ):
        assert identify(bench, revisions, serials) == []
    assert bench.refuses("4B" + SERIAL)  # the last request alone


def test_only_a_node_without_node_id_is_unconfigured(bench: LssBench, new: LssBench):
    assert bench.lss("4C") == ""
    assert new.lss("4C") == "5000000000000000"
    new.configure()
    new.lss("1107")
    assert new.lss("4C") == ""


# -- node id -----------------------------------------------------------------------------------------------------------


def test_new_node_id_is_taken_at_the_reset_of_communication(bench: LssBench):
    bench.configure()
    assert bench.lss("112A") == "1100000000000000"
    assert bench.lss("5E") == "5E05000000000000"  # not yet
    assert bench.lss("0400") == ""
    assert bench.sdo("4000100000000000") == "4300100092010200"
    assert bench.nmt(0x82) == ["72A#00"]
    assert bench.sdo("4000100000000000") == ""
    bench.node_id = 42
    assert bench.sdo("4000100000000000") == "4300100092010200"
    assert bench.read(0x1014) == 0x80 + 42
    assert bench.read(0x1200, 1) == 0x600 + 42
    assert bench.read(0x1400, 1) == 0x200 + 42
    assert bench.read(0x1800, 1) == 0x40000180 + 42
    assert bench.read(0x1018, 4) == 0xCAFE0007
    assert bench.drive.cob_ids() == {0x000, 0x080, 0x100, 0x22A, 0x62A, 0x72A, 0x7E5}
    bench.must(0x1017, 0, 10, 2)
    assert bench.run(10 * MS) == ["72A#7F"]
    bench.drive.warn(0x2310, 0x02, bench.now_ns)
    assert bench.sent() == ["0AA#1023030000000000"]
    assert NodeIdChanged(0, 5, 42) in bench.drive.take_events()
    bench.nmt(0x01)
    assert bench.tick() == ["1AA#5002"]


def test_events_tell_the_new_node_id(bench: LssBench):
    bench.configure()
    bench.lss("112A")
    bench.nmt(0x82)
    bench.node_id = 42
    bench.drive.take_events()
    bench.tick()
    bench.control(0x06)
    bench.drive.warn(0x2310, 0x02, bench.now_ns)
    bench.nmt(0x01)
    assert {event.node_id for event in bench.drive.take_events()} == {42}


def test_new_node_id_is_lost_with_a_reset_of_the_node_unless_stored(bench: LssBench):
    bench.configure()
    bench.lss("112A")
    assert bench.nmt(0x81) == ["705#00"]
    assert bench.nmt(0x82) == ["705#00"]
    bench.configure()
    bench.lss("112A")
    assert bench.lss("17") == "1700000000000000"
    assert bench.nmt(0x81) == ["72A#00"]


@pytest.mark.parametrize("node_id", ["00", "80", "FE"])
def test_impossible_node_ids_are_refused(bench: LssBench, node_id: str):
    bench.configure()
    assert bench.lss("11" + node_id) == "1101000000000000"
    assert bench.nmt(0x82) == ["705#00"]


def test_drive_that_cannot_change_refuses_another_node_id():
    bench = LssBench(can_change=False)
    bench.configure()
    assert bench.lss("1106") == "1101000000000000"
    assert bench.lss("1105") == "1100000000000000"


def test_node_id_may_be_taken_away(bench: LssBench):
    bench.must(0x1016, 1, 0x7F000A, 4)
    bench.must(0x1017, 0, 10, 2)
    bench.must(0x1029, 1, 2, 1)
    bench.put(0x77F, "05")
    bench.configure()
    assert bench.lss("11FF") == "1100000000000000"
    assert bench.nmt(0x82) == []
    assert bench.drive.cob_ids() == {0x7E5}
    assert bench.run(1000 * MS) == []
    assert bench.drive.nmt_state is NmtState.BOOT_UP
    assert bench.lss("4C") == "5000000000000000"


# -- a node without a node id ------------------------------------------------------------------------------------------


def test_node_without_node_id_takes_lss_frames_alone(new: LssBench):
    assert new.boot_frames == []
    assert new.drive.cob_ids() == {0x7E5}
    assert new.run(1000 * MS) == []
    assert new.nmt(0x01, 0) == []
    assert new.put(0x6FF, "4000100000000000") == []
    assert new.drive.next_wake_ns() is None


def test_node_boots_when_it_has_been_given_a_node_id(new: LssBench):
    new.configure()
    assert new.lss("5E") == "5EFF000000000000"
    assert new.lss("1107") == "1100000000000000"
    assert new.put(0x7E5, "0400000000000000") == ["707#00"]
    new.node_id = 7
    new.tick()
    assert new.read(0x1014) == 0x87
    assert new.statusword & 0x6F == 0x40


def test_leaving_configuration_without_a_node_id_changes_nothing(new: LssBench):
    new.configure()
    assert new.put(0x7E5, "0400000000000000") == []
    assert new.lss("4C") == "5000000000000000"


def test_configured_node_does_not_boot_when_it_goes_back_to_waiting(bench: LssBench):
    bench.configure()
    bench.lss("112A")
    assert bench.put(0x7E5, "0400000000000000") == []


def test_waiting_node_is_not_booted_by_a_second_waiting_command(new: LssBench):
    new.configure()
    new.lss("1107")
    assert new.put(0x7E5, "0400000000000000") == ["707#00"]
    assert new.put(0x7E5, "0400000000000000") == []


@pytest.mark.parametrize("node_id", [0, 128, 254, 256, -1])
def test_other_node_ids_make_no_drive(node_id: int):
    with pytest.raises(ValueError, match="node_id"):
        LssBench(node_id)
    with pytest.raises(ValueError, match="node_id"):
        LssBench(UNCONFIGURED_NODE_ID, can_change=False)


# -- storing -----------------------------------------------------------------------------------------------------------


def test_stored_node_id_is_that_of_the_next_power_on():
    store = MemoryParameterStore()
    new = LssBench(UNCONFIGURED_NODE_ID, store)
    new.configure()
    new.lss("1107")
    new.lss("130002")
    assert new.lss("17") == "1700000000000000"
    assert store.load() == StoredParameters(node_id=7, bit_timing=2)
    again = LssBench(UNCONFIGURED_NODE_ID, store)
    assert again.boot_frames == ["707#00"]
    again.node_id = 7
    assert again.read(0x1800, 1) == 0x40000187


def test_parameters_and_layer_settings_are_stored_beside_each_other():
    store = MemoryParameterStore()
    bench = LssBench(5, store)
    bench.configure()
    bench.lss("1107")
    bench.lss("17")
    bench.must(0x1017, 0, 250, 2)
    bench.must(0x1010, 1, 0x65766173, 4)
    again = LssBench(5, store)
    assert again.boot_frames == ["707#00"]
    again.node_id = 7
    assert again.read(0x1017) == 250
    again.must(0x1011, 1, 0x64616F6C, 4)
    assert store.load() == StoredParameters(node_id=7)


def test_store_that_cannot_be_written_is_told():
    class WornOutStore(MemoryParameterStore):
        def save(self, parameters: StoredParameters) -> None:
            raise ParameterStoreError("worn out")

    bench = LssBench(5, WornOutStore())
    bench.configure()
    assert bench.lss("17") == "1702000000000000"


# -- bit timing --------------------------------------------------------------------------------------------------------


def test_bit_timings_of_the_standard_table(bench: LssBench):
    bench.configure()
    accepted = [index for index in range(256) if bench.lss(f"1300{index:02X}") == "1300000000000000"]
    assert accepted == [0, 1, 2, 3, 4, 6, 7, 8]
    assert bench.lss("130005") == "1301000000000000"
    assert bench.lss("130100") == "1301000000000000"


def test_activation_is_an_event(bench: LssBench):
    bench.configure()
    bench.drive.take_events()
    assert bench.lss("15E803") == ""  # nothing is pending
    assert bench.drive.take_events() == []
    bench.lss("130002")
    assert bench.lss("15E803") == ""
    assert bench.drive.take_events() == [BitTimingActivated(0, 5, 2, 1000)]


# -- fast scan ---------------------------------------------------------------------------------------------------------

FOUND = "4F00000000000000"


def scan(bench: LssBench, number: int, bit: int, part: int, next_part: int) -> bool:
    answer = bench.lss("51" + number.to_bytes(4, "little").hex() + f"{bit:02X}{part:02X}{next_part:02X}")
    assert answer in ("", FOUND)
    return answer == FOUND


def test_fast_scan_finds_the_identity_bit_by_bit(new: LssBench):
    assert new.lss("5100000000800000") == FOUND
    found: list[int] = []
    for part in range(4):
        number = 0
        for bit in range(31, -1, -1):
            if not scan(new, number, bit, part, part):
                number |= 1 << bit
        assert scan(new, number, 0, part, (part + 1) & 3)
        found.append(number)
    assert found == [0x000004D2, 0x00001024, 0x00010000, 0xCAFE0007]
    assert new.lss("5E") == "5EFF000000000000"  # it is in configuration state now


def test_fast_scan_follows_its_own_order(new: LssBench):
    assert scan(new, 0, 128, 0, 0)
    assert not scan(new, 0x1024, 0, 1, 2)  # the product code is not its turn
    assert scan(new, 0x4D2, 0, 0, 1)
    assert not scan(new, 0x4D2, 0, 0, 1)
    assert scan(new, 0x1024, 0, 1, 2)
    assert scan(new, 0, 128, 0, 0)
    assert not scan(new, 0x1024, 0, 1, 2)
    assert not scan(new, 0x4D2, 32, 0, 0)
    assert not scan(new, 0, 31, 4, 0)


def test_fast_scan_passes_by_who_has_a_node_id(bench: LssBench, new: LssBench):
    assert not scan(bench, 0, 128, 0, 0)
    new.configure()
    assert not scan(new, 0, 128, 0, 0)  # in configuration state
    new.lss("1107")
    assert new.put(0x7E5, "0400000000000000") == ["707#00"]
    assert not scan(new, 0, 128, 0, 0)


def test_stored_cob_ids_of_the_old_node_id_become_those_of_the_new_one(bench: LssBench):
    def sdo(node_id: int, request: str) -> str:
        (answer,) = bench.put(0x600 + node_id, request)
        return answer.removeprefix(f"{0x580 + node_id:03X}#")

    # TPDO 1 is switched off, its COB-ID 185h kept; RPDO 1 gets one of its own; all is saved as node 5.
    assert sdo(5, "23001801850100C0")[:2] == "60"
    assert sdo(5, "2300140133020080")[:2] == "60"
    assert sdo(5, "2310100173617665")[:2] == "60"
    bench.put(0x7E5, "0401000000000000")
    bench.put(0x7E5, "1109000000000000")
    bench.put(0x7E5, "0400000000000000")
    bench.put(0x000, "8205")
    bench.tick()
    assert sdo(9, "4000180100000000") == "43001801890100C0"
    assert sdo(9, "4001180100000000") == "4301180189020" + "0C0"
    assert sdo(9, "4014100000000000") == "4314100089000000"
    assert sdo(9, "4000140100000000") == "4300140133020080"
    # Saved as node 9, and node 5 again after a reset of the node: not what was saved, but what it means.
    assert sdo(9, "2310100173617665")[:2] == "60"
    bench.put(0x000, "8109")
    bench.tick()
    assert sdo(5, "4000180100000000") == "43001801850100C0"
    assert sdo(5, "4000140100000000") == "4300140133020080"
