"""The socketcand server with python-can's own client, and with clients that do not behave; all on the loopback."""

import contextlib
import logging
import socket
import threading
from collections.abc import Callable, Iterator

import can
import pytest
from host_nodes import PeriodicNode, ScriptedNode

from drivers.errors import BusError
from drivers.frame import Frame
from drivers.node import Node
from drivers.ports import Port, open_port
from drivers.real_time import run_node
from drivers.socketcand_word import says_no_wire
from sim_drive import socketcand_server
from sim_drive.socketcand_server import SocketcandServer, serve

SYNC = Frame(0x080)
TPDO = Frame(0x181, b"\x27\x06")
PATIENCE_S = 20.0
"""Only a broken server lets a test wait for so long."""


@contextlib.contextmanager
def serving(node: Node) -> Iterator[int]:
    """Serve ``node`` in a thread and give the port; whatever the server raises is raised at the end."""
    stop = threading.Event()
    errors: list[BaseException] = []
    with SocketcandServer(node, channel="vcan0") as server:

        def run() -> None:
            try:
                server.run(stop.is_set)
            except BaseException as error:
                errors.append(error)

        thread = threading.Thread(target=run)
        thread.start()
        try:
            yield server.address[1]
        finally:
            stop.set()
            thread.join(PATIENCE_S)
    assert not errors, errors
    assert not thread.is_alive()


@contextlib.contextmanager
def connected(port: int, channel: str = "vcan0") -> Iterator[Port]:
    bus = open_port("socketcand", channel, port=port)
    try:
        yield bus
    finally:
        bus.close()


@contextlib.contextmanager
def raw_client(port: int, receive_buffer_bytes: int | None = None) -> Iterator[socket.socket]:
    """A client that does not go through python-can, in raw mode."""
    with socket.socket() as connection:
        connection.settimeout(PATIENCE_S)
        if receive_buffer_bytes is not None:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer_bytes)
        connection.connect(("127.0.0.1", port))
        assert connection.recv(100) == b"< hi >"
        connection.sendall(b"< open vcan0 >")
        assert connection.recv(100) == b"< ok >"
        connection.sendall(b"< rawmode >")
        assert connection.recv(100) == b"< ok >"
        yield connection


def next_frame(bus: Port) -> Frame:
    for _ in range(100):
        received = bus.receive()
        if received is not None:
            return received[0]
        assert bus.wait(PATIENCE_S)
    raise AssertionError("nothing but noise")


def answers_sync() -> ScriptedNode:
    return ScriptedNode(answer=lambda frame, _: [TPDO] if frame == SYNC else [])


def test_asked_for_its_wire_it_says_that_it_has_none_and_nobody_on_the_bus_notices() -> None:
    node = answers_sync()
    with serving(node) as port, connected(port) as bus:
        assert says_no_wire("127.0.0.1", port)
        assert bus.send(SYNC)
        assert next_frame(bus) == TPDO


def test_what_anyone_sends_all_others_hear() -> None:
    node = answers_sync()
    with serving(node) as port, connected(port) as first, connected(port) as second:
        assert first.send(SYNC)
        assert next_frame(first) == TPDO
        assert [next_frame(second), next_frame(second)] == [SYNC, TPDO]
        assert second.send(Frame(0x201, b"\x0f\x00"))
        assert next_frame(first) == Frame(0x201, b"\x0f\x00")
    assert [what for what, _ in node.received] == ["080#", "201#0F00"]


def test_29_bit_frames_pass_between_clients_only() -> None:
    node = answers_sync()
    with serving(node) as port, raw_client(port) as first, raw_client(port) as second:
        first.sendall(b"< send 00000080 1 5 >")
        assert second.recv(100).startswith(b"< frame 00000080 ")
        first.sendall(b"< send 080 0 >")
        assert second.recv(100).startswith(b"< frame 080 ")
    assert [what for what, _ in node.received] == ["080#"]


def test_python_can_gets_through_the_greeting_on_a_busy_bus() -> None:
    with serving(PeriodicNode(200_000, frame=TPDO)) as port:
        for _ in range(2):
            with can.Bus(interface="socketcand", channel="vcan0", host="127.0.0.1", port=port, tcp_tune=True) as bus:
                message = bus.recv(PATIENCE_S)
                assert message is not None
                assert (message.arbitration_id, bytes(message.data)) == TPDO[:2]


