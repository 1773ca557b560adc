"""Serves an emulated bus over the socketcand protocol, so that python-can reaches it on a machine without SocketCAN."""

import contextlib
import ipaddress
import logging
import selectors
import socket
import time
from collections.abc import Callable
from typing import Final, Self

from drivers.errors import BusError
from drivers.frame import Frame
from drivers.node import Event, Node
from drivers.node_runner import NodeRunner, RunStatistics
from drivers.real_time import wait_s
from sim_drive.socketcand_session import SessionState, SocketcandFrame, SocketcandSession, encode_frame

MAX_CLIENTS: Final = 16
MAX_BACKLOG_BYTES: Final = 256 * 1024
"""A client that leaves more than this unread is dropped, rather than holding up the bus."""
GREETING_HOLD_NS: Final = 300_000_000
"""How long frames are kept from a client that has just been told ``< ok >``, unless it says something sooner.

python-can's client takes all that it reads for the answer: a frame that arrives behind it makes the greeting fail.
"""

_READ_BYTES: Final = 4096
_LISTEN_BACKLOG: Final = 16
_QUICK_ACKNOWLEDGE: Final[int | None] = getattr(socket, "TCP_QUICKACK", None)

_log = logging.getLogger(__name__)


class _Client:
    __slots__ = ("connection", "held_until_ns", "name", "output", "session")

    def __init__(self, connection: socket.socket, name: str, channel: str) -> None:
        self.connection = connection
        self.name = name
        self.session = SocketcandSession(channel)
        self.output = bytearray(self.session.take_output())
        self.held_until_ns = 0


