"""The gateway's loop against the canopen package's and against a bare loop, unpaced on one core, over loopback sockets.

Printed, never asserted. All three exchange the same frames with the same responder, over a pair of datagram sockets
that carry ``struct can_frame``: SYNC out, a TPDO of each axis in, an RPDO for each axis out. The gateway does more in
it: cam, guard, session, account and sample. Run with -m bench -s.
"""

import gc
import socket
import time
from collections.abc import Callable, Iterator

import can
import canopen
import pytest
from peer_loops import ENABLE_OPERATION, SYNC_COB_ID, TPDO, bare_cycle, canopen_cycle, mapped_nodes
from test_bench_cycle import CONFIG, NODE_IDS, Call, PackingSink, calls, new_core

from drivers.frame import Frame
from drivers.socketcan_port import CAN_FRAME, SocketcanPort
from gateway.cyclic.axis_channel import AxisChannel
from gateway.cyclic.cycle import CyclicLoop
from gateway.cyclic.guard import Guard
from gateway.cyclic.steering import Steering
from gateway.record.sample import MAX_AXES, Phase, SampleLayout
from gateway.units import AxisUnits

pytestmark = pytest.mark.bench
__all__ = ["calls"]

ROUNDS = 5
CYCLES = 3000


@pytest.fixture(autouse=True)
def without_collector() -> Iterator[None]:
    gc.collect()
    gc.disable()
    yield
    gc.enable()


Pair = tuple[socket.socket, socket.socket]


def local_pair() -> Pair:
    return socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)


def udp_pair() -> Pair:
    """For bursts that are longer than the queue of a local socket."""
    near, far = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
    near.bind(("127.0.0.1", 0))
    far.bind(("127.0.0.1", 0))
    near.connect(far.getsockname())
    far.connect(near.getsockname())
    return near, far


class Responder:
    """The least that answers like two drives: TPDOs from a list, and everything else is read and thrown away."""

    def __init__(self, answers: list[list[bytes]], pair: Callable[[], Pair] = local_pair) -> None:
        self.near, self.far = pair()
        self.near.setblocking(False)
        self.answers = answers
        self.cycle = 0

    def answer(self) -> None:
        """Read a SYNC, send a TPDO for every axis."""
        # A heartbeat may come before it.
        while CAN_FRAME.unpack(self.far.recv(16))[0] != SYNC_COB_ID:
            pass
        send = self.far.send
        for answer in self.answers[self.cycle]:
            send(answer)
        self.cycle += 1

    def listen(self) -> None:
        """Read the demands."""
        left = len(self.answers[0])
        while left:
            left -= 0x200 < CAN_FRAME.unpack(self.far.recv(16))[0] < 0x580

    def close(self) -> None:
        self.near.close()
        self.far.close()


Figures = tuple[float, float]
"""CPU time of the master's part a cycle, and of all, responder included; us."""


