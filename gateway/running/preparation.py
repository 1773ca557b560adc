"""From a configuration to everything a run needs, with every limit proved before any bus is opened."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from config.conversion import closure_at_home, desired_curve, five_bar, home_angles
from config.schema import AxisSection, GatewayConfig
from drivers.master import Master
from gateway.cyclic.approach import Approach, ApproachDemand, ApproachLimits
from gateway.cyclic.cycle import AxisChannel, CyclicLoop, SampleSink
from gateway.cyclic.demand import CamDemand
from gateway.cyclic.guard import Guard
from gateway.cyclic.operation import Operation
from gateway.cyclic.position_loop import PositionLoop
from gateway.cyclic.reactions import CoupledStop
from gateway.cyclic.torque_offsets import build_feed_forward, build_torque_offsets, torque_violations
from gateway.cyclic.watch import AxisLimits, CamWindow, CycleWatch
from gateway.errors import GatewayError
from gateway.learning.law import Learning, build_learning
from gateway.running.commissioning import NetworkSettings, NodeSettings
from gateway.running.core import GatewayCore
from gateway.running.machine_session import START_WINDOW_RAD, MachineSession
from gateway.running.powering import AxisSetup
from gateway.units import AxisUnits
from mechanism.approach import ApproachField
from mechanism.cam import CamLimits, CompiledCam, compile_cam
from mechanism.cam_profile import CamProfile
from mechanism.errors import CamLimitError, MechanismError
from mechanism.motion import MasterPlan, plan_run
from mechanism.slave_law import LawLimits, SlaveLaw

JOG_SHARE: Final = 4.0
"""A jog is at most so many times slower than the run."""
RAMP_GRID: Final = 4096
TORQUE_GRID: Final = 256
WHOLE_REVOLUTION: Final = 1e-9
"""Share of a revolution that is rounding, and asks for no revolution more."""
NS_PER_US: Final = 1000


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
        *_guard_violations(config, cam.profile),
        *torque_violations(config, cam.profile),
    )
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


def slave_law(config: GatewayConfig, profile: CamProfile) -> SlaveLaw:
    """Where the slave is for every angle of the master: on the cam, until somebody shifts it or takes it off."""
    slave = config.ordered_axes[1].limits
    return SlaveLaw(
        profile,
        LawLimits(
            five_bar(config),
            closure_at_home(config, desired_curve(config)),
            config.machine.minimum_transmission_sine,
            slave.velocity_rad_per_s,
            slave.acceleration_rad_per_s2,
        ),
    )


def guard_limits(config: GatewayConfig, law: SlaveLaw) -> tuple[list[AxisLimits], CamWindow]:
    """What the guard compares every cycle with, in the cycle's own units."""
    guard = config.guard
    axes = [
        AxisLimits(
            velocity_counts_per_cycle=guard.velocity.limit_percent
            / 100.0
            * axis.limits.velocity_rad_per_s
            * axis.counts_per_revolution
            / math.tau
            * config.cycle_s,
            torque_permille=guard.torque.limit_permille,
            frozen_counts=round(guard.frozen_actual.limit_deg / 360.0 * axis.counts_per_revolution),
        )
        for axis in config.ordered_axes
    ]
    master, slave = config.ordered_axes
    return axes, CamWindow(
        geometry=five_bar(config).to_array(),
        closure=int(closure_at_home(config, desired_curve(config))),
        law=law,
        rad_per_count=(math.tau / master.counts_per_revolution, math.tau / slave.counts_per_revolution),
        window_rad=math.radians(guard.cam_window.limit_deg),
        end_effector_m=guard.end_effector_error.limit_mm / 1e3,
    )


def axis_units(axis: AxisSection) -> AxisUnits:
    """The converter of one axis."""
    return AxisUnits(axis.counts_per_revolution, math.radians(axis.home_angle_deg), axis.rated_torque_Nm)


def _quick_stop_deceleration(axis: AxisSection) -> int | None:
    deceleration = axis.limits.quick_stop_deceleration_rad_per_s2
    return None if deceleration is None else round(deceleration * axis.counts_per_revolution / math.tau)


def position_loop(axis: AxisSection, cycle_s: float) -> PositionLoop | None:
    """The position loop that the gateway closes itself; None where the drive does."""
    section = axis.position_loop
    if section is None:
        return None
    return PositionLoop(
        axis_units(axis),
        cycle_s,
        section.proportional_Nm_per_rad,
        section.integrating_Nm_per_rad_s,
        section.derivative_Nms_per_rad,
        section.torque_limit_Nm,
    )


def node_settings(config: GatewayConfig) -> list[NodeSettings]:
    """What commissioning must know of each drive, master first."""
    return [
        NodeSettings(
            name=name,
            node_id=axis.node_id,
            identity=(
                axis.identity.vendor_id,
                axis.identity.product_code,
                axis.identity.revision_number,
                axis.identity.serial_number,
            ),
            following_error_window=axis.limits.following_error_counts,
            rated_torque_mNm=round(axis.rated_torque_Nm * 1000.0),
            counts_per_revolution=axis.counts_per_revolution,
            quick_stop_deceleration=_quick_stop_deceleration(axis),
            torque_limit_permille=config.guard.torque.limit_permille,
            is_torque_controlled=axis.position_loop is not None,
        )
        for name, axis in zip(config.axis_names, config.ordered_axes, strict=True)
    ]


