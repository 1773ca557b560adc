"""Flexible couplings and play against closed forms, the rigid machine, and the balance of energy."""

from dataclasses import replace
from math import cos, inf, pi, sqrt

import numpy as np
import pytest
from driven_machine import OFF, PERIODS_IN_CYCLE, compiled, drive_on_the_cam, frictionless, paper_dynamics

from mechanism.dynamics import DynamicsParameters, inverse_dynamics, mass_matrix_and_bias
from sim_drive.physics.compliant import CompliantPlant
from sim_drive.physics.coupling import Coupling, coupling_torques
from sim_drive.physics.driveline import SERVO_PERIOD_S, AxisDriveline
from sim_drive.physics.five_bar_motion import METERED_SIZE
from sim_drive.physics.plant import CoupledPlant, PlantParameters

ON = (True, True)


def compliant(
    cv: Coupling | None,
    servo: Coupling | None,
    dynamics: DynamicsParameters | None = None,
    substeps: int = 4,
    smoothing: float = 0.0,
) -> CompliantPlant:
    axis = AxisDriveline(brake_torque_Nm=20.0, friction_smoothing_rad_per_s=smoothing)
    parameters = PlantParameters(dynamics or paper_dynamics(), compiled().closure, (axis, axis), substeps=substeps)
    return CompliantPlant(parameters, (cv, servo), 0.0, 0.0)


def test_torque_of_a_coupling_by_hand() -> None:
    couplings = np.array([[200.0, 0.5, 0.0, 1e-4], [200.0, 0.5, 0.01, 1e-4]])
    # Without play: 200 x 0.03 + 0.5 x 2, and it pulls, too.
    assert coupling_torques(couplings, 0, 0.03, 2.0) == pytest.approx((7.0, 6.0))
    assert coupling_torques(couplings, 0, 0.001, -2.0) == pytest.approx((-0.8, 0.2))
    # With 0.01 to either side: nothing within, the rest beyond, and never a pull.
    assert coupling_torques(couplings, 1, 0.009, 50.0) == (0.0, 0.0)
    assert coupling_torques(couplings, 1, 0.03, 2.0) == pytest.approx((5.0, 4.0))
    assert coupling_torques(couplings, 1, 0.011, -2.0) == pytest.approx((0.0, 0.2))
    assert coupling_torques(couplings, 1, -0.03, -2.0) == pytest.approx((-5.0, -4.0))
    assert coupling_torques(couplings, 1, -0.011, 2.0) == pytest.approx((0.0, -0.2))


def test_without_couplings_it_is_the_rigid_machine() -> None:
    soft = compliant(None, None)
    rigid = CoupledPlant(PlantParameters(paper_dynamics(), compiled().closure), 0.0, 0.0)
    for plant in (soft, rigid):
        drive_on_the_cam(plant, PERIODS_IN_CYCLE)
    assert soft.state == pytest.approx(rigid.state, rel=1e-9, abs=1e-9)
    for axis in (0, 1):
        assert soft.axis_energy(axis) == pytest.approx(rigid.axis_energy(axis), rel=1e-9)
    assert soft.energy() == pytest.approx(rigid.energy(), rel=1e-9)


def test_stiffer_couplings_come_nearer_to_the_rigid_machine() -> None:
    rigid = CoupledPlant(PlantParameters(paper_dynamics(), compiled().closure, substeps=16), 0.0, 0.0)
    drive_on_the_cam(rigid, 600)
    away: list[float] = []
    for stiffness in (300.0, 3000.0):
        coupling = Coupling(stiffness, 0.02, link_side_inertia_kg_m2=1e-9)
        plant = compliant(coupling, coupling, substeps=16)
        drive_on_the_cam(plant, 600)
        away.append(abs(plant.link_angle(0) - rigid.angle(0)) + abs(plant.link_angle(1) - rigid.angle(1)))
    assert away[1] < 0.2 * away[0] < 0.01


def test_a_link_swings_on_its_coupling_at_the_frequency_of_its_inertia() -> None:
    coupling = Coupling(60.0)
    dynamics = replace(frictionless(), gravity_m_s2=(0.0, 0.0))
    plant = compliant(None, coupling, dynamics)
    # Brakes on: the crank stands, and the servo's link swings alone on a motor that stands. It is let go 1 mrad away.
    plant._state[METERED_SIZE + 1] = 0.001
    assert plant.link_angle(1) == 0.001
    array = replace(dynamics, rotor_inertia_kg_m2=(0.00012, coupling.link_side_inertia_kg_m2)).to_array()
    inertia = mass_matrix_and_bias(array, 0.0, 0.0, 0.0, 0.0, int(compiled().closure))[2]
    rate = sqrt(60.0 / inertia)
    for period in range(1, 200):
        plant.advance((0.0, 0.0), ON)
        assert plant.link_angle(1) == pytest.approx(0.001 * cos(rate * period * SERVO_PERIOD_S), abs=4e-5)
    assert plant.state[:4] == (0.0, 0.0, 0.0, 0.0)


