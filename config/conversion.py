"""From what a configuration says, in its own units, to the values that ``mechanism`` computes with, in SI units."""

import math
from dataclasses import dataclass
from typing import Final

from config.schema import AxisSection, GatewayConfig, LinkSection
from config.torque_sections import NominalAxisSection, NominalLinkSection
from mechanism.curve import DesiredCurve, load_curve_csv
from mechanism.dynamics import DynamicsParameters, LinkParameters
from mechanism.five_bar import Closure, FiveBar

CONTROLLER_RATE_HZ: Final = 1024
"""Rate of the position controller of the paper's eq. (5)."""
TORQUE_SHARE_PER_GAIN: Final = 10.0 / 2048.0 / 256.0
"""Volts per count of a gain of 1 (the paper's eq. 6)."""


@dataclass(frozen=True, slots=True)
class ControllerGains:
    """Gains of a drive's position controller in SI units.

    ``proportional_Nm_per_rad`` for the error, ``integrating_Nm_per_rad_s`` for its integral, ``derivative_Nms_per_rad``
    for its rate; ``damping_Nms_per_rad`` for the actual velocity, taken off, ``velocity_Nms_per_rad`` for the demand's.
    """

    proportional_Nm_per_rad: float
    integrating_Nm_per_rad_s: float
    derivative_Nms_per_rad: float
    damping_Nms_per_rad: float
    velocity_Nms_per_rad: float


def five_bar(config: GatewayConfig) -> FiveBar:
    """The linkage."""
    section = config.machine.five_bar
    return FiveBar(
        p=section.p_mm / 1e3,
        q=section.q_mm / 1e3,
        r=section.r_mm / 1e3,
        s=section.s_mm / 1e3,
        cv_pivot=(section.cv_pivot_mm[0] / 1e3, section.cv_pivot_mm[1] / 1e3),
        servo_pivot=(section.servo_pivot_mm[0] / 1e3, section.servo_pivot_mm[1] / 1e3),
    )


def _link(section: LinkSection) -> LinkParameters:
    return LinkParameters(section.mass_kg, section.com_m, section.com_perp_m, section.inertia_com_kgm2)


def dynamics_parameters(config: GatewayConfig) -> DynamicsParameters:
    """Masses, inertias and friction of the coupled machine; pairs are (master, slave)."""
    links = config.machine.links
    master, slave = config.ordered_axes
    return DynamicsParameters(
        five_bar=five_bar(config),
        p=_link(links.p),
        q=_link(links.q),
        r=_link(links.r),
        s=_link(links.s),
        end_effector_mass_kg=config.machine.end_effector_mass_kg,
        rotor_inertia_kg_m2=(master.emulation.inertia_kgm2, slave.emulation.inertia_kgm2),
        gravity_m_s2=config.machine.gravity_m_s2,
        viscous_N_m_s=(master.emulation.viscous_Nms, slave.emulation.viscous_Nms),
        coulomb_N_m=(master.emulation.coulomb_Nm, slave.emulation.coulomb_Nm),
    )


def controller_gains(axis: AxisSection) -> ControllerGains:
    """The emulated drive's gains K_P, K_I, K_D, K_V and K_F (eq. 5 and 6 of the paper) as torques."""
    per_rad = axis.counts_per_revolution / math.tau * TORQUE_SHARE_PER_GAIN * axis.emulation.torque_per_volt_Nm
    per_rate = per_rad / CONTROLLER_RATE_HZ
    gains = axis.emulation.gains
    return ControllerGains(
        gains.K_P * per_rad,
        gains.K_I * per_rad * CONTROLLER_RATE_HZ,
        gains.K_D * per_rate,
        gains.K_V * per_rate,
        gains.K_F * per_rate,
    )


