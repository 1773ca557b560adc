"""Position demand, following error, missing set-points, homing and camming of the emulated drive."""

import struct
import zlib

import pytest
from drive_bench import MS, Bench

from sim_drive.device.axis import wrap_int32
from sim_drive.device.cia402 import PowerState
from sim_drive.device.demand import Demand
from sim_drive.settings import DriveSettings

MICRO = 1_000


def cyclic_bench(settings: DriveSettings | None = None, mode: int = 8) -> Bench:
    bench = Bench(settings)
    bench.map_cyclic()
    bench.enable(mode)
    return bench


def demand_at(bench: Bench, after_ns: int) -> float:
    """The demand ``after_ns`` from the bench's time, without letting that time pass."""
    bench.drive.on_servo_tick(bench.now_ns + after_ns, bench.shaft)
    return bench.drive.position_demand_counts


# -- the demand by itself ------------------------------------------------------------------------------------------


def test_line_then_overrun_then_hold():
    demand = Demand()
    demand.hold(100.0)
    assert demand.at(10**12) == 100.0
    demand.go_to(110.0, 1000 * MICRO, 1e-3, 1e-3)
    assert demand.at(1000 * MICRO) == 100.0
    assert demand.at(1250 * MICRO) == pytest.approx(102.5)
    assert demand.at(2000 * MICRO) == pytest.approx(110.0)
    assert demand.at(2500 * MICRO) == pytest.approx(115.0)
    assert demand.at(3000 * MICRO) == pytest.approx(120.0)
    assert demand.at(9000 * MICRO) == pytest.approx(120.0)
    assert demand.velocity_at(2500 * MICRO) == pytest.approx(10_000.0)
    assert demand.velocity_at(3000 * MICRO) == 0.0
    assert demand.at(0) == 100.0


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_brake_is_continuous_and_ends_at_v_squared_over_2a(direction: float):
    demand = Demand()
    demand.go_to(direction * 10.0, 0, 1e-3, 1e-3)
    demand.brake(500 * MICRO, 1e5)
    assert demand.at(500 * MICRO) == pytest.approx(direction * 5.0)
    assert demand.velocity_at(500 * MICRO) == pytest.approx(direction * 1e4)
    assert demand.velocity_at(0) == pytest.approx(direction * 1e4)
    assert not demand.is_over(100 * MS)
    assert demand.is_over(101 * MS)
    assert demand.at(10**12) == pytest.approx(direction * 505.0)


@pytest.mark.parametrize(
    ("value", "wrapped"),
    [(0, 0), ((1 << 31) - 1, (1 << 31) - 1), (1 << 31, -(1 << 31)), (-(1 << 31) - 1, (1 << 31) - 1), (1 << 32, 0)],
)
def test_wrap(value: int, wrapped: int):
    assert wrap_int32(value) == wrapped


# -- csp ---------------------------------------------------------------------------------------------------------------


def test_target_of_a_sync_is_reached_one_interpolation_time_later():
    bench = cyclic_bench()
    bench.set_point(0x0F, 40)
    assert demand_at(bench, 0) == 0.0  # no SYNC yet
    bench.sync()
    assert demand_at(bench, 250 * MICRO) == pytest.approx(10.0)
    assert demand_at(bench, 1000 * MICRO) == pytest.approx(40.0)
    bench.now_ns += MS
    bench.set_point(0x0F, 60)
    bench.sync()
    assert demand_at(bench, 500 * MICRO) == pytest.approx(50.0)


def test_interpolation_time_is_60c2h():
    bench = Bench()
    bench.must(0x60C2, 1, 40, 1)
    bench.must(0x60C2, 2, -4, 1)  # 4 ms
    bench.map_cyclic()
    bench.enable()
    assert bench.write(0x60C2, 1, 10, 1) == 0x08000022  # not while it is in use
    bench.set_point(0x0F, 40)
    bench.sync()
    assert demand_at(bench, 1 * MS) == pytest.approx(10.0)
    assert demand_at(bench, 4 * MS) == pytest.approx(40.0)


def test_late_sync_goes_on_from_where_the_demand_is():
    bench = cyclic_bench()
    bench.set_point(0x0F, 10)
    bench.sync()
    bench.now_ns += MS + 200 * MICRO
    bench.set_point(0x0F, 20)
    bench.sync()
    assert demand_at(bench, 0) == pytest.approx(12.0)
    assert demand_at(bench, 500 * MICRO) == pytest.approx(16.0)
    assert demand_at(bench, 1000 * MICRO) == pytest.approx(20.0)


