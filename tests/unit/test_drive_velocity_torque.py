"""Profile velocity, profile torque, csv and cst of the emulated drive, by hand."""

import struct

import pytest
from drive_bench import MS, Bench

from sim_drive.device.cia402 import PowerState
from sim_drive.physics.servo import VOLT_PER_UNIT, ServoLoop
from sim_drive.settings import DriveSettings

REACHED, LIMITED, BIT_12 = 0x0400, 0x0800, 0x1000


def started(mode: int, *writes: tuple[int, int, int, int], settings: DriveSettings | None = None) -> Bench:
    bench = Bench(settings)
    for index in (0x6083, 0x6084, 0x6085):
        bench.must(index, 0, 100_000, 4)
    for write in writes:
        bench.must(*write)
    bench.enable(mode)
    bench.follows = True
    return bench


def show(bench: Bench, velocity: float, torque: int = 0) -> None:
    bench.drive.axis.latch = lambda now_ns: (bench.shaft, velocity, torque)


# -- profile velocity ------------------------------------------------------------------------------------------------


def test_pv_ramps_and_cruises():
    bench = started(3)
    bench.must(0x60FF, 0, 5_000, 4)
    bench.run(51 * MS)  # taken at the first tick; 50 ms and 125 counts to speed
    assert bench.drive.position_demand_counts == pytest.approx(125.0)
    assert bench.read(0x606B) == 5_000
    bench.run(100 * MS)
    assert bench.drive.position_demand_counts == pytest.approx(625.0)
    bench.must(0x60FF, 0, -5_000, 4)
    bench.run(51 * MS)  # a millisecond, then down to zero
    assert bench.drive.position_demand_counts == pytest.approx(625.0 + 5.0 + 125.0)
    bench.run(50 * MS)
    assert bench.drive.position_demand_counts == pytest.approx(625.0 + 5.0)
    bench.must(0x60FF, 0, 0, 4)
    bench.run(200 * MS)
    assert bench.drive.position_demand_counts == pytest.approx(630.0 - 5.0 - 125.0)

    bench = started(3, (0x606D, 0, 100, 2), (0x606E, 0, 5, 2), (0x606F, 0, 50, 2), (0x6070, 0, 3, 2))
    show(bench, 0.0)
    bench.must(0x60FF, 0, 1_000, 4)
    bench.run(20 * MS)
    assert bench.statusword & (REACHED | BIT_12) == BIT_12  # it stands, whatever is wanted
    show(bench, 900.0)
    bench.run(5 * MS)
    assert bench.statusword & (REACHED | BIT_12) == 0
    bench.tick()
    assert bench.statusword & (REACHED | BIT_12) == REACHED
    show(bench, 899.0)
    bench.tick()
    assert bench.statusword & REACHED == 0


def test_pv_halt_and_resume():
    bench = started(3)
    bench.must(0x60FF, 0, 10_000, 4)
    bench.run(201 * MS)
    at = bench.drive.position_demand_counts
    bench.control(0x10F)
    bench.run(150 * MS)
    assert bench.drive.position_demand_counts == pytest.approx(at + 500.0)
    bench.control(0x0F)
    bench.run(101 * MS)
    assert bench.drive.position_demand_counts == pytest.approx(at + 1000.0)


def test_pv_is_limited_by_607fh_and_6080h():
    bench = started(3, (0x607F, 0, 2_000, 4))
    bench.must(0x60FF, 0, 9_000, 4)
    bench.run(21 * MS)
    before = bench.drive.position_demand_counts
    assert bench.statusword & LIMITED
    bench.run(100 * MS)
    assert bench.drive.position_demand_counts - before == pytest.approx(200.0)
    bench = started(3, (0x6080, 0, 30, 4))  # half a revolution a second: 2048 counts/s
    bench.must(0x60FF, 0, -9_000, 4)
    bench.run(100 * MS)
    before = bench.drive.position_demand_counts
    bench.run(100 * MS)
    assert bench.drive.position_demand_counts - before == pytest.approx(-204.8)


