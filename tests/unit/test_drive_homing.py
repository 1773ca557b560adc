"""Homing of the emulated drive on switches and index pulses: where home is, from wherever the axis starts."""

import pytest
from drive_bench import MS, Bench

from config.emulation_section import SwitchesSection
from config.loading import load_config
from sim_drive.assembly import switches
from sim_drive.settings import DriveSettings
from sim_drive.switches import DigitalInput, Switches

INF = float("inf")
LOW, HIGH = -9000, 9000
BUMP = (1000.0, 1400.0)
UPPER = (1000.0, INF)
LOWER = (-INF, 1400.0)

# Home in shaft counts, read off the standard's figures: the first count in the state after the edge, and the index
# pulse next in the same direction (every 4096 counts from 300: -7892, -3796, 300, 4396, 8492).
CASES = {
    1: (BUMP, -7892),
    2: (BUMP, 8492),
    3: (UPPER, 300),
    4: (UPPER, 4396),
    5: (LOWER, 4396),
    6: (LOWER, 300),
    7: (BUMP, 300),
    8: (BUMP, 4396),
    9: (BUMP, 300),
    10: (BUMP, 4396),
    11: (BUMP, 4396),
    12: (BUMP, 300),
    13: (BUMP, 4396),
    14: (BUMP, 300),
    17: (BUMP, -8999),
    18: (BUMP, 8999),
    19: (UPPER, 999),
    20: (UPPER, 1000),
    21: (LOWER, 1401),
    22: (LOWER, 1400),
    23: (BUMP, 999),
    24: (BUMP, 1000),
    25: (BUMP, 1400),
    26: (BUMP, 1401),
    27: (BUMP, 1401),
    28: (BUMP, 1400),
    29: (BUMP, 1000),
    30: (BUMP, 999),
}


def bench_for(method: int, switches: Switches, start: int, home_offset: int = 0) -> Bench:
    bench = Bench(DriveSettings(switches=switches))
    bench.shaft = start
    bench.must(0x6098, 0, method, 1)
    bench.must(0x6099, 1, 20_000, 4)
    bench.must(0x6099, 2, 5_000, 4)
    bench.must(0x609A, 0, 400_000, 4)
    bench.must(0x607C, 0, home_offset, 4)
    bench.must(0x6065, 0, 0xFFFFFFFF, 4)
    bench.tick()
    bench.enable(mode=6)
    bench.follows = True
    return bench


def home(bench: Bench, limit_ms: int = 8000) -> int:
    """Start, and give bits 13, 12, 10 when something has come of it."""
    bench.control(0x1F)
    for _ in range(limit_ms):
        bench.tick()
        if bits := bench.statusword & 0x3400:
            return bits
    return 0


@pytest.mark.parametrize("start", [-8500, 990, 1200, 1410, 8700])
@pytest.mark.parametrize("method", sorted(CASES))
def test_home_is_found_from_anywhere(method: int, start: int):
    switch, expected = CASES[method]
    bench = bench_for(method, Switches(LOW, HIGH, switch, 300), start, home_offset=-77)
    assert home(bench) == 0x1400
    assert bench.drive.axis.offset_counts == -77 - expected
    bench.tick()
    before = bench.shaft
    bench.run(20 * MS)
    assert bench.shaft == before  # at rest
    assert bench.read(0x6064, signed=True) == bench.shaft - expected - 77


@pytest.mark.parametrize(
    ("method", "start", "expected"),
    [(33, 299, -3796), (33, 301, 300), (33, 300, -3796), (34, 299, 300), (34, 300, 4396), (34, -5000, -3796)],
)
def test_index_pulse_alone(method: int, start: int, expected: int):
    bench = bench_for(method, Switches(index=300), start)
    assert home(bench) == 0x1400
    assert bench.drive.axis.offset_counts == -expected


@pytest.mark.parametrize(
    ("method", "switches"),
    [
        (1, Switches()),
        (18, Switches(negative_limit=-5)),
        (7, Switches(LOW, HIGH)),
        (24, Switches(-500, 500, (5000.0, 6000.0))),  # both limits, and no home switch between them
        (34, Switches(-500, 500, index=2000)),
    ],
)
def test_homing_error_brakes_and_shows(method: int, switches: Switches):
    bench = bench_for(method, switches, 0)
    bits = home(bench)
    assert bits & 0x3000 == 0x2000
    bench.run(100 * MS)
    assert bench.statusword & 0x3400 == 0x2400  # and at rest
    assert bench.drive.axis.offset_counts == 0
    bench.control(0x0F)
    bench.must(0x6098, 0, 37, 1)
    assert home(bench) == 0x1400  # a new start clears the error


