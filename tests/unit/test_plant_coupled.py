"""The coupled plant against energy, another integrator, and what friction and brakes must do."""

from dataclasses import replace
from itertools import pairwise
from math import exp, inf, isfinite

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from mechanism.dynamics import STANDARD_GRAVITY, DynamicsParameters, LinkParameters, acceleration
from mechanism.five_bar import Closure, FiveBar
from sim_drive.physics.driveline import SERVO_PERIOD_S, AxisDriveline
from sim_drive.physics.plant import CoupledPlant, PlantParameters

OFF = (False, False)
ON = (True, True)


def dynamics(viscous: float = 0.0, coulomb: tuple[float, float] = (0.0, 0.0)) -> DynamicsParameters:
    return DynamicsParameters(
        five_bar=FiveBar(0.15, 0.25, 0.3, 0.15, (0.0, 0.0), (0.25, 0.0)),
        p=LinkParameters(0.596, 0.0907, 0.0, 0.0015),
        q=LinkParameters(0.0405, 0.125, 0.0, 0.00021),
        r=LinkParameters(0.0486, 0.15, 0.0, 0.00036),
        s=LinkParameters(0.0363, 0.0998, 0.0, 0.000091),
        end_effector_mass_kg=0.012,
        rotor_inertia_kg_m2=(0.00012, 0.00012),
        gravity_m_s2=STANDARD_GRAVITY,
        viscous_N_m_s=(viscous, viscous),
        coulomb_N_m=coulomb,
    )


def plant_of(
    parameters: DynamicsParameters,
    theta: tuple[float, float] = (0.0, 0.0),
    driveline: AxisDriveline | None = None,
    substeps: int = 4,
) -> CoupledPlant:
    axis = driveline if driveline is not None else AxisDriveline()
    return CoupledPlant(PlantParameters(parameters, Closure.LEFT, (axis, axis), substeps=substeps), *theta)


def reference(
    parameters: DynamicsParameters,
    start: tuple[float, float, float, float],
    command: tuple[float, float],
    time_constant: float,
    duration_s: float,
    coulomb: tuple[float, float] = (0.0, 0.0),
) -> NDArray[np.float64]:
    """DOP853 over the mechanism's own acceleration; Coulomb friction with the sign of the velocity at the start."""
    params = parameters.to_array()
    signs = (np.sign(start[2]), np.sign(start[3]))

    def slope(t: float, y: NDArray[np.float64]) -> list[float]:
        torque = [
            c * (1.0 - exp(-t / time_constant)) - b * y[2 + i] - f * signs[i]
            for i, (c, b, f) in enumerate(zip(command, parameters.viscous_N_m_s, coulomb, strict=True))
        ]
        return [y[2], y[3], *acceleration(params, y[0], y[1], y[2], y[3], torque[0], torque[1], 1)]

    solution = solve_ivp(slope, (0.0, duration_s), start, method="DOP853", rtol=1e-12, atol=1e-13)
    return solution.y[:, -1]


def test_energy_is_kept_without_friction() -> None:
    plant = plant_of(dynamics())
    plant.set_motion((-1.2, 0.2), (1.0, 0.5))
    start = plant.energy()
    low, high, travel = inf, -inf, 0.0
    for _ in range(400):
        plant.advance((0.0, 0.0), OFF)
        low, high = min(low, plant.energy()), max(high, plant.energy())
        travel = max(travel, abs(plant.angle(1) - 0.2))
    assert plant.torn_at_s is None
    assert travel > 0.1
    assert high - low < 1e-9
    assert abs(plant.energy() - start) < 1e-9


def test_smooth_motion_agrees_with_another_integrator_to_fourth_order() -> None:
    parameters = dynamics(viscous=0.005)
    start = (0.3, 0.4, 5.0, -3.0)
    expected = reference(parameters, start, (0.8, -0.1), 0.001, 64 * SERVO_PERIOD_S)
    errors: list[float] = []
    for substeps in (2, 4, 8):
        plant = plant_of(parameters, substeps=substeps)
        plant.set_motion(start[:2], start[2:])
        for _ in range(64):
            plant.advance((0.8, -0.1), OFF)
        errors.append(float(np.max(np.abs(np.array(plant.state[:4]) - expected))))
    assert errors[1] < 2e-7
    for coarse, fine in pairwise(errors):
        assert 12.0 < coarse / fine < 20.0


