"""The linear axes against a pendulum worked out by hand, the equations of motion, and scipy."""

import math
from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
import scipy.signal

from config.conversion import dynamics_parameters
from config.loading import load_config
from mechanism.dynamics import LinkParameters, acceleration, inverse_dynamics
from mechanism.errors import ParameterError
from mechanism.linear_model import LinearAxes, frequency_response, linearise, sample, state_matrices

PAPER = dynamics_parameters(load_config("paper"))
NOTHING = LinkParameters(0.0, 0.0, 0.0, 0.0)
PENDULUM = replace(
    PAPER, p=LinkParameters(0.5, 0.2, 0.0, 0.003), q=NOTHING, r=NOTHING, s=NOTHING, end_effector_mass_kg=0.0
)
STILL = np.zeros((1, 2))
OPEN = 1


def test_a_link_alone_is_a_pendulum():
    theta = np.array([[math.radians(60.0), math.radians(40.0)]])
    linear = linearise(PENDULUM.to_array(), theta, STILL, STILL, OPEN)
    # Torque m g l cos(theta) holds it, so d(torque)/d(theta) = -m g l sin(theta).
    assert linear.stiffness[0, 0, 0] == pytest.approx(-0.5 * 9.80665 * 0.2 * math.sin(math.radians(60.0)), rel=1e-6)
    assert linear.mass[0] == pytest.approx(np.diag([0.00012 + 0.003 + 0.5 * 0.2**2, 0.00012]))
    assert linear.damping[0] == pytest.approx(np.diag([0.005, 0.005]), abs=1e-9)
    assert abs(linear.stiffness[0, 0, 1]) < 1e-8


def test_small_deviations_from_a_motion_accelerate_as_the_equations_of_motion_say():
    theta, omega, alpha = np.array([[2.1, 0.9]]), np.array([[6.0, -9.0]]), np.array([[3.0, 120.0]])
    linear = linearise(PAPER.to_array(), theta, omega, alpha, OPEN)
    params = replace(PAPER, viscous_N_m_s=(0.0, 0.0)).to_array()
    dx, dv = np.array([2e-5, -1e-5]), np.array([3e-4, 2e-4])

    def accelerations(x, v, friction):
        m = linear_torque - friction * (v - omega[0])
        return np.array(acceleration(params, *x, *v, *m, OPEN))

    linear_torque = np.array(inverse_dynamics(params, *theta[0], *omega[0], *alpha[0], OPEN, 0.0))
    actual = accelerations(theta[0] + dx, omega[0] + dv, 0.005) - alpha[0]
    predicted = -np.linalg.solve(linear.mass[0], linear.damping[0] @ dv + linear.stiffness[0] @ dx)
    # M itself changes with theta; that part is in the stiffness, so that both agree to first order.
    assert actual == pytest.approx(predicted, rel=2e-3)


def test_sampling_without_delay_is_scipys_zero_order_hold():
    a, b = state_matrices(linearise(PAPER.to_array(), np.array([[2.1, 0.9]]), STILL, STILL, OPEN), (0.001, 0.002))
    ours = sample(a, b, 1.0 / 1024.0)
    theirs = scipy.signal.cont2discrete((a[0], b[0], np.eye(6), np.zeros((6, 2))), 1.0 / 1024.0)
    assert ours.transition[0] == pytest.approx(theirs[0], rel=1e-10, abs=1e-12)
    assert ours.recent[0] == pytest.approx(theirs[1], rel=1e-10, abs=1e-12)
    assert not ours.older.any()


@pytest.mark.parametrize("delay_s", [0.0003, 0.001, 0.0025])
def test_a_delayed_command_acts_when_it_says(delay_s):
    period_s = 0.001
    a, b = state_matrices(
        LinearAxes(np.array([[[0.004, 0.001], [0.001, 0.002]]]), 0.1 * np.eye(2)[None], np.zeros((1, 2, 2))),
        (0.001, 0.0005),
    )
    sampled = sample(a, b, period_s, delay_s)
    generator = np.random.default_rng(5)
    commands = generator.normal(size=(12, 2))
    # By the sampled equation, and by exact steps of a tenth of a period with the command that is due in each.
    x, lag = np.zeros(6), sampled.delay_periods
    for k in range(len(commands)):
        recent = commands[k - lag] if k >= lag else np.zeros(2)
        older = commands[k - lag - 1] if k >= lag + 1 else np.zeros(2)
        x = sampled.transition[0] @ x + sampled.recent[0] @ recent + sampled.older[0] @ older
    joined = scipy.linalg.expm(np.block([[a[0], b[0]], [np.zeros((2, 8))]]) * period_s / 10)
    y = np.zeros(6)
    for step in range(10 * len(commands)):
        due = math.floor((step - 10 * delay_s / period_s) / 10 + 1e-9)
        y = joined[:6, :6] @ y + joined[:6, 6:] @ (commands[due] if due >= 0 else np.zeros(2))
    assert x == pytest.approx(y, rel=1e-9, abs=1e-12)


def test_the_frequency_response_of_an_inertia_is_that_of_a_held_double_integrator():
    inertia, period_s = 0.004, 1.0 / 1024.0
    linear = LinearAxes(inertia * np.eye(2)[None], np.zeros((1, 2, 2)), np.zeros((1, 2, 2)))
    a, b = state_matrices(linear, (1e-6, 1e-6))
    hz = np.array([3.0, 40.0, 300.0])
    response = frequency_response(sample(a, b, period_s), hz)[0]
    z = np.exp(2j * np.pi * hz * period_s)
    assert response[:, 0, 0] == pytest.approx(period_s**2 * (z + 1) / (2 * inertia * (z - 1) ** 2), rel=0.005)
    assert np.abs(response[:, 0, 1]).max() == 0.0


def test_what_cannot_be_linearised_is_refused():
    with pytest.raises(ParameterError, match="singular"):
        linearise(PAPER.to_array(), np.array([[math.pi, 0.0]]), STILL, STILL, OPEN)
    with pytest.raises(ParameterError, match="torque_time_constant_s"):
        state_matrices(LinearAxes(np.eye(2)[None], np.eye(2)[None], np.eye(2)[None]), (0.001, 0.0))
