"""What the hosts cost, and how late they wake: printed, never asserted. Run with -m bench -s."""

import subprocess
import sys
import time
from collections.abc import Sequence

import pytest

from drivers.frame import Frame
from drivers.node import Event
from drivers.node_runner import NodeRunner
from drivers.ports import Port, interface_is_up, open_port
from drivers.real_time import run_node, tighten_timers
from drivers.virtual_time import VirtualBus

pytestmark = pytest.mark.bench

SYNC = Frame(0x080)
PAYLOAD = bytes(8)
MILLISECOND = 1_000_000

ECHO_SERVER = """
import sys
from drivers.real_time import tighten_timers
from sim_drive.socketcand_server import serve
sys.path.insert(0, "tests/bench")
from test_bench_hosts import Answering
tighten_timers()
serve(Answering(1), "127.0.0.1", 0, "vcan0", lambda: False, lambda _, port: print(port, flush=True))
"""

ECHO_ON_VCAN = """
import sys
from drivers.ports import open_port
from drivers.real_time import run_node, tighten_timers
sys.path.insert(0, "tests/bench")
from test_bench_hosts import Answering
tighten_timers()
port = open_port("socketcan", "vcan0")
print(0, flush=True)
run_node(Answering(1), port, lambda: False)
"""


class Quiet:
    """Never wakes, never sends."""

    def __init__(self) -> None:
        self.out: list[Frame] = []

    def receive(self, frame: Frame, now_ns: int) -> None:
        pass

    def next_wake_ns(self) -> int | None:
        return None

    def wake(self, now_ns: int) -> None:
        pass

    def take_frames(self) -> list[Frame]:
        frames = self.out
        if frames:
            self.out = []
        return frames

    def take_events(self) -> list[Event]:
        return []


class Answering(Quiet):
    """Answers a SYNC with its TPDO."""

    def __init__(self, node_id: int) -> None:
        super().__init__()
        self.tpdo = Frame(0x180 + node_id, PAYLOAD)

    def receive(self, frame: Frame, now_ns: int) -> None:
        if frame.cob_id == 0x080:
            self.out.append(self.tpdo)


class Cyclic(Quiet):
    """Sends its frames every ``period_ns``."""

    def __init__(self, period_ns: int, frames: Sequence[Frame], start_ns: int = 0) -> None:
        super().__init__()
        self.period_ns = period_ns
        self.frames = frames
        self.due_ns = start_ns

    def next_wake_ns(self) -> int | None:
        return self.due_ns

    def wake(self, now_ns: int) -> None:
        self.out.extend(self.frames)
        self.due_ns += self.period_ns


class Pinging(Quiet):
    """Sends the next SYNC when it has heard the answer to the last; notes the arrivals."""

    def __init__(self) -> None:
        super().__init__()
        self.out = [SYNC]
        self.arrivals: list[int] = []

    def receive(self, frame: Frame, now_ns: int) -> None:
        self.arrivals.append(now_ns)
        self.out.append(SYNC)


def percentiles(values_ns: list[int]) -> str:
    ordered = sorted(values_ns)
    p50, p99 = ordered[len(ordered) // 2], ordered[len(ordered) * 99 // 100]
    return f"p50 {p50 / 1000:.1f} us, p99 {p99 / 1000:.1f} us, max {ordered[-1] / 1000:.1f} us"


def test_virtual_time_per_frame_and_wake() -> None:
    print()
    rpdos = [SYNC, Frame(0x201, PAYLOAD), Frame(0x202, PAYLOAD)]
    seconds = 10
    for drives in (1, 2):
        nodes = [Cyclic(MILLISECOND, rpdos), *(Answering(number + 1) for number in range(drives))]
        bus = VirtualBus(nodes, 1_000_000)
        begin = time.process_time_ns()
        bus.run_until(seconds * 1_000_000_000)
        spent_ns = time.process_time_ns() - begin
        print(
            f"virtual time, {drives + 1} trivial nodes, {bus.frame_count // (seconds * 1000)} frames and 1 wake a ms: "
            f"{spent_ns / seconds / 1e6:.2f} us a ms, {spent_ns / bus.frame_count / 1000:.2f} us a frame "
            f"(cores included), {seconds * 1e9 / spent_ns:.0f} times real time"
        )
    bus = VirtualBus([Cyclic(10_000, []), Quiet()], 1_000_000)
    begin = time.process_time_ns()
    bus.run_until(2_000_000_000)
    print(f"virtual time, wakes alone: {(time.process_time_ns() - begin) / 200_000 / 1000:.2f} us a wake")


def test_node_runner_per_frame_and_wake() -> None:
    print()
    count = 100_000
    runner = NodeRunner(Cyclic(1000, [SYNC]), lambda _: True, 0)
    begin = time.process_time_ns()
    for now_ns in range(0, count * 1000, 1000):
        runner.advance(now_ns)
    print(f"node runner: {(time.process_time_ns() - begin) / count / 1000:.2f} us a wake that sends a frame")
    runner = NodeRunner(Answering(1), lambda _: True, 0)
    begin = time.process_time_ns()
    for now_ns in range(count):
        runner.deliver(SYNC, now_ns)
    print(f"node runner: {(time.process_time_ns() - begin) / count / 1000:.2f} us a frame that is answered")


def serve_echo(program: str) -> tuple[subprocess.Popen[str], int]:
    process = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    return process, int(process.stdout.readline())


def measure(name: str, program: str) -> None:
    """Lateness of a 1 kHz core's wakes and the round trip to another process, over one bus."""
    tighten_timers()
    process, tcp_port = serve_echo(program)
    try:
        for case, sent in (("idle bus", []), ("SYNC and TPDO each ms", [SYNC])):
            port = open_bus(name, tcp_port)
            start_ns = time.monotonic_ns() + MILLISECOND
            lateness: list[int] = []
            node = Cyclic(MILLISECOND, sent, start_ns)
            begin = time.process_time_ns()
            run_node(
                node,
                port,
                lambda late=lateness: len(late) >= 2000,
                on_wake=lambda due_ns, now_ns, late=lateness: late.append(now_ns - due_ns),
            )
            cpu_us = (time.process_time_ns() - begin) / 2000 / 1000
            port.close()
            print(f"{name}, 1 kHz, {case}: wake-up lateness {percentiles(lateness)}; {cpu_us:.0f} us of CPU a cycle")
        port = open_bus(name, tcp_port)
        pinging = Pinging()
        run_node(pinging, port, lambda: len(pinging.arrivals) >= 3000)
        port.close()
        trips = [later - earlier for earlier, later in zip(pinging.arrivals, pinging.arrivals[1:], strict=False)]
        print(f"{name}, round trip to another process: {percentiles(trips)}")
    finally:
        process.terminate()
        process.communicate(timeout=20)


def open_bus(name: str, tcp_port: int) -> Port:
    return open_port(name, "vcan0", port=tcp_port)


def test_real_time_over_socketcand() -> None:
    print()
    measure("socketcand", ECHO_SERVER)


@pytest.mark.skipif(not interface_is_up("vcan0"), reason="there is no CAN interface vcan0 that is up")
def test_real_time_over_vcan() -> None:
    print()
    measure("socketcan", ECHO_ON_VCAN)