def network_settings(config: GatewayConfig) -> NetworkSettings:
    """What all drives have in common."""
    interpolation_time = config.bus.interpolation_time()
    if interpolation_time is None:
        raise ValueError("the configuration's own check lets no such cycle pass")
    return NetworkSettings(
        gateway_node_id=config.bus.gateway_node_id,
        heartbeat_ms=config.bus.heartbeat_ms,
        heartbeat_timeout_ms=config.bus.heartbeat_timeout_ms,
        boot_up_timeout_s=config.bus.boot_up_timeout_s,
        cycle_us=config.bus.cycle_us,
        interpolation_time=interpolation_time,
    )


def build_master(config: GatewayConfig) -> Master:
    """The CANopen master for the configuration's nodes."""
    node_ids = [axis.node_id for axis in config.ordered_axes]
    return Master(node_ids, config.bus.gateway_node_id, config.bus.heartbeat_ms * 1_000_000)


def build_core(
    config: GatewayConfig,
    profile: CamProfile,
    run_plan: MasterPlan,
    sink: SampleSink,
    cpu_clock: Callable[[], int] | None = None,
    is_homing_again: bool = False,
    learning: Learning | None = None,
    tpdo_deadline_us: float | None = None,
    approach_cycles: int | None = None,
) -> GatewayCore:
    """Put the gateway's parts together; see ``gateway.running.core``.

    ``approach_cycles``: start from anywhere, with so many machine cycles after the approach; None refuses a machine
    that does not stand where ``run_plan`` begins.

    ``learning``: what has been learned before and is to be gone on with; None leaves it to the configuration.
    ``tpdo_deadline_us``: how long after SYNC the TPDOs are waited for; None is what the bus budget leaves.
    """
    channels = [
        AxisChannel(
            name,
            axis.node_id,
            axis_units(axis),
            axis.limits.gateway_error_counts,
            position_loop(axis, config.cycle_s),
        )
        for name, axis in zip(config.axis_names, config.ordered_axes, strict=True)
    ]
    setups = [
        AxisSetup(node, channel, axis.homing_method)
        for node, channel, axis in zip(node_settings(config), channels, config.ordered_axes, strict=True)
    ]
    guard = Guard(config.guard, config.axis_names)
    law = slave_law(config, profile)
    watch = CycleWatch(guard, channels, *guard_limits(config, law))
    deceleration = config.ordered_axes[0].limits.quick_stop_deceleration_rad_per_s2
    coupled_stop = CoupledStop(
        law,
        channels,
        guard,
        config.cycle_s,
        config.ordered_axes[0].limits.acceleration_rad_per_s2 if deceleration is None else deceleration,
    )
    deadline_ns = round((config.tpdo_deadline_us if tpdo_deadline_us is None else tpdo_deadline_us) * NS_PER_US)
    loop = CyclicLoop(
        channels, config.bus.cycle_us * NS_PER_US, guard, sink, cpu_clock, deadline_ns, watch, coupled_stop
    )
    loop.sync_gap_limit = config.guard.sync_lost.limit_cycles
    units = (channels[0].units, channels[1].units)
    if learning is None and config.learning.enabled:
        learning = build_learning(config, profile)
    demand = CamDemand(
        profile,
        units,
        config.cycle_s,
        config.motion.ramp_acceleration_rad_per_s2,
        config.motion.ramp_jerk_rad_per_s3,
        build_torque_offsets(config, profile, units, learning),
        law,
    )
    approach = None if approach_cycles is None else build_approach(config, profile, approach_cycles)
    session = MachineSession(
        setups,
        network_settings(config),
        build_master(config),
        loop,
        demand,
        run_plan,
        guard,
        is_homing_again,
        approach,
        config.recovery.timeout_s,
    )
    operation = Operation(
        demand, config.speed_rad_per_s, config.motion.approach_speed_rad_per_s, config.speed_rad_per_s / JOG_SHARE
    )
    return GatewayCore(session, operation, config.bus.sdo_frames_a_cycle)


def build_approach(config: GatewayConfig, profile: CamProfile, machine_cycles: int) -> Approach:
    """How a machine gets onto its cam from anywhere, and the run that it then makes.

    Raises mechanism.errors.ApproachError for a cam that has no approach.
    """
    position = config.ordered_axes[1].limits.position_deg
    motion = config.motion
    return Approach(
        ApproachField(
            five_bar(config),
            closure_at_home(config, desired_curve(config)),
            profile,
            config.machine.minimum_transmission_sine,
            None if position is None else (math.radians(position[0]), math.radians(position[1])),
        ),
        ApproachDemand(
            [axis_units(axis) for axis in config.ordered_axes],
            config.cycle_s,
            ApproachLimits(
                motion.approach_speed_rad_per_s, motion.ramp_acceleration_rad_per_s2, motion.ramp_jerk_rad_per_s3
            ),
        ),
        lambda start: plan(config, machine_cycles, start),
    )
