"""Profiles of limited jerk (6086h = 3), end velocities 6082h, and the digital outputs 60FEh."""

from itertools import pairwise
from math import inf, sqrt

import pytest
from drive_bench import MS, Bench
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from sim_drive.device import jerk_profiles
from sim_drive.device.demand import Demand, Piece
from sim_drive.device.profiles import through_position

NS = 1_000_000_000
positions = st.floats(-1e5, 1e5)
speeds = st.floats(-5e4, 5e4)
rates = st.floats(1e3, 1e6)
ACCELERATION, JERK = 100_000, 4_000_000


def jerky(mode: int) -> Bench:
    bench = Bench()
    bench.follows = True
    for index in (0x6083, 0x6084):
        bench.must(index, 0, ACCELERATION, 4)
    bench.must(0x6086, 0, 3, 2)
    bench.must(0x60A4, 1, JERK, 4)
    bench.must(0x6081, 0, 10_000, 4)
    bench.enable(mode)
    return bench


def derivatives(bench: Bench, span_ms: int) -> tuple[list[float], list[float]]:
    """Velocities and accelerations of the demand at every millisecond, from its positions alone."""
    positions = [bench.drive.position_demand_counts]
    for _ in range(span_ms):
        bench.tick()
        positions.append(bench.drive.position_demand_counts)
    velocities = [(b - a) * 1e3 for a, b in pairwise(positions)]
    return velocities, [(b - a) * 1e3 for a, b in pairwise(velocities)]


def test_types_that_are_not_there_are_refused():
    bench = Bench()
    for kind in (1, 2):
        assert bench.write(0x6086, 0, kind, 2) == 0x06090030
    assert bench.write(0x6086, 0, 4, 2) == 0x06090031
    assert bench.write(0x60A4, 1, 0, 4) == 0x06090032


def test_a_move_takes_as_long_as_by_hand():
    bench = jerky(1)
    bench.must(0x607A, 0, 4000, 4)
    bench.control(0x1F)
    # To 10000 counts/s: jerk for 25 ms up to 100000, 75 ms of that, jerk for 25 ms: 125 ms and 625 counts each way.
    # Between them 2750 counts at 10000 counts/s: 275 ms. 525 ms altogether.
    velocities, accelerations = derivatives(bench, 540)
    assert bench.shaft == 4000
    assert max(velocities) == pytest.approx(10_000)
    assert max(accelerations) == pytest.approx(ACCELERATION, rel=1e-3)
    assert min(accelerations) == pytest.approx(-ACCELERATION, rel=1e-3)
    jerks = [(b - a) * 1e3 for a, b in pairwise(accelerations)]
    assert max(map(abs, jerks)) <= JERK * 1.001
    moving = [place for place, velocity in enumerate(velocities) if velocity > 0.0]
    assert len(moving) == pytest.approx(525, abs=2)


def test_profile_velocity_is_reached_without_a_step_of_acceleration():
    bench = jerky(3)
    bench.must(0x60FF, 0, 8_000, 4)
    velocities, accelerations = derivatives(bench, 150)
    assert velocities[-1] == pytest.approx(8_000)
    jerks = [(b - a) * 1e3 for a, b in pairwise(accelerations)]
    assert max(map(abs, jerks)) <= JERK * 1.001
    # Turned round in the middle of a ramp, it does not step either.
    bench.must(0x60FF, 0, -8_000, 4)
    derivatives(bench, 40)
    bench.must(0x60FF, 0, 3_000, 4)
    velocities, accelerations = derivatives(bench, 300)
    jerks = [(b - a) * 1e3 for a, b in pairwise(accelerations)]
    assert max(map(abs, jerks[2:])) <= JERK * 1.001
    assert velocities[-1] == pytest.approx(3_000)


@given(positions, st.floats(-1.0, 1.0), positions, st.floats(10.0, 1e5), rates, rates, st.floats(1e4, 1e8))
@settings(max_examples=40)
def test_every_move_of_limited_jerk_ends_at_its_target(
    start: float, share: float, target: float, cruise: float, up: float, down: float, jerk: float
):
    velocity = share * cruise
    demand = Demand()
    demand.launch(start, velocity, 0)
    pieces = jerk_profiles.to_position(target - start, velocity, 0.0, cruise, up, down, jerk)
    # A way of next to no length may be beyond the planner; the drive then makes a trapezoid of it.
    assume(pieces is not None or abs(target - start) > 1.0)
    assert pieces is not None
    assert all(abs(piece.jerk) <= jerk * (1 + 1e-9) for piece in pieces)
    demand.plan(pieces, 0)
    span_s = sum(piece.duration_s for piece in pieces)
    span = max(abs(target - start), 1.0) + abs(velocity) * span_s
    assert demand.at(round((span_s + 1e-6) * NS)) == pytest.approx(target, abs=1e-6 * span)
    low, high = demand.span_ahead(0)
    for n in range(50):
        assert low - 1e-6 * span <= demand.at(round(span_s * NS * n / 50)) <= high + 1e-6 * span