def test_sliding_friction_converges_to_the_continuous_law() -> None:
    coulomb = (0.04, 0.05)
    parameters = dynamics(viscous=0.005, coulomb=coulomb)
    start = (0.3, 0.4, 5.0, 4.0)
    expected = reference(parameters, start, (0.6, 0.35), 0.001, 64 * SERVO_PERIOD_S, coulomb)
    errors: list[float] = []
    for substeps in (1, 2, 4, 8):
        plant = plant_of(parameters, substeps=substeps)
        plant.set_motion(start[:2], start[2:])
        for _ in range(64):
            plant.advance((0.6, 0.35), OFF)
        assert min(plant.state[2:4]) > 0.0
        difference = np.abs(np.array(plant.state[:4]) - expected)
        errors.append(float(np.max(difference)))
        assert np.max(difference[:2]) < 8e-5 / substeps
    assert errors[2] < 5e-4
    for coarse, fine in pairwise(errors):
        assert fine < 0.65 * coarse


def test_brakes_hold_the_machine_under_gravity_without_creeping() -> None:
    plant = plant_of(dynamics(coulomb=(0.04, 0.05)))
    for _ in range(3072):
        plant.advance((0.0, 0.0), ON)
    assert plant.state[:6] == (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def test_a_stuck_axis_does_not_creep_as_its_load_varies() -> None:
    plant = plant_of(dynamics(coulomb=(0.04, 0.05)))
    for period in range(2048):
        torque = 0.4 if period % 3 else -0.9
        plant.advance((torque, -torque), ON)
        assert plant.state[:4] == (0.0, 0.0, 0.0, 0.0)
    assert plant.torque(0) != 0.0


def test_the_crank_falls_when_its_brake_is_released() -> None:
    plant = plant_of(dynamics(coulomb=(0.04, 0.05)))
    for _ in range(30):
        plant.advance((0.0, 0.0), (False, True))
    # About 0.62 N m of gravity less 0.04 N m of friction on 0.0084 kg m2 for 29.3 ms: some -0.03 rad.
    assert plant.angle(0) == pytest.approx(-0.5 * (0.62 - 0.04) / 0.0084 * (30 * SERVO_PERIOD_S) ** 2, rel=0.03)
    assert plant.state[1] == 0.0
    assert plant.state[3] == 0.0


def test_moving_axes_come_to_rest_and_stay() -> None:
    plant = plant_of(dynamics(viscous=0.005, coulomb=(0.04, 0.05)))
    plant.set_motion((0.5, 0.5), (6.0, -4.0))
    for _ in range(512):
        plant.advance((0.0, 0.0), ON)
    resting = plant.state[:4]
    assert resting[2:] == (0.0, 0.0)
    assert resting[0] > 0.5
    assert resting[1] < 0.5
    for _ in range(512):
        plant.advance((0.0, 0.0), ON)
    assert plant.state[:4] == resting


def test_amplifier_lag_is_exact_and_limited() -> None:
    plant = plant_of(dynamics(), driveline=AxisDriveline(torque_limit_Nm=2.0, torque_time_constant_s=0.002))
    plant.advance((1.0, -7.0), ON)
    rise = 1.0 - exp(-SERVO_PERIOD_S / 0.002)
    assert plant.torque(0) == pytest.approx(rise, rel=1e-14)
    assert plant.torque(1) == pytest.approx(-2.0 * rise, rel=1e-14)


def test_amplifier_without_lag() -> None:
    plant = plant_of(dynamics(), driveline=AxisDriveline(torque_time_constant_s=0.0))
    plant.advance((0.25, -0.5), OFF)
    assert (plant.torque(0), plant.torque(1)) == (0.25, -0.5)


def test_end_stop_holds_an_axis_that_runs_into_it() -> None:
    stop = AxisDriveline(end_stop_minimum_rad=-0.2)
    axes = (AxisDriveline(), stop)
    plant = CoupledPlant(PlantParameters(dynamics(), Closure.LEFT, axes), 0.0, 0.0)
    for _ in range(300):
        plant.advance((0.0, -0.8), (True, False))
        assert plant.angle(1) >= -0.2
    assert (plant.angle(1), plant.velocity(1)) == (-0.2, 0.0)
    for _ in range(100):
        plant.advance((0.0, 0.8), (True, False))
    assert plant.angle(1) > -0.1


def test_extrapolation_meets_the_next_period() -> None:
    plant = plant_of(dynamics(viscous=0.005))
    plant.set_motion((0.3, 0.4), (5.0, -3.0))
    for _ in range(20):
        plant.advance((0.5, 0.2), OFF)
    predicted = [(plant.angle(axis, SERVO_PERIOD_S), plant.velocity(axis, SERVO_PERIOD_S)) for axis in (0, 1)]
    plant.advance((0.5, 0.2), OFF)
    for axis in (0, 1):
        # A hundredth of a count at 4096 counts a revolution is 1.5e-5 rad.
        assert plant.angle(axis) == pytest.approx(predicted[axis][0], abs=1e-5)
        assert plant.velocity(axis) == pytest.approx(predicted[axis][1], abs=0.02)


@pytest.mark.parametrize("omega", [(60.0, -60.0), (-60.0, 60.0), (0.0, -200.0), (400.0, 0.0)])
def test_a_singular_position_tears_the_linkage_and_gives_no_nan(omega: tuple[float, float]) -> None:
    plant = plant_of(dynamics())
    plant.set_motion((0.0, 0.0), omega)
    for _ in range(512):
        plant.advance((0.0, 0.0), OFF)
        assert all(isfinite(value) for value in plant.state)
    torn_at_s = plant.torn_at_s
    assert torn_at_s is not None
    assert 0.0 < torn_at_s < 0.5
    standing = plant.state
    assert standing[2:] == (0.0,) * 6
    assert abs(plant.linkage_sine()) >= plant.parameters.singular_sine
    plant.advance((4.0, 4.0), OFF)
    assert plant.state == standing
    assert plant.torn_at_s == torn_at_s


def test_a_torque_that_is_not_a_number_tears_rather_than_spreads() -> None:
    plant = plant_of(dynamics())
    plant.advance((float("nan"), 0.0), OFF)
    assert plant.torn_at_s is not None
    assert all(isfinite(value) for value in plant.state)


def test_a_linkage_that_cannot_stand_there_is_refused() -> None:
    with pytest.raises(ValueError, match=r"cannot stand at theta2 = 3\.14"):
        plant_of(dynamics(), (3.14159, 0.0))


def test_parameters_are_checked() -> None:
    with pytest.raises(ValueError, match="torque_limit_Nm"):
        AxisDriveline(torque_limit_Nm=-1.0)
    with pytest.raises(ValueError, match="end_stop_minimum_rad"):
        AxisDriveline(end_stop_minimum_rad=1.0, end_stop_maximum_rad=0.0)
    good = PlantParameters(dynamics(), Closure.LEFT)
    with pytest.raises(ValueError, match="singular_sine"):
        replace(good, singular_sine=1.0)
    with pytest.raises(ValueError, match="substeps"):
        replace(good, substeps=0)


def test_two_runs_are_the_same_to_the_last_bit() -> None:
    ends: list[tuple[float, ...]] = []
    for _ in range(2):
        plant = plant_of(dynamics(viscous=0.005, coulomb=(0.04, 0.05)))
        for period in range(500):
            plant.advance((0.6 + 0.1 * (period % 7), 0.1), OFF)
        ends.append(plant.state)
    assert ends[0] == ends[1]
