"""Whatever an operator asks of a machine in motion, its demand keeps the limits of both axes and of the linkage."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from config.conversion import closure_at_home, five_bar
from config.loading import load_config, parse_config
from gateway.cyclic.demand import CamDemand
from gateway.cyclic.operation import Operation, Order
from gateway.cyclic.torque_offsets import build_feed_forward
from gateway.record.sample import Phase
from gateway.running.drive_settings import axis_units
from gateway.running.operation_setup import operation_limits, slave_law
from gateway.running.preparation import compile_config, plan

PAPER = load_config("paper")
SLOW = parse_config(PAPER.text.replace("speed_rpm: 60", "speed_rpm: 20"), PAPER.path)
PROFILE = compile_config(PAPER).profile
PERIOD_S = 1e-3
ROUNDING = 1e-6


class Operated:
    """A demand and its operator alone: no drives, no bus; every step of both axes is kept, in rad."""

    def __init__(self, config=PAPER):
        self.config = config
        self.profile = PROFILE
        self.law = slave_law(config, self.profile)
        units = tuple(axis_units(axis) for axis in config.ordered_axes)
        motion = config.motion
        limits = motion.ramp_acceleration_rad_per_s2, motion.ramp_jerk_rad_per_s3
        self.demand = CamDemand(self.profile, units, PERIOD_S, *limits, law=self.law)
        self.plan = plan(config, 100)
        self.demand.begin(self.plan, (0, 0))
        self.operation = Operation(self.demand, operation_limits(config))
        self.angles = [self.now]

    @property
    def now(self):
        position = self.demand.master_position
        return position, self.law.at(position)[0]

    def step(self):
        self.demand.step()
        self.angles.append(self.now)

    def go(self, seconds):
        for _ in range(round(seconds / PERIOD_S)):
            self.step()
        return self

    def until(self, condition, limit_s=60.0):
        for _ in range(round(limit_s / PERIOD_S)):
            if condition():
                return self
            self.step()
        raise AssertionError("it has not come to pass")

    def to_speed(self):
        self.until(lambda: self.demand.master_velocity >= self.config.speed_rad_per_s * (1 - 1e-9))
        self.angles = [self.now]
        return self

    def order(self, order, value):
        """The refusal, empty if taken; the machine moves on meanwhile."""
        answer = self.operation.carry_out(order, value, self.plan.end_position, 0)
        while answer is None:
            self.step()
            answer = self.operation.go_on(0)
        return answer.refusal

    def assert_limits_were_kept(self):
        """Divided differences are means of the derivatives, which they cannot exceed."""
        angles = np.array(self.angles)
        master, slave = (axis.limits for axis in self.config.ordered_axes)
        motion = self.config.motion
        bounds = [
            (master.velocity_rad_per_s, slave.velocity_rad_per_s),
            (motion.ramp_acceleration_rad_per_s2, slave.acceleration_rad_per_s2),
            (motion.ramp_jerk_rad_per_s3, slave.jerk_rad_per_s3),
        ]
        found = []
        for n, (of_master, of_slave) in enumerate(bounds, 1):
            worst = np.abs(np.diff(angles, n, axis=0)).max(axis=0) / PERIOD_S**n
            found.append(worst[1] / of_slave)
            assert worst[0] <= of_master * (1 + ROUNDING) + ROUNDING, n
            assert worst[1] <= of_slave * (1 + ROUNDING) + ROUNDING, n
        closure = closure_at_home(self.config)
        sines = np.abs(five_bar(self.config).transmission_sines(angles[:, 0], angles[:, 1], closure)[:, 0])
        assert sines.min() >= self.config.machine.minimum_transmission_sine * (1 - 1e-3)
        return found


def test_the_paper_machine_has_room_for_110_percent_by_hand():
    """|d2| v^2 + |d1| A <= 400 rad/s^2, A = 6 rad/s^2, over the cam: v = 1.1094 x 2 pi rad/s."""
    d1, d2 = np.abs(PROFILE.at_many(np.linspace(0.0, math.tau, 20001))[:, 1:3]).T
    by_hand = np.sqrt(((400.0 - d1 * 6.0) / d2).min()) / math.tau
    law = slave_law(PAPER, PROFILE)
    assert by_hand == pytest.approx(1.1094, abs=1e-4)
    assert law.proved_speed / math.tau == pytest.approx(by_hand, abs=1e-3)
    assert law.proved_speed / math.tau <= by_hand


def test_an_override_above_100_percent_is_taken_as_far_as_the_limits_go():
    machine = Operated().to_speed()
    assert "at 110 % axis servo's acceleration is at its limit of 400 rad/s^2" in machine.order(Order.OVERRIDE, 110.95)
    assert machine.order(Order.OVERRIDE, 110.0) == ""
    machine.go(3.0)
    assert machine.demand.master_velocity == pytest.approx(1.1 * math.tau)
    velocity, acceleration, jerk = machine.assert_limits_were_kept()
    # By hand: 3.0176 x 6.912 = 20.86 of 25 rad/s. The rest is less than proved: nobody ramps at the worst angle.
    assert velocity == pytest.approx(20.86 / 25.0, abs=2e-3)
    assert 0.9 < acceleration <= 1.0
    assert 0.7 < jerk <= 1.0


def test_a_slower_machine_goes_as_fast_as_the_faster_one():
    machine = Operated(SLOW).to_speed()
    assert machine.order(Order.OVERRIDE, 332.0) == ""
    machine.go(4.0)
    machine.assert_limits_were_kept()
    assert "333 % is too fast, at 332 % axis servo's acceleration" in machine.order(Order.OVERRIDE, 333.0)


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("velocity_rad_per_s: 14.0", "velocity_rad_per_s: 6.5", "at 103 % axis cv's velocity is at its limit of 6.5"),
        ("velocity_rad_per_s: 25.0", "velocity_rad_per_s: 19.5", "at 102 % axis servo's velocity is at its limit of"),
        ("jerk_rad_per_s3: 20000.0", "jerk_rad_per_s3: 12500", "at 100 % axis servo's jerk is at its limit of 12500"),
        ("limit_permille: 2500", "limit_permille: 640", "at 103 % axis servo's torque is at its limit of 0.96 Nm"),
    ],
)
def test_the_refusal_names_axis_limit_and_what_would_fit(old, new, sentence):
    config = parse_config(PAPER.text.replace(old, new), PAPER.path)
    assert sentence in Operated(config).order(Order.OVERRIDE, 150.0)


def test_the_torque_that_bounds_the_override_is_the_feed_forwards():
    model = build_feed_forward(PAPER, PROFILE)
    at = np.linspace(0.0, math.tau, 720).tolist()

    def worst(percent):
        speed = PAPER.speed_rad_per_s * percent / 100.0
        return max(abs(model.torques(theta2, speed, ramp)[1]) for theta2 in at for ramp in (-6.0, 6.0))

    assert worst(103.0) < 0.96 < worst(104.0)


windows = st.floats(1.0, 360.0)
angles = st.floats(0.0, 360.0)


def go_off_the_cam_and_back(percent, off, off_window, on, on_window):
    machine = Operated().to_speed()
    assert machine.order(Order.OVERRIDE, percent) == ""
    for order, at, window in ((Order.DISENGAGE, off, off_window), (Order.ENGAGE, on, on_window)):
        assert machine.order(Order.WINDOW, window) == ""
        refusal = machine.order(order, at)
        if refusal:
            # Another window, which the gateway looks for itself, may still do, and then is not the one refused.
            assert "deg within " in refusal
            assert "(limit" in refusal or "(bound" in refusal
            machine.order(Order.WINDOW, 0.0)
            if machine.order(order, at):
                break
        machine.until(lambda: not math.isfinite(machine.law._window[0]))
    machine.go(0.1)
    machine.assert_limits_were_kept()


off_and_on = given(st.floats(5.0, 110.0), angles, windows, angles, windows)


@settings(deadline=None, derandomize=True, max_examples=7)
@off_and_on
def test_on_and_off_the_cam_within_any_window_at_any_speed(percent, off, off_window, on, on_window):
    go_off_the_cam_and_back(percent, off, off_window, on, on_window)


@pytest.mark.slow
@settings(deadline=None, derandomize=True, max_examples=60)
@off_and_on
def test_on_and_off_the_cam_within_any_window_at_any_speed_very_often(percent, off, off_window, on, on_window):
    go_off_the_cam_and_back(percent, off, off_window, on, on_window)


def test_a_window_too_narrow_for_the_speed_is_refused_with_one_that_fits():
    machine = Operated().to_speed()
    machine.order(Order.WINDOW, 20.0)
    sentence = machine.order(Order.DISENGAGE, 100.0)
    assert sentence.startswith("leaving the cam at 100 deg within 20 deg at 60 rpm: axis servo's jerk would reach ")
    assert sentence.endswith("(limit 20000); 40 deg would fit")
    assert machine.law.is_plain
    # Slower it fits.
    assert machine.order(Order.OVERRIDE, 40.0) == ""
    machine.go(2.0)
    assert machine.order(Order.DISENGAGE, 100.0) == ""
    # And then bars the way to more speed, until it is passed.
    assert "axis servo's jerk is at its limit" in machine.order(Order.OVERRIDE, 100.0)
    machine.until(lambda: not math.isfinite(machine.law._window[0]))
    assert machine.order(Order.OVERRIDE, 100.0) == ""
    machine.go(1.0)
    machine.assert_limits_were_kept()


def test_a_window_is_proved_for_the_speed_that_the_master_still_has():
    machine = Operated().to_speed()
    machine.order(Order.WINDOW, 20.0)
    machine.until(lambda: math.degrees(machine.demand.master_position) % 360.0 > 60.0)
    assert machine.order(Order.OVERRIDE, 30.0) == ""
    # Still at 60 rpm, and at 100 deg in a moment.
    assert "within 20 deg at 60 rpm" in machine.order(Order.DISENGAGE, 100.0)
    machine.go(3.0)
    assert machine.order(Order.DISENGAGE, 100.0) == ""


class Told(Operated):
    """Asks the law, a step before and at every step, how the slave moves there."""

    def __init__(self):
        super().__init__()
        self.told = []

    def step(self):
        demand = self.demand
        ahead = self.law.motion(*demand._plan.at((demand._step + 1) * PERIOD_S), PERIOD_S)
        super().step()
        now = self.law.motion(demand.master_position, demand.master_velocity, demand._acceleration)
        self.told.append((*now, *ahead))


def test_the_motion_that_the_feed_forward_is_told_is_that_of_the_demand():
    """A phase shift, one stopped on its way, the slave leaving its cam and coming back, under way and in a ramp."""
    machine = Told().to_speed()
    machine.told.clear()
    for order, value, seconds in (
        (Order.PHASE_SHIFT, -6.0, 0.9),
        (Order.OVERRIDE, 50.0, 0.5),
        (Order.PHASE_SHIFT, 3.0, 0.2),
        (None, 0.0, 0.4),
        (Order.DISENGAGE, 100.0, 3.0),
        (Order.ENGAGE, 200.0, 4.0),
    ):
        if order is None:
            machine.law.halt_shift()
        else:
            assert machine.order(order, value) == ""
        machine.go(seconds)
    assert -6.0 < math.degrees(machine.law.shift) < 3.0
    assert not machine.law.is_shifting
    theta5 = np.array(machine.angles)[1:, 1]
    at, velocity, acceleration, *ahead = np.array(machine.told).T
    assert at == pytest.approx(theta5, abs=1e-12)
    by_differences = np.gradient(theta5, PERIOD_S)
    assert velocity[2:-2] == pytest.approx(by_differences[2:-2], abs=0.01)
    by_differences = np.gradient(by_differences, PERIOD_S)
    # Where the cam's jerk jumps, from one of its pieces to the next, differences of the second order do not hold.
    assert acceleration[2:-2] == pytest.approx(by_differences[2:-2], abs=20.0)
    assert np.quantile(np.abs(acceleration - by_differences)[2:-2], 0.95) < 0.1
    assert np.abs(velocity).max() > 10.0
    assert np.abs(acceleration).max() > 200.0
    # Whoever asks a step before is told the same, but where an order or the law's own end comes in between.
    amiss = np.abs(np.array(ahead) - (at, velocity, acceleration)) > [[1e-9], [1e-6], [1e-3]]
    assert np.count_nonzero(amiss.any(axis=0)) <= 8


jogs = st.lists(st.tuples(st.floats(-15.0, 15.0), st.floats(0.05, 1.5)), min_size=2, max_size=6)


def jog(legs):
    machine = Operated().to_speed()
    assert machine.order(Order.OVERRIDE, 0.0) == ""
    machine.until(lambda: machine.demand.master_velocity == 0.0)
    machine.angles = [machine.now]
    for rpm, seconds in legs:
        assert machine.order(Order.JOG, rpm) == ""
        machine.go(seconds)
    assert machine.order(Order.JOG, 0.0) == ""
    machine.go(1.5)
    assert machine.demand.master_velocity == 0.0
    machine.assert_limits_were_kept()
    # The slave, too, is no faster than the cam at the fastest of the jogs.
    fastest = max(abs(rpm) for rpm, _ in legs) * math.tau / 60.0
    steps = np.abs(np.diff(np.array(machine.angles), axis=0)).max(axis=0) / PERIOD_S
    steepest = np.abs(machine.profile.at_many(np.linspace(0.0, math.tau, 4001))[:, 1]).max()
    assert steps[0] <= fastest * (1 + ROUNDING) + ROUNDING
    assert steps[1] <= steepest * fastest * 1.001 + ROUNDING
    assert machine.order(Order.OVERRIDE, 100.0) == ""
    return np.array(machine.angles)


@settings(deadline=None, derandomize=True, max_examples=8)
@given(jogs)
def test_jogs_either_way_keep_the_limits(legs):
    jog(legs)


@pytest.mark.slow
@settings(deadline=None, derandomize=True, max_examples=60)
@given(jogs)
def test_jogs_either_way_keep_the_limits_very_often(legs):
    jog(legs)


def test_a_jog_across_theta2_0_and_back_with_a_stop_in_between():
    theta2 = np.degrees(jog([(15.0, 2.0), (0.0, 1.0), (-15.0, 2.0), (0.0, 0.3), (-15.0, 4.0), (15.0, 1.0)])[:, 0])
    revolution = round(theta2[0] / 360.0) * 360.0
    assert (theta2 - revolution).min() < -30.0
    assert (theta2 - revolution).max() > 60.0


@settings(deadline=None, derandomize=True, max_examples=6)
@given(st.floats(-8.0, -0.01) | st.floats(0.01, 8.0), st.floats(5.0, 100.0))
def test_a_shift_of_any_size_keeps_the_limits(shift, percent):
    machine = Operated().to_speed()
    machine.order(Order.OVERRIDE, percent)
    for degrees in (shift, 0.0):
        refusal = machine.order(Order.PHASE_SHIFT, degrees)
        assert refusal == "" or refusal.startswith("shifted to ")
        machine.until(lambda: not machine.law.is_shifting)
    assert machine.law.is_plain
    machine.assert_limits_were_kept()


@settings(deadline=None, derandomize=True, max_examples=8)
@given(st.floats(-6.0, 6.0).filter(lambda shift: abs(shift) > 0.1), st.floats(0.0, 1.5), st.booleans())
def test_a_stop_while_the_phase_is_shifted_brings_both_axes_to_rest_within_their_limits(shift, after, is_waiting):
    machine = Operated().to_speed()
    if is_waiting:
        machine.order(Order.OVERRIDE, 0.0)
        machine.until(lambda: machine.demand.master_velocity == 0.0)
    assert machine.order(Order.PHASE_SHIFT, shift) == ""
    machine.go(after)
    machine.demand.controlled_stop()
    machine.until(lambda: machine.demand.is_finished, 3.0)
    assert not machine.law.is_shifting
    machine.go(0.01)
    machine.assert_limits_were_kept()
    assert np.ptp(np.array(machine.angles[-8:]), axis=0) == pytest.approx(0.0, abs=1e-12)
    assert 0.0 <= machine.law.shift / math.radians(shift) <= 1.0 + 1e-9


def test_a_shift_of_a_machine_that_waits_is_shown_and_guarded_as_motion():
    machine = Operated().to_speed()
    machine.order(Order.OVERRIDE, 0.0)
    machine.until(lambda: machine.demand.phase is Phase.STANDSTILL)
    assert machine.order(Order.PHASE_SHIFT, 3.0) == ""
    machine.go(0.25)
    assert machine.demand.phase is Phase.RAMP_UP
    before, after = machine.angles[-2][1], machine.angles[-1][1]
    assert machine.demand.velocities[1] == pytest.approx((after - before) / PERIOD_S, rel=0.02)
    assert machine.demand.velocities[0] == 0.0
    machine.until(lambda: not machine.law.is_shifting)
    machine.go(0.01)
    assert machine.demand.phase is Phase.STANDSTILL
    assert machine.law.shift == pytest.approx(math.radians(3.0))


def test_where_no_window_does_the_best_one_says_why():
    """With its slave parked the master may go faster than the cam allows; there is no way back until it is slower."""
    machine = Operated().to_speed()
    assert machine.order(Order.DISENGAGE, 100.0) == ""
    machine.until(lambda: not math.isfinite(machine.law._window[0]))
    assert machine.order(Order.OVERRIDE, 200.0) == ""
    machine.go(1.5)
    sentence = machine.order(Order.ENGAGE, 100.0)
    assert sentence.startswith("returning to the cam at 100 deg within any window, ")
    assert " deg being the best, at 120 rpm: axis servo's " in sentence
    assert machine.order(Order.OVERRIDE, 100.0) == ""
    machine.go(1.5)
    assert machine.order(Order.ENGAGE, 100.0) == ""
    machine.go(2.0)
    assert machine.law.is_plain
    machine.assert_limits_were_kept()
