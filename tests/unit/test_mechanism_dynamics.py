"""Dynamics by hand-worked special cases, and the paper's machine over its cam."""

from dataclasses import replace
from math import radians, tau
from pathlib import Path

import numpy as np
import pytest

from mechanism.cam_profile import CamProfile
from mechanism.closure import track_closure
from mechanism.curve import load_curve_csv
from mechanism.dynamics import (
    PARAMETER_COUNT,
    STANDARD_GRAVITY,
    Dynamics,
    DynamicsParameters,
    LinkParameters,
    acceleration,
    energy,
    friction_torque,
    inverse_dynamics_along,
    joint_positions,
    linkage_sine,
    mass_matrix_and_bias,
)
from mechanism.errors import ParameterError
from mechanism.five_bar import Closure, FiveBar

PATH = Path(__file__).parents[2] / "config" / "desired_path.csv"
PAPER = FiveBar(0.15, 0.25, 0.3, 0.15, (0.0, 0.0), (0.25, 0.0))
NOTHING = LinkParameters(0.0, 0.0, 0.0, 0.0)
# Steel crank 150 x 40 x 10 mm with 125 g at A; q, r, s aluminium 15 x 4 mm; 12 g at C and at D.
MACHINE = DynamicsParameters(
    PAPER,
    p=LinkParameters(0.596, 0.09072986577181207, 0.0, 0.001501582508389262),
    q=LinkParameters(0.0405, 0.125, 0.0, 0.000211696875),
    r=LinkParameters(0.0486, 0.15, 0.0, 0.00036541125),
    s=LinkParameters(0.0363, 0.09979338842975206, 0.0, 9.120407541322314e-05),
    end_effector_mass_kg=0.012,
    rotor_inertia_kg_m2=(1.2e-4, 1.2e-4),
    gravity_m_s2=STANDARD_GRAVITY,
    viscous_N_m_s=(0.005, 0.005),
    coulomb_N_m=(0.04, 0.05),
)


def only(**changes: object) -> DynamicsParameters:
    values: dict[str, object] = {
        "p": NOTHING,
        "q": NOTHING,
        "r": NOTHING,
        "s": NOTHING,
        "end_effector_mass_kg": 0.0,
        "rotor_inertia_kg_m2": (1e-3, 2e-3),
        "gravity_m_s2": (0.0, 0.0),
    }
    values.update(changes)
    return DynamicsParameters(PAPER, **values)  # pyright: ignore[reportArgumentType]


def test_parameter_array_has_the_length_it_says() -> None:
    assert MACHINE.to_array().shape == (PARAMETER_COUNT,)


def test_massless_links_leave_the_rotors() -> None:
    assert mass_matrix_and_bias(only().to_array(), 1.0, 0.5, 3.0, -4.0, 1) == (1e-3, 0.0, 2e-3, 0.0, 0.0)


def test_crank_is_a_pendulum() -> None:
    # 2 kg at (0.1, 0.02) of link p, level: inertia 0.01 + 2 (0.01 + 0.0004) = 0.0308 + rotor; weight 2 g x 0.1 N m.
    params = only(p=LinkParameters(2.0, 0.1, 0.02, 0.01), gravity_m_s2=(0.0, -10.0)).to_array()
    m11, m12, m22, h1, h2 = mass_matrix_and_bias(params, 0.0, 0.5, 3.0, -4.0, 1)
    assert (m11, m12, m22) == pytest.approx((0.0318, 0.0, 2e-3), abs=1e-15)
    assert (h1, h2) == pytest.approx((2.0, 0.0), abs=1e-15)
    # Upright, the mass that sits 0.02 to the left of the link pulls on counter-clockwise.
    assert mass_matrix_and_bias(params, radians(90.0), 0.5, 0.0, 0.0, 1)[3] == pytest.approx(-0.4, abs=1e-14)


def test_servo_link_is_a_pendulum() -> None:
    params = only(s=LinkParameters(1.0, 0.1, -0.05, 0.0), gravity_m_s2=(10.0, 0.0)).to_array()
    _, _, m22, h1, h2 = mass_matrix_and_bias(params, 0.3, 0.0, 1.0, 1.0, 1)
    assert m22 == pytest.approx(2e-3 + 0.0125, abs=1e-15)
    # Weight along +x at (0.1, -0.05): torque about the pivot x fy - y fx = 0.5, which the motor has to hold back.
    assert (h1, h2) == pytest.approx((0.0, -0.5), abs=1e-15)


def test_end_effector_mass_has_the_jacobian_s_inertia() -> None:
    params = only(end_effector_mass_kg=2.0).to_array()
    jacobian = PAPER.jacobian(0.4, 0.9, Closure.LEFT)
    m11, m12, m22, _, _ = mass_matrix_and_bias(params, 0.4, 0.9, 0.0, 0.0, 1)
    expected = 2.0 * jacobian.T @ jacobian
    assert (m11 - 1e-3, m12, m22 - 2e-3) == pytest.approx((expected[0, 0], expected[0, 1], expected[1, 1]), rel=1e-12)


