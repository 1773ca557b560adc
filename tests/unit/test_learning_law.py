"""The law of learning by hand: what one revolution adds, without phase shift, within its bounds, and when it does."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from config.conversion import nominal_parameters
from config.loading import load_config
from gateway.cyclic.torque_offsets import TorqueOffsets
from gateway.learning import kernels as kernels
from gateway.learning.law import LearnedTorque, Learning, LearningSettings, masses_along
from gateway.running.preparation import compile_config
from gateway.units import AxisUnits
from mechanism.dynamics import mass_matrix_and_bias
from mechanism.slave_law import SlaveLaw

SPEED = math.tau
CYCLE_S = 0.001
BINS = 128
CLEAR = slice(24, BINS)
"""Bins away from the one at which learning began: there a window spans what is learned and what is not yet."""


def make_settings(**changes):
    values = {
        "gain": 0.5,
        "proportional_Nm_per_rad": (40.0, 20.0),
        "integrating_Nm_per_rad_s": (0.0, 0.0),
        "derivative_Nms_per_rad": (0.6, 0.2),
        "bound_Nm": (0.5, 0.25),
        "window_s": 0.03,
        "settle_cycles": 50,
        "bins": BINS,
    }
    return LearningSettings(**(values | changes))


def make(learned=None, masses=(0.0, 0.0, 0.0), **changes):
    settings = make_settings(**changes)
    return Learning(settings, np.tile(np.array(masses)[:, np.newaxis], settings.bins), learned)


class Turning:
    """Shows a `Learning` errors that are functions of theta2, at constant speed, a cycle at a time."""

    def __init__(self, learning, master_error, slave_error, speed=SPEED):
        self.learning, self.errors, self.speed = learning, (master_error, slave_error), speed
        self.position = 0.0

    def cycle(self, is_valid=True):
        master, slave = (error(self.position) for error in self.errors)
        self.learning.observe(self.position, self.speed, is_valid, master, slave)
        self.position += self.speed * CYCLE_S

    def turn(self, revolutions, **options):
        for _ in range(round(revolutions * math.tau / self.speed / CYCLE_S)):
            self.cycle(**options)
        return self

    def learn(self, revolutions):
        """Go on until every bin has been learned so often since the beginning."""
        while self.learning.revolutions < revolutions:
            self.cycle()
        return self


def table(learning, bins=BINS):
    """The correction where the bins have their middle, (bins, 2)."""
    middles = (np.arange(bins) + 0.5) * math.tau / bins
    return np.array([learning.torques(theta2, SPEED) for theta2 in middles])


def test_a_constant_error_becomes_gain_times_its_torque_once_a_revolution():
    learning = make()
    turning = Turning(learning, lambda _: 0.002, lambda _: -0.003)
    turning.learn(1)
    # 0.5 * 40 N m/rad * 0.002 rad, and 0.5 * 20 * -0.003.
    assert table(learning)[CLEAR] == pytest.approx(np.tile([0.04, -0.03], (BINS - 24, 1)))
    turning.learn(2)
    assert table(learning)[CLEAR] == pytest.approx(np.tile([0.08, -0.06], (BINS - 24, 1)))


def test_the_integral_forgets_within_a_radian():
    learning = make(proportional_Nm_per_rad=(0.0, 0.0), integrating_Nm_per_rad_s=(100.0, 0.0))
    learning_twice = make(derivative_Nms_per_rad=(0.0, 0.0), integrating_Nm_per_rad_s=(0.0, 0.0))
    waves, size = 2, 0.002
    for one in (learning, learning_twice):
        Turning(one, lambda x: size * math.sin(waves * x), lambda _: 0.0).learn(1)
    # 1 / (s + omega) of size sin(2 theta2) with s = 2j omega: size / (5 omega) * (sin - 2 cos); the mean that is taken
    # off is that of a revolution, which lets through 1 / (1 + 1 / (4 pi j)) of it. The window leaves of 2 waves what it
    # leaves of them without an integral: 0.5 * 40 N m/rad * size.
    middles = (np.arange(BINS) + 0.5) * math.tau / BINS
    window = table(learning_twice)[CLEAR, 0].max() / (0.5 * 40.0 * size)
    through = 1.0 / (1.0 + 1.0 / (2j * waves * math.pi)) / (SPEED * (1.0 + 1j * waves))
    expected = 0.5 * 100.0 * size * window * np.imag(through * np.exp(1j * waves * middles))
    derivative = 0.5 * 0.6 * size * window * waves * SPEED * np.cos(waves * middles)
    # What has not settled within the first revolution is a few per cent.
    assert table(learning)[CLEAR, 0] == pytest.approx((expected + derivative)[CLEAR], abs=1.5e-3)
    assert np.abs(expected).max() > 0.006


def test_the_mean_is_left_to_a_controller_that_integrates():
    learning = make(integrating_Nm_per_rad_s=(100.0, 0.0))
    turning = Turning(learning, lambda _: 0.0005, lambda _: 0.0005)
    turning.learn(15)
    before = table(learning)
    turning.learn(20)
    grown = table(learning) - before
    # One axis integrates, and its correction does not drift; the other one's grows by gain, P and error every time.
    assert np.abs(grown[:, 0]).max() < 0.001
    assert grown[:, 1] == pytest.approx(np.full(BINS, 5 * 0.5 * 20.0 * 0.0005), rel=0.02)


def test_an_error_that_swings_is_learned_without_phase_shift():
    learning = make(masses=(0.02, 0.003, 0.01))
    waves = 3
    Turning(learning, lambda x: 0.001 * math.sin(waves * x), lambda x: 0.001 * math.cos(waves * x)).learn(1)
    # The window is 0.03 s either way: 0.03 * 128 bins/s = 3.84, so 4 bins; what it leaves of 3 waves in 128 bins:
    weights = [1 + math.cos(math.pi * h / 5) for h in range(-4, 5)]
    left = sum(w * math.cos(math.tau * waves * h / BINS) for h, w in zip(range(-4, 5), weights, strict=True))
    left /= sum(weights)
    rate = waves * SPEED
    middles = (np.arange(BINS) + 0.5) * math.tau / BINS
    sine, cosine = np.sin(waves * middles), np.cos(waves * middles)
    torque = np.stack([40 * sine + 0.6 * rate * cosine, 20 * cosine - 0.2 * rate * sine], axis=1)
    torque -= rate**2 * np.stack([0.02 * sine + 0.003 * cosine, 0.003 * sine + 0.01 * cosine], axis=1)
    expected = 0.5 * 0.001 * left * torque
    assert table(learning)[CLEAR] == pytest.approx(expected[CLEAR], abs=3e-4)
    assert np.abs(expected).max() > 0.01


def test_noise_of_one_revolution_is_forgotten_by_the_low_pass():
    learning = make(derivative_Nms_per_rad=(0.0, 0.0))
    # An error that changes sign from bin to bin is gone; 4 + 1 + 4 weights of a raised cosine leave next to nothing.
    Turning(learning, lambda x: 0.005 * (-1) ** int(x * BINS / math.tau), lambda _: 0.0).learn(1)
    assert np.abs(table(learning)[:, 0]).max() < 0.003


def test_a_correction_never_leaves_its_bounds():
    learning = make()
    Turning(learning, lambda _: 0.02, lambda _: -0.02).turn(4.0)
    assert table(learning) == pytest.approx(np.tile([0.5, -0.25], (BINS, 1)))


@pytest.mark.parametrize("what", ["speed", "validity", "gap"])
def test_nothing_is_learned_while_the_master_is_not_steady(what):
    learning = make()
    turning = Turning(learning, lambda _: 0.002, lambda _: 0.002)
    turning.turn(1.15)
    before = table(learning)
    assert before.any()
    for cycle in range(3000):
        if what == "speed":
            turning.speed *= 1.0 + 0.002 * (-1) ** cycle
            turning.cycle()
        elif what == "validity":
            # One bad sample in 50 is enough: the window never fills.
            turning.cycle(is_valid=cycle % 50 > 0)
        else:
            turning.position += math.pi / 2
            turning.cycle()
    assert np.array_equal(table(learning), before)


def test_what_follows_a_disturbance_is_learned_again():
    learning = make()
    turning = Turning(learning, lambda _: 0.002, lambda _: 0.002).turn(1.15)
    turning.turn(0.01, is_valid=False)
    before = table(learning)
    turning.turn(1.2)
    assert np.all(table(learning) > before)


def test_no_cycle_has_more_to_do_than_another():
    learning = make(bins=256)
    turning = Turning(learning, lambda _: 0.002, lambda _: 0.002, speed=2 * math.tau)
    turning.turn(1.0)
    most = 0.0
    for _ in range(1000):
        before = learning.revolutions
        turning.cycle()
        most = max(most, learning.revolutions - before)
    # 500 cycles a revolution for 256 bins: one bin a cycle, never two.
    assert most * 256 == pytest.approx(1.0)


def test_at_another_speed_it_begins_with_the_square_of_the_ratio():
    learning = make(bound_Nm=(9.0, 9.0))
    Turning(learning, lambda _: 0.002, lambda _: 0.002).learn(1)
    at_speed = learning.torques(1.0, SPEED)
    assert at_speed == pytest.approx((0.04, 0.02))
    # On a ramp it goes with the square, and upwards it waits until the speed is there.
    assert learning.torques(1.0, 0.5 * SPEED) == pytest.approx((0.01, 0.005))
    assert learning.torques(1.0, 0.0) == (0.0, 0.0)
    assert learning.torques(1.0, 2.0 * SPEED) == at_speed
    Turning(learning, lambda _: 0.0, lambda _: 0.0, speed=1.5 * SPEED).turn(0.2)
    assert learning.torques(1.0, 1.5 * SPEED) == pytest.approx((0.09, 0.045))
    assert learning.learned is not None
    assert learning.learned.speed == pytest.approx(1.5 * SPEED)


def test_what_was_learned_before_is_gone_on_with():
    first = make()
    assert first.learned is None
    Turning(first, lambda _: 0.002, lambda x: 0.001 * math.sin(x)).learn(2)
    second = make(first.learned)
    assert np.array_equal(table(second), table(first))
    # Without errors it stays; the low pass only rounds it off.
    Turning(second, lambda _: 0.0, lambda _: 0.0).learn(3)
    assert table(second)[CLEAR] == pytest.approx(table(first)[CLEAR], abs=1e-3)


def test_another_number_of_bins_and_smaller_bounds_are_met():
    middles = (np.arange(64) + 0.5) * math.tau / 64
    known = LearnedTorque(SPEED, np.stack([0.4 * np.sin(middles), np.full(64, 0.3)]))
    learning = make(known, bound_Nm=(0.3, 0.2))
    middles = (np.arange(BINS) + 0.5) * math.tau / BINS
    expected = np.stack([np.clip(0.4 * np.sin(middles), -0.3, 0.3), np.full(BINS, 0.2)], axis=1)
    assert table(learning) == pytest.approx(expected, abs=1e-3)


def test_the_observer_shows_counts_as_angles():
    learning = make()
    offsets = TorqueOffsets((AxisUnits(4096, 0.0, 1.5), AxisUnits(1024, 0.0, 1.5)), (9.0, 9.0), 0.0, None, learning)
    assert offsets.is_learning
    position = 0.0
    for _ in range(1150):
        offsets.observe(position, SPEED, (2, -1), True)
        position += SPEED * CYCLE_S
    expected = (0.5 * 40.0 * 2 * math.tau / 4096, -0.5 * 20.0 * math.tau / 1024)
    assert learning.torques(1.0, SPEED) == pytest.approx(expected)
    plain = SlaveLaw(compile_config(load_config("paper")).profile)
    assert offsets.at(1.0, SPEED, 0.0, plain) == [round(torque * 1000 / 1.5) for torque in expected]
    assert np.array_equal(offsets.learned.torque, learning.learned.torque)


@hypothesis_settings(max_examples=30)
@given(st.lists(st.tuples(st.floats(-7, 7), st.floats(-1, 60), st.floats(-1, 1), st.booleans()), max_size=300))
def test_whatever_is_shown_the_correction_is_a_number_within_its_bounds(shown):
    learning = make(settle_cycles=0, window_s=0.01)
    for position, speed, error, is_valid in shown:
        learning.observe(position, speed, is_valid, error, -error)
        master, slave = learning.torques(position, speed)
        assert abs(master) <= 0.5
        assert abs(slave) <= 0.25


def test_windows_are_bounded_and_weigh_as_they_should():
    for window_s, half in ((1e-4, 1), (0.01, 1), (0.03, 4), (10.0, BINS // 4)):
        learning = make(window_s=window_s)
        taps, state = np.zeros((3, 2 * kernels.MAXIMUM_HALF_WINDOW + 1)), np.zeros(kernels.STATES)
        kernels._set_window(taps, state, learning._settings, BINS, SPEED)
        assert state[kernels.HALF] == half + 1
        # In seconds from the middle, one bin every 1/128 s.
        t = (np.arange(2 * half + 3) - half - 1) / BINS
        low_pass, rate, acceleration = taps[:, : 2 * half + 3]
        assert low_pass @ np.ones_like(t) == pytest.approx(1.0)
        assert [rate @ np.ones_like(t), rate @ t] == pytest.approx([0.0, 1.0], abs=1e-9)
        assert [acceleration @ np.ones_like(t), acceleration @ t] == pytest.approx([0.0, 0.0], abs=1e-9)
        assert acceleration @ t**2 == pytest.approx(2.0)


def test_masses_must_fit_the_bins():
    with pytest.raises(ValueError, match="for 128 bins"):
        Learning(make_settings(), np.zeros((3, 64)))


def test_masses_along_the_cam_are_those_of_the_model():
    config = load_config("paper")
    profile = compile_config(config).profile
    masses = masses_along(config, profile, 8)
    parameters = nominal_parameters(config).to_array()
    theta2 = 2.5 * math.tau / 8
    closure = int(compile_config(config).closure)
    expected = mass_matrix_and_bias(parameters, theta2, profile.at(theta2)[0], 0.0, 0.0, closure)[:3]
    assert masses[:, 2].tolist() == list(expected)
