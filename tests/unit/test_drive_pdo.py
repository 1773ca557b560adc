"""PDOs of the emulated drive: order of configuration, mapping, transmission types, lengths, timers."""

import pytest
from drive_bench import MS, Bench

from sim_drive.device.drive import Drive
from sim_drive.settings import DriveSettings

ORDER = 0x06010000
NOT_MAPPABLE = 0x06040041
TOO_LONG = 0x06040042
NO_OBJECT = 0x06020000
NO_SUBINDEX = 0x06090011
RANGE = 0x06090030


@pytest.fixture
def bench() -> Bench:
    return Bench()


# -- order of configuration ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("communication", "mapping", "word"), [(0x1400, 0x1600, 0x607A0020), (0x1800, 0x1A00, 0x60640020)]
)
def test_only_the_standards_order_is_accepted(bench: Bench, communication: int, mapping: int, word: int):
    base = bench.read(communication, 1) & 0x7FF
    # Valid: nothing of the mapping may change.
    assert bench.write(mapping, 0, 0, 1) == ORDER
    assert bench.write(mapping, 2, word, 4) == ORDER
    assert bench.write(communication, 1, 0x123 if base != 0x123 else 0x124, 4) == RANGE
    assert bench.write(communication, 1, base, 4) == 0  # the same again is no change
    # Invalid, but with entries: they may not change before sub-index 0 is 0.
    assert bench.write(communication, 1, 0x80000000 | base, 4) == 0
    assert bench.write(mapping, 2, word, 4) == ORDER
    assert bench.write(mapping, 0, 0, 1) == 0
    assert bench.write(mapping, 1, word, 4) == 0
    assert bench.write(mapping, 0, 1, 1) == 0
    assert bench.write(communication, 1, 0x1C5, 4) == 0
    assert bench.read(communication, 1) == 0x1C5


@pytest.mark.parametrize(
    ("mapping", "word", "code"),
    [
        (0x1600, 0x20000008, NO_OBJECT),
        (0x1600, 0x60400110, NO_SUBINDEX),
        (0x1600, 0x60410010, NOT_MAPPABLE),  # read only
        (0x1600, 0x60980008, NOT_MAPPABLE),  # not mappable
        (0x1600, 0x60400008, NOT_MAPPABLE),  # not its length
        (0x1600, 0x00080020, NO_OBJECT),
        (0x1600, 0x00040010, NOT_MAPPABLE),
        (0x1A00, 0x00040020, NOT_MAPPABLE),  # gaps are for RPDOs
        (0x1A00, 0x10080020, NOT_MAPPABLE),
        (0x1A00, 0x30000108, NOT_MAPPABLE),
    ],
)
def test_what_cannot_be_mapped_is_refused(bench: Bench, mapping: int, word: int, code: int):
    communication = mapping - 0x200
    bench.must(communication, 1, 0x80000000 | bench.read(communication, 1), 4)
    bench.must(mapping, 0, 0, 1)
    assert bench.write(mapping, 1, word, 4) == code
    assert bench.write(mapping, 0, 9, 1) == 0x06090031


def test_more_than_64_bits_are_refused_and_64_are_not(bench: Bench):
    bench.must(0x1400, 1, 0x80000205, 4)
    bench.must(0x1600, 0, 0, 1)
    for number, word in enumerate((0x607A0020, 0x60B20010, 0x60400010, 0x60600008), start=1):
        bench.must(0x1600, number, word, 4)
    assert bench.write(0x1600, 0, 4, 1) == TOO_LONG
    assert bench.read(0x1600, 0) == 0
    bench.must(0x1600, 0, 3, 1)


def test_count_beyond_the_written_entries_is_refused(bench: Bench):
    bench.must(0x1400, 1, 0x80000205, 4)
    bench.must(0x1600, 0, 0, 1)
    assert bench.write(0x1600, 0, 2, 1) == NO_OBJECT  # entry 2 is 0