def test_acceleration_undoes_the_inverse_dynamics() -> None:
    params = MACHINE.to_array()
    dynamics = Dynamics(MACHINE, Closure.LEFT)
    torque = np.array(dynamics.torque((0.7, 0.4), (6.0, -12.0), (-30.0, 250.0)))
    torque -= friction_torque(params, 6.0, -12.0, 0.0)
    assert acceleration(params, 0.7, 0.4, 6.0, -12.0, torque[0], torque[1], 1) == pytest.approx((-30.0, 250.0))


def test_friction_is_viscous_and_smoothed_coulomb() -> None:
    params = MACHINE.to_array()
    assert friction_torque(params, 10.0, -20.0, 0.0) == pytest.approx((0.05, -0.1))
    assert friction_torque(params, 10.0, -20.0, 0.01) == pytest.approx((0.09, -0.15))
    assert friction_torque(params, 0.0, 0.0, 0.01) == (0.0, 0.0)


def test_potential_energy_is_the_height_of_the_masses() -> None:
    params = only(end_effector_mass_kg=2.0, gravity_m_s2=(0.0, -10.0)).to_array()
    kinetic, potential = energy(params, 0.0, 0.0, 2.0, 0.0, 1)
    assert potential == pytest.approx(2.0 * 10.0 * 0.24)
    jacobian = PAPER.jacobian(0.0, 0.0, Closure.LEFT)
    assert kinetic == pytest.approx(0.5 * 4.0 * (1e-3 + 2.0 * float(jacobian[:, 0] @ jacobian[:, 0])))


def test_joint_positions_and_sine_at_the_reference_position() -> None:
    params = MACHINE.to_array()
    assert joint_positions(params, 0.0, 0.0, 1) == pytest.approx((0.15, 0.0, 0.22, 0.24, 0.4, 0.0), abs=1e-15)
    assert linkage_sine(params, 0.0, 0.0, 1) == pytest.approx(-0.8)
    apart = only().to_array()
    apart[6] = 5.0
    assert np.isnan(linkage_sine(apart, 0.0, 0.0, 1))


def test_paper_machine_over_the_cam_at_60_rpm() -> None:
    """paper.md: servo about -0.79 / +0.53 N m with physical bars; CV of the order of Table I's -0.57 / +0.61 N m."""
    track = track_closure(load_curve_csv(PATH), PAPER)
    profile = CamProfile.through(track.theta2, track.theta5)
    theta2 = np.arange(3600) * (tau / 3600)
    motion = profile.at_many(theta2)
    theta = np.column_stack((theta2, motion[:, 0]))
    omega = np.column_stack((np.full(3600, tau), motion[:, 1] * tau))
    alpha = np.column_stack((np.zeros(3600), motion[:, 2] * tau**2))
    torque = np.empty((3600, 2))
    frictionless = replace(MACHINE, viscous_N_m_s=(0.0, 0.0))
    inverse_dynamics_along(frictionless.to_array(), theta, omega, alpha, 1, 0.0, torque)
    assert torque.min(axis=0) == pytest.approx([-0.6254, -0.79], abs=0.005)
    assert torque.max(axis=0) == pytest.approx([0.5616, 0.53], abs=0.005)
    # Over a closed cycle without friction the two motors do no work on the whole, though each does some.
    power = torque * omega
    assert abs(power.sum()) < 1e-6 * np.abs(power).sum()
    inverse_dynamics_along(MACHINE.to_array(), theta, omega, alpha, 1, 0.0, torque)
    # Work of the two motors over a closed cycle is what viscous friction eats: 0.005 w^2 on each axis.
    power = torque * omega
    eaten = 0.005 * omega**2
    assert power.sum() == pytest.approx(eaten.sum(), rel=1e-6)


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"rotor_inertia_kg_m2": (0.0, 1e-3)}, "rotor_inertia_kg_m2"),
        ({"end_effector_mass_kg": -1.0}, "end_effector_mass_kg"),
        ({"viscous_N_m_s": (0.0, -1.0)}, "viscous_N_m_s"),
        ({"gravity_m_s2": (0.0, float("nan"))}, "gravity_m_s2"),
    ],
)
def test_impossible_parameters_are_refused(change: dict[str, object], name: str) -> None:
    with pytest.raises(ParameterError, match=name):
        only(**change)


def test_a_negative_mass_is_refused() -> None:
    with pytest.raises(ParameterError, match="mass_kg"):
        LinkParameters(-1.0, 0.0, 0.0, 0.0)
