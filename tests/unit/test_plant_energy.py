"""Energies of the plants: the balance closes with every option on, and each term agrees with a closed form."""

from dataclasses import replace
from math import exp, tanh

import numpy as np
import pytest
from driven_machine import PERIODS_IN_CYCLE, compiled, drive_on_the_cam, frictionless, paper_dynamics

from mechanism.dynamics import DynamicsParameters
from sim_drive.physics.driveline import SERVO_PERIOD_S, AxisDriveline, MotorParameters
from sim_drive.physics.free_axis import FreeAxisParameters, FreeAxisPlant
from sim_drive.physics.plant import CoupledPlant, PlantParameters

RIGID = paper_dynamics()
FRICTIONLESS = frictionless()


def imbalance(plant: CoupledPlant, cycles: int) -> float:
    """What the energies leave unexplained after so many machine cycles on the cam, as a share of the work done."""
    start = plant.energy()
    drive_on_the_cam(plant, cycles * PERIODS_IN_CYCLE)
    assert plant.torn_at_s is None
    axes = [plant.axis_energy(axis) for axis in range(plant.axis_count)]
    throughput = sum(abs(axis.shaft) for axis in axes)
    heat = sum(axis.viscous_heat + axis.dry_heat + axis.coupling_heat for axis in axes)
    assert abs(plant.angle(0) - 2.0 * 3.14159 * cycles) < 0.2
    return (sum(axis.shaft for axis in axes) - heat - (plant.energy() - start)) / throughput


def coupled(
    dynamics: DynamicsParameters = RIGID, driveline: AxisDriveline | None = None, substeps: int = 4
) -> CoupledPlant:
    axis = driveline if driveline is not None else AxisDriveline()
    return CoupledPlant(PlantParameters(dynamics, compiled().closure, (axis, axis), substeps=substeps), 0.0, 0.0)


@pytest.mark.parametrize(
    ("dynamics", "driveline", "bound"),
    [
        (FRICTIONLESS, AxisDriveline(), 1e-8),
        (replace(FRICTIONLESS, viscous_N_m_s=(0.02, 0.01)), AxisDriveline(), 1e-8),
        (replace(FRICTIONLESS, gravity_m_s2=(0.0, 0.0)), AxisDriveline(), 1e-8),
        (RIGID, AxisDriveline(friction_smoothing_rad_per_s=0.5), 1e-8),
        (RIGID, AxisDriveline(), 5e-5),
        (RIGID, AxisDriveline(breakaway_N_m=0.12), 5e-5),
        (FRICTIONLESS, AxisDriveline(motor=MotorParameters(resistance_ohm=4.0, supply_voltage_V=7.0)), 1e-8),
        (RIGID, AxisDriveline(torque_limit_Nm=0.9, torque_time_constant_s=0.0), 5e-5),
    ],
    ids=["frictionless", "viscous", "no gravity", "smoothed", "stick-slip", "breakaway", "voltage", "limit"],
)
def test_the_balance_of_the_coupled_machine_closes(
    dynamics: DynamicsParameters, driveline: AxisDriveline, bound: float
) -> None:
    rest = imbalance(coupled(dynamics, driveline), 3)
    print(f"energy left unexplained: {rest:.1e} of the work done")
    assert abs(rest) < bound


def test_a_machine_that_its_brakes_hold_does_and_loses_nothing() -> None:
    plant = coupled(driveline=AxisDriveline(brake_torque_Nm=6.0))
    start = plant.energy()
    for _ in range(512):
        plant.advance((0.9, -0.7), (True, True))
    assert plant.state[:4] == (0.0, 0.0, 0.0, 0.0)
    assert plant.energy() == start
    for axis in (0, 1):
        energy = plant.axis_energy(axis)
        # Torques that move nothing do no work; what remains is third order in the step.
        assert abs(energy.shaft) < 1e-6
        assert abs(energy.dry_heat) < 1e-6
        assert energy.copper > 1.0


@pytest.mark.slow
def test_a_hundred_frictionless_machine_cycles_keep_the_energy() -> None:
    plant = coupled(FRICTIONLESS)
    start, greatest, worst = plant.energy(), 0.0, 0.0
    for cycle in range(100):
        drive_on_the_cam(plant, PERIODS_IN_CYCLE, cycle * PERIODS_IN_CYCLE)
        work = plant.axis_energy(0).shaft + plant.axis_energy(1).shaft
        greatest = max(greatest, abs(plant.energy() - start))
        worst = max(worst, abs(plant.energy() - start - work))
    print(f"energy left unexplained: {worst:.1e} J, and {greatest:.3f} J in the motion")
    assert plant.torn_at_s is None
    assert worst < 1e-6 * greatest