def test_entering_csp_holds_until_the_first_new_target():
    bench = Bench()
    bench.shaft = 1000
    bench.map_cyclic()
    bench.must(0x607A, 0, -5000, 4)  # an old target must not count
    bench.enable()
    assert bench.run(20 * MS) == []
    assert bench.drive.position_demand_counts == 1000.0
    bench.sync()
    bench.tick()
    assert bench.drive.position_demand_counts == 1000.0
    assert bench.read(0x6062) == 1000
    bench.cycle(1003)
    assert bench.drive.position_demand_counts == pytest.approx(1003.0)


def test_switching_into_csp_holds_too():
    bench = cyclic_bench(mode=6)
    for _ in range(5):
        bench.cycle(300)
    bench.must(0x6060, 0, 8, 1)
    bench.tick()
    bench.sync()
    bench.tick()
    assert bench.drive.position_demand_counts == 0.0
    bench.cycle(2)
    assert bench.drive.position_demand_counts == pytest.approx(2.0)


def test_sdo_target_is_reached_without_running_over():
    bench = cyclic_bench()
    bench.must(0x607A, 0, 8, 4)
    bench.run(10 * MS)
    assert bench.drive.position_demand_counts == pytest.approx(8.0)
    assert bench.drive.power_state is PowerState.OPERATION_ENABLED


def test_statusword_follows_command_bit():
    bench = cyclic_bench()
    assert bench.statusword == 0x1237
    bench.control(0x07)
    assert bench.statusword == 0x0233


def test_software_limits_hold_the_demand_and_show():
    bench = Bench()
    bench.must(0x607D, 1, -10, 4)
    bench.must(0x607D, 2, 20, 4)
    bench.map_cyclic()
    bench.enable()
    bench.cycle(25)
    assert bench.drive.position_demand_counts == pytest.approx(20.0)
    assert bench.statusword & 0x0800
    bench.cycle(-25)
    assert bench.drive.position_demand_counts == pytest.approx(-10.0)
    bench.cycle(0)
    assert not bench.statusword & 0x0800


def test_targets_wrap_with_the_position():
    bench = Bench(DriveSettings(initial_offset_counts=(1 << 31) - 10))
    bench.map_cyclic()
    bench.enable()
    assert bench.read(0x6064, signed=True) == (1 << 31) - 10
    bench.cycle(wrap_int32((1 << 31) + 10))
    assert bench.drive.position_demand_counts == pytest.approx(20.0)
    assert bench.read(0x6062, signed=True) == -(1 << 31) + 10
    assert bench.read(0x60F4, signed=True) == 20


def test_torque_offset_is_per_mille_of_rated_torque_and_only_while_enabled():
    bench = cyclic_bench(DriveSettings(rated_torque_Nm=2.0))
    bench.set_point(0x0F, 0, -250)
    assert bench.drive.axis.torque_offset_Nm == 0.0
    bench.sync()
    assert bench.drive.axis.torque_offset_Nm == pytest.approx(-0.5)
    assert bench.drive.axis.torque_limit_Nm == pytest.approx(6.0)
    bench.control(0x07)
    assert bench.drive.axis.torque_offset_Nm == 0.0


def test_demand_follows_the_shaft_while_off():
    bench = Bench()
    bench.shaft = 77
    bench.tick()
    assert bench.drive.position_demand_counts == 77.0
    assert bench.read(0x60F4) == 0
    assert bench.read(0x6062) == 77


# -- missing set-points ------------------------------------------------------------------------------------------------


def test_one_missing_set_point_keeps_the_velocity_more_hold_the_position():
    bench = cyclic_bench()
    bench.cycle(10)
    bench.cycle(20)
    bench.sync()  # no new set-point before it
    bench.tick()
    assert bench.drive.position_demand_counts == pytest.approx(30.0)
    bench.sync()
    bench.tick()
    assert bench.drive.position_demand_counts == pytest.approx(30.0)
    bench.cycle(50)
    assert bench.drive.position_demand_counts == pytest.approx(50.0)


@pytest.mark.parametrize("with_sync", [True, False])
def test_fault_after_so_many_periods_without_set_point(with_sync: bool):
    bench = cyclic_bench(DriveSettings(missing_set_point_limit=5))
    bench.cycle(10)  # a millisecond has passed since its SYNC
    frames: list[str] = []
    for _ in range(4):
        if with_sync:
            bench.sync()
        frames += bench.tick()
    assert frames == []
    assert bench.drive.power_state is PowerState.OPERATION_ENABLED
    if with_sync:
        bench.sync()
    assert bench.tick() == ["085#0087210000000000"]
    bench.tick()
    assert bench.drive.power_state is PowerState.FAULT
    assert bench.read(0x603F) == 0x8700