def test_speeds_and_the_order_of_bits():
    bench = bench_for(23, Switches(LOW, HIGH, BUMP, 300), 0)
    bench.control(0x1F)
    fastest = slowest = 0.0
    before = bench.drive.position_demand_counts
    while not bench.statusword & 0x1000:
        bench.tick()
        now = bench.drive.position_demand_counts
        fastest, slowest = max(fastest, now - before), min(slowest, now - before)
        before = now
    assert fastest == pytest.approx(20.0)
    assert slowest == pytest.approx(-5.0)
    # From 5000 counts/s to rest with 400000 counts/s^2: 31.25 counts beyond the edge, and two ticks until it is seen.
    assert 999 - 31.25 - 10 <= bench.drive.position_demand_counts <= 999 - 31.25


def test_start_bit_that_falls_brakes_and_interrupts():
    bench = bench_for(24, Switches(LOW, HIGH, (5000.0, 5100.0)), 0)
    bench.control(0x1F)
    bench.run(100 * MS)
    bench.control(0x0F)
    assert bench.statusword & 0x3400 == 0
    bench.run(60 * MS)
    assert bench.statusword & 0x3400 == 0x0400
    assert bench.drive.axis.offset_counts == 0
    before = bench.shaft
    bench.run(50 * MS)
    assert bench.shaft == before


def test_halt_waits_and_the_search_goes_on():
    bench = bench_for(24, Switches(LOW, HIGH, (3000.0, 3100.0)), 0)
    bench.control(0x1F)
    bench.run(50 * MS)
    bench.control(0x11F)
    bench.run(200 * MS)
    before = bench.shaft
    bench.run(50 * MS)
    assert bench.shaft == before
    assert bench.statusword & 0x3400 == 0
    bench.control(0x1F)
    bench.run(3000 * MS)
    assert bench.statusword & 0x3400 == 0x1400
    assert bench.drive.axis.offset_counts == -3000


def test_digital_inputs_show_the_switches():
    bench = Bench(DriveSettings(switches=Switches(-10, 10, (5.0, 12.0))))
    for counts, bits in ((-11, 1), (-10, 1), (-9, 0), (4, 0), (5, 4), (9, 4), (10, 6), (12, 6), (13, 2)):
        bench.shaft = counts
        bench.tick()
        assert bench.read(0x60FD) == bits


def test_methods_that_are_not_there():
    bench = Bench()
    good = {*range(1, 15), *range(17, 31), 33, 34, 35, 37, 0}
    assert {method for method in range(-128, 128) if bench.write(0x6098, 0, method, 1) == 0} == good


def test_switch_edges_and_index_by_hand():
    switches = Switches(-100, 100, (10.0, 20.0), index=3)
    assert switches.edge(DigitalInput.HOME, 0, 15) == 10
    assert switches.edge(DigitalInput.HOME, 15, 0) == 9
    assert switches.edge(DigitalInput.HOME, 15, 40) == 21
    assert switches.edge(DigitalInput.NEGATIVE_LIMIT, -150, 0) == -99
    assert [switches.next_index(at, 1, 10) for at in (3, 4, 13, -7, -8)] == [3, 13, 13, -7, -7]
    assert [switches.next_index(at, -1, 10) for at in (3, 4, 13, -7, -8)] == [3, 3, 13, -7, -17]
    with pytest.raises(ValueError, match="negative_limit = 5"):
        Switches(5, 5)
    with pytest.raises(ValueError, match="reversed"):
        Switches(home=(2.0, 1.0))


def test_switches_come_from_the_configuration():
    config = load_config("paper")
    axis = config.ordered_axes[1]
    section = SwitchesSection(negative_limit_deg=-90.0, home_deg=(10.0, 20.0), index_deg=1.0)
    emulation = axis.emulation.model_copy(update={"switches": section})
    found = switches(axis.model_copy(update={"emulation": emulation}))
    # 4096 counts a revolution: 11.378 a degree.
    assert found == Switches(-1024, INF, (114, 228), 11)
    assert switches(axis) == Switches()
    with pytest.raises(ValueError, match="home_deg: 3 is not below 2"):
        SwitchesSection(home_deg=(3.0, 2.0))