@pytest.mark.slow
def test_a_frictionless_machine_left_alone_swings_for_a_hundred_seconds_with_its_energy() -> None:
    plant = coupled(FRICTIONLESS)
    # Both cranks hang near -1.62 and -1.36 rad.
    hanging = plant_energy_at(plant, (-1.623, -1.361))
    plant.set_motion((-1.1, -1.0), (0.0, 0.0))
    start = plant.energy()
    swing = start - hanging
    lowest, highest, travel = start, start, 0.0
    for _ in range(100 * PERIODS_IN_CYCLE):
        plant.advance((0.0, 0.0), (False, False))
        lowest, highest = min(lowest, plant.energy()), max(highest, plant.energy())
        travel = max(travel, abs(plant.angle(0) + 1.1))
    print(f"energy wanders by {highest - lowest:.1e} J of the {swing:.3f} J that swing")
    assert plant.torn_at_s is None
    assert travel > 0.8
    assert swing > 0.05
    assert highest - lowest < 1e-6 * swing


def plant_energy_at(plant: CoupledPlant, theta: tuple[float, float]) -> float:
    plant.set_motion(theta, (0.0, 0.0))
    return plant.energy()


# -- single terms, in closed form --------------------------------------------------------------------------------------


def free_axis(
    inertia: float = 0.002, viscous: float = 0.0, coulomb: float = 0.0, load: float = 0.0, **driveline: object
) -> FreeAxisPlant:
    line = AxisDriveline(torque_time_constant_s=0.0, **driveline)  # type: ignore[arg-type]
    return FreeAxisPlant([FreeAxisParameters(inertia, viscous, coulomb, load, line)], [0.0])


def advance(plant: FreeAxisPlant, torque: float, periods: int, brake: bool = False) -> None:
    for _ in range(periods):
        plant.advance((torque,), (brake,))


def test_copper_and_idle_draw_of_a_motor_that_holds_a_load() -> None:
    motor = MotorParameters(torque_constant_Nm_per_A=0.5, resistance_ohm=2.0, idle_W=7.0)
    plant = free_axis(load=0.3, motor=motor)
    advance(plant, 0.3, 1024)
    energy = plant.axis_energy(0)
    # 0.6 A through 2 ohm for a second: 0.72 J; nothing moves.
    assert energy.copper == pytest.approx(0.72, rel=1e-12)
    assert energy.drawn == pytest.approx(0.72 + 7.0, rel=1e-12)
    assert (energy.shaft, energy.dry_heat, plant.angle(0)) == (0.0, 0.0, 0.0)


def test_lag_of_the_current_loop_enters_the_copper_loss() -> None:
    motor = MotorParameters(torque_constant_Nm_per_A=0.5, resistance_ohm=2.0)
    line = AxisDriveline(torque_time_constant_s=0.002, motor=motor)
    plant = FreeAxisPlant([FreeAxisParameters(1e9, driveline=line)], [0.0])
    advance(plant, 0.25, 8)
    t, tau = 8 * SERVO_PERIOD_S, 0.002
    # i = 0.5 (1 - exp(-t/tau)): R times the integral of its square.
    square = t - 2.0 * tau * (1.0 - exp(-t / tau)) + 0.5 * tau * (1.0 - exp(-2.0 * t / tau))
    assert plant.axis_energy(0).copper == pytest.approx(2.0 * 0.25 * square, rel=1e-6)


def test_supply_voltage_sets_the_no_load_speed_and_the_stall_torque() -> None:
    motor = MotorParameters(torque_constant_Nm_per_A=0.5, resistance_ohm=2.0, supply_voltage_V=10.0)
    plant = free_axis(motor=motor)
    advance(plant, 4.0, 1)
    # Stall torque 0.5 x 10 / 2 = 2.5 N m, though 4 are asked for; the speed goes to 10 / 0.5 = 20 rad/s with the time
    # constant J R / k^2 = 16 ms.
    assert plant.torque(0) == pytest.approx(2.5 * exp(-0.75 * SERVO_PERIOD_S / 0.016), rel=1e-3)
    advance(plant, 4.0, 1023)
    assert plant.velocity(0) == pytest.approx(20.0, rel=1e-9)
    advance(plant, -4.0, 1024)
    assert plant.velocity(0) == pytest.approx(-20.0, rel=1e-9)


