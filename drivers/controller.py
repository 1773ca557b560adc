"""The error state of the own CAN controller, as its error frames tell it (linux/can/error.h); a core without I/O."""

from dataclasses import dataclass
from enum import Enum, IntFlag
from typing import Final

from drivers.node import Event

_CONTROLLER_BYTE: Final = 1
_WARNING_BITS: Final = 0x04 | 0x08
_PASSIVE_BITS: Final = 0x10 | 0x20
_ACTIVE_BIT: Final = 0x40
_TRANSMIT_COUNTER_BYTE: Final = 6
_RECEIVE_COUNTER_BYTE: Final = 7


class BusErrorClass(IntFlag):
    """What an error frame reports (linux/can/error.h)."""

    TRANSMIT_TIMEOUT = 0x001
    LOST_ARBITRATION = 0x002
    CONTROLLER = 0x004
    PROTOCOL = 0x008
    TRANSCEIVER = 0x010
    NO_ACKNOWLEDGE = 0x020
    BUS_OFF = 0x040
    BUS_ERROR = 0x080
    RESTARTED = 0x100
    COUNTERS = 0x200


class ErrorState(Enum):
    """Fault confinement of ISO 11898-1: by the greater of both error counters."""

    ACTIVE = "error-active"
    """Below 96."""
    WARNING = "error-warning"
    """From 96 on."""
    PASSIVE = "error-passive"
    """From 128 on."""
    OFF = "bus-off"
    """The transmit counter has passed 255: nothing is sent and nothing received until the controller is restarted."""


@dataclass(frozen=True, slots=True)
class ControllerChanged(Event):
    """The own controller has another error state; the counters as the last error frame had them."""

    state: ErrorState
    transmit_errors: int
    receive_errors: int


class Controller:
    """What is known of the own controller: its error state, its counters, and what its error frames have reported."""

    __slots__ = ("counts", "frame_count", "is_off", "is_restless", "receive_errors", "state", "transmit_errors")

    def __init__(self) -> None:
        self.state: ErrorState = ErrorState.ACTIVE
        self.is_off = False
        """It has left the bus: nothing goes out."""
        self.transmit_errors = 0
        self.receive_errors = 0
        self.counts: Final = dict.fromkeys(BusErrorClass, 0)
        """Error frames by what they reported; one may report several things."""
        self.frame_count = 0
        """Error frames, whatever they reported."""
        self.is_restless = False
        """The state has changed since somebody last looked, and set this back."""

    def take(self, identifier: int, data: bytes) -> None:
        """Take an error frame: the identifier with its classes, and its data, of which what is missing is 0."""
        self.frame_count += 1
        for error_class in BusErrorClass:
            if identifier & error_class:
                self.counts[error_class] += 1
        details = data.ljust(8, b"\0")
        if identifier & (BusErrorClass.CONTROLLER | BusErrorClass.COUNTERS):
            self.transmit_errors = details[_TRANSMIT_COUNTER_BYTE]
            self.receive_errors = details[_RECEIVE_COUNTER_BYTE]
        if identifier & BusErrorClass.BUS_OFF:
            self.change(ErrorState.OFF)
        elif identifier & BusErrorClass.RESTARTED:
            self.transmit_errors = self.receive_errors = 0
            self.change(ErrorState.ACTIVE)
        elif identifier & BusErrorClass.CONTROLLER:
            self._take_state(details[_CONTROLLER_BYTE])

    def change(self, state: ErrorState) -> None:
        """The state is known from elsewhere."""
        if state is not self.state:
            self.state = state
            self.is_off = state is ErrorState.OFF
            self.is_restless = True

    def _take_state(self, bits: int) -> None:
        """The gravest of what is told; overflows of the controller's buffers tell nothing of its state."""
        if bits & _ACTIVE_BIT:
            self.change(ErrorState.ACTIVE)
        elif self.is_off:
            # A late report of the way there: only a restart, or counters back at zero, ends it.
            return
        elif bits & _PASSIVE_BITS:
            self.change(ErrorState.PASSIVE)
        elif bits & _WARNING_BITS:
            self.change(ErrorState.WARNING)
