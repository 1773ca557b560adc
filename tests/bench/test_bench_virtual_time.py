"""How fast virtual time is, and where its time goes: printed, never asserted. Run with -m bench -s."""

import gc
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from config.loading import load_config
from drivers.frame import Frame
from drivers.node import Event, Node
from drivers.virtual_time import VirtualBus
from gateway.running.assembly import build_core
from gateway.running.core import GatewayCore
from gateway.running.preparation import prepare
from gateway.running.virtual_run import run_virtual
from sim_drive.assembly import build_machine

pytestmark = pytest.mark.bench

CONFIG = load_config("paper")
MACHINE_CYCLES = 3
ROUNDS = 5
"""The best of so many is printed: what else the computer does only ever adds."""

Call = tuple[int, Frame | None]
"""One call of a node: when, and the frame of ``receive``, None for ``wake``."""


class NoSink:
    """Throws the samples away."""

    def append(self, *values: float) -> None:
        pass


class Watched:
    """A node that notes what it is told, so that it can be told it again without bus and without opposite."""

    def __init__(self, node: Node) -> None:
        self.node = node
        self.calls: list[Call] = []
        self.next_wake_ns = node.next_wake_ns
        self.take_frames = node.take_frames
        self.take_events = node.take_events

    def receive(self, frame: Frame, now_ns: int) -> None:
        self.calls.append((now_ns, frame))
        self.node.receive(frame, now_ns)

    def wake(self, now_ns: int) -> None:
        self.calls.append((now_ns, None))
        self.node.wake(now_ns)


class Script:
    """Sends frames that another node has sent, each when it reached the bus; hears nothing and answers nothing."""

    def __init__(self, frames: list[tuple[int, Frame]]) -> None:
        self.frames = frames[::-1]
        self.out: list[Frame] = []

    def receive(self, frame: Frame, now_ns: int) -> None:
        pass

    def next_wake_ns(self) -> int | None:
        return self.frames[-1][0] if self.frames else None

    def wake(self, now_ns: int) -> None:
        while self.frames and self.frames[-1][0] <= now_ns:
            self.out.append(self.frames.pop()[1])

    def take_frames(self) -> list[Frame]:
        frames = self.out
        if frames:
            self.out = []
        return frames

    def take_events(self) -> list[Event]:
        return []


def ignore_event(_node: int, _event: Event) -> None:
    pass


def gateway_core() -> GatewayCore:
    prepared = prepare(CONFIG, MACHINE_CYCLES)
    return build_core(CONFIG, prepared.cam.profile, prepared.plan, NoSink())


def repeat(node: Node, calls: list[Call]) -> None:
    """Make the same calls of a node again, and ask it all that a host asks it after each."""
    for now_ns, frame in calls:
        if frame is None:
            node.wake(now_ns)
        else:
            node.receive(frame, now_ns)
        node.take_frames()
        node.next_wake_ns()
        node.take_events()


@contextmanager
def without_collector() -> Iterator[None]:
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


def best_us(prepare_round: Callable[[], Callable[[], object]], cycles: int) -> float:
    """CPU time in us a cycle of what ``prepare_round()`` gives, the best of several rounds."""
    spent: list[int] = []
    for _ in range(ROUNDS):
        work = prepare_round()
        with without_collector():
            begin = time.thread_time_ns()
            work()
            spent.append(time.thread_time_ns() - begin)
    return min(spent) / cycles / 1000


def test_the_whole_system(tmp_path: Path) -> None:
    """Two axes at 1 kHz, gateway and machine, all frames on the bus, from boot-up to disabled drives."""
    print()
    prepared = prepare(CONFIG, MACHINE_CYCLES)
    cycles = run_virtual(prepared, build_machine(CONFIG), tmp_path / "first.mcap", "", 0).loop.cycle
    cycle_us = CONFIG.cycle_s * 1e6

    def recorded(with_frames: bool) -> Callable[[], object]:
        machine = build_machine(CONFIG)
        path = tmp_path / "run.mcap"
        return lambda: run_virtual(prepared, machine, path, "", 0, is_overwriting=True, with_frames=with_frames)

    def unrecorded() -> Callable[[], object]:
        core = gateway_core()
        bus = VirtualBus([core, build_machine(CONFIG)], CONFIG.bus.bit_rate, on_event=ignore_event)
        return lambda: bus.run_while(lambda: not core.is_done, 1 << 62)

    for name, prepare_round in (
        ("samples and frames recorded", lambda: recorded(True)),
        ("samples recorded", lambda: recorded(False)),
        ("nothing recorded", unrecorded),
    ):
        us = best_us(prepare_round, cycles)
        print(f"whole system, {name}: {us:.1f} us of CPU a cycle, {cycle_us / us:.1f} machine seconds a second")


def test_where_the_time_goes() -> None:
    """Each node alone, told what it was told in a whole run; and the bus with nodes that only send."""
    print()
    core, machine = Watched(gateway_core()), Watched(build_machine(CONFIG))
    traffic: list[tuple[int, Frame]] = []
    bus = VirtualBus([core, machine], CONFIG.bus.bit_rate, 0, lambda at_ns, frame: traffic.append((at_ns, frame)))
    assert isinstance(core.node, GatewayCore)
    gateway = core.node
    bus.run_while(lambda: not gateway.is_done, 1 << 62)
    cycles = gateway.loop.cycle
    print(f"{cycles} cycles, {len(traffic) / cycles:.2f} frames a cycle")

    def gateway_alone() -> Callable[[], object]:
        node = gateway_core()
        return lambda: repeat(node, core.calls)

    def machine_alone() -> Callable[[], object]:
        node = build_machine(CONFIG)
        return lambda: repeat(node, machine.calls)

    def bus_alone() -> Callable[[], object]:
        senders = [
            Script([sent for sent in traffic if (sent[1].cob_id & 0x780 in {0x180, 0x580, 0x700}) is of_drive])
            for of_drive in (False, True)
        ]
        empty = VirtualBus(senders, CONFIG.bus.bit_rate, on_event=ignore_event)
        return lambda: empty.run_until(bus.now_ns)

    def asking_alone() -> Callable[[], object]:
        nothing = Script([])
        return lambda: (repeat(nothing, core.calls), repeat(nothing, machine.calls))

    overhead = best_us(asking_alone, cycles)
    print(f"(asking a node that does nothing, both nodes' calls together: {overhead:.1f} us a cycle)")
    for name, prepare_round, calls in (
        ("gateway", gateway_alone, len(core.calls)),
        ("emulated machine", machine_alone, len(machine.calls)),
        ("bus between two scripts", bus_alone, len(traffic)),
    ):
        us = best_us(prepare_round, cycles)
        print(f"{name}: {us:.1f} us of CPU a cycle, {calls / cycles:.2f} calls or frames a cycle")