def test_two_cores_talk_through_server_and_client_in_real_time() -> None:
    """The client's core sends the next SYNC when it has heard the TPDO to the last one, fifty times."""
    drive = answers_sync()
    master = ScriptedNode(initial=[SYNC], answer=lambda *_: [SYNC] if len(master.received) < 50 else [])
    with serving(drive) as port, connected(port) as bus:
        statistics = run_node(master, bus, lambda: len(master.received) >= 50)
    assert [what for what, _ in master.received] == ["181#2706"] * 50
    assert len(drive.received) == 50
    instants = [at_ns for _, at_ns in master.received]
    assert instants == sorted(instants)
    assert (statistics.frames_received, statistics.frames_sent, statistics.frames_dropped) == (50, 50, 0)


def test_nonsense_from_one_client_does_not_disturb_the_others() -> None:
    with serving(answers_sync()) as port, raw_client(port) as rude, connected(port) as polite:
        rude.sendall(b"\x00\xff>>><<<< send zz >" + b"<" * 5000 + b" echo >")
        answer = b""
        while not answer.endswith(b"< echo >"):
            answer += rude.recv(10_000)
        assert polite.send(SYNC)
        assert next_frame(polite) == TPDO


def test_a_client_that_hangs_up_does_not_disturb_the_others() -> None:
    with serving(answers_sync()) as port, connected(port) as stays:
        with raw_client(port) as leaves:
            leaves.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\x01\0\0\0\0\0\0\0")  # a reset, no farewell
        for _ in range(3):
            assert stays.send(SYNC)
            assert next_frame(stays) == TPDO


def test_a_client_that_does_not_read_is_dropped(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(socketcand_server, "MAX_BACKLOG_BYTES", 16_384)
    node = ScriptedNode(answer=lambda *_: [TPDO] * 200)
    with caplog.at_level(logging.WARNING), serving(node) as port, raw_client(port, 4096), raw_client(port) as reads:
        told = 0
        while not caplog.messages:
            reads.sendall(b"< send 080 0 >")
            told += 200
            assert told < 100_000
            unread = 200
            while unread:
                unread -= reads.recv(65_536).count(b">")
    assert "bytes unread" in caplog.messages[0]


def test_one_client_too_many_is_turned_away(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socketcand_server, "MAX_CLIENTS", 1)
    with (
        serving(answers_sync()) as port,
        raw_client(port),
        pytest.raises(BusError, match="the server says 'error too many clients'"),
    ):
        open_port("socketcand", "vcan0", port=port)


def test_another_bus_than_the_served_one_is_refused() -> None:
    with serving(answers_sync()) as port, pytest.raises(BusError, match="the server says 'error could not open bus'"):
        open_port("socketcand", "vcan7", port=port)


def test_a_server_that_goes_away_is_a_lost_bus() -> None:
    stack = contextlib.ExitStack()
    with contextlib.ExitStack() as server:
        port = server.enter_context(serving(answers_sync()))
        bus = stack.enter_context(connected(port))
        assert bus.send(SYNC)
        assert next_frame(bus) == TPDO
    with stack, pytest.raises(BusError, match=r"closed the connection|reset"):
        run_node(ScriptedNode(), bus, lambda: False)


def test_what_cannot_be_listened_at() -> None:
    with pytest.raises(BusError, match=r"192\.0\.2\.1 is not a loopback address"):
        SocketcandServer(ScriptedNode(), "192.0.2.1")
    with SocketcandServer(ScriptedNode()) as server, pytest.raises(BusError, match="Address already in use"):
        SocketcandServer(ScriptedNode(), *server.address)


def test_serve_says_where_it_listens_and_stops_when_told() -> None:
    places: list[tuple[str, int]] = []
    listening = threading.Event()
    answered = threading.Event()

    def ready(host: str, port: int) -> None:
        places.append((host, port))
        listening.set()

    def ask() -> None:
        assert listening.wait(PATIENCE_S)
        with connected(places[0][1]) as bus:
            bus.send(SYNC)
            next_frame(bus)
        answered.set()

    stop: Callable[[], bool] = answered.is_set
    client = threading.Thread(target=ask)
    client.start()
    statistics = serve(answers_sync(), "127.0.0.1", 0, "vcan0", stop, ready)
    client.join(PATIENCE_S)
    assert places[0][0] == "127.0.0.1"
    assert (statistics.frames_received, statistics.frames_sent) == (1, 1)
