"""The SYNC cycle of two axes on the virtual bus, against the wire budget worked out by hand."""

import random
from collections.abc import Sequence

from drivers.frame import Frame
from drivers.node import Event
from drivers.virtual_time import VirtualBus

MILLISECOND = 1_000_000
SYNC = Frame(0x080)
RPDOS = [Frame(0x201, bytes(8)), Frame(0x202, bytes(8))]


class Core:
    def __init__(self) -> None:
        self.out: list[Frame] = []
        self.due_ns: int | None = None

    def receive(self, frame: Frame, now_ns: int) -> None:
        raise NotImplementedError

    def next_wake_ns(self) -> int | None:
        return self.due_ns

    def wake(self, now_ns: int) -> None:
        raise NotImplementedError

    def take_frames(self) -> list[Frame]:
        frames, self.out = self.out, []
        return frames

    def take_events(self) -> list[Event]:
        return []


class Master(Core):
    """A SYNC every millisecond; both RPDOs once both TPDOs are there."""

    def __init__(self) -> None:
        super().__init__()
        self.due_ns: int | None = 0
        self.heard = 0
        self.complete_cycles = 0

    def wake(self, now_ns: int) -> None:
        self.out.append(SYNC)
        self.heard = 0
        self.due_ns = now_ns + MILLISECOND

    def receive(self, frame: Frame, now_ns: int) -> None:
        self.heard += 1
        if self.heard == 2:
            self.complete_cycles += 1
            self.out += RPDOS


class Drive(Core):
    """Answers a SYNC at once."""

    def __init__(self, node_id: int) -> None:
        super().__init__()
        self.tpdo = Frame(0x180 + node_id, bytes(8))

    def receive(self, frame: Frame, now_ns: int) -> None:
        if frame == SYNC:
            self.out.append(self.tpdo)


def run(milliseconds: int, faults: "Losses | None" = None, seed: int = 0) -> tuple[VirtualBus, Master, list[str]]:
    trace: list[str] = []
    master = Master()
    # The second drive stands before the first: the order on the wire comes from the COB-IDs.
    bus = VirtualBus(
        [Drive(2), Drive(1), master],
        1_000_000,
        seed,
        lambda now_ns, frame: trace.append(f"{now_ns} {frame.cob_id:03X}"),
        faults,
    )
    bus.run_until(milliseconds * MILLISECOND - 1)
    return bus, master, trace


def test_a_cycle_of_two_axes_takes_595_us_of_a_megabit_bus() -> None:
    """SYNC 55 bits, four PDOs of 8 bytes 135 bits each; nothing waits, so the cycle ends after 595 us."""
    bus, master, trace = run(3)
    one_cycle = [(55_000, "080"), (190_000, "181"), (325_000, "182"), (460_000, "201"), (595_000, "202")]
    assert trace == [f"{cycle * MILLISECOND + at_ns} {cob_id}" for cycle in range(3) for at_ns, cob_id in one_cycle]
    assert bus.busy_ns == 3 * 595_000
    assert master.complete_cycles == 3


class Losses:
    """Loses every tenth TPDO or so."""

    def delays_ns(self, sender: int, frame: Frame, now_ns: int, source: random.Random) -> Sequence[int]:
        return () if 0x181 <= frame.cob_id <= 0x1FF and source.random() < 0.1 else (0,)


def test_lost_tpdos_cost_their_cycle_alone_and_the_seed_decides_which() -> None:
    _, master, trace = run(1000, Losses(), seed=1)
    lost = 2000 - sum(line.endswith(("181", "182")) for line in trace)
    assert 100 < lost < 300
    assert 1000 - lost <= master.complete_cycles < 1000
    assert sum(line.endswith("080") for line in trace) == 1000
    assert run(1000, Losses(), seed=1)[2] == trace
    assert run(1000, Losses(), seed=2)[2] != trace
