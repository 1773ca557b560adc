"""NMT, heartbeats, EMCY and error objects of the emulated drive."""

import pytest
from drive_bench import MS, Bench

from drivers.frame import Frame
from drivers.nmt import NmtState
from sim_drive.device.drive import DriveSettings

BOOT_UP = "705#00"


@pytest.fixture
def bench() -> Bench:
    return Bench()


# -- NMT ---------------------------------------------------------------------------------------------------------------


def test_boot_up_at_power_on_and_silence_before():
    bench = Bench(boot=False)
    assert bench.drive.next_wake_ns() == 0
    assert bench.sdo("4000100000000000") == ""
    bench.drive.wake(0)
    assert bench.sent() == [BOOT_UP]
    assert bench.drive.nmt_state is NmtState.PRE_OPERATIONAL
    assert bench.sdo("4000100000000000") == "4300100092010200"


def test_boot_up_may_take_its_time():
    bench = Bench(DriveSettings(boot_up_delay_s=0.5), boot=False)
    bench.drive.wake(0)
    assert bench.run(499 * MS) == []
    assert bench.run(1 * MS) == [BOOT_UP]
    assert bench.nmt(0x81) == []
    assert bench.sdo("4000100000000000") == ""
    assert bench.run(500 * MS) == [BOOT_UP]


@pytest.mark.parametrize("command", [0x81, 0x82])
@pytest.mark.parametrize("node_id", [0, 5])
def test_both_resets_boot_up_from_every_state(bench: Bench, command: int, node_id: int):
    for before in (0x01, 0x02, 0x80):
        bench.nmt(before)
        bench.sent()
        assert bench.nmt(command, node_id) == [BOOT_UP]
        assert bench.drive.nmt_state is NmtState.PRE_OPERATIONAL


@pytest.mark.parametrize("data", ["", "01", "010500", "0106", "0305", "0005", "FF05", "0180"])
def test_commands_for_others_wrong_lengths_and_unknown_ones_are_ignored(bench: Bench, data: str):
    assert bench.put(0x000, data) == []
    assert bench.drive.nmt_state is NmtState.PRE_OPERATIONAL


def test_remote_frames_are_ignored(bench: Bench):
    bench.drive.receive(Frame(0x000, b"", is_remote=True), bench.now_ns)
    bench.drive.receive(Frame(0x605, b"", is_remote=True), bench.now_ns)
    assert bench.sent() == []


def test_every_state_and_command(bench: Bench):
    states = {0x01: NmtState.OPERATIONAL, 0x02: NmtState.STOPPED, 0x80: NmtState.PRE_OPERATIONAL}
    for first in states:
        for second, expected in states.items():
            bench.nmt(first)
            bench.nmt(second)
            assert bench.drive.nmt_state is expected


def test_stopped_answers_nmt_and_heartbeat_alone(bench: Bench):
    bench.must(0x1017, 0, 100, 2)
    bench.map_cyclic()
    bench.nmt(0x02)
    assert bench.sdo("4000100000000000") == ""
    assert bench.sync() == []
    bench.drive.trip(0x2310, 0x02, bench.now_ns)
    assert bench.run(99 * MS) == []
    assert bench.run(1 * MS) == ["705#04"]
    bench.nmt(0x80)
    assert bench.read(0x1003, 1) == 0x2310


def test_stopping_drops_the_transfer_and_the_set_point_under_way(bench: Bench):
    bench.map_cyclic()
    bench.sdo("2100300109000000")
    bench.set_point(0x06, 0)
    bench.nmt(0x02)
    bench.nmt(0x01)
    assert bench.sdo("0001020304050607")[8:] == "01000405"
    bench.sync()
    assert bench.statusword & 0x6F == 0x40


def test_reset_communication_restores_1000h_to_1fffh_and_leaves_the_rest(bench: Bench):
    bench.must(0x1017, 0, 100, 2)
    bench.must(0x6065, 0, 77, 4)
    bench.map_cyclic()
    bench.nmt(0x82)
    assert bench.read(0x1017) == 0
    assert bench.read(0x1600, 0) == 1
    assert bench.read(0x1400, 1) == 0x205
    assert bench.read(0x6065) == 77
    assert bench.run(500 * MS) == []