def nominal_parameters(config: GatewayConfig) -> DynamicsParameters:
    """The machine as the feed-forward's model has it; pairs are (master, slave)."""
    section, machine = config.feed_forward, config.machine
    links, own = section.links, machine.links
    mass, gravity = section.end_effector_mass_kg, section.gravity_m_s2
    master, slave = (_nominal_axis(config, name) for name in config.axis_names)
    return DynamicsParameters(
        five_bar=five_bar(config),
        p=_nominal_link(links.p, own.p),
        q=_nominal_link(links.q, own.q),
        r=_nominal_link(links.r, own.r),
        s=_nominal_link(links.s, own.s),
        end_effector_mass_kg=machine.end_effector_mass_kg if mass is None else mass,
        rotor_inertia_kg_m2=(master[0], slave[0]),
        gravity_m_s2=machine.gravity_m_s2 if gravity is None else gravity,
        viscous_N_m_s=(master[1], slave[1]),
        coulomb_N_m=(master[2], slave[2]),
    )


def _nominal_link(given: NominalLinkSection, own: LinkSection) -> LinkParameters:
    return LinkParameters(
        own.mass_kg if given.mass_kg is None else given.mass_kg,
        own.com_m if given.com_m is None else given.com_m,
        own.com_perp_m if given.com_perp_m is None else given.com_perp_m,
        own.inertia_com_kgm2 if given.inertia_com_kgm2 is None else given.inertia_com_kgm2,
    )


def _nominal_axis(config: GatewayConfig, name: str) -> tuple[float, float, float]:
    """Inertia, viscous and Coulomb friction of an axis' nominal model."""
    given, own = config.feed_forward.axes.get(name, NominalAxisSection()), config.axes[name].emulation
    return (
        own.inertia_kgm2 if given.inertia_kgm2 is None else given.inertia_kgm2,
        own.viscous_Nms if given.viscous_Nms is None else given.viscous_Nms,
        own.coulomb_Nm if given.coulomb_Nm is None else given.coulomb_Nm,
    )


def drive_damping(config: GatewayConfig, name: str) -> float:
    """N m s/rad that the drive of an axis gives with the demand's velocity beyond what it takes off with the actual."""
    given = config.feed_forward.axes.get(name, NominalAxisSection()).drive_damping_Nms
    if given is not None:
        return given
    gains = controller_gains(config.axes[name])
    return gains.velocity_Nms_per_rad - gains.damping_Nms_per_rad


def torque_delay_s(config: GatewayConfig) -> float:
    """From the SYNC that applies a torque offset to the torque on the shaft, seconds, the mean of both axes.

    A controller takes its output for a whole period, so on average for half of one later.
    """
    given = config.feed_forward.torque_delay_us
    if given is not None:
        return given * 1e-6
    drives = [axis.emulation for axis in config.ordered_axes]
    return sum(
        (0.5 + drive.output_delay_periods) / CONTROLLER_RATE_HZ + drive.torque_time_constant_s for drive in drives
    ) / len(drives)


def torque_offset_limit(config: GatewayConfig, name: str) -> float:
    """Bound of an axis' torque offset in N m, either way: the amplifier's unless a smaller one is given."""
    given, own = config.feed_forward.axes.get(name, NominalAxisSection()), config.axes[name].emulation
    return own.torque_limit_Nm if given.torque_limit_Nm is None else min(given.torque_limit_Nm, own.torque_limit_Nm)


def desired_curve(config: GatewayConfig) -> DesiredCurve:
    """The desired curve that the configuration names. Raises mechanism.errors.CurveError."""
    return load_curve_csv(config.relative(config.motion.curve))


def home_angles(config: GatewayConfig) -> tuple[float, float]:
    """theta2 and theta5 (rad) where the axes are homed, which is where an emulated machine stands at first."""
    master, slave = config.ordered_axes
    return math.radians(master.home_angle_deg), math.radians(slave.home_angle_deg)


def closure_at_home(config: GatewayConfig) -> Closure:
    """How the linkage is assembled: the side on which the desired curve has the end effector at the home position.

    Raises mechanism.errors.CurveError.
    """
    curve = desired_curve(config)
    theta2, theta5 = home_angles(config)
    nearest = min(
        range(len(curve.theta2)), key=lambda i: abs(math.remainder(float(curve.theta2[i]) - theta2, math.tau))
    )
    return five_bar(config).closure_at(theta2, theta5, float(curve.x[nearest]), float(curve.y[nearest]))
