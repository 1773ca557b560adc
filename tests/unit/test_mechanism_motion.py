"""Plans of the master by hand-worked ramps."""

from math import nan, pi, tau

import pytest

from mechanism.errors import MotionError
from mechanism.motion import MasterPhase, plan_run, plan_stop


def test_a_ramp_worked_by_hand() -> None:
    # 0 to 4 rad/s at 2 rad/s^2 and 4 rad/s^3: jerk 0.5 s, constant 1.5 s, jerk 0.5 s; 2.5 s at 2 rad/s mean: 5 rad.
    plan = plan_run(0.0, 4.0, 1, 2.0, 4.0, end_at_multiple_of_revolution=False)
    assert plan.cruise_start_s == pytest.approx(2.5)
    assert plan.at(0.5) == pytest.approx((4.0 / 6 * 0.125, 0.5, 2.0))
    assert plan.at(2.0) == pytest.approx((5.0 - 4.0 * 0.5 + 4.0 / 6 * 0.125, 3.5, 2.0))
    assert plan.at(2.5) == pytest.approx((5.0, 4.0, 0.0))
    assert plan.cruise_end_s == pytest.approx(2.5 + tau / 4.0)
    assert plan.duration_s == pytest.approx(5.0 + tau / 4.0)
    assert plan.end_position == pytest.approx(10.0 + tau)
    # 10 + 2 pi is in the third turn: the run is made longer, up to 6 pi.
    whole = plan_run(0.0, 4.0, 1, 2.0, 4.0)
    assert whole.end_position == pytest.approx(3 * tau)
    assert whole.duration_s == pytest.approx(5.0 + (3 * tau - 10.0) / 4.0)


def test_phases_follow_each_other() -> None:
    plan = plan_run(0.0, tau, 10, 20.0, 200.0)
    assert plan.phase_at(-1.0) is MasterPhase.RAMP_UP
    assert plan.phase_at(0.0) is MasterPhase.RAMP_UP
    assert plan.phase_at(plan.cruise_start_s) is MasterPhase.CRUISE
    assert plan.phase_at(plan.cruise_end_s) is MasterPhase.RAMP_DOWN
    assert plan.phase_at(plan.duration_s) is MasterPhase.FINISHED


def test_a_run_that_fits_exactly_is_not_made_a_turn_longer() -> None:
    # Both ramps together turn v^2/a + v a/j: in turns 16/4 + 4 x 4/8 = 6, a whole number, so nothing is added.
    plan = plan_run(0.0, 4 * tau, 3, 4 * tau, 8 * tau)
    ramps = (4.0**2 / 4.0 + 4.0 * 4.0 / 8.0) * tau
    assert plan.end_position == pytest.approx(ramps + 3 * tau)
    assert plan.cruise_end_s - plan.cruise_start_s == pytest.approx(3.0 / 4.0)


def test_a_run_may_start_off_a_whole_turn_and_turn_backwards() -> None:
    plan = plan_run(0.3, -3.0, 2, 20.0, 200.0)
    assert plan.end_position == pytest.approx(-3 * tau)
    assert plan.at(plan.cruise_start_s)[1] == -3.0


def test_a_stop_worked_by_hand() -> None:
    # 4 rad/s at 2 rad/s^2, 4 rad/s^3: the ramp above, mirrored.
    plan = plan_stop(1.0, 4.0, 0.0, 2.0, 4.0)
    assert plan.duration_s == pytest.approx(2.5)
    assert plan.end_position == pytest.approx(6.0)
    assert plan.at(0.5)[1:] == pytest.approx((3.5, -2.0))
    assert plan.phase_at(0.0) is MasterPhase.RAMP_DOWN


def test_a_stop_at_rest_is_over_at_once() -> None:
    plan = plan_stop(pi, 0.0, 0.0, 2.0, 4.0)
    assert plan.duration_s == 0.0
    assert plan.at(0.0) == (pi, 0.0, 0.0)
    assert plan.phase_at(0.0) is MasterPhase.FINISHED


def test_a_stop_from_beyond_the_acceleration_limit_first_comes_back_to_it() -> None:
    plan = plan_stop(0.0, 6.0, 30.0, 20.0, 200.0)
    assert plan.at(0.0) == (0.0, 6.0, 30.0)
    assert plan.at(0.05)[2] == pytest.approx(20.0)
    assert plan.at(plan.duration_s)[1:] == (0.0, 0.0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0.0, 1.0, 1, 0.0, 1.0), "acceleration limit is 0 rad/s"),
        ((0.0, 1.0, 1, 1.0, -1.0), "jerk limit is -1 rad/s"),
        ((0.0, 1.0, 1, 1.0, nan), "jerk limit is nan"),
        ((0.0, 0.0, 1, 1.0, 1.0), "cruise speed is 0 rad/s"),
        ((0.0, nan, 1, 1.0, 1.0), "must be finite"),
        ((0.0, 1.0, -1, 1.0, 1.0), "number of cycles is -1"),
    ],
)
def test_impossible_runs_are_refused(arguments: tuple[float, float, int, float, float], message: str) -> None:
    with pytest.raises(MotionError, match=message):
        plan_run(*arguments)


def test_impossible_stops_are_refused() -> None:
    for state in ((nan, 1.0, 1.0), (0.0, nan, 0.0), (0.0, 0.0, nan)):
        with pytest.raises(MotionError, match=r"position, velocity and acceleration must be finite$"):
            plan_stop(*state, 1.0, 1.0)
    with pytest.raises(MotionError, match="acceleration limit"):
        plan_stop(0.0, 1.0, 0.0, 0.0, 1.0)
