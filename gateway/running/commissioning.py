"""Brings the drives of a configuration to the state in which the cycle can run: everything checked, nothing moving.

Every step is taken on all drives before the next one, and what is wrong with *all* of them is reported at once.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

from drivers import objects
from drivers.errors import NoAnswerError, NodeError, SdoAbortedError
from drivers.master import Master, Procedure
from drivers.nmt import NmtCommand
from drivers.node import Event
from drivers.object_dictionary import DataType
from drivers.pdo import (
    PDO_COB_ID_INVALID,
    PDO_COB_ID_NO_RTR,
    RPDO_BASE,
    SYNCHRONOUS_EVERY_SYNC,
    TPDO_BASE,
    MappingEntry,
)
from gateway.errors import CommissioningError
from gateway.running.drive_guards import DriveGuard, check_guards, is_absence, write_guards

DEVICE_PROFILE_402: Final = 0x0192
"""Low word of 1000h of every CiA 402 drive."""
ABORT_CONNECTION_FAULT: Final = 1
"""6007h: a drive that loses the gateway goes into a fault, and so stops."""
QUICK_STOP_RAMP: Final = 2
"""605Ah and 605Eh: a drive that is told to stop quickly, or faults with its amplifier whole, stops with the ramp 6085h
and is without torque then; so the other axis can follow it, and a brake takes hold of an axis that stands."""
RAMP_TOLERANCE: Final = 0.01
"""Drives keep 6085h in units of their own."""
PDO_COUNT: Final = 4
U8, U16, U32 = DataType.UNSIGNED8, DataType.UNSIGNED16, DataType.UNSIGNED32
I8, I16, I32 = DataType.INTEGER8, DataType.INTEGER16, DataType.INTEGER32

RPDO_ENTRIES: Final = (
    MappingEntry(objects.CONTROLWORD, 0, 16),
    MappingEntry(objects.TARGET_POSITION, 0, 32),
    MappingEntry(objects.TORQUE_OFFSET, 0, 16),
)
TORQUE_RPDO_ENTRIES: Final = (*RPDO_ENTRIES[:2], MappingEntry(objects.TARGET_TORQUE, 0, 16))
"""Where the gateway closes the position loop; the target position is sent for the record."""
TPDO_ENTRIES: Final = (
    MappingEntry(objects.STATUSWORD, 0, 16),
    MappingEntry(objects.POSITION_ACTUAL_VALUE, 0, 32),
    MappingEntry(objects.TORQUE_ACTUAL_VALUE, 0, 16),
)


@dataclass(frozen=True, slots=True)
class BootUpMissing(Event):
    """A node has sent no boot-up message after its reset, but answers by SDO."""

    node_id: int


@dataclass(frozen=True, slots=True)
class NodeSettings:
    """What one drive is to be, as commissioning needs it."""

    name: str
    node_id: int
    identity: tuple[int | None, int | None, int | None, int | None]
    """1018h:01 to :04 as they must be; None: not checked."""
    following_error_window: int
    """Counts, 6065h."""
    rated_torque_mNm: int
    counts_per_revolution: int
    quick_stop_deceleration: int | None = None
    """Counts/s^2, 6085h; None: as the drive has it."""
    torque_limit_permille: int | None = None
    """Where the gateway's guard trips; a drive that gives no more than that (6072h) is refused. None: not checked."""
    is_torque_controlled: bool = False
    """The gateway closes the position loop: cyclic synchronous torque."""
    sync_watchdog: DriveGuard | None = None
    """The drive's own watch over SYNC, as the configuration names it; None: left as the drive has it."""


@dataclass(frozen=True, slots=True)
class NetworkSettings:
    """What all drives have in common."""

    gateway_node_id: int
    heartbeat_ms: int
    heartbeat_timeout_ms: int
    boot_up_timeout_s: float
    cycle_us: int
    interpolation_time: tuple[int, int]
    """60C2h: value, power of ten in seconds."""


IDENTITY_NAMES: Final = ("vendor id", "product code", "revision number", "serial number")

Step = Callable[[NodeSettings], Procedure[None]]


def for_all(nodes: Sequence[NodeSettings], step: Step) -> Procedure[None]:
    """Take a step on every node; raises one CommissioningError with what went wrong on any of them."""
    problems: list[str] = []
    for node in nodes:
        try:
            yield from step(node)
        except NodeError as error:
            problems.append(f"axis {node.name}: {error}")
        except CommissioningError as error:
            problems.extend(f"axis {node.name}: {problem}" for problem in error.problems)
    if problems:
        raise CommissioningError(problems)


def commission(master: Master, nodes: Sequence[NodeSettings], network: NetworkSettings) -> Procedure[None]:
    """Boot-up, identity, parameters, PDO mapping, heartbeats, guards read back. Leaves the nodes pre-operational.

    Raises CommissioningError.
    """
    yield from for_all(nodes, lambda node: restart(master, node, network))
    yield from for_all(nodes, lambda node: check_identity(master, node))
    yield from for_all(nodes, lambda node: write_parameters(master, node, network))
    yield from for_all(nodes, lambda node: map_pdos(master, node))
    yield from for_all(nodes, lambda node: set_up_heartbeats(master, node, network))
    since_ns = master.now_ns
    # Read while the first heartbeats are awaited, it takes no time of its own.
    yield from for_all(nodes, lambda node: read_back(master, node, network))
    yield from for_all(nodes, lambda node: hear_heartbeat(master, node, network, since_ns))


