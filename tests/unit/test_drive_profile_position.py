"""Profile position mode of the emulated drive, with trapezoids worked by hand."""

import pytest
from drive_bench import MS, Bench

from sim_drive.device.cia402 import PowerState

REACHED, LIMITED, ACKNOWLEDGED = 0x0400, 0x0800, 0x1000


def bench_pp(low: int | None = None, high: int | None = None) -> Bench:
    """10000 counts/s and 100000 counts/s^2 both ways: 100 ms and 500 counts to speed, and again to rest."""
    bench = Bench()
    bench.must(0x6081, 0, 10_000, 4)
    for index in (0x6083, 0x6084, 0x6085):
        bench.must(index, 0, 100_000, 4)
    if low is not None and high is not None:
        bench.must(0x607D, 1, low, 4)
        bench.must(0x607D, 2, high, 4)
    bench.enable(mode=1)
    bench.follows = True
    bench.tick()
    return bench


def begin(bench: Bench, target: int, bits: int = 0) -> None:
    bench.must(0x607A, 0, target, 4)
    bench.control(0x1F | bits)


def release(bench: Bench) -> None:
    bench.control(0x0F)


def test_trapezoid_by_hand():
    bench = bench_pp()
    begin(bench, 3000)
    expected = {50: 125.0, 100: 500.0, 200: 1500.0, 300: 2500.0, 350: 2875.0, 400: 3000.0}
    for at_ms in range(1, 420):
        bench.tick()
        if at_ms in expected:
            assert bench.drive.position_demand_counts == pytest.approx(expected[at_ms], abs=1e-6), at_ms
    assert bench.shaft == 3000


def test_short_move_is_a_triangle():
    bench = bench_pp()
    begin(bench, -250)  # half of the way in 50 ms: 100000 * 0.05^2 / 2 = 125
    bench.run(50 * MS)
    assert bench.drive.position_demand_counts == pytest.approx(-125.0)
    bench.run(50 * MS)
    assert bench.drive.position_demand_counts == pytest.approx(-250.0)


def test_handshake_and_target_reached():
    bench = bench_pp()
    bench.must(0x6068, 0, 5, 2)
    begin(bench, 1000)
    assert bench.statusword & (REACHED | ACKNOWLEDGED) == ACKNOWLEDGED
    release(bench)
    assert bench.statusword & (REACHED | ACKNOWLEDGED) == 0
    bench.run(199 * MS)
    assert bench.statusword & REACHED == 0
    bench.run(10 * MS)
    assert bench.statusword & (REACHED | ACKNOWLEDGED) == REACHED
    bench.shaft = 1011
    bench.follows = False
    bench.tick()
    assert bench.statusword & REACHED == 0  # the window is 10 counts
    bench.shaft = 1010
    bench.run(7 * MS)
    assert bench.statusword & REACHED


def test_only_the_rising_edge_counts():
    bench = bench_pp()
    begin(bench, 100)
    bench.run(300 * MS)
    begin(bench, 200)  # bit 4 has not fallen
    bench.run(300 * MS)
    assert bench.shaft == 100


def test_one_set_point_waits_and_a_third_is_ignored():
    bench = bench_pp()
    begin(bench, 1000)
    release(bench)
    begin(bench, 500)
    release(bench)
    assert bench.statusword & ACKNOWLEDGED  # full
    begin(bench, 7777)
    release(bench)
    assert bench.statusword & ACKNOWLEDGED
    bench.run(203 * MS)
    assert bench.statusword & (ACKNOWLEDGED | REACHED) == 0  # the second is in work, and there is room again
    bench.run(400 * MS)
    assert bench.shaft == 500


def test_immediate_set_point_turns_back():
    bench = bench_pp()
    begin(bench, 3000)
    release(bench)
    bench.run(200 * MS)  # 1500 at 10000 counts/s
    begin(bench, 1500, 0x20)
    bench.run(100 * MS)
    assert bench.drive.position_demand_counts == pytest.approx(2000.0, abs=1.0)  # braked to rest
    bench.run(400 * MS)
    assert bench.shaft == 1500


