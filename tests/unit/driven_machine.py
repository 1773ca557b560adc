"""The reference machine under a plain controller of its own, for tests of the plant alone."""

from dataclasses import replace
from functools import cache

from config.conversion import dynamics_parameters
from config.loading import load_config
from gateway.running.preparation import compile_config
from mechanism.cam import CompiledCam
from mechanism.dynamics import DynamicsParameters
from sim_drive.physics.driveline import SERVO_PERIOD_S
from sim_drive.physics.plant import Plant

PERIODS_IN_CYCLE = 1024
OFF = (False, False)


@cache
def compiled() -> CompiledCam:
    return compile_config(load_config("paper"))


@cache
def paper_dynamics() -> DynamicsParameters:
    return dynamics_parameters(load_config("paper"))


def frictionless() -> DynamicsParameters:
    return replace(paper_dynamics(), viscous_N_m_s=(0.0, 0.0), coulomb_N_m=(0.0, 0.0))


def drive_on_the_cam(plant: Plant, periods: int, first: int = 0, stiffness: float = 8.0, damping: float = 0.12) -> None:
    """60 rpm on the cam from period ``first`` on: a proportional controller of angle and velocity on both axes."""
    profile = compiled().cam.profile
    speed = 2.0 * 3.141592653589793
    for period in range(first, first + periods):
        theta2 = speed * period * SERVO_PERIOD_S
        theta5, slope, _, _ = profile.at(theta2)
        wanted = ((theta2, speed), (theta5, slope * speed))
        plant.advance(
            [
                stiffness * (angle - plant.angle(axis)) + damping * (velocity - plant.velocity(axis))
                for axis, (angle, velocity) in enumerate(wanted)
            ],
            OFF,
        )