def restart(master: Master, node: NodeSettings, network: NetworkSettings) -> Procedure[None]:
    """Reset a node's communication; one that tells of no boot-up, but answers, is taken as it is, and that is told."""
    try:
        yield from master.reset_communication(node.node_id, network.boot_up_timeout_s)
    except NoAnswerError as silence:
        try:
            yield from master.read_int(node.node_id, objects.DEVICE_TYPE, 0, U32)
        except NodeError:
            raise silence from None
        master.events.append(BootUpMissing(master.now_ns, node.node_id))


def check_identity(master: Master, node: NodeSettings) -> Procedure[None]:
    """Refuse a node that is no CiA 402 drive, or another one than the configuration names."""
    problems: list[str] = []
    device_type = yield from master.read_int(node.node_id, objects.DEVICE_TYPE, 0, U32)
    if device_type & 0xFFFF != DEVICE_PROFILE_402:
        problems.append(
            f"node {node.node_id} has device type {device_type:08X}h, which is no CiA 402 drive (low word 0192h)"
        )
    for subindex, (name, expected) in enumerate(zip(IDENTITY_NAMES, node.identity, strict=True), start=1):
        if expected is None:
            continue
        found = yield from master.read_int(node.node_id, objects.IDENTITY, subindex, U32)
        if found != expected:
            problems.append(f"node {node.node_id} has {name} {found:08X}h, the configuration says {expected:08X}h")
    if problems:
        raise CommissioningError(problems)


def parameter_guards(node: NodeSettings, network: NetworkSettings) -> list[DriveGuard]:
    """What the cycle relies on, and what stops the axis without it, in the order in which it is written.

    A drive whose quick stop ramp cannot be met to a per cent is another one than the limits were made for.
    """
    value, exponent = network.interpolation_time
    period, cycle = objects.INTERPOLATION_TIME_PERIOD, objects.COMMUNICATION_CYCLE_PERIOD
    window, connection = objects.FOLLOWING_ERROR_WINDOW, objects.ABORT_CONNECTION_OPTION_CODE
    quick_stop, fault = objects.QUICK_STOP_OPTION_CODE, objects.FAULT_REACTION_OPTION_CODE
    guards = [
        DriveGuard("interpolation time period value", period, 1, U8, value),
        DriveGuard("interpolation time index", period, 2, I8, exponent),
        DriveGuard("communication cycle period", cycle, 0, U32, network.cycle_us, is_optional=True),
        DriveGuard("following error window", window, 0, U32, node.following_error_window),
        DriveGuard("abort connection option code", connection, 0, I16, ABORT_CONNECTION_FAULT, is_optional=True),
        DriveGuard("quick stop option code", quick_stop, 0, I16, QUICK_STOP_RAMP, is_optional=True),
        DriveGuard("fault reaction option code", fault, 0, I16, QUICK_STOP_RAMP, is_optional=True),
    ]
    if node.quick_stop_deceleration is not None:
        ramp, deceleration = objects.QUICK_STOP_DECELERATION, node.quick_stop_deceleration
        guards.append(DriveGuard("quick stop deceleration", ramp, 0, U32, deceleration, tolerance=RAMP_TOLERANCE))
    if node.sync_watchdog is not None:
        guards.append(node.sync_watchdog)
    return guards


def heartbeat_guard(network: NetworkSettings) -> DriveGuard:
    """The drive's watch over the gateway's heartbeat."""
    consumer = network.gateway_node_id << 16 | network.heartbeat_timeout_ms
    return DriveGuard("consumer heartbeat time", objects.CONSUMER_HEARTBEAT_TIME, 1, U32, consumer, is_packed=True)


def read_back(master: Master, node: NodeSettings, network: NetworkSettings) -> Procedure[None]:
    """Go on only with a drive that holds what guards it: some take a value without a word, and keep another one."""
    guards = [*parameter_guards(node, network), heartbeat_guard(network)]
    yield from check_guards(master, node.name, node.node_id, guards)


def write_parameters(master: Master, node: NodeSettings, network: NetworkSettings) -> Procedure[None]:
    """Write what the cycle relies on, and check the scales that the drive itself has, where it tells them."""
    node_id = node.node_id
    yield from write_guards(master, node_id, parameter_guards(node, network))
    rated = yield from _read_if_there(master, node_id, objects.MOTOR_RATED_TORQUE, 0)
    increments = yield from _read_if_there(master, node_id, objects.POSITION_ENCODER_RESOLUTION, 1)
    revolutions = yield from _read_if_there(master, node_id, objects.POSITION_ENCODER_RESOLUTION, 2)
    problems: list[str] = []
    most = yield from _read_if_there(master, node_id, objects.MAX_TORQUE, 0, U16)
    if node.torque_limit_permille is not None and most is not None and node.torque_limit_permille >= most:
        problems.append(
            f"node {node_id} gives {most} per mille of its rated torque at most (6072h), at the guard's "
            f"torque.limit_permille of {node.torque_limit_permille} it can never trip"
        )
    if rated is not None and rated != node.rated_torque_mNm:
        problems.append(
            f"node {node_id} has a rated torque of {rated} mN m (6076h), the configuration says {node.rated_torque_mNm}"
        )
    if increments is None or revolutions is None:
        increments, revolutions = node.counts_per_revolution, 1
    if revolutions == 0 or increments != node.counts_per_revolution * revolutions:
        problems.append(
            f"node {node_id} has {increments} increments in {revolutions} revolutions (608Fh), "
            f"the configuration says {node.counts_per_revolution} a revolution"
        )
    if problems:
        raise CommissioningError(problems)