def test_relative_to_the_last_target_the_demand_and_the_actual_position():
    bench = bench_pp()
    begin(bench, 100)
    bench.run(100 * MS)
    release(bench)
    begin(bench, 50, 0x40)
    bench.run(100 * MS)
    assert bench.shaft == 150
    bench.follows = False
    bench.shaft = 160
    release(bench)
    bench.must(0x60F2, 0, 1, 2)
    begin(bench, 50, 0x40)
    bench.run(100 * MS)
    assert bench.drive.position_demand_counts == pytest.approx(200.0)
    bench.shaft = 190
    bench.tick()
    release(bench)
    bench.must(0x60F2, 0, 2, 2)
    begin(bench, -90, 0x40)
    bench.run(200 * MS)
    assert bench.drive.position_demand_counts == pytest.approx(100.0)
    assert bench.write(0x60F2, 0, 3, 2) == 0x06090031


def test_passing_the_first_target_at_speed():
    bench = bench_pp()
    begin(bench, 2000)
    release(bench)
    bench.run(10 * MS)
    begin(bench, 4000, 0x200)
    release(bench)
    speeds: list[float] = []
    before = bench.drive.position_demand_counts
    for _ in range(600):
        bench.tick()
        now = bench.drive.position_demand_counts
        if 1000 < now < 3400:
            speeds.append((now - before) * 1000)
        before = now
    assert min(speeds) == pytest.approx(10_000, rel=1e-6)
    assert bench.shaft == 4000
    assert bench.statusword & REACHED


def test_software_limits_hold_the_target():
    bench = bench_pp(-100, 300)
    begin(bench, 5000)
    assert bench.statusword & LIMITED
    bench.run(500 * MS)
    assert bench.shaft == 300
    release(bench)
    begin(bench, 200)
    assert not bench.statusword & LIMITED


def test_halt_and_go_on():
    bench = bench_pp()
    begin(bench, 3000)
    bench.run(200 * MS)
    bench.control(0x11F)
    assert bench.statusword & REACHED == 0
    bench.run(102 * MS)
    assert bench.shaft == 2000
    assert bench.statusword & REACHED  # in a halt: it stands
    bench.control(0x1F)
    bench.run(400 * MS)
    assert bench.shaft == 3000
    assert bench.drive.power_state is PowerState.OPERATION_ENABLED


def test_max_profile_velocity_and_max_acceleration():
    bench = bench_pp()
    bench.must(0x607F, 0, 5_000, 4)
    bench.must(0x60C5, 0, 50_000, 4)
    bench.must(0x60C6, 0, 50_000, 4)
    begin(bench, 1000)  # 100 ms and 250 counts each way, 100 ms of 5000 counts/s between
    bench.run(150 * MS)
    assert bench.drive.position_demand_counts == pytest.approx(500.0)
    bench.run(150 * MS)
    assert bench.drive.position_demand_counts == pytest.approx(1000.0)


def test_a_set_point_that_was_held_before_is_none():
    bench = Bench()
    bench.enable(mode=8)
    bench.must(0x607A, 0, 0, 4)
    bench.control(0x1F)
    bench.must(0x607A, 0, 0, 4)
    bench.must(0x6060, 0, 1, 1)
    bench.run(2 * MS)
    bench.must(0x607A, 0, 500, 4)
    bench.control(0x1F)
    bench.run(100 * MS)
    assert bench.drive.position_demand_counts == 0.0


def test_from_csp_in_motion_to_pp_brakes_at_6084h():
    bench = Bench()
    bench.must(0x6084, 0, 100_000, 4)
    bench.map_cyclic()
    bench.enable()
    bench.follows = True
    for k in range(1, 20):
        bench.cycle(10 * k)
    bench.must(0x6060, 0, 1, 1)
    bench.cycle(200)
    bench.run(150 * MS)
    assert bench.read(0x6061) == 1
    assert bench.shaft == 200 + 500  # 10000^2 / 200000
