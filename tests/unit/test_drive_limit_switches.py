"""Limit switches outside homing stop the axis that runs onto them, and let it go back."""

import struct

import pytest
from drive_bench import MS, Bench

from sim_drive.device.cia402 import PowerState
from sim_drive.settings import DriveSettings
from sim_drive.switches import Switches

UPPER = 1000
LIMITED = 0x800
FITTED = DriveSettings(switches=Switches(-1000, UPPER))


def ready(mode: int, sign: int = 1) -> Bench:
    bench = Bench(FITTED)
    bench.follows = True
    bench.shaft = sign * 500
    bench.tick()
    for index in (0x6083, 0x6084, 0x6085):
        bench.must(index, 0, 400_000, 4)
    bench.must(0x60C2, 1, 1, 1)
    bench.enable(mode)
    return bench


def overrun(speed: float) -> float:
    """From the switch to rest at 400 000 counts/s^2, and two ticks to notice it in."""
    return speed * speed / 800_000 + 2 * speed * 1e-3 + 1


@pytest.mark.parametrize("sign", [1, -1])
def test_profile_velocity_stops_at_the_switch_and_goes_back(sign: int):
    bench = ready(3, sign)
    bench.must(0x60FF, 0, sign * 10_000, 4)
    bench.run(500 * MS)
    assert UPPER <= sign * bench.shaft <= UPPER + overrun(10_000)
    assert bench.statusword & (LIMITED | 0x6F) == LIMITED | 0x27
    # Further on it does not go, however often it is told.
    stood = bench.shaft
    bench.must(0x60FF, 0, sign * 5_000, 4)
    bench.run(100 * MS)
    assert bench.shaft == stood
    bench.must(0x60FF, 0, -sign * 5_000, 4)
    bench.run(100 * MS)
    assert sign * bench.shaft < UPPER
    assert not bench.statusword & LIMITED


def test_the_other_switch_does_not_matter():
    bench = ready(3)
    bench.must(0x60FF, 0, -5_000, 4)
    bench.run(200 * MS)
    assert bench.shaft < -400
    assert not bench.statusword & LIMITED


def test_profile_position_stops_at_the_switch_and_never_reaches_its_target():
    bench = ready(1)
    bench.must(0x6081, 0, 10_000, 4)
    bench.must(0x607A, 0, 5000, 4)
    bench.control(0x1F)
    bench.run(1000 * MS)
    assert UPPER <= bench.shaft <= UPPER + overrun(10_000)
    assert bench.statusword & (LIMITED | 0x400) == LIMITED
    bench.control(0x0F)
    bench.must(0x607A, 0, 0, 4)
    bench.control(0x3F)
    bench.run(500 * MS)
    assert bench.shaft == 0
    assert bench.statusword & (LIMITED | 0x400) == 0x400


def test_csp_stops_at_the_switch_takes_no_target_beyond_and_goes_back():
    bench = ready(8)
    bench.map_cyclic()
    for target in range(500, 3000, 10):
        bench.cycle(target)
    assert UPPER <= bench.shaft <= UPPER + overrun(10_000)
    assert bench.statusword & (LIMITED | 0x6F) == LIMITED | 0x27
    stood = bench.shaft
    for target in range(3000, 2000, -10):
        bench.cycle(target)
    assert bench.shaft == stood
    for target in range(stood, 0, -10):
        bench.cycle(target)
    assert bench.shaft < 30
    assert not bench.statusword & LIMITED


def test_csv_stops_at_the_switch():
    bench = ready(9)
    bench.map_rpdo(1, 0x205, 1, [0x60400010, 0x60FF0020])
    bench.nmt(0x01)
    for _ in range(300):
        bench.put(0x205, struct.pack("<Hi", 0x0F, 10_000).hex())
        bench.sync()
        bench.tick()
    assert UPPER <= bench.shaft <= UPPER + overrun(10_000)
    assert bench.statusword & LIMITED
    assert bench.drive.power_state is PowerState.OPERATION_ENABLED


def test_interpolated_position_stops_at_the_switch():
    bench = ready(7)
    bench.control(0x1F)
    for target in range(500, 3000, 10):
        bench.must(0x60C1, 1, target, 4)
        bench.tick()
    assert UPPER <= bench.shaft <= UPPER + overrun(10_000)
    assert bench.statusword & LIMITED


@pytest.mark.parametrize("mode", [4, 10])
def test_no_torque_drives_the_axis_further_onto_the_switch(mode: int):
    bench = ready(mode)
    bench.follows = False
    bench.must(0x6087, 0, 1_000_000, 4)
    bench.must(0x6071, 0, 200, 2)
    bench.run(5 * MS)
    assert bench.drive.axis.torque_demand_Nm == pytest.approx(0.3)
    bench.shaft = UPPER
    bench.tick()
    assert bench.drive.axis.torque_demand_Nm == 0.0
    assert bench.statusword & LIMITED
    bench.must(0x6071, 0, -200, 2)
    bench.run(5 * MS)
    assert bench.drive.axis.torque_demand_Nm == pytest.approx(-0.3)
    bench.shaft = UPPER - 1
    bench.tick()
    assert not bench.statusword & LIMITED


def test_homing_finds_the_switch_that_stops_all_others():
    bench = ready(6)
    bench.must(0x6098, 0, 18, 1)
    bench.must(0x609A, 0, 400_000, 4)
    bench.control(0x1F)
    bench.run(3000 * MS)
    assert bench.statusword & 0x3400 == 0x1400
    assert not bench.statusword & LIMITED


def test_switching_off_on_the_switch_forgets_it():
    bench = ready(3)
    bench.must(0x60FF, 0, 10_000, 4)
    bench.run(500 * MS)
    assert bench.statusword & LIMITED
    bench.control(0x07)
    bench.run(100 * MS)
    assert not bench.statusword & LIMITED