def test_the_crank_sags_by_half_the_play_and_what_its_weight_twists() -> None:
    coupling = Coupling(250.0, 0.15, backlash_rad=0.02)
    plant = compliant(coupling, None)
    for _ in range(2048):
        plant.advance((0.0, 0.0), ON)
    angle = plant.link_angle(0)
    assert plant.angle(0) == 0.0
    closure = int(compiled().closure)
    weight, _ = inverse_dynamics(paper_dynamics().to_array(), angle, 0.0, 0.0, 0.0, 0.0, 0.0, closure, 0.0)
    assert weight > 0.3
    assert angle == pytest.approx(-0.01 - weight / 250.0, rel=1e-4)


def test_play_lets_the_motor_turn_before_the_link_does() -> None:
    dynamics = replace(frictionless(), gravity_m_s2=(0.0, 0.0))
    plant = compliant(None, Coupling(500.0, 0.01, backlash_rad=0.2), dynamics)
    # 0.012 N m on 0.00012 kg m2 alone: 100 rad/s2, 0.1 rad after 44.7 ms or 45.8 periods (1 ms of lag adds one).
    moved = 0
    while plant.link_angle(1) == 0.0 and moved < 100:
        plant.advance((0.0, 0.012), (True, False))
        moved += 1
    assert moved == 47
    assert plant.angle(1) == pytest.approx(0.1, abs=0.01)


@pytest.mark.parametrize(
    ("cv", "servo", "smoothing", "is_frictionless", "bound"),
    [
        (Coupling(1000.0, 0.02), None, 0.5, False, 1e-6),
        (Coupling(1000.0, 0.02), Coupling(1000.0, 0.02), 0.0, False, 2e-5),
        (Coupling(1000.0, 0.02, 0.01), Coupling(1000.0, 0.02, 0.01), 0.0, False, 2e-5),
        (None, Coupling(800.0, 0.05), 0.0, True, 1e-7),
        (Coupling(800.0, 0.05, 0.005), None, 0.0, True, 2e-5),
    ],
    ids=["smoothed friction", "flexible", "play", "one axis, frictionless", "play of the crank"],
)
def test_the_balance_of_energy_closes(
    cv: Coupling | None, servo: Coupling | None, smoothing: float, is_frictionless: bool, bound: float
) -> None:
    plant = compliant(cv, servo, frictionless() if is_frictionless else None, 16, smoothing)
    start = plant.energy()
    drive_on_the_cam(plant, 2 * PERIODS_IN_CYCLE, stiffness=5.0, damping=0.05)
    assert plant.torn_at_s is None
    axes = [plant.axis_energy(axis) for axis in (0, 1)]
    heat = sum(axis.viscous_heat + axis.dry_heat + axis.coupling_heat for axis in axes)
    rest = sum(axis.shaft for axis in axes) - heat - (plant.energy() - start)
    print(f"energy left unexplained: {rest / sum(abs(axis.shaft) for axis in axes):.1e} of the work done")
    assert abs(rest) < bound * sum(abs(axis.shaft) for axis in axes)
    for axis, coupling in zip(axes, (cv, servo), strict=True):
        assert (axis.coupling_heat > 0.0) == (coupling is not None)


def test_a_singular_position_tears_it_as_well() -> None:
    plant = compliant(Coupling(300.0, 0.02), Coupling(300.0, 0.02))
    plant.set_motion((0.0, 0.0), (60.0, -60.0))
    for _ in range(512):
        plant.advance((0.0, 0.0), OFF)
        assert all(abs(value) < inf for value in plant.state)
    assert plant.torn_at_s is not None
    standing = plant.state
    plant.advance((4.0, 4.0), OFF)
    assert plant.state == standing
    assert standing[2:] == (0.0,) * 6


def test_couplings_are_checked() -> None:
    with pytest.raises(ValueError, match="stiffness_N_m_per_rad"):
        Coupling(0.0)
    with pytest.raises(ValueError, match="backlash_rad"):
        Coupling(1.0, backlash_rad=-1.0)
    parameters = PlantParameters(paper_dynamics(), compiled().closure)
    with pytest.raises(ValueError, match=r"cannot stand at theta2 = 3\.14"):
        CompliantPlant(parameters, (Coupling(1.0), None), pi, 0.0)
