"""The coupled five-bar on one two-axis node: what two nodes do, in the same counts at the same nanoseconds."""

import struct

from config.loading import load_config
from drivers.frame import Frame
from sim_drive.assembly import build_machine
from sim_drive.injection.faults import Fault, FaultKind
from sim_drive.injection.injector import Injector
from sim_drive.machine import EmulatedMachine

CONFIG = load_config("paper")
MS = 1_000_000
CYCLES = 400
SPEED = 20
"""Counts a millisecond."""


class Master:
    """Hand-written frames: SDO downloads, one RPDO an axis, SYNC; ``shifts`` are (node id, 800h shift) of each axis."""

    def __init__(self, machine: EmulatedMachine | Injector, shifts: list[tuple[int, int]]) -> None:
        self.machine = machine
        self.shifts = shifts
        self.now_ns = 0
        self.wait(5)

    def wait(self, span_ms: int) -> None:
        end_ns = self.now_ns + span_ms * MS
        while (due_ns := self.machine.next_wake_ns()) is not None and due_ns <= end_ns:
            self.now_ns = max(self.now_ns, due_ns)
            self.machine.wake(self.now_ns)
        self.now_ns = end_ns
        self.machine.take_frames()

    def send(self, cob_id: int, data: bytes = b"") -> list[Frame]:
        self.machine.receive(Frame(cob_id, data), self.now_ns)
        return self.machine.take_frames()

    def write(self, node_id: int, index: int, subindex: int, value: int, size: int) -> None:
        request = struct.pack("<BHB", 0x23 | (4 - size) << 2, index, subindex) + value.to_bytes(4, "little")
        (answer,) = (frame for frame in self.send(0x600 + node_id, request) if frame.cob_id == 0x580 + node_id)
        assert answer.data[0] == 0x60, answer

    def prepare(self) -> None:
        for place, (node_id, shift) in enumerate(self.shifts):
            pdo = 0x40 * (shift // 0x800)
            first = 0x6000 + shift
            for communication, mapping, cob_id, words in (
                (0x1400, 0x1600, 0x210 + place, (first + 0x40 << 16 | 16, first + 0x7A << 16 | 32)),
                (0x1800, 0x1A00, 0x190 + place, (first + 0x41 << 16 | 16, first + 0x64 << 16 | 32)),
            ):
                self.write(node_id, communication + pdo, 1, 0x80000000 | cob_id, 4)
                self.write(node_id, mapping + pdo, 0, 0, 1)
                for number, word in enumerate(words, start=1):
                    self.write(node_id, mapping + pdo, number, word, 4)
                self.write(node_id, mapping + pdo, 0, len(words), 1)
                self.write(node_id, communication + pdo, 2, 1, 1)
                self.write(node_id, communication + pdo, 1, cob_id, 4)
            self.write(node_id, first + 0xC2, 1, 1, 1)
            self.write(node_id, first + 0x60, 0, 8, 1)
        self.send(0x000, bytes((1, 0)))
        self.wait(5)
        for word in (0x06, 0x07, 0x0F):
            for node_id, shift in self.shifts:
                self.write(node_id, 0x6040 + shift, 0, word, 2)

    def cycle(self, targets: list[int]) -> dict[int, tuple[int, int]]:
        """Statusword and position by the COB-ID of the TPDO."""
        for place, target in enumerate(targets):
            self.send(0x210 + place, struct.pack("<Hi", 0x0F, target))
        answers = self.send(0x080)
        self.wait(1)
        return {frame.cob_id: struct.unpack("<Hi", frame.data) for frame in answers if frame.cob_id in (0x190, 0x191)}


def drive_both(machine: EmulatedMachine, shifts: list[tuple[int, int]]) -> list[dict[int, tuple[int, int]]]:
    """The master axis forwards, the slave a little backwards and forwards: both move, and drag each other."""
    master = Master(machine, shifts)
    master.prepare()
    start = master.cycle([0, 0])
    counts = [start[0x190][1], start[0x191][1]]
    seen: list[dict[int, tuple[int, int]]] = []
    for cycle in range(CYCLES):
        target = [counts[0] + min(cycle, 200) * SPEED // 20, counts[1] - (cycle if cycle < 200 else 400 - cycle) // 2]
        seen.append(master.cycle(target))
    return seen


def test_one_node_of_two_axes_moves_the_linkage_as_two_nodes_do():
    two = drive_both(build_machine(CONFIG, seed=1), [(1, 0), (2, 0)])
    one = drive_both(build_machine(CONFIG, seed=1, in_one_node=True), [(1, 0), (1, 0x800)])
    assert one == two
    assert all(status & 0x6F == 0x27 for answers in one for status, _ in answers.values())
    assert one[-1][0x190][1] - one[0][0x190][1] > 150
    assert len({position for answers in one for position in (answers[0x191][1],)}) > 50


def test_a_fault_of_one_axis_leaves_the_other_enabled():
    injector = Injector(build_machine(CONFIG, in_one_node=True), [Fault(FaultKind.OVER_CURRENT, 1, at_s=0.1, axis=2)])
    master = Master(injector, [(1, 0), (1, 0x800)])
    master.prepare()
    for _ in range(200):
        answers = master.cycle([0, 0])
    assert answers[0x190][0] & 0x6F == 0x27
    assert answers[0x191][0] & 0x4F == 0x08
