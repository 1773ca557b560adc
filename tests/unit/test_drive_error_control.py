"""Node guarding, several heartbeat producers, EMCY inhibit time and TIME of the emulated drive."""

import pytest
from drive_bench import MS, Bench

from drivers.frame import Frame
from sim_drive.communication.time_of_day import TimeOfDay

RANGE = 0x06090030
BOOT_UP = "705#00"
LOST, BACK = "085#3081110000000000", "085#0000000000000000"


@pytest.fixture
def bench() -> Bench:
    return Bench()


def guard(bench: Bench) -> list[str]:
    """A guard request of the master."""
    bench.drive.receive(Frame(0x705, b"", is_remote=True), bench.now_ns)
    return bench.sent()


# -- node guarding -----------------------------------------------------------------------------------------------------


def test_guard_requests_are_answered_with_state_and_toggle_bit(bench: Bench):
    assert guard(bench) == ["705#7F"]
    assert guard(bench) == ["705#FF"]
    bench.nmt(0x01)
    assert guard(bench) == ["705#05"]
    bench.nmt(0x02)
    assert guard(bench) == ["705#84"]
    assert guard(bench) == ["705#04"]


@pytest.mark.parametrize("command", [0x81, 0x82])
def test_resets_begin_with_the_toggle_bit_at_0(bench: Bench, command: int):
    guard(bench)
    assert bench.nmt(command) == [BOOT_UP]
    assert guard(bench) == ["705#7F"]


def test_heartbeat_producer_leaves_guard_requests_unanswered(bench: Bench):
    bench.must(0x1017, 0, 1000, 2)
    assert guard(bench) == []
    bench.must(0x1017, 0, 0, 2)
    assert guard(bench) == ["705#7F"]


def test_requests_to_others_pass_by(bench: Bench):
    bench.drive.receive(Frame(0x706, b"", is_remote=True), bench.now_ns)
    assert bench.sent() == []
    assert bench.put(0x705, "7F") == []  # nor is a heartbeat with our own number a request


def test_life_guarding_starts_with_the_first_request(bench: Bench):
    bench.must(0x100C, 0, 50, 2)
    bench.must(0x100D, 0, 3, 1)
    assert bench.run(1000 * MS) == []
    assert guard(bench) == ["705#7F"]
    assert bench.run(149 * MS) == []
    assert guard(bench) == ["705#FF"]
    assert bench.run(149 * MS) == []
    assert bench.run(1 * MS) == [LOST]
    assert bench.read(0x1003, 1) == 0x8130
    assert bench.run(1000 * MS) == []
    assert guard(bench) == ["705#7F", BACK]
    assert bench.read(0x1001) == 0


@pytest.mark.parametrize(("guard_time", "factor"), [(0, 3), (50, 0)])
def test_no_life_guarding_with_a_factor_or_time_of_0(bench: Bench, guard_time: int, factor: int):
    bench.must(0x100C, 0, guard_time, 2)
    bench.must(0x100D, 0, factor, 1)
    guard(bench)
    assert bench.run(1000 * MS) == []


def test_new_life_time_begins_with_the_next_request(bench: Bench):
    bench.must(0x100C, 0, 10, 2)
    bench.must(0x100D, 0, 1, 1)
    guard(bench)
    assert bench.run(10 * MS) == [LOST]
    bench.must(0x100C, 0, 20, 2)
    assert bench.aside == [BACK]
    assert bench.run(1000 * MS) == []


@pytest.mark.parametrize(("action", "state"), [(0, "7F"), (1, "85"), (2, "04")])
def test_loss_acts_as_1029h_says(bench: Bench, action: int, state: str):
    bench.must(0x1029, 1, action, 1)
    bench.must(0x100C, 0, 10, 2)
    bench.must(0x100D, 0, 1, 1)
    bench.must(0x1800, 1, 0xC0000185, 4)
    bench.nmt(0x01)
    assert guard(bench) == ["705#05"]
    assert bench.run(10 * MS) == [LOST]
    # The toggle bit of the second answer is set.
    assert guard(bench)[0] == f"705#{int(state, 16) | 0x80:02X}"


def test_enabled_axis_faults_when_the_guarding_master_is_lost(bench: Bench):
    bench.must(0x605E, 0, 0, 2)
    bench.must(0x100C, 0, 10, 2)
    bench.must(0x100D, 0, 2, 1)
    bench.enable()
    guard(bench)
    assert LOST in bench.run(20 * MS)
    bench.tick()
    assert bench.statusword & 0x4F == 0x08
    assert not bench.drive.is_powered


def test_heartbeat_and_guarding_have_to_be_back_both(bench: Bench):
    bench.must(0x100C, 0, 10, 2)
    bench.must(0x100D, 0, 1, 1)
    bench.must(0x1016, 1, 0x7F000A, 4)
    guard(bench)
    bench.put(0x77F, "05")
    assert bench.run(10 * MS) == [LOST]
    assert bench.put(0x77F, "05") == []
    assert guard(bench)[-1] == BACK


# -- several heartbeat producers ---------------------------------------------------------------------------------------


def test_four_producers_are_watched_each_by_its_own_time(bench: Bench):
    for number, (node_id, time) in enumerate(((1, 10), (2, 20), (3, 30), (4, 40)), start=1):
        bench.must(0x1016, number, node_id << 16 | time, 4)
    assert {0x701, 0x702, 0x703, 0x704} <= bench.drive.cob_ids()
    for node_id in (2, 3, 4):
        assert bench.put(0x700 + node_id, "05") == []
    assert bench.run(19 * MS) == []  # node 1 has never been heard
    bench.put(0x703, "05")
    assert bench.run(1 * MS) == [LOST]
    assert bench.put(0x702, "05") == [BACK]
    assert bench.run(19 * MS) == []
    bench.put(0x702, "05")
    assert bench.run(1 * MS) == [LOST]  # node 4 after 40 ms
    assert bench.put(0x704, "05") == [BACK]
    assert bench.run(8 * MS) == []
    assert bench.run(1 * MS) == [LOST]  # node 3 after 19 + 30 ms