def test_what_no_plan_of_limited_jerk_does_is_done_in_a_trapezoid():
    assert jerk_profiles.to_position(100.0, 0.0, 0.0, -1.0, 1e5, 1e5, 1e6) is None
    bench = jerky(3)
    bench.must(0x607F, 0, 1, 4)
    bench.must(0x60FF, 0, 0, 4)
    bench.run(50 * MS)
    assert bench.shaft == 0


@given(st.floats(1.0, 1e5), st.booleans(), speeds, st.floats(10.0, 1e5), rates, rates, st.floats(1.0, 1e5))
@settings(max_examples=100)
def test_a_target_is_passed_with_the_end_velocity_or_the_nearest_to_it(
    length: float, is_back: bool, velocity: float, cruise: float, up: float, down: float, end: float
):
    end = min(end, cruise)
    direction = -1.0 if is_back else 1.0
    demand = Demand()
    demand.launch(0.0, velocity, 0)
    pieces = through_position(direction * length, velocity, cruise, up, down, end)
    assert pieces[-1] == Piece(0.0, inf)
    assert all(piece.duration_s >= -1e-9 for piece in pieces)
    demand.plan(pieces, 0)
    span_s = sum(piece.duration_s for piece in pieces[:-1])
    after = round((span_s + 1.0) * NS)
    assert demand.velocity_at(after) == pytest.approx(direction * end, rel=1e-6, abs=1e-6)
    # Where it is at the target it has a speed that the rates allow, and the end velocity if they allow that.
    forwards = max(velocity * direction, 0.0)
    run_up = length + (velocity * velocity / (2.0 * down) if velocity * direction < 0.0 else 0.0)
    fastest = sqrt(forwards * forwards + 2.0 * up * run_up)
    slowest = sqrt(max(forwards * forwards - 2.0 * down * run_up, 0.0))
    passed = max(min(end, fastest), slowest)
    at_s = 0.0
    low, high = 0.0, span_s + (2.0 * length + abs(demand.at(round(span_s * NS)))) / end + 1.0
    for _ in range(80):
        at_s = (low + high) / 2
        if (demand.at(round(at_s * NS)) - direction * length) * direction >= 0.0:
            high = at_s
        else:
            low = at_s
    assert abs(demand.velocity_at(round(high * NS))) == pytest.approx(passed, rel=1e-2, abs=1.0)


@pytest.mark.parametrize("kind", [0, 3])
def test_an_end_velocity_is_kept_until_the_next_set_point(kind: int):
    bench = jerky(1)
    bench.must(0x6086, 0, kind, 2)
    bench.must(0x6082, 0, 2_000, 4)
    bench.must(0x607A, 0, 3_000, 4)
    bench.control(0x1F)
    while bench.shaft < 3_000:
        bench.tick()
        assert bench.now_ns < 5 * NS
    assert bench.drive.axis.demand.velocity_at(bench.now_ns) == pytest.approx(2_000, rel=1e-3)
    bench.run(100 * MS)
    assert bench.shaft == pytest.approx(3_200, abs=5)
    assert bench.statusword & 0x400
    bench.control(0x0F)
    bench.must(0x6082, 0, 0, 4)
    bench.must(0x607A, 0, 4_000, 4)
    bench.control(0x1F)
    bench.run(1000 * MS)
    assert bench.shaft == 4_000


def test_a_halt_ends_the_motion_after_an_end_velocity():
    bench = jerky(1)
    bench.must(0x6082, 0, 2_000, 4)
    bench.must(0x607A, 0, 500, 4)
    bench.control(0x1F)
    bench.run(500 * MS)
    bench.control(0x10F)
    bench.run(200 * MS)
    stood = bench.shaft
    bench.control(0x0F)
    bench.run(200 * MS)
    assert bench.shaft == stood


@pytest.mark.parametrize(
    ("outputs", "mask", "is_enabled", "is_released"),
    [
        (0, 0, False, False),
        (1, 0, True, True),
        (0, 0, True, True),
        (1, 1, True, False),
        (0, 1, False, True),
        (1, 1, False, False),
        (0xFFFE, 0xFFFE, False, False),
    ],
)
def test_the_brake_is_the_drives_unless_the_mask_gives_it_away(
    outputs: int, mask: int, is_enabled: bool, is_released: bool
):
    bench = Bench()
    bench.must(0x60FE, 1, outputs, 4)
    bench.must(0x60FE, 2, mask, 4)
    if is_enabled:
        bench.enable()
    assert bench.drive.axis.is_brake_released is is_released


def test_outputs_act_where_the_mask_lets_them_and_are_off_after_a_reset():
    bench = Bench()
    bench.must(0x60FE, 1, 0x00F0_0000, 4)
    assert bench.drive.axis.digital_outputs == 0
    bench.must(0x60FE, 2, 0x0030_0001, 4)
    assert bench.drive.axis.digital_outputs == 0x0030_0000
    bench.must(0x1010, 1, 0x65766173, 4)
    bench.nmt(0x81)
    bench.tick()
    assert (bench.read(0x60FE, 1), bench.read(0x60FE, 2)) == (0, 0)