def test_no_fault_before_the_first_set_point_nor_without_a_limit_nor_when_off():
    bench = cyclic_bench()
    assert bench.run(100 * MS) == []
    bench = cyclic_bench(DriveSettings(missing_set_point_limit=0))
    bench.cycle(1)
    assert bench.run(100 * MS) == []
    bench = cyclic_bench()
    bench.cycle(1)
    bench.control(0x07)
    assert bench.run(100 * MS) == []


def test_the_watchdog_is_set_by_the_master_and_counts_interpolation_times():
    bench = cyclic_bench(DriveSettings(missing_set_point_limit=0))
    assert bench.read(0x3050) == 0
    bench.must(0x3050, 0, 8, 2)
    bench.cycle(10)  # a millisecond has passed since its SYNC
    assert [bench.tick() for _ in range(7)] == [[]] * 7
    assert bench.tick() == ["085#0087210000000000"]


@pytest.mark.parametrize("reaction", [0, 2])
def test_the_age_of_the_last_set_point_is_kept_when_the_torque_ends(reaction: int):
    bench = cyclic_bench(DriveSettings(missing_set_point_limit=8))
    assert bench.read(0x3051) == 0
    bench.must(0x605E, 0, reaction, 2)
    bench.cycle(10)
    bench.run(50 * MS)
    assert bench.drive.power_state is PowerState.FAULT
    # Eight times and the half of grace, seen at the tick after; a ramp that is over already costs one tick more.
    assert bench.read(0x3051) == (9000 if reaction == 0 else 10_000)


def test_the_watchdog_may_be_changed_and_switched_off_in_operation():
    bench = cyclic_bench(DriveSettings(missing_set_point_limit=5))
    bench.cycle(10)
    bench.must(0x3050, 0, 20, 2)
    assert [bench.tick() for _ in range(10)] == [[]] * 10
    bench.must(0x3050, 0, 0, 2)
    assert bench.run(100 * MS) == []
    assert bench.drive.power_state is PowerState.OPERATION_ENABLED
    assert bench.write(0x3050, 0, 1001, 2) == 0x06090031


def test_a_restart_gives_the_watchdog_its_default_again():
    bench = cyclic_bench(DriveSettings(missing_set_point_limit=5))
    bench.must(0x3050, 0, 0, 2)
    bench.nmt(0x81)
    bench.run(10 * MS)
    assert bench.read(0x3050) == 5
    assert bench.drive.axis.set_point_timeout_ns == bench.drive.axis.period_ns * 11 // 2


# -- following error ---------------------------------------------------------------------------------------------------


def test_following_error_trips_after_its_time():
    bench = Bench()
    bench.must(0x6065, 0, 100, 4)
    bench.must(0x6066, 0, 5, 2)
    bench.map_cyclic()
    bench.enable()
    bench.cycle(100)
    bench.must(0x6066, 0, 5, 2)
    for _ in range(10):
        assert len(bench.cycle(100)) == 1  # at the window, not beyond it
    bench.cycle(101)
    frames: list[str] = []
    for _ in range(4):
        frames += [frame for frame in bench.cycle(101) if frame.startswith("085")]
    assert frames == []
    frames = bench.cycle(101)
    assert "085#1186210000000000" in frames
    assert bench.statusword & 0x2000
    assert bench.read(0x603F) == 0x8611
    bench.tick()
    assert bench.drive.power_state is PowerState.FAULT


def test_following_error_that_goes_away_in_time_is_none():
    bench = Bench()
    bench.must(0x6065, 0, 100, 4)
    bench.must(0x6066, 0, 5, 2)
    bench.map_cyclic()
    bench.enable()
    for _ in range(4):
        for _ in range(4):
            bench.cycle(150)
        bench.shaft = 150
        bench.cycle(150)
        bench.shaft = 0
    assert bench.drive.power_state is PowerState.OPERATION_ENABLED


def test_following_error_window_may_be_off():
    bench = Bench()
    bench.must(0x6065, 0, 0xFFFFFFFF, 4)
    bench.must(0x6066, 0, 0, 2)
    bench.map_cyclic()
    bench.enable()
    for _ in range(20):
        bench.cycle(1_000_000)
    assert bench.drive.power_state is PowerState.OPERATION_ENABLED
    assert bench.read(0x60F4) == 1_000_000


