"""From a configuration to everything a run needs, with every limit proved before any bus is opened."""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from config.conversion import desired_curve, five_bar, home_angles
from config.schema import GatewayConfig
from gateway.cyclic.torque_offsets import build_feed_forward, torque_violations
from gateway.errors import GatewayError
from gateway.running.drive_settings import axis_units
from gateway.running.machine_session import START_WINDOW_RAD
from gateway.running.operation_setup import slave_law
from mechanism.cam import CamLimits, CompiledCam, compile_cam
from mechanism.cam_profile import CamProfile
from mechanism.errors import CamLimitError, MechanismError
from mechanism.law_proof import finish
from mechanism.motion import MasterPlan, plan_run
from mechanism.slave_law import EngagementError

RAMP_GRID: Final = 4096
TORQUE_GRID: Final = 256
WINDOW_STARTS: Final = 36
WHOLE_REVOLUTION: Final = 1e-9
"""Share of a revolution that is rounding, and asks for no revolution more."""


@dataclass(frozen=True, slots=True)
class PreparedRun:
    """A run that may be carried out: compiled, checked and planned.

    ``violations`` is empty unless the run was prepared for a check, which reports instead of refusing.
    """

    config: GatewayConfig
    cam: CompiledCam
    plan: MasterPlan
    violations: tuple[MechanismError | GatewayError, ...]


def compile_config(config: GatewayConfig) -> CompiledCam:
    """Compile the configuration's curve; limits that are broken are in its ``violations``.

    Raises mechanism.errors.MechanismError for a curve that cannot be read.
    """
    slave = config.ordered_axes[1]
    position = slave.limits.position_deg
    limits = CamLimits(
        velocity_rad_per_s=slave.limits.velocity_rad_per_s,
        acceleration_rad_per_s2=slave.limits.acceleration_rad_per_s2,
        jerk_rad_per_s3=slave.limits.jerk_rad_per_s3,
        position_minimum_rad=None if position is None else math.radians(position[0]),
        position_maximum_rad=None if position is None else math.radians(position[1]),
        structural_error_m=config.motion.structural_error_limit_mm / 1e3,
        minimum_transmission_sine=config.machine.minimum_transmission_sine,
    )
    return compile_cam(
        desired_curve(config),
        five_bar(config),
        limits,
        config.speed_rad_per_s,
        counts_per_revolution=slave.counts_per_revolution,
        cycle_s=config.cycle_s,
        knots=config.motion.cam_points,
        image_points=config.motion.cam_points,
    )


def prepare(config: GatewayConfig, machine_cycles: int | None = None, is_strict: bool = True) -> PreparedRun:
    """Compile, check and plan; ``machine_cycles`` overrides the configuration's.

    Raises GatewayError with a sentence for every violation if ``is_strict``.
    """
    cam = compile_config(config)
    violations = (
        *cam.violations,
        *_ramp_violations(config, cam.profile),
        *_home_violations(config, cam.profile),
        *_turning_violations(config, cam.profile),
        *_guard_violations(config, cam.profile),
        *torque_violations(config, cam.profile),
    )
    # A law that breaks limits by itself has no window that would keep them.
    if not violations:
        violations = tuple(_window_violations(config, cam.profile))
    if is_strict and violations:
        raise GatewayError("\n".join(str(violation) for violation in violations))
    return PreparedRun(config, cam, plan(config, machine_cycles), violations)


def plan(config: GatewayConfig, machine_cycles: int | None = None, start: float | None = None) -> MasterPlan:
    """The master's plan: from home, or ``start`` (rad), up to speed, the machine cycles, and down again to home.

    Homing takes the position where the linkage stands for home, so that a run must end where the next one begins.
    """
    motion = config.motion
    cycles = motion.machine_cycles if machine_cycles is None else machine_cycles
    home = home_angles(config)[0]

    def run(revolutions: float) -> MasterPlan:
        return plan_run(
            home if start is None else start,
            config.speed_rad_per_s,
            revolutions,
            motion.ramp_acceleration_rad_per_s2,
            motion.ramp_jerk_rad_per_s3,
            end_at_multiple_of_revolution=False,
        )

    turned = (run(cycles).end_position - home) / math.tau
    return run(cycles + math.ceil(turned - WHOLE_REVOLUTION) - turned)


