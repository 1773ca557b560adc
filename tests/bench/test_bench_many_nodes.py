"""How fast 127 emulated drives on one bus are in virtual time: printed, never asserted. Run with -m bench -s."""

import struct
import time
from collections import Counter

import pytest

from drivers.frame import Frame
from drivers.node import Event
from drivers.virtual_time import VirtualBus
from sim_drive.assembly import free_machine
from sim_drive.injection.faults import Fault, FaultKind
from sim_drive.injection.injector import Injector

pytestmark = pytest.mark.bench

MS = 1_000_000
SECOND = 1_000_000_000
SYNC_PERIOD_NS = 10 * MS
HEARTBEAT_MS = 100
CONFIGURATION_NS = 2 * MS
"""Between two SDO requests of the master: answered long before."""


class Master:
    """Configures TPDO 1 of every node to every SYNC, its heartbeat to 100 ms, starts all, then sends SYNCs."""

    def __init__(self, node_ids: range, sync_period_ns: int = SYNC_PERIOD_NS) -> None:
        self.sync_period_ns = sync_period_ns
        self.requests: list[Frame] = []
        for node_id in node_ids:
            for index, subindex, size, value in (
                (0x1800, 2, 1, 1),
                (0x1800, 1, 4, 0x180 + node_id),
                (0x1017, 0, 2, HEARTBEAT_MS),
            ):
                data = struct.pack("<BHBI", 0x23 | (4 - size) << 2, index, subindex, value)
                self.requests.append(Frame(0x600 + node_id, data))
        self.requests.append(Frame(0x000, b"\x01\x00"))
        self.requests.reverse()
        self.due_ns = MS
        self.out: list[Frame] = []

    def receive(self, frame: Frame, now_ns: int) -> None:
        assert not (frame.cob_id & 0x780 == 0x580 and frame.data[0] == 0x80), frame

    def next_wake_ns(self) -> int | None:
        return self.due_ns

    def wake(self, now_ns: int) -> None:
        if self.requests:
            self.out.append(self.requests.pop())
            self.due_ns += CONFIGURATION_NS
        else:
            self.out.append(Frame(0x080))
            self.due_ns += self.sync_period_ns

    def take_frames(self) -> list[Frame]:
        frames, self.out = self.out, []
        return frames

    def take_events(self) -> list[Event]:
        return []


@pytest.mark.parametrize("nodes", [16, 64, 127])
def test_many_nodes_with_heartbeat_and_synchronous_pdos(nodes: int) -> None:
    """Heartbeats every 100 ms, and TPDO 1 of every node at a SYNC of 100 Hz; on a bus of 10 Mbit/s for 127 of them.

    At 1 Mbit/s, 127 TPDOs of up to 8 bytes take up to 17 ms, so that only every other SYNC could be answered in time.
    """
    node_ids = range(1, nodes + 1)
    master = Master(node_ids)
    seen: Counter[int] = Counter()

    def count(now_ns: int, frame: Frame) -> None:
        seen[frame.cob_id & 0x780] += 1

    machine = free_machine(node_ids)
    bus = VirtualBus([master, machine], 10_000_000, trace=count)
    assert bus.run_while(lambda: bool(master.requests), 10 * SECOND)
    begin_ns = bus.now_ns + SYNC_PERIOD_NS
    bus.run_until(begin_ns)
    seen.clear()
    ticks = machine.servo_ticks
    begin = time.process_time()
    bus.run_until(begin_ns + SECOND)
    spent_s = time.process_time() - begin
    assert machine.servo_ticks - ticks == 1024
    assert seen[0x180] == pytest.approx(nodes * 100, rel=0.02)
    assert seen[0x700] == pytest.approx(nodes * 10, rel=0.02)
    print(f"\n{nodes} nodes: {sum(seen.values())} frames, {1 / spent_s:.2f} machine seconds a second of CPU")


@pytest.mark.parametrize("faults", [0, 1, 100])
def test_what_faults_cost(faults: int) -> None:
    """Two drives with SYNC at 1 kHz: bare, and with faults that concern frames which never come."""
    node_ids = range(1, 3)
    spent: list[float] = []
    for _ in range(3):
        master = Master(node_ids, MS)
        machine = free_machine(node_ids)
        idle = [Fault(FaultKind.LOST_FRAMES, 1, cob_id=0x7F0)] * faults
        node = Injector(machine, idle) if faults else machine
        bus = VirtualBus([master, node], 1_000_000)
        bus.run_until(SECOND // 10)
        begin = time.process_time()
        bus.run_until(SECOND // 10 + SECOND)
        spent.append(time.process_time() - begin)
    print(f"\n{faults} idle faults: {min(spent) * 1e3:.1f} us of CPU a cycle")
