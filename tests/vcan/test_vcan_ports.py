"""The SocketCAN port on a real vcan0: raw socket, kernel time stamps, filters, error frames; and the hosts on it."""

import json
import os
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator

import can
import pytest

from drivers.can_link import LinkState, NetworkLink
from drivers.controller import BusErrorClass, ErrorState
from drivers.errors import BusError
from drivers.frame import Frame
from drivers.hardware_stamps import why_no_hardware_stamps
from drivers.node import Event
from drivers.ports import Port, interface_is_up, open_port
from drivers.real_time import run_node
from drivers.socketcan_port import SocketcanPort

pytestmark = [
    pytest.mark.vcan,
    pytest.mark.skipif(not interface_is_up("vcan0"), reason="there is no CAN interface vcan0 that is up"),
]

SYNC = Frame(0x080)
TPDO = Frame(0x181, b"\x27\x06\xff\xff\xff\xff\x00\x00")
PATIENCE_S = 20.0
RAW = struct.Struct("=IB3x8s")
CAN_ERR_FLAG = 0x20000000
CAN_EFF_FLAG = 0x80000000


@pytest.fixture
def port() -> Iterator[SocketcanPort]:
    opened = open_port("socketcan", "vcan0")
    assert isinstance(opened, SocketcanPort)
    yield opened
    opened.close()


@pytest.fixture
def raw() -> Iterator[socket.socket]:
    """A raw socket of the test's own, for frames that the port cannot send."""
    with socket.socket(29, socket.SOCK_RAW, 1) as opened:
        opened.settimeout(PATIENCE_S)
        opened.bind(("vcan0",))
        yield opened


def ip(*arguments: str) -> None:
    subprocess.run(["ip", "link", *arguments], check=True, capture_output=True, timeout=PATIENCE_S)


def tc(*arguments: str) -> None:
    subprocess.run(["tc", "qdisc", *arguments], check=True, capture_output=True, timeout=PATIENCE_S)


def next_frame(port: Port) -> tuple[Frame, int]:
    for _ in range(100):
        received = port.receive()
        if received is not None:
            return received
        assert port.wait(PATIENCE_S)
    raise AssertionError("nothing but noise")


def test_frames_go_out_as_bytes_that_the_kernel_knows(port: SocketcanPort, raw: socket.socket) -> None:
    for frame in (TPDO, SYNC, Frame(0x701, b"", True)):
        assert port.send(frame)
    assert raw.recv(16) == bytes.fromhex("81010000 08000000 2706FFFFFFFF0000")
    assert raw.recv(16) == bytes.fromhex("80000000 00000000 0000000000000000")
    assert raw.recv(16) == bytes.fromhex("01070040 00000000 0000000000000000")


def test_python_can_reads_and_writes_the_same_frames(port: SocketcanPort) -> None:
    with can.Bus(interface="socketcan", channel="vcan0") as peer:
        assert port.send(TPDO)
        heard = peer.recv(PATIENCE_S)
        assert heard is not None
        assert (heard.arbitration_id, bytes(heard.data), heard.is_extended_id) == (*TPDO[:2], False)
        peer.send(can.Message(arbitration_id=0x201, data=b"\x0f\x00", is_extended_id=False))
        peer.send(can.Message(arbitration_id=0x702, is_remote_frame=True, dlc=1, is_extended_id=False))
        assert next_frame(port)[0] == Frame(0x201, b"\x0f\x00")
        assert next_frame(port)[0] == Frame(0x702, b"", True)
    assert port.receive() is None


def test_arrivals_are_the_kernels_on_the_monotonic_clock(port: SocketcanPort, raw: socket.socket) -> None:
    """Three frames that lie in the queue for a while get the instants at which they were sent, not read."""
    bounds = [time.monotonic_ns()]
    for number in range(3):
        raw.send(RAW.pack(0x100 + number, 0, b""))
        bounds.append(time.monotonic_ns())
    assert port.wait(PATIENCE_S)
    slack_ns = 50_000  # the two clocks are read one after the other
    for number in range(3):
        frame, arrival_ns = next_frame(port)
        assert frame.cob_id == 0x100 + number
        assert bounds[number] - slack_ns <= arrival_ns <= bounds[number + 1] + slack_ns


