"""From what a configuration says, in its own units, to the values that ``mechanism`` computes with, in SI units."""

import math

from config.schema import GatewayConfig, LinkSection
from mechanism.curve import DesiredCurve, load_curve_csv
from mechanism.dynamics import DynamicsParameters, LinkParameters
from mechanism.five_bar import Closure, FiveBar


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


def desired_curve(config: GatewayConfig) -> DesiredCurve:
    """The desired curve that the configuration names. Raises mechanism.errors.CurveError."""
    return load_curve_csv(config.relative(config.motion.curve))


def home_angles(config: GatewayConfig) -> tuple[float, float]:
    """theta2 and theta5 (rad) where the axes are homed, which is where an emulated machine stands at first."""
    master, slave = config.ordered_axes
    return math.radians(master.home_angle_deg), math.radians(slave.home_angle_deg)


def closure_at_home(config: GatewayConfig, curve: DesiredCurve) -> Closure:
    """How the linkage is assembled: the side on which the desired curve has the end effector at the home position."""
    theta2, theta5 = home_angles(config)
    nearest = min(
        range(len(curve.theta2)), key=lambda i: abs(math.remainder(float(curve.theta2[i]) - theta2, math.tau))
    )
    return five_bar(config).closure_at(theta2, theta5, float(curve.x[nearest]), float(curve.y[nearest]))
