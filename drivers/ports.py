"""Ports: how the real-time host reaches a bus, whichever it is."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, Protocol

from drivers.bus_off import Link
from drivers.controller import Controller
from drivers.frame import Frame
from drivers.python_can_port import PythonCanPort, open_socketcand
from drivers.socketcan_port import SocketcanPort

SOCKETCAND_DEFAULT_PORT: Final = 29536
"""TCP port of a socketcand server that is given none."""

_NETWORK_INTERFACES: Final = Path("/sys/class/net")
_ARPHRD_CAN: Final = 280
_IFF_UP: Final = 1


class Port(Protocol):
    """An open connection to one CAN bus, without blocking except in ``wait``."""

    outlives_bus_off: bool
    """A controller that goes bus-off is no lost bus: whoever sets this sees to it that it comes back."""

    @property
    def controller(self) -> Controller:
        """What the interface tells of its own controller."""
        ...

    @property
    def link(self) -> Link | None:
        """What can restart the controller; None where the interface offers nothing."""
        ...

    def send(self, frame: Frame) -> bool:
        """Give ``frame`` to the bus; False when its transmit queue is full, or the controller bus-off, and the frame
        was not taken.

        Raises:
            BusError: the bus has gone away.
        """
        ...

    def receive(self) -> tuple[Frame, int] | None:
        """The oldest frame that has arrived and its arrival on the ``time.monotonic_ns`` clock; None if there is none.

        None may also mean that there was none a moment ago, when the queue was read; ``wait`` then ends at once.

        Raises:
            BusError: the bus has gone away, or the controller has gone bus-off and nobody ``outlives_bus_off``.
        """
        ...

    def wait(self, timeout_s: float) -> bool:
        """Wait until a frame may have arrived, at most ``timeout_s``, to the microsecond; True if so.

        Only to be called after ``receive`` has answered None: what a port has read ahead does not end the wait.

        Raises:
            BusError: the bus has gone away.
        """
        ...

    def fileno(self) -> int:
        """File descriptor that becomes readable with the next frame, or -1 where the interface has none."""
        ...

    def close(self) -> None:
        """Leave the bus; may be called twice."""
        ...


def open_port(
    interface: str,
    channel: str,
    *,
    host: str = "127.0.0.1",
    port: int = SOCKETCAND_DEFAULT_PORT,
    filters: Sequence[tuple[int, int]] | None = None,
    **options: Any,
) -> Port:
    """Open ``channel`` of ``interface``.

    ``socketcan`` is a raw socket of this package's own; ``socketcand`` connects to the server at ``host`` and ``port``;
    every other name is a python-can interface, which is given ``options`` as they are. ``filters`` are pairs of COB-ID
    and mask; a frame passes that agrees with one of them in the bits of its mask. None lets all pass.

    Raises:
        BusError: there is no such interface or channel, it is down, or it does not answer; ``reason`` says which.
    """
    if interface == "socketcan":
        return SocketcanPort(channel, filters)
    if interface == "socketcand":
        return open_socketcand(channel, host, port, filters)
    return PythonCanPort.open(interface, channel, filters, options)


def interface_is_up(name: str, root: Path = _NETWORK_INTERFACES) -> bool:
    """Whether there is a CAN network interface ``name`` that is up (vcan0, can0), as the kernel's ``root`` tells it."""
    if not name or "/" in name or name in (".", ".."):
        return False
    try:
        is_can = int((root / name / "type").read_text()) == _ARPHRD_CAN
        is_up = int((root / name / "flags").read_text(), 16) & _IFF_UP
        # A virtual interface has no carrier to report: its state is "unknown" for good.
        is_operating = (root / name / "operstate").read_text().strip() in ("up", "unknown")
    except (OSError, ValueError):
        return False
    return is_can and bool(is_up) and is_operating
