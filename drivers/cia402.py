"""CiA 402 as the master sees it: statusword in, controlword out.

Written from the standard independently of the emulated drive's table; the two meet only on the bus.
"""

from enum import Enum, IntEnum, IntFlag
from typing import Final


class State(Enum):
    """States of the CiA 402 finite state automaton, as the statusword tells them."""

    NOT_READY_TO_SWITCH_ON = "not ready to switch on"
    SWITCH_ON_DISABLED = "switch on disabled"
    READY_TO_SWITCH_ON = "ready to switch on"
    SWITCHED_ON = "switched on"
    OPERATION_ENABLED = "operation enabled"
    QUICK_STOP_ACTIVE = "quick stop active"
    FAULT_REACTION_ACTIVE = "fault reaction active"
    FAULT = "fault"
    UNKNOWN = "no state of CiA 402"


class ModeOfOperation(IntEnum):
    """Values of 6060h that the gateway uses."""

    ELECTRONIC_CAMMING = -2
    NONE = 0
    HOMING = 6
    CYCLIC_SYNCHRONOUS_POSITION = 8
    CYCLIC_SYNCHRONOUS_TORQUE = 10


class Controlword(IntFlag):
    """Bits of the controlword 6040h."""

    SWITCH_ON = 1 << 0
    ENABLE_VOLTAGE = 1 << 1
    QUICK_STOP_INACTIVE = 1 << 2
    """The quick stop command is low-active: this bit set means *no* quick stop."""
    ENABLE_OPERATION = 1 << 3
    MODE_SPECIFIC_4 = 1 << 4
    """Homing: start."""
    FAULT_RESET = 1 << 7
    HALT = 1 << 8


class Statusword(IntFlag):
    """Bits of the statusword 6041h."""

    READY_TO_SWITCH_ON = 1 << 0
    SWITCHED_ON = 1 << 1
    OPERATION_ENABLED = 1 << 2
    FAULT = 1 << 3
    VOLTAGE_ENABLED = 1 << 4
    QUICK_STOP_INACTIVE = 1 << 5
    SWITCH_ON_DISABLED = 1 << 6
    WARNING = 1 << 7
    REMOTE = 1 << 9
    TARGET_REACHED = 1 << 10
    INTERNAL_LIMIT_ACTIVE = 1 << 11
    MODE_SPECIFIC_12 = 1 << 12
    """Homing: attained. Cyclic synchronous position: the drive follows the command."""
    MODE_SPECIFIC_13 = 1 << 13
    """Homing: error. Position modes: following error."""


COMMAND_SHUTDOWN: Final = int(Controlword.ENABLE_VOLTAGE | Controlword.QUICK_STOP_INACTIVE)
COMMAND_SWITCH_ON: Final = COMMAND_SHUTDOWN | int(Controlword.SWITCH_ON)
COMMAND_ENABLE_OPERATION: Final = COMMAND_SWITCH_ON | int(Controlword.ENABLE_OPERATION)
COMMAND_DISABLE_VOLTAGE: Final = 0
COMMAND_QUICK_STOP: Final = int(Controlword.ENABLE_VOLTAGE)
COMMAND_FAULT_RESET: Final = int(Controlword.FAULT_RESET)

STATUSWORD_PATTERNS: Final = (
    (0x4F, 0x00, State.NOT_READY_TO_SWITCH_ON),
    (0x4F, 0x40, State.SWITCH_ON_DISABLED),
    (0x6F, 0x21, State.READY_TO_SWITCH_ON),
    (0x6F, 0x23, State.SWITCHED_ON),
    (0x6F, 0x27, State.OPERATION_ENABLED),
    (0x6F, 0x07, State.QUICK_STOP_ACTIVE),
    (0x4F, 0x0F, State.FAULT_REACTION_ACTIVE),
    (0x4F, 0x08, State.FAULT),
)
"""Mask, value and state (CiA 402-2, statusword)."""


def _decode(low_bits: int) -> State:
    for mask, value, state in STATUSWORD_PATTERNS:
        if low_bits & mask == value:
            return state
    return State.UNKNOWN


_STATE_OF_LOW_BITS: Final = tuple(_decode(bits) for bits in range(128))


def state_of(statusword: int) -> State:
    """State that a statusword tells; UNKNOWN for a pattern that the standard does not give."""
    return _STATE_OF_LOW_BITS[statusword & 0x7F]


NEXT_COMMAND_TO_ENABLE: Final = {
    State.NOT_READY_TO_SWITCH_ON: None,
    State.SWITCH_ON_DISABLED: COMMAND_SHUTDOWN,
    State.READY_TO_SWITCH_ON: COMMAND_SWITCH_ON,
    State.SWITCHED_ON: COMMAND_ENABLE_OPERATION,
    State.OPERATION_ENABLED: COMMAND_ENABLE_OPERATION,
    State.QUICK_STOP_ACTIVE: COMMAND_DISABLE_VOLTAGE,
    State.FAULT_REACTION_ACTIVE: None,
    State.FAULT: None,
    State.UNKNOWN: None,
}
"""Command that brings a drive one transition nearer to Operation enabled; None: wait, or it is not ours to leave
(a fault is reset on purpose, with an edge, never on the way)."""
