"""Ports: python-can's virtual bus in this process, what cannot be opened, and the arithmetic of arrivals."""

import socket
import threading
from pathlib import Path

import can
import pytest

from drivers.arrival_clock import ArrivalClock
from drivers.errors import BusError
from drivers.frame import Frame
from drivers.ports import interface_is_up, open_port
from drivers.python_can_port import open_socketcand


class Clocks:
    """Two clocks, one of which can be put forward and back."""

    def __init__(self) -> None:
        self.monotonic = 5_000_000_000
        self.time_of_day = 1_700_000_000_000_000_000

    def advance(self, by_ns: int) -> None:
        self.monotonic += by_ns
        self.time_of_day += by_ns

    def arrival_clock(self) -> ArrivalClock:
        return ArrivalClock(lambda: self.monotonic, lambda: self.time_of_day)


def test_the_age_of_a_stamp_is_taken_off_the_monotonic_clock() -> None:
    clocks = Clocks()
    clock = clocks.arrival_clock()
    clocks.advance(10_000_000)
    clock.look()
    assert clock.arrival_ns(clocks.time_of_day - 300_000) == 5_010_000_000 - 300_000


def test_a_step_of_the_time_of_day_between_two_frames_does_no_harm() -> None:
    clocks = Clocks()
    clock = clocks.arrival_clock()
    clocks.advance(10_000_000)
    clocks.time_of_day += 3_600_000_000_000
    clock.look()
    assert clock.arrival_ns(clocks.time_of_day - 300_000) == 5_010_000_000 - 300_000


@pytest.mark.parametrize("age_ns", [-1, -3_600_000_000_000, 3_600_000_000_000, 12_000_000, 1_700_000_000_000_000_000])
def test_a_stamp_that_cannot_be_true_is_replaced_by_the_present(age_ns: int) -> None:
    """The queue was empty 10 ms ago, so that a frame of 12 ms cannot be; nor one of a clock that began at start-up."""
    clocks = Clocks()
    clock = clocks.arrival_clock()
    clocks.advance(50_000_000)
    clock.queue_is_empty()
    clocks.advance(10_000_000)
    clock.look()
    assert clock.arrival_ns(clocks.time_of_day - age_ns) == clocks.monotonic


def test_python_can_virtual_bus_carries_frames_both_ways() -> None:
    port = open_port("virtual", "test_host_ports_a")
    with can.Bus(interface="virtual", channel="test_host_ports_a") as peer:
        try:
            assert port.receive() is None
            assert not port.wait(0.0)
            assert port.send(Frame(0x201, b"\x0f\x00"))
            assert port.send(Frame(0x701, b"", True))
            heard = peer.recv(0)
            assert heard is not None
            assert (heard.arbitration_id, bytes(heard.data), heard.is_extended_id) == (0x201, b"\x0f\x00", False)
            asked = peer.recv(0)
            assert asked is not None
            assert asked.is_remote_frame

            peer.send(can.Message(arbitration_id=0x12345, is_extended_id=True))
            peer.send(can.Message(arbitration_id=0x181, is_extended_id=False, is_error_frame=True))
            peer.send(can.Message(arbitration_id=0x181, is_extended_id=False, data=b"\x27\x06"))
            assert port.wait(1.0)
            first = port.receive()
            assert first is not None
            assert first[0] == Frame(0x181, b"\x27\x06")
            assert port.receive() is None
            assert port.fileno() == -1
        finally:
            port.close()
            port.close()


def test_filters_pass_what_agrees_with_one_of_them() -> None:
    port = open_port("virtual", "test_host_ports_b", filters=[(0x180, 0x780), (0x080, 0x7FF)])
    with can.Bus(interface="virtual", channel="test_host_ports_b") as peer:
        for cob_id in (0x080, 0x081, 0x180, 0x1FF, 0x200, 0x581):
            peer.send(can.Message(arbitration_id=cob_id, is_extended_id=False))
        heard: list[int] = []
        while received := port.receive():
            heard.append(received[0].cob_id)
        port.close()
    assert heard == [0x080, 0x180, 0x1FF]


@pytest.mark.parametrize(
    ("interface", "reason"),
    [("no_such_interface", "cannot be opened"), ("socketcan", "SocketCAN|no such interface")],
)
def test_what_cannot_be_opened_is_said_in_one_sentence(interface: str, reason: str) -> None:
    with pytest.raises(BusError, match=reason) as caught:
        open_port(interface, "nosuchcan9")
    assert "\n" not in str(caught.value)
    assert (caught.value.interface, caught.value.channel) == (interface, "nosuchcan9")


def test_a_socketcand_server_that_is_not_there_is_reported_at_once(caplog: pytest.LogCaptureFixture) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        free_port = listener.getsockname()[1]
    with pytest.raises(BusError, match=f"nothing listens at 127.0.0.1:{free_port}"):
        open_port("socketcand", "vcan0", port=free_port)
    assert caplog.records == []


def test_a_server_that_says_nothing_is_given_up() -> None:
    with (
        socket.create_server(("127.0.0.1", 0)) as listener,
        pytest.raises(BusError, match=r"does not answer within 0\.02 s"),
    ):
        open_socketcand("vcan0", *listener.getsockname(), timeout_s=0.02)


@pytest.mark.parametrize(
    ("greeting", "reason"),
    [(b"220 smtp ready\r\n", "the server says '220 smtp ready'"), (b"", "closed the connection")],
)
def test_a_server_of_another_kind_is_recognised(greeting: bytes, reason: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def answer() -> None:
            connection, _ = listener.accept()
            with connection:
                connection.sendall(greeting)

        server = threading.Thread(target=answer)
        server.start()
        with pytest.raises(BusError, match=reason):
            open_socketcand("vcan0", *listener.getsockname())
        server.join(10)


@pytest.mark.parametrize(
    ("kind", "flags", "state", "is_up"),
    [
        ("280", "0x40081", "unknown", True),  # vcan, as it is
        ("280", "0x40081", "up", True),
        ("280", "0x40080", "down", False),
        ("280", "0x40081", "down", False),  # up, but without a carrier: a CAN controller that is bus-off
        ("1", "0x1003", "up", False),  # Ethernet
        ("what", "0x1", "up", False),
    ],
)
def test_an_interface_is_up_as_the_kernel_says(tmp_path: Path, kind: str, flags: str, state: str, is_up: bool) -> None:
    (tmp_path / "vcan0").mkdir()
    for name, text in (("type", kind), ("flags", flags), ("operstate", state)):
        (tmp_path / "vcan0" / name).write_text(text + "\n")
    assert interface_is_up("vcan0", tmp_path) is is_up


@pytest.mark.parametrize("name", ["", ".", "..", "vcan9", "../vcan0", "lo"])
def test_a_name_that_is_no_can_interface_is_not_up(name: str) -> None:
    assert not interface_is_up(name)