@pytest.mark.parametrize(
    "cob_id", [0x000, 0x001, 0x07F, 0x080, 0x101, 0x180, 0x581, 0x5FF, 0x601, 0x67F, 0x6E0, 0x701, 0x7FF, 0x20000205]
)
def test_restricted_and_extended_cob_ids_are_refused(bench: Bench, cob_id: int):
    bench.must(0x1400, 1, 0x80000205, 4)
    assert bench.write(0x1400, 1, cob_id, 4) == RANGE
    assert bench.read(0x1400, 1) == 0x80000205


def test_rtr_bit_is_kept(bench: Bench):
    assert bench.read(0x1800, 1) == 0x40000185
    bench.must(0x1800, 1, 0xC0000185, 4)
    assert bench.read(0x1800, 1) == 0xC0000185
    bench.must(0x1800, 1, 0x80000185, 4)
    assert bench.read(0x1800, 1) == 0x80000185


@pytest.mark.parametrize("kind", [241, 251])
def test_reserved_transmission_types_are_refused(bench: Bench, kind: int):
    assert bench.write(0x1400, 2, kind, 1) == RANGE
    assert bench.write(0x1800, 2, kind, 1) == RANGE


def test_types_on_remote_request_are_for_tpdos_alone(bench: Bench):
    for kind in (0, 1, 240, 254, 255):
        assert bench.write(0x1400, 2, kind, 1) == 0
        assert bench.write(0x1800, 2, kind, 1) == 0
    for kind in (252, 253):
        assert bench.write(0x1400, 2, kind, 1) == RANGE
        assert bench.write(0x1800, 2, kind, 1) == 0


def test_subscriptions_follow_the_configuration(bench: Bench):
    drive = bench.drive
    usual = {0x000, 0x100, 0x205, 0x605, 0x705, 0x7E5}  # NMT, TIME, RPDO 1, SDO, guard requests, LSS
    assert drive.cob_ids() == usual | {0x080}
    drive.subscriptions_changed = False
    bench.map_rpdo(2, 0x181, 1, [0x00060010, 0x30110020])
    assert drive.subscriptions_changed
    assert drive.cob_ids() == usual | {0x080, 0x181}
    bench.must(0x1005, 0, 0x90, 4)
    bench.must(0x1016, 2, 0x030064, 4)
    bench.must(0x1012, 0, 0x00000100, 4)
    assert drive.cob_ids() == usual - {0x100} | {0x090, 0x181, 0x703}
    drive.subscriptions_changed = False
    bench.nmt(0x82)
    assert drive.subscriptions_changed
    assert drive.cob_ids() == usual | {0x080}


@pytest.mark.parametrize("value", [0x40000080, 0x20000080, 0x0, 0x7F, 0x101, 0x600 + 5, 0x701])
def test_sync_is_consumed_alone(bench: Bench, value: int):
    assert bench.write(0x1005, 0, value, 4) == RANGE


# -- reception ---------------------------------------------------------------------------------------------------------


def test_pdos_are_exchanged_in_operational_alone(bench: Bench):
    bench.map_cyclic()
    bench.nmt(0x80)
    bench.set_point(0x06, 0)
    assert bench.sync() == []
    assert bench.read(0x6040) == 0
    bench.nmt(0x01)
    assert bench.sync() == ["185#5002000000000000"]
    assert bench.read(0x6040) == 0  # what came before is not kept


def test_event_driven_rpdo_acts_at_once_and_synchronous_at_the_sync(bench: Bench):
    bench.map_rpdo(1, 0x205, 255, [0x60650020])
    bench.map_rpdo(2, 0x305, 240, [0x60660010])
    bench.nmt(0x01)
    bench.put(0x205, "11000000")
    bench.put(0x305, "2200")
    assert bench.read(0x6065) == 0x11
    assert bench.read(0x6066) == 10
    bench.put(0x305, "3300")  # the later one counts
    bench.sync()
    assert bench.read(0x6066) == 0x33


