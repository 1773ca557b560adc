"""Interpolated position mode of the emulated drive: buffer, timing and underflow by hand."""

import pytest
from drive_bench import MS, Bench

UNDERFLOW = "085#22FF210000000000"
NO_ERROR = "085#0000000000000000"
REACHED, ACTIVE = 0x0400, 0x1000


def bench_ip(period_ms: int = 4) -> Bench:
    bench = Bench()
    bench.must(0x60C2, 1, period_ms, 1)
    bench.enable(mode=7)
    bench.follows = True
    bench.tick()
    return bench


def put(bench: Bench, *targets: int) -> None:
    for target in targets:
        bench.must(0x60C1, 1, target, 4)


def demands(bench: Bench, count: int) -> list[float]:
    found: list[float] = []
    for _ in range(count):
        bench.aside += bench.tick()
        found.append(round(bench.drive.position_demand_counts, 6))
    return found


def test_records_are_lines_of_60c2h_each():
    bench = bench_ip()
    put(bench, 8, 24, 24)
    assert bench.read(0x60C4, 4) == 3
    assert bench.statusword & ACTIVE == 0
    assert demands(bench, 3) == [0.0] * 3  # bit 4 is not set
    bench.control(0x1F)
    assert bench.statusword & (ACTIVE | REACHED) == ACTIVE
    assert demands(bench, 13) == [0, 2, 4, 6, 8, 12, 16, 20, 24, 24, 24, 24, 24]
    assert bench.read(0x60C4, 4) == 0
    assert bench.statusword & (ACTIVE | REACHED) == ACTIVE | REACHED
    assert bench.aside == []


def test_running_empty_in_motion_is_an_emcy_and_no_fault():
    bench = bench_ip()
    put(bench, 8)
    bench.control(0x1F)
    assert demands(bench, 8) == [0, 2, 4, 6, 8, 8, 8, 8]
    assert bench.aside == [UNDERFLOW]
    assert bench.statusword & 0x6F == 0x27
    put(bench, 16, 16)
    assert demands(bench, 5) == [8, 10, 12, 14, 16]
    assert bench.aside == [UNDERFLOW, NO_ERROR]


def test_buffer_is_bounded_cleared_and_locked():
    bench = bench_ip()
    put(bench, *range(16))
    assert bench.write(0x60C1, 1, 99, 4) == 0x08000022
    bench.must(0x60C4, 6, 0, 1)
    assert bench.read(0x60C4, 4) == 0
    assert bench.write(0x60C1, 1, 99, 4) == 0x08000022
    bench.must(0x60C4, 6, 1, 1)
    bench.must(0x60C4, 2, 2, 4)
    put(bench, 1, 2)
    assert bench.write(0x60C1, 1, 3, 4) == 0x08000022
    assert bench.read_abort(0x60C4, 6) == 0x06010001
    for subindex, value, size, code in ((2, 17, 4, 0x06090031), (3, 1, 1, 0x06090031), (5, 8, 1, 0x06090031)):
        assert bench.write(0x60C4, subindex, value, size) == code
    assert bench.write(0x60C0, 0, -1, 2) == 0x06090032


def test_records_by_rpdo_one_a_sync():
    bench = Bench()
    bench.map_rpdo(1, 0x205, 1, [0x60400010, 0x60C10120])
    bench.nmt(0x01)
    bench.enable(mode=7)
    found: list[float] = []
    for target in (3, 6, 9, 12, 12):
        bench.put(0x205, "1f00" + target.to_bytes(4, "little").hex())
        bench.sync()
        bench.tick()
        found.append(bench.drive.position_demand_counts)
    assert found == pytest.approx([0.0, 3.0, 6.0, 9.0, 12.0])


def test_clearing_bit_4_halting_and_leaving_the_mode():
    bench = bench_ip(period_ms=100)
    bench.must(0x6084, 0, 100_000, 4)
    put(bench, 1000, 2000)
    bench.control(0x1F)
    bench.run(51 * MS)
    assert bench.drive.position_demand_counts == pytest.approx(500.0)
    bench.control(0x11F)
    bench.run(101 * MS)
    assert bench.drive.position_demand_counts == pytest.approx(1000.0)  # 10000^2 / 200000 more
    bench.control(0x1F)
    bench.run(51 * MS)
    assert bench.drive.position_demand_counts == pytest.approx(1500.0)
    put(bench, 3000)
    bench.control(0x0F)
    bench.run(200 * MS)
    assert bench.drive.position_demand_counts == pytest.approx(2000.0)
    assert bench.read(0x60C4, 4) == 1
    bench.must(0x6060, 0, 1, 1)
    bench.tick()
    assert bench.read(0x60C4, 4) == 0


def test_interpolation_time_must_not_change_under_way():
    bench = bench_ip()
    assert bench.write(0x60C2, 1, 5, 1) == 0x08000022
