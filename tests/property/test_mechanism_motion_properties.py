"""Plans of the master keep their limits and are continuous, whatever is asked for."""

from math import tau

import numpy as np
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from mechanism.motion import MasterPhase, MasterPlan, plan_run, plan_stop

speeds = st.floats(0.05, 60.0) | st.floats(-60.0, -0.05)
accelerations = st.floats(0.5, 200.0)
jerks = st.floats(1.0, 5000.0)


def sampled(plan: MasterPlan, count: int = 2001) -> tuple[np.ndarray, np.ndarray]:
    times = np.linspace(0.0, plan.duration_s, count)
    return times, np.array([plan.at(float(t)) for t in times])


def check_shape(plan: MasterPlan, acceleration: float, jerk: float) -> None:
    times, motion = sampled(plan)
    assert np.abs(motion[:, 2]).max() <= acceleration * (1 + 1e-9) + 1e-9
    step = times[1] - times[0]
    assert np.abs(np.diff(motion[:, 2])).max() <= jerk * step * (1 + 1e-6) + 1e-9
    # Velocity and position are the integrals of what stands above them (the trapezium misses jerk step^2 / 12 at most).
    velocity = np.diff(motion[:, 1]) - 0.5 * (motion[1:, 2] + motion[:-1, 2]) * step
    assert np.abs(velocity).max() <= jerk * step**2 / 2 + 1e-9
    position = np.diff(motion[:, 0]) - 0.5 * (motion[1:, 1] + motion[:-1, 1]) * step
    assert np.abs(position).max() <= acceleration * step**2 / 2 + 1e-9
    # Across every joint of the pieces nothing jumps.
    for start in plan.starts_s[1:]:
        before, after = plan.at(start - 1e-9), plan.at(start)
        assert np.abs(np.array(before) - np.array(after)).max() <= 1e-7 + 1e-8 * (abs(before[1]) + acceleration + jerk)


@settings(deadline=None, derandomize=True, max_examples=60)
@given(st.floats(-20.0, 20.0), speeds, st.integers(0, 12), accelerations, jerks)
def test_a_run(start: float, speed: float, cycles: int, acceleration: float, jerk: float) -> None:
    plan = plan_run(start, speed, cycles, acceleration, jerk)
    assume(plan.duration_s < 1e4)
    check_shape(plan, acceleration, jerk)
    assert plan.at(0.0) == (start, 0.0, 0.0)
    assert plan.at(-1.0) == (start, 0.0, 0.0)
    for late in (plan.duration_s, plan.duration_s + 100.0):
        position, velocity, last = plan.at(late)
        assert abs(position / tau - round(position / tau)) < 1e-9
        assert (velocity, last) == (0.0, 0.0)
    near = plan.at(plan.duration_s * (1 - 1e-12))
    assert abs(near[0] - plan.end_position) < 1e-6
    assert abs(near[1]) < 1e-6 * (1 + abs(speed))
    # The cruise has at least the cycles asked for, and not a whole one too many.
    cruised = (plan.cruise_end_s - plan.cruise_start_s) * abs(speed) / tau
    assert cycles - 1e-6 <= cruised < cycles + 1 + 1e-6
    middle = 0.5 * (plan.cruise_start_s + plan.cruise_end_s)
    if plan.phase_at(middle) is MasterPhase.CRUISE:
        assert plan.at(middle)[1:] == (speed, 0.0)
    _, motion = sampled(plan, 501)
    assert np.all(motion[:, 1] * np.sign(speed) >= -1e-9)
    assert np.abs(motion[:, 1]).max() <= abs(speed) * (1 + 1e-9)


@settings(deadline=None, derandomize=True, max_examples=60)
@given(st.floats(-1e3, 1e3), st.floats(-60.0, 60.0), st.floats(-1.0, 1.0), accelerations, jerks)
def test_a_stop_from_any_state(
    position: float, velocity: float, share: float, acceleration: float, jerk: float
) -> None:
    plan = plan_stop(position, velocity, share * acceleration, acceleration, jerk)
    check_shape(plan, acceleration, jerk)
    at_once = plan.at(0.0)
    assert np.allclose(at_once, (position, velocity, share * acceleration), atol=1e-9) or plan.duration_s == 0.0
    assert plan.at(plan.duration_s) == (plan.end_position, 0.0, 0.0)
    near = plan.at(plan.duration_s * (1 - 1e-12))
    assert abs(near[0] - plan.end_position) < 1e-6
    assert plan.phase_at(0.0) in (MasterPhase.RAMP_DOWN, MasterPhase.FINISHED)


@settings(deadline=None, derandomize=True, max_examples=40)
@given(speeds, accelerations, jerks, st.floats(0.0, 1.0))
def test_a_stop_out_of_a_run_goes_on_from_it(speed: float, acceleration: float, jerk: float, share: float) -> None:
    run = plan_run(0.0, speed, 1, acceleration, jerk)
    state = run.at(share * run.duration_s)
    stop = plan_stop(*state, acceleration, jerk)
    assert np.allclose(stop.at(0.0), state, atol=1e-9)
    check_shape(stop, acceleration, jerk)
    # Bringing the acceleration to zero adds at most a^2 / (2 j) to the speed that is to be taken away.
    rest = abs(state[2]) / jerk
    fastest = abs(state[1]) + 0.5 * rest * abs(state[2])
    slowest_s = fastest / acceleration + acceleration / jerk
    assert stop.duration_s <= rest + max(slowest_s, 2.0 * (fastest / jerk) ** 0.5) + 1e-6
