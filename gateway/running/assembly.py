"""From a configuration that has been prepared to the gateway's core, with all its parts put together."""

import math
from collections.abc import Callable
from typing import Final

from config.conversion import closure_at_home, five_bar, nominal_parameters
from config.schema import GatewayConfig
from gateway.cyclic.approach import Approach, ApproachDemand, ApproachLimits
from gateway.cyclic.axis_channel import AxisChannel, AxisLimits
from gateway.cyclic.cam_window import CamWindow
from gateway.cyclic.cycle import CyclicLoop
from gateway.cyclic.demand import CamDemand
from gateway.cyclic.free_motion import FreeMotion
from gateway.cyclic.guard import Guard
from gateway.cyclic.listeners import SampleSink
from gateway.cyclic.operation import Operation
from gateway.cyclic.reactions import CoupledStop
from gateway.cyclic.steering import Steering
from gateway.cyclic.torque_offsets import build_torque_offsets
from gateway.cyclic.watch import CycleWatch
from gateway.learning.law import Learning, build_learning
from gateway.running.core import GatewayCore
from gateway.running.drive_settings import (
    axis_units,
    build_master,
    lasting_pushes,
    network_settings,
    node_settings,
    position_loop,
)
from gateway.running.load_check import build_load_check
from gateway.running.machine_session import MachineSession
from gateway.running.operation_setup import operation_limits, slave_law
from gateway.running.powering import AxisSetup
from gateway.running.preparation import plan
from mechanism.approach import ApproachField
from mechanism.cam_profile import CamProfile
from mechanism.deviation import harmless_error
from mechanism.five_bar import Closure
from mechanism.motion import MasterPlan
from mechanism.slave_law import SlaveLaw

NS_PER_US: Final = 1000


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
            unanswered_permille=guard.unanswered_torque.limit_permille,
            pushed_permille=pushed,
        )
        for axis, pushed in zip(config.ordered_axes, lasting_pushes(config), strict=True)
    ]
    master, slave = config.ordered_axes
    geometry, closure = five_bar(config).to_array(), int(closure_at_home(config))
    window_rad, end_effector_m = math.radians(guard.cam_window.limit_deg), guard.end_effector_error.limit_mm / 1e3
    cam = law.cam
    harmless = harmless_error(geometry, closure, cam.coefficients, cam.net_turns, window_rad, end_effector_m)
    return axes, CamWindow(
        geometry=geometry,
        closure=closure,
        law=law,
        rad_per_count=(math.tau / master.counts_per_revolution, math.tau / slave.counts_per_revolution),
        window_rad=window_rad,
        end_effector_m=end_effector_m,
        harmless_counts=(
            int(harmless * master.counts_per_revolution / math.tau),
            int(harmless * slave.counts_per_revolution / math.tau),
        ),
    )


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
    limits, window = guard_limits(config, law)
    closure = Closure(window.closure)
    free_motion = None
    if config.feed_forward.tells_loads:
        free_motion = FreeMotion(channels, nominal_parameters(config), closure, config.cycle_s)
    watch = CycleWatch(guard, channels, limits, window, free_motion)
    deceleration = config.ordered_axes[0].limits.quick_stop_deceleration_rad_per_s2
    coupled_stop = CoupledStop(
        law,
        channels,
        guard,
        config.cycle_s,
        config.ordered_axes[0].limits.acceleration_rad_per_s2 if deceleration is None else deceleration,
    )
    deadline_ns = round((config.tpdo_deadline_us if tpdo_deadline_us is None else tpdo_deadline_us) * NS_PER_US)
    steering = Steering(channels, guard, watch, coupled_stop)
    loop = CyclicLoop(steering, config.bus.cycle_us * NS_PER_US, sink, cpu_clock, deadline_ns)
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
        config.recovery.bus_off_timeout_s,
        build_load_check(config, closure),
    )
    return GatewayCore(session, Operation(demand, operation_limits(config)), config.bus.sdo_frames_a_cycle)


def build_approach(config: GatewayConfig, profile: CamProfile, machine_cycles: int) -> Approach:
    """How a machine gets onto its cam from anywhere, and the run that it then makes.

    Raises mechanism.errors.ApproachError for position limits of a slave that gains turns on its cam.
    """
    slave = config.ordered_axes[1].limits
    position = slave.position_deg
    motion = config.motion
    return Approach(
        ApproachField(
            five_bar(config),
            closure_at_home(config),
            profile,
            config.machine.minimum_transmission_sine,
            None if position is None else (math.radians(position[0]), math.radians(position[1])),
        ),
        ApproachDemand(
            [axis_units(axis) for axis in config.ordered_axes],
            config.cycle_s,
            ApproachLimits(
                motion.approach_speed_rad_per_s,
                min(motion.ramp_acceleration_rad_per_s2, slave.acceleration_rad_per_s2),
                min(motion.ramp_jerk_rad_per_s3, slave.jerk_rad_per_s3 or math.inf),
            ),
        ),
        lambda start: plan(config, machine_cycles, start),
    )
