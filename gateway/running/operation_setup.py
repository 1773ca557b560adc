"""From a configuration to what an operator's orders are measured by: the slave's law, its limits, the orders' own."""

import math
from typing import Final

from config.conversion import closure_at_home, nominal_parameters, torque_offset_limit
from config.schema import GatewayConfig
from gateway.cyclic.operation import OperationLimits
from mechanism.cam_profile import CamProfile
from mechanism.law_proof import LawLimits, Pace
from mechanism.slave_law import SlaveLaw

JOG_SHARE: Final = 4.0
"""A jog is at most so many times slower than the run."""
PASS_US: Final = 1000
"""Of a cycle's time, for each pass of a proof: some 65 us."""
PERMILLE: Final = 1000.0


def slave_law(config: GatewayConfig, profile: CamProfile) -> SlaveLaw:
    """Where the slave is for every angle of the master: on the cam, until somebody shifts it or takes it off."""
    return SlaveLaw(profile, law_limits(config), config.speed_rad_per_s)


def law_limits(config: GatewayConfig) -> LawLimits:
    """What orders in motion must keep; torques (by the model of the machine) are those that the guard lets pass, and,
    where they are fed forward, that may be sent.
    """
    master, slave = (axis.limits for axis in config.ordered_axes)
    names = config.axis_names
    torques = [config.guard.torque.limit_permille / PERMILLE * axis.rated_torque_Nm for axis in config.ordered_axes]
    if config.feed_forward.enabled:
        torques = [min(torque, torque_offset_limit(config, name)) for torque, name in zip(torques, names, strict=True)]
    return LawLimits(
        axis_names=(names[0], names[1]),
        dynamics=nominal_parameters(config).to_array(),
        closure=int(closure_at_home(config)),
        coulomb_velocity=config.feed_forward.coulomb_velocity_rad_per_s,
        minimum_sine=config.machine.minimum_transmission_sine,
        master_velocity=master.velocity_rad_per_s,
        velocity=slave.velocity_rad_per_s,
        acceleration=slave.acceleration_rad_per_s2,
        jerk=math.inf if slave.jerk_rad_per_s3 is None else slave.jerk_rad_per_s3,
        torques=(torques[0], torques[1]),
        ramp_acceleration=config.motion.ramp_acceleration_rad_per_s2,
        ramp_jerk=config.motion.ramp_jerk_rad_per_s3,
    )


def operation_limits(config: GatewayConfig) -> OperationLimits:
    """What an operator's orders are measured by."""
    motion = config.motion
    return OperationLimits(
        config.speed_rad_per_s,
        config.speed_rad_per_s / JOG_SHARE,
        Pace(0.0, motion.approach_speed_rad_per_s, motion.ramp_acceleration_rad_per_s2, motion.ramp_jerk_rad_per_s3),
        math.radians(motion.engagement_window_deg or 0.0),
        max(config.bus.cycle_us // PASS_US, 1),
    )
