"""One client's side of the socketcand text protocol, without a socket.

The protocol is that of the program socketcand (https://github.com/linux-can/socketcand), as far as its raw mode goes:
the client says ``< open NAME >``, ``< rawmode >`` and ``< send ID LENGTH BYTES >``, the server answers ``< ok >`` or
``< error ... >`` and tells every frame as ``< frame ID SECONDS.MICROSECONDS HEXDATA >``. Beyond that
program, ``< wire >`` is answered with ``< wire none >``: behind this server frames take no time.
"""

import re
from enum import Enum
from typing import Final, NamedTuple

from drivers.socketcand_word import COMMAND as WIRE_COMMAND
from drivers.socketcand_word import NO_WIRE

GREETING: Final = b"< hi >"
MAX_COMMAND_BYTES: Final = 256

_OK: Final = b"< ok >"
_SEND: Final = re.compile(r"([0-9A-Fa-f]{1,8}) ([0-8])((?: [0-9A-Fa-f]{1,2}){0,8})")
_BASE_DIGITS: Final = 3
_MAX_BASE_IDENTIFIER: Final = 0x7FF
_MAX_EXTENDED_IDENTIFIER: Final = 0x1FFFFFFF


class SessionState(Enum):
    """How far the client has come."""

    NO_BUS = "no bus open"
    BUS_OPEN = "bus open"
    RAW = "raw mode"


class SocketcandFrame(NamedTuple):
    """A data frame as the protocol tells it; unlike CANopen's it may have a 29-bit identifier."""

    identifier: int
    data: bytes
    is_extended: bool = False


class SocketcandSession:
    """What one client has said, and the answers that it is owed.

    Whatever bytes come in, nothing is raised: what is no command is answered with an error or, outside of angle
    brackets, ignored. At most ``MAX_COMMAND_BYTES`` of an unfinished command are kept.
    """

    def __init__(self, channel: str) -> None:
        """Serve the bus called ``channel``."""
        self._channel = channel
        self._state = SessionState.NO_BUS
        self._input = b""
        self._output = bytearray(GREETING)

    @property
    def state(self) -> SessionState:
        """How far the client has come; in RAW it wants to hear all frames."""
        return self._state

    def receive_data(self, data: bytes) -> list[SocketcandFrame]:
        """Take bytes from the client and give the frames that it wants sent, oldest first."""
        frames: list[SocketcandFrame] = []
        *commands, rest = (self._input + data).split(b">")
        for command in commands:
            _, bracket, text = command.rpartition(b"<")
            if len(text) > MAX_COMMAND_BYTES:
                self._refuse("command too long")
            elif bracket:
                frame = self._execute(text)
                if frame is not None:
                    frames.append(frame)
        _, bracket, text = rest.rpartition(b"<")
        if len(text) > MAX_COMMAND_BYTES:
            self._refuse("command too long")
            bracket = b""
        self._input = bracket + text if bracket else b""
        return frames

    def take_output(self) -> bytes:
        """Bytes for the client; they are the caller's from here on."""
        output = bytes(self._output)
        self._output.clear()
        return output

    def _execute(self, text: bytes) -> SocketcandFrame | None:
        name, *arguments = text.decode("ascii", "replace").split() or [""]
        match name, self._state:
            case "send", SessionState.BUS_OPEN | SessionState.RAW:
                frame = _parse_send(" ".join(arguments))
                if frame is None:
                    self._refuse("could not parse send command")
                return frame
            case "open", SessionState.NO_BUS:
                if arguments == [self._channel]:
                    self._state = SessionState.BUS_OPEN
                    self._output += _OK
                else:
                    self._refuse("could not open bus")
            case "rawmode", SessionState.BUS_OPEN:
                self._state = SessionState.RAW
                self._output += _OK
            case "echo", _:
                self._output += b"< echo >"
            case command, _ if command == WIRE_COMMAND:
                self._output += NO_WIRE
            case (("send" | "rawmode"), SessionState.NO_BUS):
                self._refuse("no bus is open")
            case (("open" | "rawmode"), _):
                self._refuse(f"{name} comes too late")
            case _:
                self._refuse("unknown command")
        return None

    def _refuse(self, reason: str) -> None:
        self._output += b"< error %s >" % reason.encode("ascii")


def encode_frame(frame: SocketcandFrame, time_of_day_ns: int) -> bytes:
    """``frame`` as clients are told of it; ``time_of_day_ns`` is when it was on the bus (Unix time)."""
    seconds, nanoseconds = divmod(time_of_day_ns, 1_000_000_000)
    digits = 8 if frame.is_extended else _BASE_DIGITS
    # An empty frame leaves two blanks; python-can's client counts on the second.
    return (
        f"< frame {frame.identifier:0{digits}X} {seconds}.{nanoseconds // 1000:06d} {frame.data.hex().upper()} >"
    ).encode("ascii")


def _parse_send(arguments: str) -> SocketcandFrame | None:
    match = _SEND.fullmatch(arguments)
    if match is None:
        return None
    identifier_text, length, data_text = match.groups()
    identifier = int(identifier_text, 16)
    is_extended = len(identifier_text) > _BASE_DIGITS
    data = bytes(int(text, 16) for text in data_text.split())
    if len(data) != int(length):
        return None
    if identifier > (_MAX_EXTENDED_IDENTIFIER if is_extended else _MAX_BASE_IDENTIFIER):
        return None
    return SocketcandFrame(identifier, data, is_extended)
