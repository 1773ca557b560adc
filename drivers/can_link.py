"""The CAN side of a network interface: its state and its restart, by netlink (linux/if_link.h, linux/can/netlink.h)."""

import errno
import os
import socket
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

from drivers.controller import ErrorState
from drivers.errors import BusError

_RTM_NEWLINK: Final = 16
_RTM_GETLINK: Final = 18
_NLMSG_ERROR: Final = 2
_NLM_F_REQUEST: Final = 1
_NLM_F_ACK: Final = 4
_IFLA_LINKINFO: Final = 18
_IFLA_INFO_KIND: Final = 1
_IFLA_INFO_DATA: Final = 2
_IFLA_CAN_STATE: Final = 4
_IFLA_CAN_RESTART_MS: Final = 6
_IFLA_CAN_RESTART: Final = 7
_TYPE_MASK: Final = 0x3FFF
_HEADER: Final = struct.Struct("=IHHII")
_LINK: Final = struct.Struct("=BxHiII")
_ATTRIBUTE: Final = struct.Struct("=HH")
_UNSIGNED: Final = struct.Struct("=I")
_SIGNED: Final = struct.Struct("=i")
_MAX_ANSWER_BYTES: Final = 1 << 16
_TIMEOUT_S: Final = 0.2
_STATES: Final = (ErrorState.ACTIVE, ErrorState.WARNING, ErrorState.PASSIVE, ErrorState.OFF)


@dataclass(frozen=True, slots=True)
class LinkState:
    """What the kernel says of an interface; None where it does not tell (a virtual one has neither)."""

    state: ErrorState | None
    restart_ms: int | None
    """After so long the kernel itself restarts a controller that is bus-off; 0: never."""


class NetworkLink:
    """A `drivers.bus_off.Link` to a network interface of SocketCAN."""

    def __init__(self, channel: str) -> None:
        self.channel: Final = channel

    def read(self) -> LinkState:
        """See Link."""
        return read_link(self.channel)

    def restart(self) -> None:
        """See Link."""
        restart(self.channel)


def read_link(channel: str) -> LinkState:
    """Ask the kernel; needs no privileges. Raises BusError."""
    answer = _ask(channel, _request(_RTM_GETLINK, _NLM_F_REQUEST, _index(channel), b""))
    return parse_link(answer)


def restart(channel: str) -> None:
    """Bring a controller that is bus-off back. Raises BusError with a remedy where this is refused."""
    answer = _ask(channel, restart_request(_index(channel)))
    code = error_of(answer)
    if code == errno.EPERM:
        raise _error(
            channel,
            "to restart its controller needs CAP_NET_ADMIN; 'ip link set "
            f"{channel} type can restart-ms 100', with the interface down, lets the kernel do it",
        )
    if code == errno.EOPNOTSUPP:
        raise _error(channel, "it has no controller that could be restarted")
    # Busy: it is not bus-off any more, which is as good.
    if code not in (0, errno.EBUSY):
        raise _error(channel, f"its controller cannot be restarted ({os.strerror(code)})")


def restart_request(index: int) -> bytes:
    """The netlink message that restarts the controller of interface number ``index``."""
    data = _attribute(_IFLA_CAN_RESTART, _UNSIGNED.pack(1))
    info = _attribute(_IFLA_INFO_KIND, b"can\0") + _attribute(_IFLA_INFO_DATA, data)
    return _request(_RTM_NEWLINK, _NLM_F_REQUEST | _NLM_F_ACK, index, _attribute(_IFLA_LINKINFO, info))


def parse_link(answer: bytes) -> LinkState:
    """State and restart-ms out of an RTM_NEWLINK message; whatever is not there, or cut off, is None."""
    found: dict[int, bytes] = {}
    for kind, value in _attributes(answer[_HEADER.size + _LINK.size :]):
        if kind == _IFLA_LINKINFO:
            info = dict(_attributes(value))
            if info.get(_IFLA_INFO_KIND, b"").rstrip(b"\0") == b"can":
                found = dict(_attributes(info.get(_IFLA_INFO_DATA, b"")))
    state, restart_ms = found.get(_IFLA_CAN_STATE, b""), found.get(_IFLA_CAN_RESTART_MS, b"")
    number = _UNSIGNED.unpack(state)[0] if len(state) == _UNSIGNED.size else len(_STATES)
    return LinkState(
        _STATES[number] if number < len(_STATES) else None,
        _UNSIGNED.unpack(restart_ms)[0] if len(restart_ms) == _UNSIGNED.size else None,
    )


def error_of(answer: bytes) -> int:
    """The error number in an acknowledgement, 0 for none; an answer that is no acknowledgement is EPROTO."""
    if len(answer) < _HEADER.size + _SIGNED.size or _HEADER.unpack_from(answer)[1] != _NLMSG_ERROR:
        return errno.EPROTO
    return -_SIGNED.unpack_from(answer, _HEADER.size)[0]


def _attribute(kind: int, value: bytes) -> bytes:
    packed = _ATTRIBUTE.pack(_ATTRIBUTE.size + len(value), kind) + value
    return packed.ljust(-(-len(packed) // 4) * 4, b"\0")


def _attributes(data: bytes) -> Iterator[tuple[int, bytes]]:
    while len(data) >= _ATTRIBUTE.size:
        length, kind = _ATTRIBUTE.unpack_from(data)
        if not _ATTRIBUTE.size <= length <= len(data):
            return
        yield kind & _TYPE_MASK, data[_ATTRIBUTE.size : length]
        data = data[-(-length // 4) * 4 :]


def _request(kind: int, flags: int, index: int, attributes: bytes) -> bytes:
    body = _LINK.pack(socket.AF_UNSPEC, 0, index, 0, 0) + attributes
    return _HEADER.pack(_HEADER.size + len(body), kind, flags, 1, 0) + body


def _index(channel: str) -> int:
    try:
        return socket.if_nametoindex(channel)
    except OSError:
        raise _error(channel, "no such interface") from None


def _ask(channel: str, request: bytes) -> bytes:
    try:
        with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, socket.NETLINK_ROUTE) as netlink:
            netlink.settimeout(_TIMEOUT_S)
            netlink.bind((0, 0))
            netlink.send(request)
            return netlink.recv(_MAX_ANSWER_BYTES)
    except OSError as error:
        raise _error(channel, f"the kernel does not answer ({error.strerror or error})") from None


def _error(channel: str, reason: str) -> BusError:
    return BusError("socketcan", channel, reason)