def _ramp_violations(config: GatewayConfig, profile: CamProfile) -> list[MechanismError]:
    """What the servo axis would exceed if the master ramped, or stopped, at any position of the cycle."""
    limits = config.ordered_axes[1].limits
    theta2 = np.linspace(0.0, math.tau, RAMP_GRID, endpoint=False)
    first, second, third = np.abs(profile.at_many(theta2)[:, 1:]).T
    speed, ramp, jerk = (
        config.speed_rad_per_s,
        config.motion.ramp_acceleration_rad_per_s2,
        config.motion.ramp_jerk_rad_per_s3,
    )
    found = [
        ("acceleration", "rad/s^2", second * speed**2 + first * ramp, limits.acceleration_rad_per_s2),
        (
            "jerk",
            "rad/s^3",
            third * speed**3 + 3.0 * second * speed * ramp + first * jerk,
            limits.jerk_rad_per_s3,
        ),
    ]
    violations: list[MechanismError] = []
    for name, unit, worst, limit in found:
        at = int(np.argmax(worst))
        if limit is not None and worst[at] > limit:
            what = f"{name} while the master ramps at {ramp:g} rad/s^2"
            violations.append(CamLimitError(what, float(worst[at]), limit, unit, float(theta2[at])))
    return violations


def _home_violations(config: GatewayConfig, profile: CamProfile) -> list[GatewayError]:
    """A homed slave stands at 0 counts, and the cam must have it there where the master is at home."""
    slave = config.ordered_axes[1]
    theta2, theta5 = home_angles(config)
    on_cam = profile.at(theta2)[0]
    distance = axis_units(slave).counts(on_cam)
    if profile.net_turns:
        distance = round(math.remainder(distance, slave.counts_per_revolution))
    window = axis_units(slave).counts_in(START_WINDOW_RAD)
    if slave.homing_method is None or abs(distance) <= window:
        return []
    name = config.axis_names[1]
    return [
        GatewayError(
            f"axes.{name}.home_angle_deg: {math.degrees(theta5):g} is {abs(distance)} counts from the cam, which has "
            f"{math.degrees(on_cam):.3f} deg where the master is at home (bound {window} counts)"
        )
    ]


def _turning_violations(config: GatewayConfig, profile: CamProfile) -> list[GatewayError]:
    """A slave that gains turns passes every angle sooner or later."""
    slave = config.ordered_axes[1]
    if not profile.net_turns or slave.limits.position_deg is None:
        return []
    turns = f"{abs(profile.net_turns)} turn{'s' if abs(profile.net_turns) > 1 else ''}"
    return [
        GatewayError(
            f"axes.{config.axis_names[1]}.limits.position_deg: the servo axis gains {turns} on its cam with every "
            "revolution of the master and would pass any limit, leave it out"
        )
    ]


def _window_violations(config: GatewayConfig, profile: CamProfile) -> list[GatewayError]:
    """A window within which the slave cannot leave its cam anywhere."""
    window_deg = config.motion.engagement_window_deg
    if window_deg is None:
        return []
    law = slave_law(config, profile)
    fitting: list[float] = []
    for at in np.linspace(0.0, math.tau, WINDOW_STARTS, endpoint=False).tolist():
        try:
            finish(law.prove_engagement(False, at, math.radians(window_deg), config.speed_rad_per_s))
        except EngagementError as error:
            if error.fitting is not None:
                fitting.append(error.fitting)
        else:
            return []
    fits = f", {math.degrees(min(fitting)):.0f} deg would somewhere" if fitting else ""
    return [
        GatewayError(
            f"motion.engagement_window_deg: within {window_deg:g} deg the slave can leave its cam nowhere at "
            f"{config.motion.speed_rpm:g} rpm{fits}"
        )
    ]


def _guard_violations(config: GatewayConfig, profile: CamProfile) -> list[GatewayError]:
    """Torques that the model of the machine needs on its cam, and that the guard would take for too much."""
    limit = config.guard.torque.limit_permille
    model = build_feed_forward(config, profile)
    theta2 = np.linspace(0.0, math.tau, TORQUE_GRID, endpoint=False)
    torques = np.abs([model.torques(position, config.speed_rad_per_s, 0.0) for position in theta2.tolist()])
    found: list[GatewayError] = []
    for number, (name, axis) in enumerate(zip(config.axis_names, config.ordered_axes, strict=True)):
        needed = float(torques[:, number].max()) / axis.rated_torque_Nm * 1000.0
        if needed > limit:
            found.append(
                GatewayError(
                    f"guard.torque.limit_permille: {limit} would always trip, axis {name} needs {needed:.0f} per mille "
                    f"of its rated torque at {config.motion.speed_rpm:g} rpm"
                )
            )
    return found
