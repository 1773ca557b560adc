"""What one cycle of two axes costs the gateway's processor, beside the canopen package's: printed, never asserted.

No pacing and no waiting: CPU time of the master's side alone, measured around what it does. Run with -m bench -s.
"""

import gc
import time
from collections.abc import Iterator

import can
import canopen
import pytest
from peer_loops import TPDO, mapped_nodes, send_demands

from config.loading import load_config
from drivers.frame import Frame
from drivers.python_can_port import PythonCanPort
from drivers.virtual_time import VirtualBus
from gateway.record.sample import Phase, SampleLayout
from gateway.running.assembly import build_core
from gateway.running.core import GatewayCore
from gateway.running.preparation import prepare
from sim_drive.assembly import build_machine

pytestmark = pytest.mark.bench

CONFIG = load_config("paper")
NODE_IDS = [axis.node_id for axis in CONFIG.ordered_axes]
ROUNDS = 3
"""The best of so many is printed: what else the computer does only ever adds."""
CYCLES = 3000

Call = tuple[int, Frame | None]
"""When the gateway was called, and with which frame; None for a wake."""


class PackingSink:
    """Packs every sample, as the ring does, and keeps the last one."""

    def __init__(self) -> None:
        self.layout = SampleLayout(CONFIG.axis_names)
        self.buffer = bytearray(self.layout.size)

    def append(self, *values: float) -> None:
        self.layout.pack_into(self.buffer, 0, *values)


class Witness:
    """A gateway core on a bus, with a note of every call."""

    def __init__(self, core: GatewayCore) -> None:
        self.core = core
        self.calls: list[Call] = []
        self.next_wake_ns = core.next_wake_ns
        self.take_frames = core.take_frames
        self.take_events = core.take_events

    def receive(self, frame: Frame, now_ns: int) -> None:
        self.calls.append((now_ns, frame))
        self.core.receive(frame, now_ns)

    def wake(self, now_ns: int) -> None:
        self.calls.append((now_ns, None))
        self.core.wake(now_ns)


def new_core() -> GatewayCore:
    prepared = prepare(CONFIG, 3)
    return build_core(CONFIG, prepared.cam.profile, prepared.plan, PackingSink())


@pytest.fixture(scope="module")
def calls() -> tuple[list[Call], int]:
    """What a gateway is told from boot-up to well within the motion, and where the steady motion begins."""
    witness = Witness(new_core())
    bus = VirtualBus([witness, build_machine(CONFIG)], CONFIG.bus.bit_rate)
    loop = witness.core.loop
    bus.run_while(lambda: loop.steering.phase is not Phase.CAM, 1 << 62)
    start = len(witness.calls)
    first = loop.cycle
    bus.run_while(lambda: loop.cycle < first + CYCLES, 1 << 62)
    assert loop.steering.phase is Phase.CAM
    return witness.calls, start


@pytest.fixture(autouse=True)
def without_collector() -> Iterator[None]:
    gc.collect()
    gc.disable()
    yield
    gc.enable()


def quantiles(values_ns: list[int]) -> str:
    ordered = sorted(values_ns)
    middle, high = ordered[len(ordered) // 2], ordered[len(ordered) * 99 // 100]
    return f"p50 {middle / 1000:.1f} us, p99 {high / 1000:.1f} us, max {ordered[-1] / 1000:.1f} us"


def test_the_core_alone(calls: tuple[list[Call], int]) -> None:
    """A canned machine: the frames of a run are given to a gateway's core once more, and its answers are counted."""
    print()
    told, start = calls
    best_us = float("inf")
    for _ in range(ROUNDS):
        core = new_core()
        for now_ns, frame in told[:start]:
            core.wake(now_ns) if frame is None else core.receive(frame, now_ns)
            core.take_frames()
        sent = 0
        answers: list[int] = []
        begin = time.thread_time_ns()
        for now_ns, frame in told[start:]:
            at = time.perf_counter_ns()
            core.wake(now_ns) if frame is None else core.receive(frame, now_ns)
            frames = core.take_frames()
            core.next_wake_ns()
            sent += len(frames)
            if len(frames) == len(NODE_IDS):
                answers.append(time.perf_counter_ns() - at)
        best_us = min(best_us, (time.thread_time_ns() - begin) / CYCLES / 1000)
    print(
        f"gateway's core, {len(NODE_IDS)} axes, {sent / CYCLES:.2f} frames sent a cycle: "
        f"{best_us:.1f} us of CPU a cycle; from the last TPDO to the RPDOs {quantiles(answers)} of wall clock"
    )


class CannedDrives:
    """The other end of a python-can bus: it answers from a list and throws away what it hears."""

    def __init__(self, channel: str) -> None:
        self.bus = can.Bus(interface="virtual", channel=channel)

    def answer(self, cob_id: int, data: bytes) -> None:
        self.bus.send(can.Message(arbitration_id=cob_id, data=data, is_extended_id=False))

    def heard(self) -> int:
        count = 0
        while self.bus.recv(0) is not None:
            count += 1
        return count


def test_against_the_canopen_package(calls: tuple[list[Call], int]) -> None:
    """The same exchange over python-can's virtual bus: SYNC out, two TPDOs in, two RPDOs out, at constant targets.

    The gateway does more in it: cam, guard, session and the sample's record.
    """
    print()
    gateway_us = min(over_python_can(calls) for _ in range(ROUNDS))
    canopen_us = min(with_canopen() for _ in range(ROUNDS))
    print(f"over python-can's virtual bus: gateway {gateway_us:.1f} us of CPU a cycle, canopen {canopen_us:.1f} us")


def over_python_can(calls: tuple[list[Call], int]) -> float:
    told, start = calls
    drives = CannedDrives("gateway")
    port = PythonCanPort.open("virtual", "gateway")
    core = new_core()
    for now_ns, frame in told[:start]:
        core.wake(now_ns) if frame is None else core.receive(frame, now_ns)
        core.take_frames()
    spent_ns = sent = 0
    for now_ns, frame in told[start:]:
        if frame is not None:
            drives.answer(frame.cob_id, frame.data)
        begin = time.thread_time_ns()
        if frame is None:
            core.wake(now_ns)
        else:
            received = port.receive()
            assert received is not None
            core.receive(received[0], now_ns)
        for out in core.take_frames():
            port.send(out)
        core.next_wake_ns()
        spent_ns += time.thread_time_ns() - begin
        sent += drives.heard()
    port.close()
    drives.bus.shutdown()
    assert sent >= CYCLES * 3 - 3
    return spent_ns / CYCLES / 1000


def with_canopen() -> float:
    drives = CannedDrives("canopen")
    bus = can.Bus(interface="virtual", channel="canopen")
    network = canopen.Network()
    network.bus = bus  # no notifier: its thread would be measured with it
    nodes = mapped_nodes(network, NODE_IDS)
    spent_ns = sent = 0
    for cycle in range(CYCLES):
        begin = time.thread_time_ns()
        network.sync.transmit()
        spent_ns += time.thread_time_ns() - begin
        for node_id in NODE_IDS:
            drives.answer(0x180 + node_id, TPDO.pack(0x1637, cycle, 0))
        begin = time.thread_time_ns()
        for _ in NODE_IDS:
            message = bus.recv(0)
            assert message is not None
            network.notify(message.arbitration_id, message.data, message.timestamp)
        send_demands(nodes)
        spent_ns += time.thread_time_ns() - begin
        sent += drives.heard()
    bus.shutdown()
    drives.bus.shutdown()
    assert sent == CYCLES * 3
    return spent_ns / CYCLES / 1000
