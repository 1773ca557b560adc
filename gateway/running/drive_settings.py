"""What a configuration says of its drives, in the words of commissioning and the cycle: units, settings, the master."""

import math
from typing import Final

from config.conversion import nominal_parameters
from config.schema import AxisSection, GatewayConfig
from drivers.master import Master
from drivers.object_dictionary import DataType
from gateway.cyclic.position_loop import PositionLoop
from gateway.running.commissioning import NetworkSettings, NodeSettings
from gateway.running.drive_guards import DriveGuard
from gateway.units import AxisUnits

_UNSIGNED: Final = {8: DataType.UNSIGNED8, 16: DataType.UNSIGNED16, 32: DataType.UNSIGNED32}


def axis_units(axis: AxisSection) -> AxisUnits:
    """The converter of one axis."""
    return AxisUnits(axis.counts_per_revolution, math.radians(axis.home_angle_deg), axis.rated_torque_Nm)


def lasting_pushes(config: GatewayConfig) -> list[int]:
    """Torques that nothing may come of for long (per mille of rated torque), one an axis, master first."""
    rule, friction = config.guard.unanswered_torque, nominal_parameters(config).coulomb_N_m
    return [
        rule.lasting_permille(axis_units(axis).permille(dry))
        for axis, dry in zip(config.ordered_axes, friction, strict=True)
    ]


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


def _sync_watchdog(axis: AxisSection, cycle_us: int) -> DriveGuard | None:
    section = axis.sync_watchdog
    if section is None:
        return None
    data_type = _UNSIGNED[section.bits]
    return DriveGuard("SYNC watchdog", section.index, section.subindex, data_type, section.value(cycle_us))


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
            sync_watchdog=_sync_watchdog(axis, config.bus.cycle_us),
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
