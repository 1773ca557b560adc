"""CPU time a cycle at 1 kHz over loopback: the gateway's host and core, the canopen package, a bare loop.

The same responder, a process of its own, answers all of them with the TPDOs of a recorded run. To the gateway it also
sends SYNC, as the kernel does on SocketCAN. Printed, never asserted. Run with -m bench -s;
``DRIVE_GATEWAY_BENCH_S`` (2) chooses the seconds of each loop.
"""

import gc
import os
import pickle
import select
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import can
import canopen
import pytest
from peer_loops import ENABLE_OPERATION, bare_cycle, canopen_cycle, mapped_nodes, paced_us, waiting_for
from test_bench_cycle import NODE_IDS, Call, calls, new_core
from test_bench_loop import LoopbackBus, canned

from drivers.frame import Frame
from drivers.real_time import tighten_timers
from drivers.socketcan_port import CAN_FRAME, SocketcanPort
from gateway.running.cycle_host import CycleHost

pytestmark = pytest.mark.bench
__all__ = ["calls"]

ROOT = Path(__file__).parents[2]
PERIOD_S = 0.001
SPAN_S = min(float(os.environ.get("DRIVE_GATEWAY_BENCH_S", "2")), 2.5)
CYCLES = round(SPAN_S / PERIOD_S)
ROUNDS = 3

RESPONDER = """
import pickle, socket, struct, sys, time
frame = struct.Struct("=IB3x8s")
end = socket.socket(fileno=int(sys.argv[1]))
answers = pickle.loads(sys.stdin.buffer.read())
sends_sync = sys.argv[2] == "sync"
heartbeats = [frame.pack(0x701, 1, b"\\x05"), frame.pack(0x702, 1, b"\\x05")]
sync = frame.pack(0x080, 0, b"")
print("ready", flush=True)
end.recv(16)
due = time.monotonic()
for number, answer in enumerate(answers):
    if sends_sync:
        end.send(sync)
    else:
        while frame.unpack(end.recv(16))[0] != 0x080:
            pass
    for one in answer:
        end.send(one)
    if number % 50 == 0 and sends_sync:
        for one in heartbeats:
            end.send(one)
    if sends_sync:
        due += 0.001
        end.setblocking(False)
        try:
            while True:
                end.recv(16)
        except BlockingIOError:
            pass
        end.setblocking(True)
        time.sleep(max(0.0, due - time.monotonic()))
while True:
    end.recv(16)
"""


@pytest.fixture(autouse=True)
def without_collector() -> Iterator[None]:
    gc.collect()
    gc.disable()
    yield
    gc.enable()


@contextmanager
def responder(answers: list[list[bytes]], mode: str) -> Iterator[socket.socket]:
    """The near end of a responder that starts with the first frame it hears."""
    near, far = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
    for end in (near, far):
        end.bind(("127.0.0.1", 0))
    near.connect(far.getsockname())
    far.connect(near.getsockname())
    command = [sys.executable, "-c", RESPONDER, str(far.fileno()), mode]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, pass_fds=[far.fileno()]) as process:
        far.close()
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.write(pickle.dumps(answers))
        process.stdin.close()
        assert process.stdout.readline() == b"ready\n"
        try:
            yield near
        finally:
            process.kill()
            near.close()


class ShiftedPort:
    """A port whose instants are those of the recorded run that goes on here."""

    def __init__(self, port: SocketcanPort, shift_ns: int) -> None:
        self.port = port
        self.shift_ns = shift_ns
        self.send, self.wait, self.fileno, self.close = port.send, port.wait, port.fileno, port.close

    def receive(self) -> tuple[Frame, int] | None:
        received = self.port.receive()
        return None if received is None else (received[0], received[1] + self.shift_ns)


class Starter:
    """SYNC begins with the first frame that the responder hears."""

    def __init__(self, near: socket.socket) -> None:
        self.near = near
        self.has_started = False

    def start(self) -> None:
        if not self.has_started:
            self.near.send(CAN_FRAME.pack(0x7FF, 0, b""))
        self.has_started = True

    def stop(self) -> None:
        pass

    def retime(self, period_us: int) -> None:
        pass


def gateway_us(told: list[Call], start: int) -> tuple[float, CycleHost]:
    core = new_core()
    while told[start][1] is not None:
        start += 1
    for now_ns, frame in told[:start]:
        core.wake(now_ns) if frame is None else core.receive(frame, now_ns)
        core.take_frames()
    tpdos = [frame for _, frame in told[start:] if frame is not None and frame.cob_id in core.loop.tpdo_slots]
    packed = [CAN_FRAME.pack(frame.cob_id, 8, frame.data) for frame in tpdos]
    answers = [packed[n : n + 2] for n in range(0, min(len(packed) - 1, 2 * CYCLES + 200), 2)]
    last = core.loop.cycle + CYCLES
    with responder(answers, "sync") as near:
        near.setblocking(False)
        near.setsockopt(socket.SOL_SOCKET, 35, 1)  # SO_TIMESTAMPNS
        starter = Starter(near)
        starter.start()
        select.select([near], [], [])
        shift_ns = core.loop.sync_due_ns - time.monotonic_ns()

        def poll() -> None:
            if core.loop.cycle >= last:
                core.is_done = True

        port = ShiftedPort(SocketcanPort("loopback", carrier=near), shift_ns)
        host = CycleHost(core, port, poll, sync=starter, clock=lambda: time.monotonic_ns() + shift_ns)
        begin, first = time.process_time_ns(), core.loop.cycle
        host.run()
        spent_us = (time.process_time_ns() - begin) / (core.loop.cycle - first) / 1000
    return spent_us, host


def bare_us() -> float:
    with responder(canned(CYCLES), "answers") as near:
        near.settimeout(1.0)
        near.send(CAN_FRAME.pack(0x7FF, 0, b""))
        return paced_us(bare_cycle(near.send, near.recv, NODE_IDS, ENABLE_OPERATION), CYCLES, PERIOD_S)


class WaitingBus(LoopbackBus):
    """For the notifier's thread: it waits in the socket, as python-can's socketcan does."""

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        self.near.settimeout(timeout)
        try:
            return super()._recv_internal(timeout)
        except (TimeoutError, OSError):
            return None, False


def canopen_us() -> float:
    with responder(canned(CYCLES), "answers") as near:
        near.send(CAN_FRAME.pack(0x7FF, 0, b""))
        network = canopen.Network(WaitingBus(near))
        network.connect()
        nodes = mapped_nodes(network, NODE_IDS)
        spent_us = paced_us(canopen_cycle(network, nodes, waiting_for(nodes, PERIOD_S)), CYCLES, PERIOD_S)
        network.disconnect()
    return spent_us


@contextmanager
def real_time_priority() -> Iterator[str]:
    """For all alike, the responder's process included; on a busy computer nothing else can be compared."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(10))
    except PermissionError:
        yield "without real-time priority"
        return
    try:
        yield "SCHED_FIFO"
    finally:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def test_paced_at_one_kilohertz(calls: tuple[list[Call], int]) -> None:
    print()
    tighten_timers()
    with real_time_priority() as how:
        rounds = [(gateway_us(*calls)[0], bare_us(), canopen_us()) for _ in range(ROUNDS)]
    ours, floor, package = map(min, zip(*rounds, strict=True))
    print(
        f"1 kHz over loopback, two axes, {how}: gateway {ours:.1f} us of CPU a cycle, bare loop {floor:.1f}, "
        f"canopen package {package:.1f}; gateway : bare {ours / floor:.2f}, gateway : canopen {ours / package:.2f}"
    )