def measure(cycle: Callable[[Callable[[], None], Callable[[], None]], None], responder: Responder) -> Figures:
    """``cycle(answer, listen)`` is one cycle of the master, which calls the responder where it would otherwise wait."""
    clock = time.thread_time_ns
    away_ns = 0

    def away(part: Callable[[], None]) -> Callable[[], None]:
        def timed() -> None:
            nonlocal away_ns
            begin = clock()
            part()
            away_ns += clock() - begin

        return timed

    answer, listen = away(responder.answer), away(responder.listen)
    count = len(responder.answers)
    begin = clock()
    for _ in range(count // 2):
        cycle(answer, listen)
    total_ns = clock() - begin - away_ns
    # Once more without the clock's own cost, for the whole.
    begin = clock()
    for _ in range(count // 2):
        cycle(responder.answer, responder.listen)
    return total_ns / (count // 2) / 1000, (clock() - begin) / (count // 2) / 1000


def tell(name: str, figures: list[Figures]) -> Figures:
    best = min(figures)[0], min(whole for _, whole in figures)
    print(f"{name}: {best[0]:.1f} us of CPU a cycle; unpaced, with its responder, {1e6 / best[1]:,.0f} cycles a second")
    return best


def gateway_round(told: list[Call], start: int) -> Figures:
    core = new_core()
    while told[start][1] is not None:
        start += 1
    for now_ns, frame in told[:start]:
        core.wake(now_ns) if frame is None else core.receive(frame, now_ns)
        core.take_frames()
    for node_id in NODE_IDS:
        # Their heartbeats are not told again, and a coupled stop is not what is to be measured.
        core.session.master.watch_heartbeat(node_id, 0.0)
    tpdos = [(now, f) for now, f in told[start:] if f is not None and f.cob_id in core.loop.tpdo_slots]
    pairs = [tpdos[n : n + 2] for n in range(0, len(tpdos) - 1, 2)]
    answers = [[CAN_FRAME.pack(frame.cob_id, 8, frame.data) for _, frame in pair] for pair in pairs]
    responder = Responder(answers)
    port = SocketcanPort("loopback", carrier=responder.near)
    loop = core.loop

    def cycle(answer: Callable[[], None], listen: Callable[[], None]) -> None:
        due_ns = loop.next_wake_ns()
        core.wake(due_ns)
        for frame in core.take_frames():
            port.send(frame)
        loop.sent(due_ns)
        answer()
        while not loop.is_closed:
            received = port.receive()
            if received is not None:
                core.receive(received[0], due_ns)
        for frame in core.take_frames():
            port.send(frame)
        loop.sent(due_ns)
        core.next_wake_ns()
        listen()

    figures = measure(cycle, responder)
    assert loop.steering.phase is Phase.CAM
    responder.close()
    return figures


def canned(cycles: int) -> list[list[bytes]]:
    return [[CAN_FRAME.pack(0x180 + n, 8, TPDO.pack(0x1637, k, 0)) for n in NODE_IDS] for k in range(cycles)]


def bare_round() -> Figures:
    responder = Responder(canned(CYCLES))
    exchange = bare_cycle(responder.near.send, responder.near.recv, NODE_IDS, ENABLE_OPERATION)

    def cycle(answer: Callable[[], None], listen: Callable[[], None]) -> None:
        exchange(answer)
        listen()

    figures = measure(cycle, responder)
    responder.close()
    return figures


class LoopbackBus(can.BusABC):
    """python-can on the same sockets."""

    def __init__(self, near: socket.socket) -> None:
        self.near = near
        super().__init__("loopback")

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        self.near.send(CAN_FRAME.pack(msg.arbitration_id, msg.dlc, bytes(msg.data)))

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        identifier, length, data = CAN_FRAME.unpack(self.near.recv(16))
        message = can.Message(time.time(), identifier, is_extended_id=False, dlc=length, data=data[:length])
        return message, False


def canopen_round() -> Figures:
    responder = Responder(canned(CYCLES))
    bus = LoopbackBus(responder.near)
    network = canopen.Network()
    network.bus = bus
    nodes = mapped_nodes(network, NODE_IDS)

    def wait(answer: Callable[[], None]) -> None:
        answer()
        for _ in NODE_IDS:
            message = bus.recv(0)
            assert message is not None
            network.notify(message.arbitration_id, message.data, message.timestamp)

    exchange = canopen_cycle(network, nodes, wait)

    def cycle(answer: Callable[[], None], listen: Callable[[], None]) -> None:
        exchange(answer)
        listen()

    figures = measure(cycle, responder)
    bus.shutdown()
    responder.close()
    return figures


def test_unpaced_over_loopback(calls: tuple[list[Call], int]) -> None:
    print()
    # Turn by turn, so that what else the computer does falls on all of them.
    rounds = [(gateway_round(*calls), bare_round(), canopen_round()) for _ in range(ROUNDS)]
    gateway, bare, package = map(list, zip(*rounds, strict=True))
    ours = tell("gateway", gateway)
    floor = tell("bare loop of sockets and struct", bare)
    theirs = tell("canopen package", package)
    print(f"gateway : bare {ours[0] / floor[0]:.2f}, gateway : canopen {ours[0] / theirs[0]:.2f} of CPU a cycle")


class Wide:
    """A loop of many axes; a sample holds eight, and is left out of what is measured for all alike."""

    def append(self, *values: float) -> None:
        pass


class Still:
    """A demand that costs nothing."""

    def __init__(self, axes: int) -> None:
        self.targets = [0] * axes
        self.torque_offsets = [0] * axes
        self.velocities = [0.0] * axes
        self.master_position = self.master_velocity = 0.0
        self.phase = 3

    def step(self) -> None:
        pass


def axes_round(axes: int, cycles: int = 1000) -> float:
    """CPU time of the loop a cycle with so many axes, sockets included; us."""
    names = tuple(f"a{number}" for number in range(axes))
    units = AxisUnits(4096, 0.0, 1.5)
    channels = [AxisChannel(name, number + 1, units, 10**6) for number, name in enumerate(names)]
    sink = PackingSink() if axes <= MAX_AXES else Wide()
    if isinstance(sink, PackingSink):
        sink.layout = SampleLayout(names)
        sink.buffer = bytearray(sink.layout.size)
    loop = CyclicLoop(Steering(channels, Guard(CONFIG.guard, names)), 1_000_000, sink)
    loop.steering.follow(Still(axes))  # pyright: ignore[reportArgumentType]
    loop.start(0)
    answers = [[CAN_FRAME.pack(0x181 + n, 8, TPDO.pack(0x1637, k, 0)) for n in range(axes)] for k in range(cycles)]
    responder = Responder(answers, udp_pair)
    port = SocketcanPort("loopback", carrier=responder.near)
    spent_ns = 0
    for _ in range(cycles):
        begin = time.thread_time_ns()
        due_ns = loop.next_wake_ns()
        loop.wake(due_ns)
        port.send(take(loop)[0])
        spent_ns += time.thread_time_ns() - begin
        responder.answer()
        begin = time.thread_time_ns()
        while not loop.is_closed:
            received = port.receive()
            if received is not None:
                loop.receive_tpdo(loop.tpdo_slots[received[0].cob_id], received[0].data, due_ns)
        for frame in take(loop):
            port.send(frame)
        loop.sent(due_ns)
        spent_ns += time.thread_time_ns() - begin
        responder.listen()
    responder.close()
    return spent_ns / cycles / 1000


def take(loop: CyclicLoop) -> list[Frame]:
    frames, loop.outbox = loop.outbox, []
    return frames


def test_the_cost_of_an_axis() -> None:
    print()
    counts = (2, 4, 8, 16, 32)
    costs = [min(axes_round(axes) for _ in range(ROUNDS)) for axes in counts]
    mean_x, mean_y = sum(counts) / len(counts), sum(costs) / len(costs)
    spread = sum((x - mean_x) ** 2 for x in counts)
    slope = sum((x - mean_x) * (y - mean_y) for x, y in zip(counts, costs, strict=True)) / spread
    line = ", ".join(f"{axes}: {cost:.1f}" for axes, cost in zip(counts, costs, strict=True))
    worst = max(abs(y - mean_y - slope * (x - mean_x)) / y for x, y in zip(counts, costs, strict=True))
    print(
        f"loop and sockets, us of CPU a cycle by axes: {line}; {slope:.2f} us an axis, {worst:.0%} off the line at most"
    )
