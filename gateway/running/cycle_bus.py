"""The sockets of a run: SYNC and PDOs on one of their own, all the rest on another, and who sends SYNC."""

from dataclasses import dataclass
from typing import Final

from config.schema import GatewayConfig, SyncSource, Timestamps
from drivers.broadcast_manager import PeriodicFrame
from drivers.errors import BusError
from drivers.hardware_stamps import why_no_hardware_stamps
from drivers.nmt import EMCY_BASE, HEARTBEAT_BASE, SYNC_COB_ID
from drivers.pdo import RPDO_BASE, TPDO_BASE
from drivers.ports import Port
from drivers.real_time import RealTimeFeature, RealTimeSetting
from drivers.sdo import SDO_RESPONSE_BASE
from drivers.socketcan_port import SocketcanPort
from gateway.cyclic.cycle import SYNC_FRAME
from gateway.errors import GatewayError
from gateway.running.bus_address import BusAddress

_WHOLE_IDENTIFIER: Final = 0x7FF


@dataclass(frozen=True, slots=True)
class CycleBus:
    """What ``gateway.running.cycle_host`` runs on."""

    cyclic: Port
    """SYNC and TPDOs come in here, everything goes out here."""
    service: Port | None
    """SDO, heartbeats and EMCY; None where ``cyclic`` has them too."""
    sync: PeriodicFrame | None
    """The kernel's SYNC; None where the loop sends it."""
    sync_setting: RealTimeSetting
    stamp_setting: RealTimeSetting
    """By whose clock the arrival of a TPDO is told."""
    echo_cob_id: int | None = None
    """Of the last demand of a cycle, where ``cyclic`` hears it when it has been on the bus."""

    def close(self) -> None:
        """Leave the bus; the kernel's SYNC ends with it."""
        if self.sync is not None:
            self.sync.close()
        if self.service is not None:
            self.service.close()
        self.cyclic.close()


def open_cycle_bus(address: BusAddress, config: GatewayConfig, listener: Port) -> CycleBus:
    """Open what a run needs. ``listener`` is an open port on the same bus, used where one port has to do for all.

    Raises BusError, and GatewayError for a kernel's SYNC, or hardware timestamps, on a bus that has none.
    """
    source = config.bus.sync_source
    stamps = _stamp_setting(address, config.bus.timestamps)
    if address.interface != "socketcan":
        if source is SyncSource.KERNEL:
            raise GatewayError(
                f"bus.sync_source: kernel needs the interface socketcan, this bus is {address} (auto or loop)"
            )
        listener.outlives_bus_off = True
        setting = _loop_setting(f"{address.interface} has no timer of its own")
        return CycleBus(listener, None, None, setting, stamps)
    sync, setting = _sync_timer(address, config)
    node_ids = [axis.node_id for axis in config.ordered_axes]
    tpdos = [TPDO_BASE[0] + node_id for node_id in node_ids]
    if sync is None:
        cyclic, echo = address.open(_exactly(tpdos)), None
    else:
        # Which demand a SYNC takes over is a matter of their order on the bus, and only the bus can tell it.
        echo = RPDO_BASE[0] + node_ids[-1]
        cyclic = SocketcanPort(address.channel, _exactly([SYNC_COB_ID, echo, *tpdos]), hears_own=True)
    bases = (EMCY_BASE, SDO_RESPONSE_BASE, HEARTBEAT_BASE)
    service = address.open(_exactly([base + node_id for node_id in node_ids for base in bases]))
    cyclic.outlives_bus_off = service.outlives_bus_off = True
    if stamps.is_on and isinstance(cyclic, SocketcanPort):
        cyclic.use_hardware_stamps()
    return CycleBus(cyclic, service, sync, setting, stamps, echo)


def _stamp_setting(address: BusAddress, wanted: Timestamps) -> RealTimeSetting:
    """By whose clock arrivals are told, and why. Raises GatewayError where the wanted one is not to be had."""
    feature = RealTimeFeature.HARDWARE_STAMPS
    if wanted is Timestamps.KERNEL:
        return RealTimeSetting(feature, False, "bus.timestamps is kernel")
    if address.interface == "socketcan":
        reason = why_no_hardware_stamps(address.channel)
    else:
        reason = f"{address.interface} does not tell by which clock it stamps, if at all"
    if not reason:
        return RealTimeSetting(feature, True, f"by the clock of {address.channel}'s controller")
    if wanted is Timestamps.HARDWARE:
        raise GatewayError(f"bus.timestamps: hardware is not to be had on {address}: {reason} (auto or kernel)")
    return RealTimeSetting(feature, False, reason)


def _sync_timer(address: BusAddress, config: GatewayConfig) -> tuple[PeriodicFrame | None, RealTimeSetting]:
    source = config.bus.sync_source
    if source is SyncSource.LOOP:
        return None, _loop_setting("bus.sync_source is loop")
    try:
        timer = PeriodicFrame(address.channel, SYNC_FRAME, config.bus.cycle_us)
    except BusError as error:
        if source is SyncSource.KERNEL:
            raise
        return None, _loop_setting(str(error.reason))
    return timer, RealTimeSetting(RealTimeFeature.KERNEL_SYNC, True, f"broadcast manager on {address.channel}")


def _loop_setting(reason: str) -> RealTimeSetting:
    return RealTimeSetting(RealTimeFeature.KERNEL_SYNC, False, f"the loop sends SYNC itself, {reason}")


def _exactly(cob_ids: list[int]) -> list[tuple[int, int]]:
    return [(cob_id, _WHOLE_IDENTIFIER) for cob_id in cob_ids]