def test_error_is_over_when_all_are_back(bench: Bench):
    bench.must(0x1016, 1, 0x01000A, 4)
    bench.must(0x1016, 2, 0x02000A, 4)
    bench.put(0x701, "05")
    bench.put(0x702, "05")
    assert bench.run(10 * MS) == [LOST]
    assert bench.put(0x701, "05") == []
    assert bench.put(0x702, "05") == [BACK]


@pytest.mark.parametrize("time", [1, 0xFFFF])
def test_one_producer_is_watched_once(bench: Bench, time: int):
    bench.must(0x1016, 1, 0x7F0064, 4)
    assert bench.write(0x1016, 4, 0x7F0000 | time, 4) == 0x06040043
    bench.must(0x1016, 4, 0x7F0000, 4)  # an entry that is off is no second one
    assert bench.read_abort(0x1016, 5) == 0x06090011


# -- EMCY --------------------------------------------------------------------------------------------------------------


def test_inhibit_time_keeps_emcy_apart_and_loses_none(bench: Bench):
    bench.must(0x1015, 0, 100, 2)  # 10 ms
    bench.drive.warn(0x2310, 0x02, bench.now_ns)
    bench.drive.warn(0x4210, 0x08, bench.now_ns)
    assert bench.sent() == ["085#1023030000000000"]
    bench.drive.end_trip(0x4210, bench.now_ns)
    bench.drive.end_trip(0x2310, bench.now_ns)
    assert bench.run(9 * MS) == []
    assert bench.run(1 * MS) == ["085#10420B0000000000"]  # with the register as it was
    assert bench.run(9 * MS) == []
    assert bench.run(1 * MS) == [BACK]
    assert bench.run(100 * MS) == []
    assert bench.drive.next_wake_ns() is None
    bench.drive.warn(0x2310, 0x02, bench.now_ns)
    assert bench.sent() == ["085#1023030000000000"]


def test_stopping_forgets_what_was_held_back(bench: Bench):
    bench.must(0x1015, 0, 100, 2)
    bench.drive.warn(0x2310, 0x02, bench.now_ns)
    bench.drive.warn(0x4210, 0x08, bench.now_ns)
    bench.nmt(0x02)
    bench.sent()
    assert bench.run(100 * MS) == []
    bench.nmt(0x80)
    assert bench.run(100 * MS) == []


def test_flood_of_errors_is_bounded(bench: Bench):
    bench.must(0x1015, 0, 100, 2)
    for code in range(0xFF00, 0xFF40):
        bench.drive.warn(code, 0x80, bench.now_ns)
    bench.sent()
    frames = bench.run(1000 * MS)
    assert len(frames) == 16
    assert frames[-1] == "085#3FFF810000000000"


# -- TIME --------------------------------------------------------------------------------------------------------------

# 14975 days after 1984-01-01 is 2024-12-31; 86 399 500 ms is half a second before midnight.
NEW_YEARS_EVE = "0C5A26057F3A"


def test_time_message_sets_a_clock_that_goes_on(bench: Bench):
    assert bench.drive.time_of_day(bench.now_ns) is None
    assert (bench.read(0x3030, 1), bench.read(0x3030, 2)) == (0, 0)
    assert bench.put(0x100, NEW_YEARS_EVE) == []
    assert (bench.read(0x3030, 1), bench.read(0x3030, 2)) == (86_399_500, 14_975)
    bench.run(750 * MS)
    assert (bench.read(0x3030, 1), bench.read(0x3030, 2)) == (250, 14_976)
    assert bench.drive.time_of_day(bench.now_ns) == TimeOfDay(14_976, 250)
    bench.nmt(0x82)
    assert bench.read(0x3030, 2) == 14_976
    bench.nmt(0x81)
    assert bench.read(0x3030, 2) == 0


@pytest.mark.parametrize("data", ["", NEW_YEARS_EVE[:10], NEW_YEARS_EVE + "00", "005C26057F3A", "FFFFFF0F0000"])
def test_what_is_no_time_is_ignored(bench: Bench, data: str):
    bench.put(0x100, data)
    assert bench.drive.time_of_day(bench.now_ns) is None


def test_four_reserved_bits_of_the_milliseconds_count_for_nothing(bench: Bench):
    bench.put(0x100, "010000F00200")
    assert bench.drive.time_of_day(bench.now_ns) == TimeOfDay(2, 1)


def test_time_is_taken_where_1012h_says(bench: Bench):
    assert bench.write(0x1012, 0, 0x80000110, 4) == RANGE  # not while it exists
    for refused in (0xC0000100, 0x40000100, 0xA0000100, 0x00000000, 0x00000181 - 1):
        assert bench.write(0x1012, 0, refused, 4) == RANGE
    bench.must(0x1012, 0, 0x00000190, 4)
    bench.put(0x100, NEW_YEARS_EVE)
    bench.put(0x190, NEW_YEARS_EVE)
    assert bench.drive.time_of_day(bench.now_ns) is None
    bench.must(0x1012, 0, 0x80000190, 4)
    bench.put(0x190, NEW_YEARS_EVE)
    assert bench.read(0x3030, 2) == 14_975


def test_time_is_not_taken_in_stopped(bench: Bench):
    bench.nmt(0x02)
    bench.put(0x100, NEW_YEARS_EVE)
    bench.nmt(0x80)
    assert bench.drive.time_of_day(bench.now_ns) is None