def test_reset_node_restores_everything_but_the_slots(bench: Bench):
    image = b"OK" + bytes(16)
    assert bench.download(0x3001, 1, image) == 0
    bench.must(0x3001, 2, 1, 1)
    bench.must(0x3010, 0, 2, 1)
    bench.must(0x3020, 1, 77, 4)
    bench.must(0x6065, 0, 77, 4)
    bench.enable()
    assert bench.drive.is_powered
    bench.nmt(0x81)
    assert not bench.drive.is_powered
    bench.tick()
    assert bench.statusword & 0x6F == 0x40
    assert bench.read(0x6065) == 512
    assert bench.read(0x3010) == 0
    assert bench.drive.axis.gains == (256, 0, 0, 0, 0)
    assert bench.read(0x3001, 3) == 2
    assert bench.read(0x3001, 6) == 7


# -- heartbeats --------------------------------------------------------------------------------------------------------


def test_producer_period_starts_at_once(bench: Bench):
    bench.must(0x1017, 0, 50, 2)
    assert bench.run(49 * MS) == []
    assert bench.run(1 * MS) == ["705#7F"]
    assert bench.run(30 * MS) == []
    bench.must(0x1017, 0, 10, 2)
    assert bench.run(9 * MS) == []
    assert bench.run(1 * MS) == ["705#7F"]
    bench.nmt(0x01)
    assert "705#05" in bench.run(10 * MS)
    bench.must(0x1017, 0, 0, 2)
    assert bench.run(1000 * MS) == []


def test_late_host_gets_one_heartbeat_on_the_old_grid(bench: Bench):
    bench.must(0x1017, 0, 10, 2)
    start_ns = bench.now_ns
    bench.drive.wake(start_ns + 55 * MS)
    assert bench.sent() == ["705#7F"]
    assert bench.drive.next_wake_ns() == start_ns + 60 * MS


def test_consumer_starts_with_the_first_heartbeat(bench: Bench):
    bench.must(0x1016, 1, 0x7F0064, 4)  # node 127, 100 ms
    assert bench.run(1000 * MS) == []
    bench.put(0x77F, "05")
    assert bench.run(99 * MS) == []
    bench.put(0x77F, "05")
    assert bench.run(99 * MS) == []
    assert bench.run(1 * MS) == ["085#3081110000000000"]
    assert bench.read(0x1001) == 0x11
    assert bench.read(0x1003, 1) == 0x8130
    assert bench.run(1000 * MS) == []
    assert bench.put(0x77F, "05") == ["085#0000000000000000"]
    assert bench.read(0x1001) == 0


def test_boot_up_of_the_watched_node_is_its_loss_and_no_heartbeat(bench: Bench):
    bench.must(0x1016, 1, 0x7F0064, 4)
    assert bench.put(0x77F, "00") == []
    assert bench.run(1000 * MS) == []
    bench.put(0x77F, "7F")
    assert bench.put(0x77F, "00") == ["085#3081110000000000"]
    assert bench.put(0x77F, "7F") == ["085#0000000000000000"]


@pytest.mark.parametrize(("action", "state"), [(0, 0x7F), (1, 0x05), (2, 0x04)])
def test_loss_acts_as_1029h_says(bench: Bench, action: int, state: int):
    bench.must(0x1029, 1, action, 1)
    bench.must(0x1016, 1, 0x7F0064, 4)
    bench.must(0x1017, 0, 1000, 2)
    bench.nmt(0x01)
    bench.put(0x77F, "05")
    frames = bench.run(1000 * MS)
    assert "085#3081110000000000" in frames
    assert frames[-1] == f"705#{state:02X}"


def test_loss_while_enabled_brakes_and_faults_until_the_master_is_back(bench: Bench):
    bench.must(0x1029, 1, 1, 1)
    bench.must(0x1016, 1, 0x7F0014, 4)  # 20 ms
    bench.must(0x605E, 0, 2, 2)
    bench.must(0x6085, 0, 100_000, 4)
    bench.enable()
    bench.follows = True
    bench.map_cyclic()
    bench.put(0x77F, "05")
    for k in range(1, 20):
        bench.cycle(10 * k)
    frames = bench.cycle(200)
    assert "085#3081110000000000" in frames
    # 10000 counts/s at 100000 counts/s^2: 100 ms and 500 counts to standstill.
    stopped_from = bench.drive.position_demand_counts
    assert bench.statusword & 0x4F == 0x0F
    bench.run(98 * MS)
    assert bench.statusword & 0x4F == 0x0F
    assert bench.drive.is_powered
    bench.run(3 * MS)
    assert bench.statusword & 0x4F == 0x08
    assert not bench.drive.is_powered
    assert abs(bench.shaft - stopped_from - 500) < 12
    bench.control(0x80)
    assert bench.statusword & 0x4F == 0x08  # the cause persists
    bench.put(0x77F, "05")
    bench.control(0x00)
    bench.control(0x80)
    assert bench.statusword & 0x6F == 0x40


