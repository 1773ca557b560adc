"""Touch probes of the emulated drive: what is latched, once or again, and where."""

from drive_bench import Bench

from sim_drive.settings import DriveSettings
from sim_drive.switches import Switches


def probe_bench(function: int) -> Bench:
    bench = Bench(DriveSettings(switches=Switches(-500, 500, (100.0, 200.0), index=7), initial_offset_counts=1000))
    bench.must(0x60B8, 0, function, 2)
    return bench


def go(bench: Bench, *places: int) -> None:
    for place in places:
        bench.shaft = place
        bench.tick()


def latched(bench: Bench) -> list[int]:
    return [bench.read(index) for index in (0x60B9, 0x60BA, 0x60BB, 0x60BC, 0x60BD)]


def test_both_edges_of_probe_1_once():
    bench = probe_bench(0x0031)
    assert latched(bench) == [0x0001, 0, 0, 0, 0]
    go(bench, 90, 130)
    assert latched(bench) == [0x0003, 1100, 0, 0, 0]
    go(bench, 260)
    assert latched(bench) == [0x0007, 1100, 1201, 0, 0]
    go(bench, 150, 50)  # from the other side: latched already
    assert latched(bench) == [0x0007, 1100, 1201, 0, 0]
    bench.must(0x60B8, 0, 0, 2)
    assert bench.read(0x60B9) == 0
    bench.must(0x60B8, 0, 0x0031, 2)
    go(bench, 220, 150)  # from 50 to 220 the whole switch is passed between two ticks, unseen
    assert latched(bench)[:3] == [0x0003, 1200, 1201]
    go(bench, 80)
    assert latched(bench)[:3] == [0x0007, 1200, 1099]


def test_continuous_latching():
    bench = probe_bench(0x0013)
    go(bench, 150)
    assert latched(bench)[:2] == [0x0003, 1100]
    go(bench, 300, 180)
    assert latched(bench)[:2] == [0x0003, 1200]


def test_probe_2_and_the_index_pulse():
    bench = probe_bench(0x1100 | 0x0015)
    go(bench, 6)
    assert latched(bench) == [0x0101, 0, 0, 0, 0]
    go(bench, 9)
    assert latched(bench) == [0x0103, 1007, 0, 0, 0]
    go(bench, 600)
    assert latched(bench) == [0x0303, 1007, 0, 1500, 0]


def test_a_reset_disarms():
    bench = probe_bench(0x0011)
    bench.nmt(0x81)
    bench.wake()
    go(bench, 150)
    assert latched(bench) == [0, 0, 0, 0, 0]
