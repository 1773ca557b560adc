"""Factor group: user units of 0.1 degree behind a gear of 2 : 1, so 3600 units are 8192 counts of the motor."""

from fractions import Fraction

import pytest
from drive_bench import MS, Bench
from hypothesis import given
from hypothesis import strategies as st

from sim_drive.device.scaling import IDENTITY, Scaling, make_scaling
from sim_drive.settings import DriveSettings
from sim_drive.switches import Switches

CANNOT = 0x08000022


def geared(polarity: int = 0, settings: DriveSettings | None = None) -> Bench:
    bench = Bench(settings)
    bench.must(0x6091, 1, 2, 4)
    bench.must(0x6092, 1, 3600, 4)
    bench.must(0x607E, 0, polarity, 1)
    return bench


def test_user_units_are_counts_by_default():
    bench = Bench()
    assert bench.drive.axis.scaling == IDENTITY
    bench = Bench(DriveSettings(counts_per_revolution=8192))
    assert bench.drive.axis.scaling == IDENTITY
    assert (bench.read(0x608F, 1), bench.read(0x6090, 1), bench.read(0x6092, 1)) == (8192, 8192, 8192)


@pytest.mark.parametrize(("shaft", "shown"), [(8192, 3600), (0, 0), (1, 0), (2, 1), (-2, -1), (-8192, -3600), (5, 2)])
def test_positions_are_shown_in_user_units(shaft: int, shown: int):
    bench = geared()
    bench.shaft = shaft
    bench.tick()
    assert bench.read(0x6064, signed=True) == shown
    assert bench.read(0x6062, signed=True) == shown


def test_velocities_are_shown_in_user_units():
    bench = geared()
    bench.drive.axis.latch = lambda now_ns: (8192, -8192.0, 0)
    assert bench.read(0x606C, signed=True) == -3600
    assert bench.read(0x6064, signed=True) == 3600


@pytest.mark.parametrize(("polarity", "sign"), [(0, 1), (0x80, -1), (0x40, 1), (0xC0, -1)])
def test_a_target_is_in_user_units(polarity: int, sign: int):
    bench = geared(polarity)
    bench.follows = True
    bench.must(0x60C2, 1, 100, 1)
    bench.enable()
    bench.must(0x607A, 0, 450, 4)
    bench.run(200 * MS)
    assert bench.shaft == sign * 1024
    assert bench.read(0x6064, signed=True) == 450
    assert bench.read(0x60F4, signed=True) == 0


@pytest.mark.parametrize(("polarity", "sign"), [(0, 1), (0x40, -1), (0x80, 1)])
def test_profile_velocity_is_in_user_units(polarity: int, sign: int):
    bench = geared(polarity)
    bench.follows = True
    for index in (0x6083, 0x6084):
        bench.must(index, 0, 36_000, 4)
    bench.enable(mode=3)
    bench.must(0x60FF, 0, 3600, 4)
    # 8192 counts/s with 81920 counts/s^2: 0.1 s.
    bench.run(100 * MS)
    assert bench.drive.axis.demand.velocity_at(bench.now_ns) == pytest.approx(sign * 8192, rel=0.02)
    assert bench.read(0x606B, signed=True) == pytest.approx(3600, rel=0.02)
    before = bench.shaft
    bench.run(1000 * MS)
    assert bench.shaft - before == pytest.approx(sign * 8192, abs=2)


def test_profile_position_keeps_to_velocities_and_rates_in_user_units():
    bench = geared()
    bench.follows = True
    for index, value in ((0x6081, 3600), (0x6083, 36_000), (0x6084, 36_000), (0x6067, 2)):
        bench.must(index, 0, value, 4)
    bench.enable(mode=1)
    bench.must(0x607A, 0, 3600, 4)
    bench.control(0x1F)
    # 3600 units at 3600 units/s with ramps of 0.1 s: 1.1 s.
    bench.run(600 * MS)
    assert bench.drive.axis.demand.velocity_at(bench.now_ns) == pytest.approx(8192)
    bench.run(480 * MS)
    assert bench.shaft == pytest.approx(8192 - 40_960 * 0.02**2, abs=1)
    bench.run(20 * MS)
    assert bench.shaft == 8192
    bench.run(100 * MS)
    assert bench.statusword & 0x400


@pytest.mark.parametrize(("polarity", "sign"), [(0, 1), (0x80, -1)])
def test_software_limits_are_in_user_units(polarity: int, sign: int):
    bench = geared(polarity)
    bench.follows = True
    bench.must(0x607D, 1, -450, 4)
    bench.must(0x607D, 2, 900, 4)
    bench.must(0x6085, 0, 3_600_000, 4)
    for index in (0x6083, 0x6084):
        bench.must(index, 0, 36_000, 4)
    bench.enable(mode=1)
    for target, end in ((5000, 2048), (-5000, -1024)):
        bench.must(0x607A, 0, target, 4)
        bench.control(0x1F)
        bench.run(3000 * MS)
        bench.control(0x0F)
        assert bench.shaft == sign * end
        assert bench.statusword & 0x800
    bench.must(0x6060, 0, 3, 1)
    for velocity, end in ((3600, 2048), (-3600, -1024)):
        bench.must(0x60FF, 0, velocity * sign, 4)
        bench.run(3000 * MS)
        assert bench.shaft == pytest.approx(sign * end, abs=1)


