"""The emulated machine's options: what a configuration says reaches the plant, and impossible ones get a sentence."""

import math

import pytest

from config.emulation_section import DemandRounding
from config.loading import ConfigError, load_config, parse_config
from config.schema import SERVO_RATE_HZ, GatewayConfig
from mechanism.errors import ParameterError
from sim_drive.assembly import build_machine
from sim_drive.closed_loop import closed_loop_of
from sim_drive.physics import servo
from sim_drive.physics.compliant import CompliantPlant
from sim_drive.physics.plant import CoupledPlant

PAPER = load_config("paper")
BRAKE = "      brake_torque_Nm: 6.0\n"


def with_option(line: str, *, axis: int = 0) -> GatewayConfig:
    """The paper's machine with a line more in the emulation of an axis."""
    parts = PAPER.text.split(BRAKE)
    parts[axis] += f"      {line}\n"
    return parse_config(BRAKE.join(parts), PAPER.path)


def changed(old: str, new: str) -> GatewayConfig:
    assert old in PAPER.text
    return parse_config(PAPER.text.replace(old, new, 1), PAPER.path)


def test_both_rooms_have_the_same_servo_rate() -> None:
    assert servo.SERVO_RATE_HZ == SERVO_RATE_HZ


def test_the_paper_has_rigid_couplings_and_stick_slip() -> None:
    plant = build_machine(PAPER).plant
    assert isinstance(plant, CoupledPlant)
    for axis in plant.parameters.axes:
        assert axis.friction_smoothing_rad_per_s == 0.0
        assert axis.motor.supply_voltage_V == 160.0


def test_a_coupling_makes_the_plant_compliant() -> None:
    line = "coupling: {stiffness_Nm_per_rad: 600, damping_Nms_per_rad: 0.02, backlash_deg: 0.2}"
    plant = build_machine(with_option(line, axis=1)).plant
    assert isinstance(plant, CompliantPlant)
    none, coupling = plant.couplings
    assert none is None
    assert coupling is not None
    assert coupling.stiffness_N_m_per_rad == 600.0
    assert coupling.backlash_rad == pytest.approx(math.radians(0.2))


def test_further_options_reach_the_plant() -> None:
    machine = build_machine(with_option("friction_law: smoothed"))
    plant = machine.plant
    assert isinstance(plant, CoupledPlant)
    assert plant.parameters.axes[0].friction_smoothing_rad_per_s == 0.05
    plant = build_machine(with_option("breakaway_Nm: 0.09")).plant
    assert isinstance(plant, CoupledPlant)
    assert (plant.parameters.axes[0].breakaway_N_m, plant.parameters.axes[1].breakaway_N_m) == (0.09, 0.0)
    axis = build_machine(with_option("resolver_eccentricity_counts: 4\n      resolver_eccentricity_deg: 90")).axes[0]
    assert (axis.resolver_eccentricity_counts, axis.resolver_eccentricity_rad) == (4.0, pytest.approx(math.pi / 2))


def test_every_rounding_of_the_demand_has_its_resolution_in_the_controller() -> None:
    assert [rounding.name for rounding in DemandRounding] == [resolution.name for resolution in servo.DemandResolution]
    master, slave = build_machine(with_option("demand_rounding: counts")).axes
    assert master.demand_resolution is servo.DemandResolution.COUNTS
    assert slave.demand_resolution is servo.DemandResolution.UNROUNDED_DIFFERENCE


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        (
            "inertia_kgm2: 0.00012",
            "inertia_kgm2: -0.1",
            "axes.cv.emulation.inertia_kgm2: -0.1 should be greater than 0",
        ),
        ("mass_kg: 0.596", "mass_kg: -1", "machine.links.p.mass_kg: -1 should be greater than or equal to 0"),
        (
            "home_angle_deg: 0.0",
            "home_angle_deg: 180.0",
            "axes: at home_angle_deg 180 and 0 the linkage cannot stand, the sine of the angle between links q",
        ),
        (
            "viscous_Nms: 0.005",
            "viscous_Nms: 40",
            # 40 / (0.00012 + 0.0015016 + 0.596 x 0.0907299^2 = 0.0065278) a second, by 244 us: 1.4963.
            "axes.cv.emulation.viscous_Nms: 40 stops the axis too fast for steps of 244 us (bound 163 us)",
        ),
        (
            BRAKE,
            BRAKE + "      friction_law: smoothed\n      friction_smoothing_rad_per_s: 0.001\n",
            "axes.cv.emulation.friction_smoothing_rad_per_s: 0.001 stops the axis too fast",
        ),
        (
            BRAKE,
            BRAKE + "      coupling: {stiffness_Nm_per_rad: 5000}\n",
            # 5000 x (1/0.00012 + 1/(0.0064078 + 0.00002)) = 6516^2: 1037 Hz.
            (
                "stiffness_Nm_per_rad: 5000 makes the motor swing at 1037 Hz against its link too fast for steps of "
                "244 us (bound 107 us), emulator.sub_steps would have to be 3 times as many"
            ),
        ),
        (
            BRAKE,
            BRAKE + "      coupling: {stiffness_Nm_per_rad: 500, damping_Nms_per_rad: 0.6}\n",
            "axes.cv.emulation.coupling.damping_Nms_per_rad: 0.6 stops the motor against its link too fast",
        ),
        (
            BRAKE,
            BRAKE + "      coupling: {stiffness_Nm_per_rad: 500, play: 1}\n",
            "axes.cv.emulation.coupling.play: unknown key",
        ),
        (
            "motor: {torque_constant_Nm_per_A: 0.45, resistance_ohm: 1.5",
            "motor: {torque_constant_Nm_per_A: 0.45, resistance_ohm: 0",
            "axes.cv.emulation.motor.resistance_ohm: 0 should be greater than 0",
        ),
        (BRAKE, BRAKE + "      friction_law: sticky\n", "axes.cv.emulation.friction_law: 'sticky' should be"),
    ],
)
def test_impossible_machines_are_refused_with_a_sentence(old: str, new: str, sentence: str) -> None:
    with pytest.raises(ConfigError) as refused:
        changed(old, new)
    (problem,) = refused.value.problems
    assert sentence in problem


def test_the_fast_loop_refuses_what_it_does_not_have() -> None:
    config = with_option("coupling: {stiffness_Nm_per_rad: 500}")
    with pytest.raises(ParameterError, match=r"axes\.\*\.emulation\.coupling is given, but must be null where"):
        closed_loop_of(config)


def test_more_steps_make_a_stiff_coupling_possible() -> None:
    text = PAPER.text.replace(BRAKE, BRAKE + "      coupling: {stiffness_Nm_per_rad: 5000}\n", 1)
    config = parse_config(text.replace("sub_steps: 4", "sub_steps: 12"), PAPER.path)
    assert isinstance(build_machine(config).plant, CompliantPlant)