def test_actual_values_are_taken_before_new_demands_act(bench: Bench):
    bench.map_cyclic()
    bench.set_point(0x06, 0)
    assert bench.sync() == ["185#5002000000000000"]  # still switch on disabled
    assert bench.sync() == ["185#3102000000000000"]  # ready to switch on
    bench.drive.axis.latch = lambda now_ns: (now_ns // MS, -1.0, -7)
    bench.now_ns = 0x123 * MS
    assert bench.sync() == ["185#310223010000F9FF"]


def test_gaps_take_their_place_in_the_frame(bench: Bench):
    # Statusword of another drive skipped, its position taken, and its torque skipped.
    bench.map_rpdo(2, 0x181, 255, [0x00060010, 0x30110020, 0x00030010])
    bench.nmt(0x01)
    bench.put(0x181, "3712785634120101")
    assert bench.read(0x3011) == 0x12345678


def test_gaps_of_single_bits_shift_what_follows(bench: Bench):
    bench.map_rpdo(2, 0x305, 255, [0x00010001, 0x30110020, 0x00010001, 0x60B20010])
    bench.nmt(0x01)
    word = 1 | (-3 & 0xFFFFFFFF) << 1 | 1 << 33 | (-5 & 0xFFFF) << 34
    bench.put(0x305, word.to_bytes(7, "little").hex())
    assert bench.read(0x3011, signed=True) == -3
    assert bench.read(0x60B2, signed=True) == -5


def test_two_rpdos_may_share_a_cob_id(bench: Bench):
    bench.map_rpdo(1, 0x305, 255, [0x60650020])
    bench.map_rpdo(2, 0x305, 255, [0x00070020, 0x60660010])
    bench.nmt(0x01)
    bench.aside += bench.put(0x305, "110000002200")
    assert bench.read(0x6065) == 0x11
    assert bench.read(0x6066) == 0x22


def test_short_rpdo_is_not_applied_and_long_one_is(bench: Bench):
    bench.map_rpdo(1, 0x205, 255, [0x60650020])
    bench.nmt(0x01)
    assert bench.put(0x205, "110000") == ["085#1082110000000000"]
    assert bench.read(0x6065) == 512
    assert bench.read(0x1001) == 0x11
    assert bench.put(0x205, "1100000099") == ["085#2082110000000000"]
    assert bench.read(0x6065) == 0x11
    assert bench.put(0x205, "12000000") == ["085#0000000000000000"]
    assert bench.read(0x1001) == 0
    assert bench.drive.power_state.name == "SWITCH_ON_DISABLED"  # no fault of the axis


def test_sync_with_data_is_an_error_and_no_sync(bench: Bench):
    bench.map_cyclic()
    assert bench.put(0x080, "01") == ["085#4082110000000000"]
    assert bench.put(0x080, "02") == []
    assert bench.sync() == ["085#0000000000000000", "185#5002000000000000"]


def test_rpdo_without_entries_takes_nothing(bench: Bench):
    bench.map_rpdo(1, 0x205, 255, [])
    bench.nmt(0x01)
    assert bench.put(0x205, "1122") == []


def test_value_that_its_object_refuses_leaves_it_as_it_was(bench: Bench):
    bench.map_rpdo(1, 0x205, 255, [0x60850020, 0x60650020])
    bench.nmt(0x01)
    bench.put(0x205, "0000000007000000")
    assert bench.read(0x6085) == 200_000
    assert bench.read(0x6065) == 7


# -- transmission ------------------------------------------------------------------------------------------------------


def test_every_nth_sync(bench: Bench):
    bench.map_tpdo(1, 0x185, 3, [0x60610008])
    bench.map_tpdo(2, 0x285, 1, [0x10010008])
    bench.nmt(0x01)
    assert [bench.sync() for _ in range(6)] == [["285#00"], ["285#00"], ["185#00", "285#00"]] * 2


def test_type_zero_sends_at_the_sync_after_a_change(bench: Bench):
    bench.map_tpdo(1, 0x185, 0, [0x60410010, 0x60640020])
    bench.nmt(0x01)
    assert bench.sync() == ["185#500200000000"]
    assert bench.sync() == []
    bench.drive.axis.latch = lambda now_ns: (5, 0.0, 0)
    bench.tick()
    assert bench.sync() == []  # a measured value that moves is no event
    bench.control(0x06)
    assert bench.sync() == ["185#310205000000"]


def test_event_driven_tpdo_is_sent_on_entering_operational_and_on_change(bench: Bench):
    bench.nmt(0x01)
    assert bench.tick() == ["185#5002"]
    assert bench.run(100 * MS) == []
    bench.control(0x06)
    assert bench.tick() == ["185#3102"]
    assert bench.run(100 * MS) == []


def test_inhibit_time_holds_back_and_sends_the_last_state(bench: Bench):
    bench.must(0x1800, 1, 0xC0000185, 4)
    bench.must(0x1800, 3, 100, 2)  # 10 ms
    bench.must(0x1800, 1, 0x40000185, 4)
    assert bench.write(0x1800, 3, 50, 2) == RANGE
    bench.nmt(0x01)
    assert bench.tick() == ["185#5002"]
    bench.control(0x06)
    bench.tick()
    bench.control(0x07)
    assert bench.run(8 * MS) == []
    assert bench.run(1 * MS) == ["185#3302"]


def test_event_timer_runs_from_the_last_transmission(bench: Bench):
    bench.must(0x1800, 5, 20, 2)
    bench.nmt(0x01)
    assert bench.tick() == ["185#5002"]
    assert bench.run(19 * MS) == []
    assert bench.run(1 * MS) == ["185#5002"]
    assert bench.run(9 * MS) == []
    bench.control(0x06)
    assert bench.tick() == ["185#3102"]
    assert bench.run(19 * MS) == []
    assert bench.run(1 * MS) == ["185#3102"]
    bench.nmt(0x80)
    assert bench.run(100 * MS) == []
    assert bench.drive.next_wake_ns() is None


def test_jitter_of_a_measured_value_does_not_flood(bench: Bench):
    bench.map_tpdo(1, 0x185, 255, [0x60410010, 0x60640020])
    bench.nmt(0x01)
    bench.tick()
    frames: list[str] = []
    for k in range(50):
        bench.shaft = k % 2
        assert bench.read(0x6064) == (k + 1) % 2 * (k > 0)  # reading it is no event either
        frames += bench.tick()
    assert frames == []


def test_all_four_pairs_of_pdos(bench: Bench):
    targets = (0x60650020, 0x60660010, 0x60720010, 0x60B20010)
    for number, word in enumerate(targets):
        bench.map_tpdo(number + 1, 0x185 + 0x100 * number, 1, [0x60640020])
        bench.map_rpdo(number + 1, 0x205 + 0x100 * number, 1, [word])
    bench.nmt(0x01)
    for number, data in enumerate(("01020304", "0506", "0708", "090A")):
        assert bench.put(0x205 + 0x100 * number, data) == []
    assert [frame[:4] for frame in bench.sync()] == ["185#", "285#", "385#", "485#"]
    assert [bench.read(word >> 16) for word in targets] == [0x04030201, 0x0605, 0x0807, 0x0A09]


def test_extreme_actual_values_do_not_break_the_frame(bench: Bench):
    bench.map_tpdo(1, 0x185, 1, [0x60640020, 0x606C0020])
    bench.map_tpdo(2, 0x285, 1, [0x60770010, 0x60F40020])
    bench.nmt(0x01)
    bench.drive.axis.latch = lambda now_ns: ((1 << 31) + 2, 1e12, 100_000)
    assert bench.sync() == ["185#02000080FFFFFF7F", "285#FF7F00000000"]


def test_settings_show_in_the_dictionary():
    bench = Bench(DriveSettings(counts_per_revolution=8192, rated_torque_Nm=2.25, gains=(1, 2, 3, 4, 5)))
    assert bench.read(0x608F, 1) == 8192
    assert bench.read(0x6076) == 2250
    assert bench.drive.axis.gains == (1, 2, 3, 4, 5)
    bench.must(0x3020, 4, -9, 4)
    assert bench.drive.axis.gains == (1, 2, 3, -9, 5)


def test_settings_are_checked():
    drive = Bench().drive
    with pytest.raises(ValueError, match="5 gains"):
        Drive(5, drive.dictionary.description, DriveSettings(gains=(1, 2)), lambda image: None)
    with pytest.raises(ValueError, match="node_id"):
        Drive(0, drive.dictionary.description, DriveSettings(), lambda image: None)
