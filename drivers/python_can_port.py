"""Every other bus: an adapter over python-can's interfaces, and a connection to a socketcand server."""

import logging
import select
import socket
import time
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any, Final

import can

from drivers.arrival_clock import ArrivalClock
from drivers.bus_off import Link
from drivers.controller import Controller, ErrorState
from drivers.errors import BusError
from drivers.frame import Frame
from drivers.python_can_controller import link_to, take_error_frame, told_state

CONNECT_TIMEOUT_S: Final = 0.8
"""How long a socketcand server may take for each step of the greeting."""

_MAX_SKIPPED_FRAMES: Final = 64
_MAX_REPLY_BYTES: Final = 256
_BUS_OFF_PAUSE_S: Final = 0.005


class PythonCanPort:
    """Port on a python-can bus.

    29-bit and CAN FD frames are skipped, error frames told to ``controller``. ``filters`` are applied here rather than
    by the interface: some of them cannot, and python-can then answers "nothing there" for a frame that it has filtered
    out.
    """

    def __init__(
        self,
        bus: can.BusABC,
        interface: str,
        channel: str,
        filters: Sequence[tuple[int, int]] | None = None,
    ) -> None:
        """Take over the open ``bus``; ``interface`` and ``channel`` are for error messages."""
        self.controller: Final = Controller()
        self.link: Final[Link | None] = link_to(bus, interface, channel)
        """See Port."""
        self.outlives_bus_off = False
        """See Port."""
        self._bus = bus
        self._interface = interface
        self._channel = channel
        self._filters = None if filters is None else tuple((cob_id & mask, mask) for cob_id, mask in filters)
        self._clock = ArrivalClock()
        self._read_ahead: deque[can.Message] = deque()
        self._socket = _socket_of(bus) if interface == "socketcand" else None
        self._carries_remote_frames = interface != "socketcand"
        self._may_hold_more = False
        self._is_closed = False

    @classmethod
    def open(
        cls,
        interface: str,
        channel: str,
        filters: Sequence[tuple[int, int]] | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> "PythonCanPort":
        """Open ``channel`` of the python-can interface ``interface`` with python-can's own ``options``.

        Raises:
            BusError: python-can does not know the interface, or cannot open it.
        """
        try:
            bus = can.Bus(channel=channel, interface=interface, **(options or {}))
        # The interfaces raise what their driver libraries raise: OSError, ImportError, TypeError, their own.
        except Exception as error:
            raise BusError(interface, channel, f"cannot be opened ({_one_line(error)})") from None
        return cls(bus, interface, channel, filters)

    def send(self, frame: Frame) -> bool:
        """See Port. Over socketcand a remote frame is dropped: the protocol has none."""
        if frame.is_remote and not self._carries_remote_frames:
            return True
        if self.controller.is_off:
            return False
        message = can.Message(
            arbitration_id=frame.cob_id, is_extended_id=False, is_remote_frame=frame.is_remote, data=frame.data
        )
        try:
            self._bus.send(message, timeout=0)
        except can.CanOperationError as error:
            # python-can has no error of its own for a full queue; what failed for good shows on the next receive.
            if isinstance(error.__cause__, OSError):
                raise self._error(error) from None
            self._is_bus_off()
            return False
        except (can.CanError, OSError) as error:
            if self._is_bus_off():
                return False
            raise self._error(error) from None
        return True

    def receive(self) -> tuple[Frame, int] | None:
        """See Port."""
        for _ in range(_MAX_SKIPPED_FRAMES):
            message = self._read_ahead.popleft() if self._read_ahead else self._read(0.0)
            if message is None:
                self._clock.queue_is_empty()
                self._may_hold_more = False
                return None
            if message.is_error_frame:
                take_error_frame(self.controller, self._bus, self._interface, message)
                if self.controller.is_off and not self.outlives_bus_off:
                    raise BusError(self._interface, self._channel, "the controller has gone bus-off")
                continue
            if message.is_extended_id or message.is_fd:
                continue
            cob_id = message.arbitration_id
            if self._filters is not None and not any(cob_id & mask == wanted for wanted, mask in self._filters):
                continue
            data = b"" if message.is_remote_frame else bytes(message.data)
            frame = Frame(cob_id, data, message.is_remote_frame)
            self._clock.look()
            return frame, self._clock.arrival_ns(round(message.timestamp * 1e9))
        self._may_hold_more = True
        return None

    def wait(self, timeout_s: float) -> bool:
        """See Port."""
        if self._read_ahead or self._may_hold_more:
            return True
        if self._socket is not None:
            return self._wait_for_socket(self._socket, timeout_s)
        message = self._read(timeout_s)
        if message is None:
            if self.controller.is_off:
                # Such an interface answers at once, and would be asked again at once.
                time.sleep(min(timeout_s, _BUS_OFF_PAUSE_S))
            return False
        self._read_ahead.append(message)
        return True

    def fileno(self) -> int:
        """See Port."""
        if self._socket is not None:
            return self._socket.fileno()
        try:
            return self._bus.fileno()
        except NotImplementedError:
            return -1

    def close(self) -> None:
        """See Port."""
        if not self._is_closed:
            self._is_closed = True
            self._bus.shutdown()

    def _read(self, timeout_s: float) -> can.Message | None:
        try:
            return self._bus.recv(timeout_s)
        except (can.CanError, OSError) as error:
            if self._is_bus_off():
                return None
            raise self._error(error) from None

    def _is_bus_off(self) -> bool:
        """Whether what has just failed has failed because the controller is bus-off."""
        if told_state(self._bus, self._interface) is ErrorState.OFF:
            self.controller.change(ErrorState.OFF)
        return self.controller.is_off and self.outlives_bus_off

    def _wait_for_socket(self, stream: socket.socket, timeout_s: float) -> bool:
        try:
            if not select.select((stream,), (), (), timeout_s)[0]:
                return False
            # python-can reads the end of a stream as "no frame", for ever.
            if not stream.recv(1, socket.MSG_PEEK):
                raise BusError(self._interface, self._channel, "the server has closed the connection")
        except (OSError, ValueError) as error:
            raise self._error(error) from None
        return True

    def _error(self, error: Exception) -> BusError:
        return BusError(self._interface, self._channel, f"the bus has failed ({_one_line(error)})")


def open_socketcand(
    channel: str,
    host: str,
    port: int,
    filters: Sequence[tuple[int, int]] | None = None,
    timeout_s: float = CONNECT_TIMEOUT_S,
) -> PythonCanPort:
    """Connect to the socketcand server at ``host`` and ``port`` and open its bus ``channel``.

    The greeting is first tried on a connection of its own, because python-can's client waits ten seconds for a server
    that is not there, and for ever for one that does not answer.

    Raises:
        BusError: nothing listens there, it does not speak socketcand, or it does not serve ``channel``.
    """
    _silence_client()
    _try_greeting(channel, host, port, timeout_s)
    return PythonCanPort.open("socketcand", channel, filters, {"host": host, "port": port, "tcp_tune": True})


def _socket_of(bus: can.BusABC) -> socket.socket | None:
    """The connection that python-can's client keeps to itself; without it the end of the stream would go unseen."""
    return next((value for value in vars(bus).values() if isinstance(value, socket.socket)), None)


def _try_greeting(channel: str, host: str, port: int, timeout_s: float) -> None:
    try:
        with socket.create_connection((host, port), timeout_s) as stream:
            _expect(stream, "< hi >")
            stream.sendall(f"< open {channel} >".encode())
            _expect(stream, "< ok >")
    except ConnectionRefusedError:
        reason = f"nothing listens at {host}:{port}; is the server running?"
    except TimeoutError:
        reason = f"the server at {host}:{port} does not answer within {timeout_s:g} s"
    except (OSError, ValueError) as error:
        reason = f"{_one_line(error)} (at {host}:{port})"
    else:
        return
    raise BusError("socketcand", channel, reason)


def _expect(stream: socket.socket, expected: str) -> None:
    reply = stream.recv(_MAX_REPLY_BYTES).decode("ascii", "replace")
    if reply != expected:
        shown = reply.strip("<> \r\n")[:80]
        raise ValueError(f"the server says '{shown}'" if shown else "the server has closed the connection")


def _silence_client() -> None:
    """Stop python-can's client from logging what is answered with a BusError, or is harmless (a frame read in two)."""
    logging.getLogger("can.interfaces.socketcand.socketcand").setLevel(logging.CRITICAL)


def _one_line(error: Exception) -> str:
    """The cause in one line: python-can puts whole tracebacks into the text of its errors."""
    cause = error.__cause__ if isinstance(error.__cause__, OSError) else error
    if isinstance(cause, OSError) and cause.strerror:
        return cause.strerror
    lines = str(cause).strip().splitlines()
    return lines[0] if lines else type(cause).__name__