def _read_if_there(
    master: Master, node_id: int, index: int, subindex: int, data_type: DataType = U32
) -> Procedure[int | None]:
    """Read an integer that the standard leaves optional; None from a drive that does not have it."""
    try:
        return (yield from master.read_int(node_id, index, subindex, data_type))
    except SdoAbortedError as error:
        if not is_absence(error):
            raise
        return None


def map_pdos(master: Master, node: NodeSettings) -> Procedure[None]:
    """Map the first RPDO and TPDO as the cycle needs them, synchronous, and switch all others off."""
    node_id = node.node_id
    for number in range(1, PDO_COUNT):
        yield from _disable_pdo(master, node_id, objects.RPDO_COMMUNICATION + number)
        yield from _disable_pdo(master, node_id, objects.TPDO_COMMUNICATION + number)
    yield from map_pdo(
        master,
        node_id,
        objects.RPDO_COMMUNICATION,
        objects.RPDO_MAPPING,
        RPDO_BASE[0] + node_id,
        TORQUE_RPDO_ENTRIES if node.is_torque_controlled else RPDO_ENTRIES,
    )
    yield from map_pdo(
        master,
        node_id,
        objects.TPDO_COMMUNICATION,
        objects.TPDO_MAPPING,
        (TPDO_BASE[0] + node_id) | PDO_COB_ID_NO_RTR,
        TPDO_ENTRIES,
    )


def _disable_pdo(master: Master, node_id: int, communication: int) -> Procedure[None]:
    """Set bit 31 and keep the rest, as some drives demand; a PDO that the drive does not have is no fault."""
    try:
        cob_id = yield from master.read_int(node_id, communication, 1, U32)
    except SdoAbortedError:
        return
    if not cob_id & PDO_COB_ID_INVALID:
        yield from master.write(node_id, communication, 1, U32, cob_id | PDO_COB_ID_INVALID)


def map_pdo(
    master: Master, node_id: int, communication: int, mapping: int, cob_id: int, entries: Sequence[MappingEntry]
) -> Procedure[None]:
    """Map one PDO in the order that CiA 301 prescribes: invalid, no entries, entries, their number, valid."""
    current = yield from master.read_int(node_id, communication, 1, U32)
    yield from master.write(node_id, communication, 1, U32, current | PDO_COB_ID_INVALID)
    yield from master.write(node_id, communication, 2, U8, SYNCHRONOUS_EVERY_SYNC)
    yield from master.write(node_id, mapping, 0, U8, 0)
    for number, entry in enumerate(entries, start=1):
        yield from master.write(node_id, mapping, number, U32, entry.word)
    yield from master.write(node_id, mapping, 0, U8, len(entries))
    yield from master.write(node_id, communication, 1, U32, cob_id)


def set_up_heartbeats(master: Master, node: NodeSettings, network: NetworkSettings) -> Procedure[None]:
    """The drive's heartbeat, its watch over the gateway's, and our watch over the drive's."""
    node_id = node.node_id
    yield from write_guards(master, node_id, [heartbeat_guard(network)])
    yield from master.write(node_id, objects.PRODUCER_HEARTBEAT_TIME, 0, U16, network.heartbeat_ms)
    master.watch_heartbeat(node_id, network.heartbeat_timeout_ms / 1000.0)


def hear_heartbeat(master: Master, node: NodeSettings, network: NetworkSettings, since_ns: int) -> Procedure[None]:
    """Go on only with a drive whose heartbeat has been heard: one that sends none could fall silent unnoticed."""
    remote = master.nodes[node.node_id]
    timeout_s = network.heartbeat_timeout_ms / 1000.0
    heard = yield from master.wait_for(lambda: remote.heartbeat_at_ns > since_ns, timeout_s)
    if not heard:
        raise NoAnswerError(node.node_id, "its heartbeat", timeout_s)


def release_heartbeat(master: Master, node: NodeSettings) -> Procedure[None]:
    """Let the drive watch over the gateway no more."""
    yield from master.write(node.node_id, objects.CONSUMER_HEARTBEAT_TIME, 1, U32, 0)


def start_nodes(master: Master, nodes: Sequence[NodeSettings]) -> None:
    """NMT start, node by node: nodes that are not ours stay as they are."""
    for node in nodes:
        master.command(NmtCommand.START, node.node_id)