@pytest.mark.parametrize("mode", [3, 9])
@pytest.mark.parametrize("direction", [1, -1])
def test_velocity_modes_stand_at_the_software_limit(mode: int, direction: int):
    bench = started(mode, (0x607D, 1, -1000, 4), (0x607D, 2, 1000, 4))
    bench.must(0x60FF, 0, direction * 8_000, 4)
    furthest = 0.0
    for _ in range(400):
        bench.tick()
        furthest = max(furthest, direction * bench.drive.position_demand_counts)
    assert bench.drive.position_demand_counts == pytest.approx(direction * 1000.0)
    assert furthest <= 1000.0 + 1e-6
    assert bench.statusword & LIMITED
    bench.must(0x60FF, 0, direction * 9_000, 4)
    bench.run(10 * MS)
    assert bench.drive.position_demand_counts == pytest.approx(direction * 1000.0)
    bench.must(0x60FF, 0, direction * -1_000, 4)
    bench.run(100 * MS)
    assert direction * bench.drive.position_demand_counts < 1000.0
    assert not bench.statusword & LIMITED


# -- cyclic synchronous velocity ---------------------------------------------------------------------------------------


def cyclic(mode: int, object_word: int, *writes: tuple[int, int, int, int], **settings: int) -> Bench:
    bench = Bench(DriveSettings(**settings))  # type: ignore[arg-type]
    bench.must(0x6085, 0, 100_000, 4)
    for write in writes:
        bench.must(*write)
    bench.map_rpdo(1, 0x205, 1, [0x60400010, object_word])
    bench.nmt(0x01)
    bench.enable(mode)
    bench.follows = True
    return bench


def cycle(bench: Bench, form: str, value: int, controlword: int = 0x0F) -> list[str]:
    bench.put(0x205, struct.pack("<H" + form, controlword, value).hex())
    bench.sync()
    return bench.tick()


def test_csv_integrates_the_velocity():
    bench = cyclic(9, 0x60FF0020)
    bench.run(20 * MS)
    assert bench.drive.position_demand_counts == 0.0
    cycle(bench, "i", 4_000)
    assert bench.drive.position_demand_counts == pytest.approx(2.0)  # from 0 to 4000 counts/s within the period
    cycle(bench, "i", 4_000)
    assert bench.drive.position_demand_counts == pytest.approx(6.0)
    bench.must(0x60B1, 0, 2_000, 4)
    cycle(bench, "i", 4_000)
    assert bench.drive.position_demand_counts == pytest.approx(6.0 + 5.0)
    assert bench.statusword & BIT_12


def test_csv_does_not_take_an_old_target():
    bench = cyclic(9, 0x60FF0020, (0x60FF, 0, 5_000, 4))
    bench.run(50 * MS)
    assert bench.drive.position_demand_counts == 0.0


def test_csv_without_set_points_faults_and_brakes():
    bench = cyclic(9, 0x60FF0020, missing_set_point_limit=5)
    cycle(bench, "i", 10_000)
    assert bench.run(4 * MS) == []
    assert "085#0087210000000000" in bench.tick()
    assert bench.drive.power_state is PowerState.FAULT_REACTION_ACTIVE
    at = bench.drive.position_demand_counts
    bench.run(110 * MS)
    assert bench.shaft == round(at + 500.0)
    assert bench.drive.power_state is PowerState.FAULT


def test_csv_to_csp_comes_to_rest_and_holds():
    bench = cyclic(9, 0x60FF0020, (0x6084, 0, 100_000, 4))
    for _ in range(10):
        cycle(bench, "i", 10_000)
    at = bench.drive.position_demand_counts
    bench.must(0x6060, 0, 8, 1)
    bench.run(150 * MS)
    assert bench.drive.position_demand_counts == pytest.approx(at + 10.0 + 500.0)


# -- torque ------------------------------------------------------------------------------------------------------------