class SocketcandServer:
    """A TCP server for one bus with one core on it, in one thread; it listens from its construction on.

    All clients and the core are on one bus: what one of them sends, all others get, and nobody his own. Remote frames
    cannot be told in this protocol and stay away; frames of 29-bit identifiers pass between clients only.
    """

    def __init__(
        self,
        node: Node,
        host: str = "127.0.0.1",
        port: int = 0,
        channel: str = "vcan0",
        *,
        on_event: Callable[[Event], None] | None = None,
        on_wake: Callable[[int, int], None] | None = None,
        allow_remote: bool = False,
        clock: Callable[[], int] = time.monotonic_ns,
        time_of_day: Callable[[], int] = time.time_ns,
    ) -> None:
        """Listen at ``host`` and ``port`` (0 takes any free one) for clients of the bus ``channel``.

        ``on_event`` gets the core's events, ``on_wake(due_ns, now_ns)`` tells how late a wake was. Anyone who reaches
        the port can move the machine: ``allow_remote`` must be given for a ``host`` that is not the loopback.

        Raises:
            BusError: the address is not allowed, unknown or taken.
        """
        self._node = node
        self._channel = channel
        self._on_event = on_event
        self._on_wake = on_wake
        self._clock = clock
        self._time_of_day = time_of_day
        self._clients: list[_Client] = []
        if not _is_loopback(host):
            if not allow_remote:
                raise self._error(f"{host} is not a loopback address, so other machines could reach the emulated bus")
            _log.warning("the emulated bus at %s can be reached, and the machine moved, from other machines", host)
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        try:
            self._listener = socket.create_server((host, port), family=family, backlog=_LISTEN_BACKLOG)
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or error
            raise self._error(f"cannot listen at {host}:{port} ({reason})") from None
        self._listener.setblocking(False)
        # Not the default selector: epoll and poll round a time-out up to whole milliseconds.
        self._selector = selectors.SelectSelector()
        self._selector.register(self._listener, selectors.EVENT_READ)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def address(self) -> tuple[str, int]:
        """Host and port at which the server listens."""
        host, port, *_ = self._listener.getsockname()
        return host, port

    def run(self, stop: Callable[[], bool]) -> RunStatistics:
        """Serve until ``stop()``, which is asked at least every ``drivers.real_time.MAX_WAIT_S``.

        Raises:
            LivelockError: the core does not let the time go on.
        """
        clock = self._clock
        runner = NodeRunner(self._node, self._transmit, clock(), self._on_event, self._on_wake)
        while not stop():
            for key, _ in self._selector.select(wait_s(runner, clock())):
                client: _Client | None = key.data
                if client is None:
                    self._accept()
                else:
                    self._read(client, runner)
            now_ns = clock()
            runner.advance(now_ns)
            self._flush(now_ns)
        return runner.statistics

    def close(self) -> None:
        """Hang up on all clients and stop listening; may be called twice."""
        for client in self._clients:
            client.connection.close()
        self._clients.clear()
        self._selector.close()
        self._listener.close()

    def _transmit(self, frame: Frame) -> bool:
        if not frame.is_remote:
            self._broadcast(SocketcandFrame(frame.cob_id, frame.data), None)
        return True

    def _broadcast(self, frame: SocketcandFrame, sender: _Client | None) -> None:
        text = b""
        for client in self._clients:
            if client is not sender and client.session.state is SessionState.RAW:
                text = text or encode_frame(frame, self._time_of_day())
                client.output += text

    def _accept(self) -> None:
        try:
            connection, address = self._listener.accept()
        except OSError as error:
            # The client has already gone, or this process is out of file descriptors; the bus goes on either way.
            _log.warning("a client could not be accepted (%s)", error.strerror or error)
            return
        name = f"{address[0]}:{address[1]}"
        try:
            connection.setblocking(False)
            if len(self._clients) >= MAX_CLIENTS:
                _log.warning("%s is turned away: there are %d clients already", name, MAX_CLIENTS)
                connection.send(b"< error too many clients >")
                connection.close()
                return
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, MAX_BACKLOG_BYTES)
            self._selector.register(
                connection, selectors.EVENT_READ, client := _Client(connection, name, self._channel)
            )
        except (OSError, ValueError) as error:
            connection.close()
            _log.warning("%s is turned away (%s)", name, error)
            return
        self._clients.append(client)
        _log.info("%s has connected", name)

    def _read(self, client: _Client, runner: NodeRunner) -> None:
        if client not in self._clients:
            return
        try:
            data = client.connection.recv(_READ_BYTES)
            if _QUICK_ACKNOWLEDGE is not None:
                # Not lasting, so asked for every time; a client without TCP_NODELAY waits for it.
                client.connection.setsockopt(socket.IPPROTO_TCP, _QUICK_ACKNOWLEDGE, 1)
        except BlockingIOError:
            return
        except OSError as error:
            self._drop(client, error.strerror or str(error))
            return
        if not data:
            self._drop(client, "it has hung up")
            return
        client.held_until_ns = 0
        was_raw = client.session.state is SessionState.RAW
        arrival_ns = self._clock()
        for frame in client.session.receive_data(data):
            # First what the core still had to say before the frame came, so that everyone hears it in that order.
            runner.advance(arrival_ns)
            self._broadcast(frame, client)
            if not frame.is_extended:
                runner.deliver(Frame(frame.identifier, frame.data), arrival_ns)
        client.output += client.session.take_output()
        if not was_raw and client.session.state is SessionState.RAW:
            self._write(client)
            client.held_until_ns = arrival_ns + GREETING_HOLD_NS

    def _flush(self, now_ns: int) -> None:
        for client in tuple(self._clients):
            if not client.output:
                continue
            if client.held_until_ns <= now_ns:
                self._write(client)
            if len(client.output) > MAX_BACKLOG_BYTES:
                self._drop(client, f"it has left {len(client.output)} bytes unread", logging.WARNING)

    def _write(self, client: _Client) -> None:
        try:
            sent = client.connection.send(client.output)
        except BlockingIOError:
            return
        except OSError as error:
            self._drop(client, error.strerror or str(error))
            return
        del client.output[:sent]

    def _drop(self, client: _Client, reason: str, level: int = logging.INFO) -> None:
        if client not in self._clients:
            return
        _log.log(level, "%s is dropped: %s", client.name, reason)
        self._clients.remove(client)
        with contextlib.suppress(KeyError, ValueError):
            self._selector.unregister(client.connection)
        client.connection.close()

    def _error(self, reason: str) -> BusError:
        return BusError("socketcand", self._channel, reason)


def serve(
    node: Node,
    host: str,
    port: int,
    channel: str,
    stop: Callable[[], bool],
    ready: Callable[[str, int], None] | None = None,
    *,
    on_event: Callable[[Event], None] | None = None,
    allow_remote: bool = False,
) -> RunStatistics:
    """Serve ``node`` until ``stop()``; ``ready`` is told host and port once the server listens (see SocketcandServer).

    Raises:
        BusError: the address is not allowed, unknown or taken.
        LivelockError: the core does not let the time go on.
    """
    with SocketcandServer(node, host, port, channel, on_event=on_event, allow_remote=allow_remote) as server:
        if ready is not None:
            ready(*server.address)
        return server.run(stop)


def _is_loopback(host: str) -> bool:
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