# -- homing ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", [35, 37])
def test_homing_on_the_current_position(method: int):
    bench = Bench()
    bench.shaft = 12345
    bench.must(0x6098, 0, method, 1)
    bench.must(0x607C, 0, -100, 4)
    bench.enable(mode=6)
    assert bench.statusword & 0x3400 == 0x0400  # not started
    bench.control(0x1F)
    assert bench.statusword & 0x3400 == 0x0000  # in progress
    bench.tick()
    assert bench.statusword & 0x3400 == 0x1400  # attained and reached
    assert bench.read(0x6064, signed=True) == -100
    assert bench.drive.position_demand_counts == 12345.0
    assert bench.drive.axis.is_homed
    bench.control(0x0F)
    assert bench.statusword & 0x3400 == 0x1400
    bench.shaft = 20000
    bench.tick()
    assert bench.read(0x6064, signed=True) == 20000 - 12345 - 100


def test_homing_start_bit_that_falls_interrupts():
    bench = Bench()
    bench.shaft = 50
    bench.enable(mode=6)
    bench.control(0x1F)
    bench.control(0x0F)
    bench.tick()
    assert bench.statusword & 0x3400 == 0x0400
    assert bench.read(0x6064) == 50


def test_homing_starts_on_the_edge_alone_and_in_its_mode_alone():
    bench = Bench()
    bench.shaft = 50
    bench.enable(mode=8)
    bench.control(0x1F)
    bench.tick()
    assert bench.read(0x6064) == 50
    bench.control(0x0F)
    bench.must(0x6060, 0, 6, 1)
    bench.tick()
    bench.control(0x1F)
    bench.tick()
    assert bench.read(0x6064) == 0
    bench.shaft = 60
    bench.control(0x1F)
    bench.tick()
    assert bench.read(0x6064) == 10  # no new edge


def test_homing_method_none_attains_without_moving_the_zero():
    bench = Bench()
    bench.shaft = 50
    bench.must(0x6098, 0, 0, 1)
    bench.enable(mode=6)
    bench.control(0x1F)
    bench.tick()
    assert bench.statusword & 0x3400 == 0x1400
    assert bench.read(0x6064) == 50
    assert bench.write(0x6098, 0, 15, 1) == 0x06090030


def test_homing_then_csp_in_the_new_frame_does_not_jump():
    bench = Bench()
    bench.shaft = 5000
    bench.map_cyclic()
    bench.enable(mode=6)
    bench.control(0x1F)
    bench.tick()
    bench.must(0x6060, 0, 8, 1)
    bench.tick()
    bench.cycle(0)
    assert bench.drive.position_demand_counts == pytest.approx(5000.0)
    bench.cycle(3)
    assert bench.drive.position_demand_counts == pytest.approx(5003.0)


# -- profile slots -----------------------------------------------------------------------------------------------------


def image(start: int = 0, ratio: float = 2.0) -> bytes:
    return b"OK" + struct.pack("<qd", start, ratio)


def test_slot_life_cycle():
    bench = Bench()
    data = image(11) + bytes(100)
    assert [bench.read(0x3002, sub) for sub in (2, 3, 4, 5, 6)] == [0, 0, 0, 0, 0]
    assert bench.write(0x3002, 2, 1, 1) == 0x08000024  # nothing to parse
    assert bench.download(0x3002, 1, data) == 0
    assert [bench.read(0x3002, sub) for sub in (2, 3, 4, 5, 6)] == [0, 1, 0, zlib.crc32(data), 0]
    bench.must(0x3002, 2, 1, 1)
    assert [bench.read(0x3002, sub) for sub in (2, 3, 4, 5, 6)] == [0, 2, 0, zlib.crc32(data), 7]
    assert bench.download(0x3002, 1, b"\x2a bad") == 0
    assert bench.read(0x3002, 3) == 1
    bench.must(0x3002, 2, 1, 1)
    assert [bench.read(0x3002, sub) for sub in (2, 3, 4, 6)] == [0, 3, 0x2A, 0]
    bench.must(0x3002, 2, 2, 1)
    assert [bench.read(0x3002, sub) for sub in (2, 3, 4, 5, 6)] == [0, 0, 0, 0, 0]
    assert bench.write(0x3002, 2, 3, 1) == 0x06090031
    assert bench.write(0x3010, 0, 5, 1) == 0x06090031


# -- camming -----------------------------------------------------------------------------------------------------------