def test_cst_holds_then_takes_the_torque_with_its_offset():
    bench = cyclic(10, 0x60710010, (0x6071, 0, 900, 2))
    bench.run(10 * MS)
    assert bench.drive.axis.torque_demand_Nm is None  # the position is held
    bench.must(0x60B2, 0, -50, 2)
    cycle(bench, "h", 250)
    assert bench.drive.axis.torque_demand_Nm == pytest.approx(0.2 * 1.5)
    bench.follows = False
    bench.shaft = 400
    cycle(bench, "h", 4_000)
    assert bench.drive.axis.torque_demand_Nm == pytest.approx(3.0 * 1.5)  # max torque 6072h
    assert bench.drive.position_demand_counts == 400.0
    assert bench.read(0x60F4) == 0

    bench = cyclic(10, 0x60710010, (0x6084, 0, 100_000, 4))
    cycle(bench, "h", 100)
    bench.follows = False
    bench.shaft = 1_000
    show(bench, 10_000.0)
    cycle(bench, "h", 100)
    bench.control(0x02)
    assert bench.drive.axis.torque_demand_Nm is None
    bench.run(150 * MS)
    assert bench.drive.power_state is PowerState.SWITCH_ON_DISABLED
    bench = cyclic(10, 0x60710010, (0x6084, 0, 100_000, 4))
    cycle(bench, "h", 100)
    bench.follows = False
    bench.shaft = 1_000
    show(bench, 10_000.0)
    cycle(bench, "h", 100)
    bench.must(0x6060, 0, 8, 1)
    bench.must(0x6065, 0, 0xFFFFFFFF, 4)
    bench.run(101 * MS)
    assert bench.drive.position_demand_counts == pytest.approx(1_500.0)


def test_tq_starts_from_the_actual_torque_and_keeps_to_the_slope():
    bench = started(3)
    show(bench, 0.0, 100)
    bench.must(0x6087, 0, 10_000, 4)
    bench.must(0x6071, 0, 200, 2)
    bench.must(0x6060, 0, 4, 1)
    bench.tick()
    assert bench.drive.axis.torque_demand_Nm == pytest.approx(0.1 * 1.5)
    bench.tick()
    assert bench.drive.axis.torque_demand_Nm == pytest.approx(0.11 * 1.5)
    assert bench.read(0x6074) == 110
    assert bench.statusword & REACHED == 0
    bench.run(9 * MS)
    assert bench.drive.axis.torque_demand_Nm == pytest.approx(0.2 * 1.5)
    assert bench.statusword & REACHED
    bench.control(0x10F)
    bench.run(20 * MS)
    assert bench.drive.axis.torque_demand_Nm == 0.0
    bench.control(0x0F)
    bench.run(5 * MS)
    assert bench.drive.axis.torque_demand_Nm == pytest.approx(0.05 * 1.5)


# -- csp with its offset ----------------------------------------------------------------------------------------------


def test_csp_adds_the_position_offset():
    bench = cyclic(8, 0x607A0020, (0x60B0, 0, 7, 4))
    cycle(bench, "i", 10)
    assert bench.drive.position_demand_counts == pytest.approx(17.0)


def test_csp_does_not_run_over_a_software_limit():
    bench = cyclic(8, 0x607A0020, (0x607D, 1, -25, 4), (0x607D, 2, 25, 4))
    cycle(bench, "i", 10)
    cycle(bench, "i", 20)
    bench.tick()  # the overrun would lead to 30
    bench.tick()
    assert bench.drive.position_demand_counts == pytest.approx(25.0)


# -- torque limits --------------------------------------------------------------------------------


def test_the_least_of_max_torque_and_the_limit_of_the_direction_counts():
    bench = cyclic(10, 0x60710010, (0x6072, 0, 800, 2), (0x60E0, 0, 500, 2), (0x60E1, 0, 900, 2))
    assert bench.drive.axis.torque_limit_Nm == pytest.approx(0.5 * 1.5)
    assert bench.drive.axis.negative_torque_limit_Nm == pytest.approx(0.8 * 1.5)
    cycle(bench, "h", 1_000)
    assert bench.drive.axis.torque_demand_Nm == pytest.approx(0.5 * 1.5)
    cycle(bench, "h", -1_000)
    assert bench.drive.axis.torque_demand_Nm == pytest.approx(-0.8 * 1.5)
    bench.nmt(0x81)
    bench.wake()
    assert bench.drive.axis.torque_limit_Nm == pytest.approx(3.0 * 1.5)


def test_the_servo_loop_is_limited_in_each_direction():
    for demand, units in ((1e6, 20), (-1e6, -40)):
        servo = ServoLoop()
        servo.reset(0.0, 0)
        volt = 20 * VOLT_PER_UNIT
        servo.update(demand, 0, (256, 0, 0, 0, 0), 0.0, 0.45, 0.45 * volt * 1.01, 0.45 * volt * 2.01)
        assert servo.output_units == units