@pytest.mark.parametrize("regeneration", [0.0, 0.6, 1.0])
def test_what_braking_gives_back(regeneration: float) -> None:
    motor = MotorParameters(torque_constant_Nm_per_A=0.5, resistance_ohm=0.02, regeneration=regeneration)
    plant = free_axis(motor=motor)
    advance(plant, 0.2, 512)
    drawn = plant.axis_energy(0).drawn
    advance(plant, -0.2, 512)
    # To 50 rad/s and back: 2.5 J of motion, 0.0032 W of copper loss. Braking power passes zero 16 ms of 0.5 s from
    # standstill at most, where the copper loss is more than it.
    assert plant.velocity(0) == pytest.approx(0.0, abs=1e-9)
    assert drawn == pytest.approx(2.5 + 0.5 * 0.0032, rel=1e-9)
    assert plant.axis_energy(0).drawn - drawn == pytest.approx(-regeneration * (2.5 - 0.5 * 0.0032), rel=1e-5, abs=1e-5)


def test_dry_friction_heats_with_its_torque_times_the_way() -> None:
    plant = free_axis(inertia=0.001, coulomb=0.05)
    advance(plant, 0.55, 128)
    # 0.5 N m of surplus: 62.5 rad/s after 0.125 s, over 3.90625 rad.
    energy = plant.axis_energy(0)
    assert energy.shaft == pytest.approx(0.55 * 3.90625, rel=1e-12)
    assert energy.dry_heat == pytest.approx(0.05 * 3.90625, rel=1e-12)
    advance(plant, 0.0, 2000)
    assert plant.axis_energy(0).dry_heat == pytest.approx(energy.shaft, rel=1e-9)
    assert plant.energy() == 0.0


def test_an_end_stop_takes_all_that_is_left() -> None:
    plant = free_axis(inertia=0.001, end_stop_maximum_rad=0.5)
    advance(plant, 0.1, 512)
    assert (plant.angle(0), plant.velocity(0)) == (0.5, 0.0)
    energy = plant.axis_energy(0)
    assert energy.shaft == pytest.approx(0.1 * 0.5, rel=1e-3)
    assert energy.dry_heat == pytest.approx(energy.shaft, rel=1e-3)


def test_an_axis_breaks_away_later_than_it_slides_on() -> None:
    plant = free_axis(inertia=0.001, coulomb=0.05, breakaway_N_m=0.08)
    advance(plant, 0.0799, 1024)
    assert (plant.angle(0), plant.velocity(0)) == (0.0, 0.0)
    advance(plant, 0.0801, 1024)
    # 0.0301 N m of surplus on 0.001 kg m2 once it moves.
    assert plant.velocity(0) == pytest.approx(30.1, rel=1e-3)


def test_smoothed_friction_creeps_where_the_other_sticks() -> None:
    plant = free_axis(inertia=0.001, coulomb=0.05, friction_smoothing_rad_per_s=0.5)
    advance(plant, 0.03, 2048)
    # It settles where 0.05 tanh(v / 0.5) = 0.03.
    velocity = plant.velocity(0)
    assert velocity == pytest.approx(0.5 * np.arctanh(0.6), rel=1e-9)
    assert 0.05 * tanh(velocity / 0.5) == pytest.approx(0.03, rel=1e-9)
    assert plant.axis_energy(0).dry_heat == 0.0


def test_smoothed_friction_leaves_the_brake_as_it_is() -> None:
    plant = free_axis(inertia=0.001, coulomb=0.05, load=1.5, friction_smoothing_rad_per_s=0.5)
    advance(plant, 0.0, 512, brake=True)
    assert plant.angle(0) == 0.0


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"torque_constant_Nm_per_A": 0.0}, "torque_constant_Nm_per_A"),
        ({"resistance_ohm": -1.0}, "resistance_ohm"),
        ({"supply_voltage_V": 0.0}, "supply_voltage_V"),
        ({"regeneration": 1.1}, "regeneration"),
        ({"idle_W": float("nan")}, "idle_W"),
    ],
)
def test_motors_are_checked(wrong: dict[str, float], named: str) -> None:
    with pytest.raises(ValueError, match=named):
        MotorParameters(**wrong)
