"""What python-can's interfaces tell of the own controller, as far as they do; they differ.

``socketcand`` passes on the kernel's error frames, without their data. ``pcan`` has a status word, refuses to send and
receive while it is bus-off, and can be reset. Of the others some have a ``state``; ``slcan`` tells nothing at all.
"""

from collections.abc import Callable
from typing import Any, Final

import can

from drivers.can_link import LinkState
from drivers.controller import Controller, ErrorState
from drivers.errors import BusError

_PCAN_BUS_OFF: Final = 0x00010
_PCAN_BUS_PASSIVE: Final = 0x40000
_PCAN_BUS_HEAVY: Final = 0x00008
_KERNEL_INTERFACES: Final = ("socketcand", "socketcan")


def told_state(bus: can.BusABC, interface: str) -> ErrorState | None:
    """The controller's error state by the interface's own account; None where it gives none."""
    try:
        if interface == "pcan":
            return _pcan_state(int(bus.status()))  # type: ignore[attr-defined]
        return ErrorState.OFF if bus.state is can.BusState.ERROR else None
    # Driver libraries raise what they like, also when the device has been pulled out.
    except Exception:
        return None


def _pcan_state(status: int) -> ErrorState:
    if status & _PCAN_BUS_OFF:
        return ErrorState.OFF
    if status & _PCAN_BUS_PASSIVE:
        return ErrorState.PASSIVE
    return ErrorState.WARNING if status & _PCAN_BUS_HEAVY else ErrorState.ACTIVE


def take_error_frame(controller: Controller, bus: can.BusABC, interface: str, message: can.Message) -> None:
    """Note what an error frame says: the kernel's classes, or else what the interface's account now is."""
    if interface in _KERNEL_INTERFACES:
        controller.take(message.arbitration_id, bytes(message.data))
        return
    controller.take(0, b"")
    state = told_state(bus, interface)
    if state is not None:
        controller.change(state)


class PythonCanLink:
    """A `drivers.bus_off.Link` to an interface that can be reset, and says how it is."""

    def __init__(self, bus: can.BusABC, interface: str, channel: str) -> None:
        self._bus = bus
        self._interface = interface
        self._channel = channel

    def read(self) -> LinkState:
        """See Link."""
        return LinkState(told_state(self._bus, self._interface), None)

    def restart(self) -> None:
        """See Link. Raises BusError."""
        reset: Callable[[], Any] = self._bus.reset  # type: ignore[attr-defined]
        try:
            is_refused = reset() is False
        except Exception as error:
            raise self._error(str(error).partition("\n")[0]) from None
        if is_refused:
            raise self._error("the reset is refused")

    def _error(self, reason: str) -> BusError:
        return BusError(self._interface, self._channel, f"its controller cannot be restarted ({reason})")


def link_to(bus: can.BusABC, interface: str, channel: str) -> PythonCanLink | None:
    """The way to restart this bus' controller; None where the interface knows none that leaves the bus open."""
    return PythonCanLink(bus, interface, channel) if interface == "pcan" and hasattr(bus, "reset") else None