def test_consumer_entries_are_checked(bench: Bench):
    bench.must(0x1016, 1, 0x7F0064, 4)
    assert bench.write(0x1016, 2, 0x7F0032, 4) == 0x06040043
    assert bench.write(0x1016, 2, 0x800032, 4) == 0x06090030
    assert bench.write(0x1016, 2, 0x1010032, 4) == 0x06090030
    bench.must(0x1016, 1, 0, 4)
    bench.must(0x1016, 2, 0x7F0032, 4)
    assert 0x77F in bench.drive.cob_ids()


# -- EMCY and errors -----------------------------------------------------------------------------------------------


def test_emcy_register_history_and_recovery_agree(bench: Bench):
    bench.drive.trip(0x2310, 0x02, bench.now_ns)  # current
    bench.drive.trip(0x4210, 0x08, bench.now_ns)  # temperature
    assert bench.sent() == ["085#1023030000000000", "085#10420B0000000000"]
    assert bench.read(0x1001) == 0x0B
    assert bench.read(0x1003, 0) == 2
    assert bench.read(0x1003, 1) == 0x4210
    assert bench.read(0x1003, 2) == 0x2310
    assert bench.read_abort(0x1003, 3) == 0x08000024
    assert bench.read(0x603F) == 0x4210
    bench.tick()
    frames = bench.put(0x605, "2B40600080000000")
    assert frames == ["085#0000000000000000", "585#6040600000000000"]
    assert bench.read(0x1001) == 0
    assert bench.read(0x1003, 1) == 0x4210


def test_an_error_is_told_once(bench: Bench):
    bench.drive.trip(0x2310, 0x02, bench.now_ns)
    bench.drive.trip(0x2310, 0x02, bench.now_ns)
    assert len(bench.sent()) == 1
    assert bench.read(0x1003, 0) == 1


def test_history_holds_eight_and_is_cleared_by_zero_alone(bench: Bench):
    for code in range(0x2310, 0x231A):
        bench.drive.trip(code, 0, bench.now_ns)
    bench.sent()
    assert bench.read(0x1003, 0) == 8
    assert [bench.read(0x1003, n) for n in range(1, 9)] == list(range(0x2319, 0x2311, -1))
    assert bench.write(0x1003, 0, 1, 1) == 0x06090030
    assert bench.write(0x1003, 0, 0, 1) == 0
    assert bench.read_abort(0x1003, 1) == 0x08000024


def test_emcy_may_be_moved_only_while_off(bench: Bench):
    assert bench.write(0x1014, 0, 0x190, 4) == 0x06090030
    bench.must(0x1014, 0, 0x80000085, 4)
    bench.drive.trip(0x2310, 0x02, bench.now_ns)
    assert bench.sent() == []
    for restricted in (0x000, 0x07F, 0x123, 0x585, 0x605, 0x6E0, 0x705, 0x7E5, 0x20000190):
        assert bench.write(0x1014, 0, restricted, 4) == 0x06090030
    bench.must(0x1014, 0, 0x190, 4)
    bench.drive.trip(0x2311, 0x02, bench.now_ns)
    assert bench.sent() == ["190#1123030000000000"]


def test_persisting_trip_outlives_fault_resets_and_a_node_reset(bench: Bench):
    bench.drive.trip(0xFF10, 0x80, bench.now_ns, persists=True)
    bench.tick()
    bench.sent()
    bench.control(0x80)
    assert bench.statusword & 0x4F == 0x08
    bench.nmt(0x81)
    bench.tick()
    bench.tick()
    assert bench.statusword & 0x4F == 0x08
    assert bench.read(0x1001) == 0x81
    assert bench.read(0x603F) == 0xFF10
    bench.drive.end_trip(0xFF10, bench.now_ns)
    bench.control(0x80)
    bench.sent()
    assert bench.statusword & 0x6F == 0x40


def test_stop_and_communication_reset_fault_an_enabled_axis(bench: Bench):
    for command in (0x02, 0x82):
        bench.enable()
        bench.nmt(command)
        bench.nmt(0x80)
        bench.tick()
        bench.tick()
        assert bench.statusword & 0x4F == 0x08
        assert bench.read(0x603F) == 0x8100
        bench.control(0x80)
        bench.control(0x00)
    bench.enable()
    bench.nmt(0x80)  # pre-operational is no loss of the master: SDO still commands
    bench.tick()
    assert bench.statusword & 0x6F == 0x27
