"""Uncoupled axes against closed forms."""

from math import exp

import pytest

from sim_drive.physics.driveline import SERVO_PERIOD_S, AxisDriveline
from sim_drive.physics.free_axis import FreeAxisParameters, FreeAxisPlant

NO_LAG = AxisDriveline(torque_time_constant_s=0.0)


def run(plant: FreeAxisPlant, torque: float, periods: int, brake: bool = False) -> None:
    for _ in range(periods):
        plant.advance((torque,), (brake,))


def test_viscous_axis_follows_its_closed_form() -> None:
    inertia, viscous, torque = 0.002, 0.01, 0.3
    plant = FreeAxisPlant([FreeAxisParameters(inertia, viscous_N_m_s=viscous, driveline=NO_LAG)], [0.5])
    run(plant, torque, 256)
    t = 256 * SERVO_PERIOD_S
    final = torque / viscous
    decay = exp(-viscous / inertia * t)
    assert plant.velocity(0) == pytest.approx(final * (1.0 - decay), rel=1e-10)
    assert plant.angle(0) == pytest.approx(0.5 + final * (t - inertia / viscous * (1.0 - decay)), rel=1e-10)


def test_coulomb_friction_holds_below_and_lets_go_above() -> None:
    axis = FreeAxisParameters(0.001, coulomb_N_m=0.05, driveline=NO_LAG)
    plant = FreeAxisPlant([axis], [0.0])
    run(plant, 0.0499, 2048)
    assert (plant.angle(0), plant.velocity(0)) == (0.0, 0.0)
    run(plant, 0.0501, 1024)
    # 0.1 mN m of surplus on 0.001 kg m2 for one second.
    assert plant.velocity(0) == pytest.approx(0.1, rel=1e-6)
    assert plant.angle(0) == pytest.approx(0.05, rel=1e-6)


def test_coulomb_friction_stops_an_axis_where_it_should() -> None:
    plant = FreeAxisPlant([FreeAxisParameters(0.001, coulomb_N_m=0.05, driveline=NO_LAG)], [0.0])
    run(plant, 0.55, 128)
    speed, angle = plant.velocity(0), plant.angle(0)
    assert speed == pytest.approx(0.5 / 0.001 * 0.125)
    # It slides for v J / F = 1.25 s over v^2 J / 2 F.
    run(plant, 0.0, 1300)
    assert plant.velocity(0) == 0.0
    assert plant.angle(0) - angle == pytest.approx(speed * speed * 0.001 / 0.1, rel=1e-4)
    resting = plant.angle(0)
    run(plant, 0.0, 512)
    assert plant.angle(0) == resting


def test_brake_holds_a_hanging_load_and_a_free_axis_falls() -> None:
    axis = FreeAxisParameters(0.01, load_torque_Nm=1.5, driveline=NO_LAG)
    plant = FreeAxisPlant([axis], [1.0])
    run(plant, 0.0, 1024, brake=True)
    assert plant.angle(0) == 1.0
    run(plant, 0.0, 128)
    assert plant.velocity(0) == pytest.approx(-150.0 * 0.125)


def test_a_brake_that_is_too_weak_slips() -> None:
    weak = AxisDriveline(torque_time_constant_s=0.0, brake_torque_Nm=1.0)
    plant = FreeAxisPlant([FreeAxisParameters(0.01, load_torque_Nm=1.5, driveline=weak)], [0.0])
    run(plant, 0.0, 128, brake=True)
    assert plant.velocity(0) == pytest.approx(-50.0 * 0.125)


def test_axes_do_not_disturb_each_other() -> None:
    axes = [FreeAxisParameters(0.001), FreeAxisParameters(0.002), FreeAxisParameters(0.003)]
    plant = FreeAxisPlant(axes, [0.0, 1.0, 2.0])
    assert plant.axis_count == 3
    for _ in range(100):
        plant.advance((0.0, 0.1, 0.0), (False, False, False))
    assert (plant.angle(0), plant.angle(2)) == (0.0, 2.0)
    assert plant.angle(1) > 1.0
    assert plant.energy() == pytest.approx(0.001 * plant.velocity(1) ** 2)
    assert plant.torn_at_s is None


def test_end_stop() -> None:
    stop = AxisDriveline(torque_time_constant_s=0.0, end_stop_maximum_rad=0.1)
    plant = FreeAxisPlant([FreeAxisParameters(0.001, driveline=stop)], [0.0])
    run(plant, 0.5, 200)
    assert (plant.angle(0), plant.velocity(0)) == (0.1, 0.0)
    run(plant, -0.5, 20)
    assert plant.angle(0) < 0.1


def test_parameters_are_checked() -> None:
    with pytest.raises(ValueError, match="inertia_kg_m2"):
        FreeAxisParameters(0.0)
    with pytest.raises(ValueError, match="coulomb_N_m"):
        FreeAxisParameters(1.0, coulomb_N_m=-0.1)
    with pytest.raises(ValueError, match="2 initial angles for 1 axes"):
        FreeAxisPlant([FreeAxisParameters(1.0)], [0.0, 0.0])
