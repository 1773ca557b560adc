"""The loops that the gateway's is measured against: a bare one of sockets and struct, and the canopen package's own.

Every cycle is SYNC out, a TPDO of each axis in, an RPDO for each axis out with the position that it has told.
"""

import struct
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import canopen

from drivers.socketcan_port import CAN_FRAME

EDS = Path(__file__).parents[2] / "config" / "eds" / "sim_drive.eds"
SYNC_COB_ID = 0x080
TPDO = struct.Struct("<Hih")
RPDO = struct.Struct("<Hih")
ENABLE_OPERATION = 0x0F

Part = Callable[[], None]


def nothing() -> None:
    """Where there is nothing to do while the loop would wait."""


def bare_cycle(
    send: Callable[[bytes], int], receive: Callable[[int], bytes], node_ids: Sequence[int], controlword: int
) -> Callable[[Part], None]:
    """What cannot be less in Python: sockets and struct, no clock, no check, no record.

    The cycle calls what it is given where it waits for the TPDOs; it gives up those that time out.
    """
    pack, unpack = CAN_FRAME.pack, CAN_FRAME.unpack
    sync = pack(SYNC_COB_ID, 0, b"")
    slots = {0x180 + node_id: number for number, node_id in enumerate(node_ids)}
    actuals = [0] * len(node_ids)

    def cycle(answer: Part = nothing) -> None:
        send(sync)
        answer()
        try:
            for _ in node_ids:
                cob_id, _, data = unpack(receive(16))
                _, actuals[slots[cob_id]], _ = TPDO.unpack(data)
        except TimeoutError:
            pass
        for number, node_id in enumerate(node_ids):
            send(pack(0x200 + node_id, 8, RPDO.pack(controlword, actuals[number], 0)))

    return cycle


def mapped_nodes(network: canopen.Network, node_ids: Sequence[int]) -> list[canopen.RemoteNode]:
    """Nodes with the mapping that commissioning gives the drives, without asking one."""
    return [map_pdos(network.add_node(node_id, str(EDS))) for node_id in node_ids]


def map_pdos(node: canopen.RemoteNode) -> canopen.RemoteNode:
    for pdo, cob_id, indices in (
        (node.tpdo[1], 0x180 + node.id, (0x6041, 0x6064, 0x6077)),
        (node.rpdo[1], 0x200 + node.id, (0x6040, 0x607A, 0x60B2)),
    ):
        pdo.clear()
        for index in indices:
            pdo.add_variable(index)
        pdo.cob_id = cob_id
        pdo.enabled = True
        pdo.subscribe()
    return node


def send_demands(nodes: Sequence[canopen.RemoteNode]) -> None:
    """The package's way to answer a cycle: objects read and written by name, and a PDO sent."""
    for node in nodes:
        actual = node.tpdo[1][1].raw
        enabled = node.tpdo[1][0].raw & 0x6F == 0x27
        node.rpdo[1][0].raw = ENABLE_OPERATION if enabled else 0
        node.rpdo[1][1].raw = actual
        node.rpdo[1][2].raw = 0
        node.rpdo[1].transmit()


def canopen_cycle(
    network: canopen.Network, nodes: Sequence[canopen.RemoteNode], wait: Callable[[Part], None]
) -> Callable[[Part], None]:
    """The package's own cycle; ``wait(answer)`` brings it the TPDOs."""

    def cycle(answer: Part = nothing) -> None:
        network.sync.transmit()
        wait(answer)
        send_demands(nodes)

    return cycle


def waiting_for(nodes: Sequence[canopen.RemoteNode], timeout_s: float) -> Callable[[Part], None]:
    """A notifier's thread takes what comes, and the loop waits for it."""

    def wait(_: Part) -> None:
        for node in nodes:
            node.tpdo[1].wait_for_reception(timeout=timeout_s)

    return wait


def paced_us(cycle: Callable[[], None], count: int, period_s: float) -> float:
    """CPU time (us) a cycle of the whole process, its cycles begun at absolute instants."""
    due = time.monotonic()
    begin = time.process_time_ns()
    for _ in range(count):
        cycle()
        due += period_s
        time.sleep(max(0.0, due - time.monotonic()))
    return (time.process_time_ns() - begin) / count / 1000