def cam_bench(
    start: int = 0, shaft: int = 0, kind: int = 255, settings: DriveSettings | None = None, ratio: float = 2.0
) -> Bench:
    """Camming on slot 3, the master's TPDO on 181h with its position between two gaps."""
    bench = Bench(settings)
    bench.shaft = shaft
    assert bench.download(0x3002, 1, image(start, ratio)) == 0
    bench.must(0x3002, 2, 1, 1)
    bench.must(0x3010, 0, 3, 1)
    bench.map_rpdo(2, 0x181, kind, [0x00060010, 0x30110020, 0x00030010])
    bench.nmt(0x01)
    bench.enable(mode=-2)
    bench.tick()
    return bench


def master(bench: Bench, counts: int) -> list[str]:
    return bench.put(0x181, struct.pack("<Hih", 0x1237, counts, 0).hex())


def test_camming_follows_the_master_at_once_with_an_event_driven_rpdo():
    bench = cam_bench(start=10, shaft=12)
    assert bench.statusword & 0x1000 == 0
    master(bench, 0)
    assert bench.statusword & 0x1000
    bench.tick()
    assert bench.drive.position_demand_counts == pytest.approx(10.0)
    master(bench, 4)
    assert demand_at(bench, 500 * MICRO) == pytest.approx(14.0)
    bench.tick()
    assert bench.drive.position_demand_counts == pytest.approx(18.0)
    assert bench.read(0x6061, signed=True) == -2


def test_camming_follows_at_the_sync_with_a_synchronous_rpdo():
    bench = cam_bench(kind=1)
    master(bench, 4)
    bench.tick()
    assert bench.drive.position_demand_counts == 0.0
    bench.sync()
    bench.tick()
    assert bench.drive.position_demand_counts == pytest.approx(8.0)


def test_master_offset_shifts_the_phase():
    bench = cam_bench()
    bench.must(0x3012, 0, 3, 4)
    master(bench, 2)
    bench.tick()
    assert bench.drive.position_demand_counts == pytest.approx(10.0)


def test_master_counter_wraps_and_the_cam_goes_on():
    # A ratio of 1/4: without the unwrapping the slave would jump by 2^32 / 4 counts.
    bench = cam_bench(start=-(1 << 29) + 1, ratio=0.25)
    master(bench, (1 << 31) - 4)
    bench.tick()
    assert bench.drive.position_demand_counts == pytest.approx(0.0)
    master(bench, -(1 << 31) + 4)
    bench.tick()
    assert bench.drive.position_demand_counts == pytest.approx(2.0)


def test_engaging_with_a_jump_is_refused():
    bench = cam_bench(start=65, settings=DriveSettings(cam_jump_window_counts=64))
    assert master(bench, 0) == ["085#21FF210000000000"]
    bench.tick()
    assert bench.drive.power_state is PowerState.FAULT
    assert bench.drive.position_demand_counts == 0.0
    bench = cam_bench(start=64, settings=DriveSettings(cam_jump_window_counts=64))
    assert master(bench, 0) == []
    bench.tick()
    assert bench.drive.position_demand_counts == pytest.approx(64.0)


def test_camming_without_a_valid_table_faults():
    bench = Bench()
    bench.must(0x6060, 0, -2, 1)
    bench.tick()
    for word in (0x06, 0x07, 0x0F):
        bench.control(word)
    assert bench.aside == ["085#20FF210000000000"]
    bench.tick()
    assert bench.drive.power_state is PowerState.FAULT


def test_running_cam_is_locked():
    bench = cam_bench()
    assert bench.write(0x3010, 0, 1, 1) == 0x08000022
    assert bench.write(0x3002, 2, 2, 1) == 0x08000022
    assert bench.download(0x3002, 1, image()) == 0x08000022
    assert bench.download(0x3001, 1, image()) == 0
    bench.control(0x07)
    assert bench.write(0x3010, 0, 2, 1) == 0


def test_camming_without_master_holds_and_faults():
    bench = cam_bench()
    master(bench, 0)
    bench.tick()
    master(bench, 5)
    bench.tick()
    bench.tick()
    assert bench.drive.position_demand_counts == pytest.approx(20.0)
    bench.run(3 * MS)
    assert bench.drive.position_demand_counts == pytest.approx(20.0)
    assert bench.tick() == ["085#0087210000000000", "185#1F02"]


def test_cam_from_standstill_to_csp_in_motion_does_not_stop_dead():
    bench = cam_bench()
    master(bench, 0)
    bench.tick()
    master(bench, 2)
    bench.must(0x6060, 0, 8, 1)
    bench.tick()
    assert bench.drive.position_demand_counts == pytest.approx(4.0)
    bench.tick()
    assert bench.drive.position_demand_counts == pytest.approx(8.0)  # the line runs out
    bench.tick()
    assert bench.drive.position_demand_counts == pytest.approx(8.0)
