"""Random faults at random times while random frames arrive: nothing is raised, and afterwards the drives are sound."""

import random
import struct
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.frame import Frame
from drivers.node import Event
from drivers.virtual_time import VirtualBus
from sim_drive.assembly import free_machine
from sim_drive.device.drive import Drive
from sim_drive.injection.faults import FAULTS, Direction, Fault, FaultKind
from sim_drive.injection.injector import FaultEnded, FaultStarted, Injector

SECOND = 1_000_000_000
NODES = (5, 9)
END_S = 1.0
PARAMETERS: dict[str, st.SearchStrategy[Any]] = {
    "error_code": st.integers(1, 0xFFFF),
    "axis": st.just(1),
    "counts": st.integers(-10_000, 10_000).filter(bool),
    "delay_s": st.floats(1e-6, 0.2),
    "index": st.sampled_from([0x1000, 0x1017, 0x1800, 0x6040, 0x6060]),
    "subindex": st.integers(0, 3),
    "abort_code": st.sampled_from([0x06010000, 0x08000022]),
    "cob_id": st.sampled_from([0x000, 0x080, 0x185, 0x585, 0x605, 0x705]),
    "cob_id_mask": st.sampled_from([0x7FF, 0x780, 0]),
    "direction": st.sampled_from(Direction),
    "probability": st.floats(0.01, 1.0),
    "count": st.integers(1, 20),
    "vendor_id": st.integers(0, 0xFFFFFFFF),
    "product_code": st.integers(0, 0xFFFFFFFF),
    "revision_number": st.integers(0, 0xFFFFFFFF),
    "serial_number": st.integers(0, 0xFFFFFFFF),
}


@st.composite
def faults(draw: st.DrawFn) -> Fault:
    """A fault of any kind that begins and ends within the run."""
    kind = draw(st.sampled_from(FaultKind))
    described = FAULTS[kind]
    wanted = [*described.required, *(key for key in described.optional if draw(st.booleans()))]
    if kind is FaultKind.WRONG_IDENTITY and not wanted:
        wanted = ["serial_number"]
    given_parameters = {key: draw(PARAMETERS[key]) for key in wanted}
    at_s = draw(st.floats(0.0, 0.5))
    for_s = draw(st.floats(1e-9, END_S / 2)) if described.has_end else None
    return Fault(kind, draw(st.sampled_from(NODES)), at_s, for_s, **given_parameters)


class Chatter:
    """Sends a random frame every 3 ms, most of them such as drives know; then speaks to them properly."""

    def __init__(self, seed: int) -> None:
        self.source = random.Random(seed)
        self.due_ns: int | None = 0
        self.out: list[Frame] = []
        self.heard: list[Frame] = []

    def receive(self, frame: Frame, now_ns: int) -> None:
        self.heard.append(frame)

    def next_wake_ns(self) -> int | None:
        return self.due_ns

    def wake(self, now_ns: int) -> None:
        source = self.source
        node_id = source.choice(NODES)
        self.out.append(
            source.choice(
                [
                    Frame(0x000, bytes((source.choice([1, 1, 2, 128, 129, 130]), node_id))),
                    Frame(0x080),
                    Frame(0x600 + node_id, bytes((0x2B, 0x40, 0x60, 0, source.choice([6, 7, 15, 128]), 0, 0, 0))),
                    Frame(0x600 + node_id, bytes((0x2F, 0x60, 0x60, 0, source.choice([1, 3, 6, 8]), 0, 0, 0))),
                    Frame(0x600 + node_id, bytes((0x2B, 0x17, 0x10, 0, source.choice([0, 5, 50]), 0, 0, 0))),
                    Frame(0x600 + node_id, source.randbytes(8)),
                    Frame(0x200 + node_id, source.randbytes(source.randrange(9))),
                ]
            )
        )
        self.due_ns = now_ns + 3_000_000

    def take_frames(self) -> list[Frame]:
        frames, self.out = self.out, []
        return frames

    def take_events(self) -> list[Event]:
        return []


@settings(max_examples=25, deadline=None)
@given(st.lists(faults(), max_size=12), st.integers(0, 2**32))
def test_after_all_faults_the_drives_answer_as_ever(drawn: list[Fault], seed: int) -> None:
    """What began has ended; after a reset of all nodes they boot, and are who they are."""
    told: list[Event] = []
    chatter = Chatter(seed)
    machine = free_machine(NODES)
    injector = Injector(machine, drawn, seed)
    bus = VirtualBus([chatter, injector], 1_000_000, on_event=lambda _, event: told.append(event))
    bus.run_until(round(END_S * SECOND) + SECOND // 2)
    chatter.due_ns = None
    # A transfer that the chatter has begun is given up by then, and what was held back has passed.
    bus.run_until(3 * SECOND)
    assert injector.active == ()
    assert sum(isinstance(event, FaultStarted) for event in told) == len(drawn)
    assert sum(isinstance(event, FaultEnded) for event in told) == len(drawn)
    times = [event.at_ns for event in told]
    assert times == sorted(times)

    chatter.heard.clear()
    chatter.out.append(Frame(0x000, b"\x81\x00"))
    bus.run_until(bus.now_ns + SECOND // 10)
    assert [frame for frame in chatter.heard if frame.cob_id > 0x700] == [Frame(0x705, b"\0"), Frame(0x709, b"\0")]
    for node_id in NODES:
        chatter.heard.clear()
        chatter.out.append(Frame(0x600 + node_id, b"\x40\x18\x10\x04\0\0\0\0"))
        bus.run_until(bus.now_ns + SECOND // 100)
        assert chatter.heard == [Frame(0x580 + node_id, b"\x43\x18\x10\x04" + struct.pack("<I", node_id))]
    for place, drive in enumerate(machine.drives):
        assert isinstance(drive, Drive)
        assert not drive.is_powered
        shown, _, _ = drive.axis.latch(bus.now_ns)
        angle_counts = machine.plant.angle(place) * 4096 / 6.283185307179586
        assert abs(shown - angle_counts) <= 1.0, "neither frozen nor displaced"