def test_frames_of_29_bits_stay_in_the_kernel(port: SocketcanPort, raw: socket.socket) -> None:
    raw.send(RAW.pack(0x080 | CAN_EFF_FLAG, 0, b""))
    raw.send(RAW.pack(0x081, 0, b""))
    assert next_frame(port)[0] == Frame(0x081)


def test_the_kernel_applies_the_filters(raw: socket.socket) -> None:
    port = open_port("socketcan", "vcan0", filters=[(0x180, 0x780), (0x080, 0x7FF)])
    try:
        for cob_id in (0x080, 0x081, 0x180, 0x1FF, 0x200, 0x581, 0x180 | CAN_EFF_FLAG):
            raw.send(RAW.pack(cob_id, 0, b""))
        assert [next_frame(port)[0].cob_id for _ in range(3)] == [0x080, 0x180, 0x1FF]
        assert port.receive() is None
    finally:
        port.close()


def test_error_frames_are_counted_and_bus_off_lasts_until_the_restart(port: SocketcanPort, raw: socket.socket) -> None:
    error_passive = RAW.pack(CAN_ERR_FLAG | BusErrorClass.CONTROLLER | BusErrorClass.NO_ACKNOWLEDGE, 8, b"\0\x20")
    raw.send(error_passive)
    raw.send(error_passive)
    raw.send(RAW.pack(0x081, 0, b""))
    assert next_frame(port)[0] == Frame(0x081)
    assert port.controller.counts[BusErrorClass.CONTROLLER] == 2
    assert port.controller.counts[BusErrorClass.NO_ACKNOWLEDGE] == 2
    assert port.controller.counts[BusErrorClass.BUS_OFF] == 0
    assert port.controller.state is ErrorState.PASSIVE
    port.outlives_bus_off = True
    raw.send(RAW.pack(CAN_ERR_FLAG | BusErrorClass.BUS_OFF, 8, b""))
    raw.send(RAW.pack(0x082, 0, b""))
    assert next_frame(port)[0] == Frame(0x082)
    assert not port.send(SYNC), "bus-off"
    raw.send(RAW.pack(CAN_ERR_FLAG | BusErrorClass.RESTARTED, 8, b""))
    raw.send(RAW.pack(0x083, 0, b""))
    assert next_frame(port)[0] == Frame(0x083)
    assert port.send(SYNC)


def test_a_virtual_interface_has_no_clock_of_its_own_and_keeps_the_kernels_stamps(raw: socket.socket) -> None:
    assert why_no_hardware_stamps("vcan0")
    port = SocketcanPort("vcan0")
    try:
        port.use_hardware_stamps()
        assert port.receive() is None
        before_ns = time.monotonic_ns()
        raw.send(RAW.pack(0x181, 0, b""))
        after_ns = time.monotonic_ns()
        time.sleep(0.02)  # else the stamp could not be told from the present
        frame, at_ns = next_frame(port)
        assert frame == Frame(0x181)
        assert before_ns - 1_000_000 <= at_ns <= after_ns + 1_000_000
    finally:
        port.close()


def test_the_kernel_tells_of_a_virtual_interface_that_it_has_no_controller() -> None:
    link = NetworkLink("vcan0")
    assert link.read() == LinkState(None, None)
    with pytest.raises(BusError, match="socketcan:vcan0: it has no controller that could be restarted"):
        link.restart()
    with pytest.raises(BusError, match="socketcan:vcan99: no such interface"):
        NetworkLink("vcan99").read()


def test_a_full_queue_is_a_result_and_not_an_error() -> None:
    """A transmit queue with room for no frame at all."""
    port = open_port("socketcan", "vcan1")
    try:
        tc("replace", "dev", "vcan1", "root", "pfifo", "limit", "0")
        try:
            assert not port.send(SYNC)
        finally:
            tc("delete", "dev", "vcan1", "root")
        assert port.send(SYNC)
    finally:
        port.close()


def test_an_interface_that_is_not_there() -> None:
    with pytest.raises(BusError, match="socketcan:vcan99: no such interface"):
        open_port("socketcan", "vcan99")
    with pytest.raises(BusError, match="no such interface"):
        open_port("socketcan", "a_name_that_is_too_long_for_an_interface")


def test_an_interface_that_is_no_can_bus_is_refused() -> None:
    with pytest.raises(BusError, match="no such interface"):
        open_port("socketcan", "lo")