def test_the_following_error_and_its_window_are_in_user_units():
    bench = geared()
    bench.must(0x6065, 0, 100, 4)
    bench.must(0x6066, 0, 10, 2)
    bench.must(0x60C2, 1, 10, 1)
    bench.enable()
    bench.must(0x607A, 0, 99, 4)  # 225.28 counts
    bench.run(100 * MS)
    assert bench.read(0x60F4, signed=True) == 99
    assert bench.statusword & 0x6F == 0x27
    bench.must(0x607A, 0, 102, 4)
    bench.run(100 * MS)
    assert bench.statusword & 0x08
    assert bench.read(0x603F) == 0x8611


def test_home_offset_and_homing_speeds_are_in_user_units():
    bench = geared(settings=DriveSettings(switches=Switches(home=(1000.0, 3000.0))))
    bench.follows = True
    bench.must(0x607C, 0, 7200, 4)
    bench.must(0x6099, 1, 3600, 4)
    bench.must(0x6099, 2, 360, 4)
    bench.must(0x609A, 0, 360_000, 4)
    bench.must(0x6098, 0, 20, 1)  # rising edge of the home switch, going up
    bench.enable(mode=6)
    bench.control(0x1F)
    bench.run(50 * MS)
    assert abs(bench.drive.axis.demand.velocity_at(bench.now_ns)) == pytest.approx(8192)
    bench.run(5000 * MS)
    assert bench.statusword & 0x1400 == 0x1400
    # At the edge, count 1000, the position is 7200 units.
    bench.control(0x00)
    bench.shaft = 1000 + 8192
    bench.tick()
    assert bench.read(0x6064, signed=True) == pytest.approx(7200 + 3600, abs=1)


def test_a_touch_probe_latches_user_units():
    bench = geared(settings=DriveSettings(switches=Switches(home=(2048.0, 9000.0))))
    bench.must(0x60B8, 0, 0x11, 2)
    bench.shaft = 4000
    bench.tick()
    assert bench.read(0x60BA, signed=True) == 900


def test_factors_cannot_change_under_power():
    bench = geared()
    bench.enable()
    for place in ((0x607E, 0, 1), (0x6091, 1, 4), (0x6091, 2, 4), (0x6092, 1, 4), (0x6092, 2, 4)):
        assert bench.write(*place[:2], 1, place[2]) == CANNOT
    for place in ((0x6091, 1), (0x6091, 2), (0x6092, 1), (0x6092, 2)):
        bench.control(0x00)
        assert bench.write(*place, 0, 4) == 0x06090032


def test_stored_factors_act_after_a_reset_and_unstored_ones_do_not():
    bench = geared(0x80)
    bench.must(0x1010, 1, 0x65766173, 4)
    bench.must(0x6091, 1, 4, 4)
    bench.nmt(0x81)
    bench.shaft = 8192
    bench.tick()
    assert bench.read(0x6064, signed=True) == -3600


def test_positions_wrap_in_user_units():
    # 10^9 units a revolution: INTEGER32 wraps after 2.147 of them.
    bench = Bench()
    bench.must(0x6092, 1, 1_000_000_000, 4)
    bench.must(0x6065, 0, 0xFFFFFFFF, 4)
    bench.follows = True
    bench.shaft = 4096 * 2
    bench.tick()
    assert bench.read(0x6064, signed=True) == 2_000_000_000
    bench.shaft = 4096 * 3
    bench.tick()
    assert bench.read(0x6064, signed=True) == 3_000_000_000 - (1 << 32)
    # The shortest way to what shows as 2 * 10^9 is back by one revolution.
    bench.must(0x60C2, 1, 100, 1)
    bench.enable()
    bench.must(0x607A, 0, 2_000_000_000, 4)
    bench.run(200 * MS)
    assert bench.shaft == 4096 * 2


def test_the_velocity_offset_is_fed_forward_with_the_next_target_and_leaves_with_the_mode():
    bench = geared()
    bench.enable()
    bench.must(0x60B1, 0, 360, 4)
    assert bench.drive.axis.velocity_offset == 0.0
    bench.must(0x607A, 0, 1, 4)
    assert bench.drive.axis.velocity_offset == pytest.approx(819.2)
    bench.control(0x07)
    assert bench.drive.axis.velocity_offset == 0.0


@given(
    st.integers(0, 255),
    st.integers(-(1 << 40), 1 << 40),
    *(st.tuples(st.integers(1, 1 << 20), st.integers(1, 1 << 20)) for _ in range(4)),
)
def test_scaling_is_exact_to_half_a_unit(
    polarity: int,
    counts: int,
    position: tuple[int, int],
    velocity: tuple[int, int],
    gear: tuple[int, int],
    feed: tuple[int, int],
):
    scaling = make_scaling(polarity, position, velocity, gear, feed)
    exact = Fraction(counts * feed[0] * gear[1] * position[1], feed[1] * gear[0] * position[0])
    if polarity & 0x80:
        exact = -exact
    assert abs(scaling.position(counts) - exact) <= Fraction(1, 2)
    assert (scaling.velocity_unit < 0) is bool(polarity & 0x40)
    assert isinstance(scaling, Scaling)