def test_an_interface_that_is_down_goes_down_or_goes_away() -> None:
    ip("add", "dev", "vcan7", "type", "vcan")
    try:
        assert not interface_is_up("vcan7")
        with pytest.raises(BusError, match="socketcan:vcan7: the interface is down; 'ip link set vcan7 up'"):
            open_port("socketcan", "vcan7")
        ip("set", "vcan7", "up")
        assert interface_is_up("vcan7")
        listening, sending = open_port("socketcan", "vcan7"), open_port("socketcan", "vcan7")
        try:
            ip("set", "vcan7", "down")
            assert listening.wait(PATIENCE_S)
            with pytest.raises(BusError, match="the interface has gone down"):
                listening.receive()
            with pytest.raises(BusError, match="the interface has gone down"):
                sending.send(SYNC)
            ip("delete", "vcan7")
            with pytest.raises(BusError, match="the interface has been removed"):
                sending.send(SYNC)
        finally:
            listening.close()
            sending.close()
    finally:
        subprocess.run(["ip", "link", "delete", "vcan7"], check=False, capture_output=True, timeout=PATIENCE_S)


class Ping:
    """Sends ``frame`` first and after every frame heard, ``count`` times."""

    def __init__(self, frame: Frame, count: int, starts: bool) -> None:
        self.frame = frame
        self.left = count - starts
        self.out = [frame] if starts else []
        self.heard: list[tuple[Frame, int]] = []

    def receive(self, frame: Frame, now_ns: int) -> None:
        self.heard.append((frame, now_ns))
        if self.left:
            self.left -= 1
            self.out.append(self.frame)

    def next_wake_ns(self) -> int | None:
        return None

    def wake(self, now_ns: int) -> None:
        raise AssertionError("it never asked for it")

    def take_frames(self) -> list[Frame]:
        frames, self.out = self.out, []
        return frames

    def take_events(self) -> list[Event]:
        return []


def test_two_cores_talk_over_vcan_in_real_time() -> None:
    count = 200
    master, drive = Ping(SYNC, count, starts=True), Ping(TPDO, count, starts=False)
    master_port, drive_port = open_port("socketcan", "vcan0"), open_port("socketcan", "vcan0")
    is_over = threading.Event()
    drive_thread = threading.Thread(target=run_node, args=(drive, drive_port, is_over.is_set))
    end_ns = time.monotonic_ns() + round(PATIENCE_S * 1e9)
    stop: Callable[[], bool] = lambda: len(master.heard) >= count or time.monotonic_ns() > end_ns  # noqa: E731
    drive_thread.start()
    try:
        statistics = run_node(master, master_port, stop)
    finally:
        is_over.set()
        drive_thread.join(PATIENCE_S)
        master_port.close()
        drive_port.close()
    assert [frame for frame, _ in master.heard] == [TPDO] * count
    assert [frame for frame, _ in drive.heard] == [SYNC] * count
    assert (statistics.frames_sent, statistics.frames_received, statistics.frames_dropped) == (count, count, 0)
    instants = [at_ns for _, at_ns in master.heard]
    assert instants == sorted(instants)


def test_the_emulated_machine_takes_its_channel_by_itself_and_ends_with_its_bus() -> None:
    """No --interface is given: what is up is taken. When the interface goes down, the exit status is 1."""
    ip("add", "dev", "vcan8", "type", "vcan")
    ip("set", "vcan8", "up")
    reading, writing = os.pipe()
    command = [sys.executable, "-m", "sim_drive", "paper", "--channel", "vcan8", "--ready-fd", str(writing)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, pass_fds=[writing]) as process:
        try:
            os.close(writing)
            with os.fdopen(reading, encoding="utf-8") as pipe:
                place = json.loads(pipe.readline())
            assert place == {"interface": "socketcan", "channel": "vcan8", "host": None, "port": None}
            bus = open_port("socketcan", "vcan8")
            try:
                bus.send(Frame(0x000, b"\x81\x00"))
                booted = {next_frame(bus)[0] for _ in range(2)}
            finally:
                bus.close()
            assert {frame.data for frame in booted} == {b"\x00"}
            assert {frame.cob_id & 0x780 for frame in booted} == {0x700}
            ip("set", "vcan8", "down")
            _, stderr = process.communicate(timeout=PATIENCE_S)
        finally:
            process.kill()
            ip("delete", "vcan8")
    assert process.returncode == 1
    assert stderr.splitlines()[-1] == "sim-drive: bus socketcan:vcan8: the interface has gone down"
