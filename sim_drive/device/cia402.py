"""The CiA 402 power drive state machine as a device implements it (CiA 402-2, clauses 6.3 and 8.4).

Written from the standard for the drive's side alone; the master has its own table, and the two meet only on the bus.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum, IntFlag, unique
from typing import Final

from drivers.node import Event


@unique
class PowerState(IntEnum):
    """States of the power drive system."""

    NOT_READY_TO_SWITCH_ON = 0
    SWITCH_ON_DISABLED = 1
    READY_TO_SWITCH_ON = 2
    SWITCHED_ON = 3
    OPERATION_ENABLED = 4
    QUICK_STOP_ACTIVE = 5
    FAULT_REACTION_ACTIVE = 6
    FAULT = 7


@unique
class PowerCommand(IntEnum):
    """Commands that a controlword's bits 0 to 3 and 7 stand for."""

    NONE = 0
    SHUTDOWN = 1
    SWITCH_ON = 2
    """Also the command *disable operation*: the coding is one, the state decides."""
    ENABLE_OPERATION = 3
    DISABLE_VOLTAGE = 4
    QUICK_STOP = 5


class Controlword(IntFlag):
    """Bits of 6040h that are not commands of the state machine by themselves."""

    SWITCH_ON = 1 << 0
    ENABLE_VOLTAGE = 1 << 1
    QUICK_STOP = 1 << 2
    ENABLE_OPERATION = 1 << 3
    HOMING_START = 1 << 4
    NEW_SET_POINT = 1 << 4
    ENABLE_INTERPOLATION = 1 << 4
    CHANGE_IMMEDIATELY = 1 << 5
    RELATIVE = 1 << 6
    FAULT_RESET = 1 << 7
    HALT = 1 << 8
    CHANGE_ON_SET_POINT = 1 << 9


class Statusword(IntFlag):
    """Bits of 6041h beside the state."""

    VOLTAGE_ENABLED = 1 << 4
    WARNING = 1 << 7
    REMOTE = 1 << 9
    TARGET_REACHED = 1 << 10
    INTERNAL_LIMIT_ACTIVE = 1 << 11
    FOLLOWS_COMMAND = 1 << 12
    """csp and camming: the drive follows the command value."""
    HOMING_ATTAINED = 1 << 12
    SET_POINT_ACKNOWLEDGE = 1 << 12
    SPEED_ZERO = 1 << 12
    INTERPOLATION_ACTIVE = 1 << 12
    FOLLOWING_ERROR = 1 << 13
    FROZEN = 1 << 15
    """A manufacturer's bit, with the habit of freezing when a SYNC is late."""
    HOMING_ERROR = 1 << 13


STATE_BITS: Final = (0x00, 0x40, 0x21, 0x23, 0x27, 0x07, 0x0F, 0x08)
"""Bits 0 to 3, 5 and 6 of the statusword in each PowerState (quick stop, bit 5, is low-active)."""


def _command_of(low_byte: int) -> PowerCommand:
    """CiA 402-2, table of the command coding. A command has bit 7 at 0; its rising edge alone resets a fault."""
    if low_byte & 0x82 == 0x00:
        return PowerCommand.DISABLE_VOLTAGE
    if low_byte & 0x86 == 0x02:
        return PowerCommand.QUICK_STOP
    if low_byte & 0x87 == 0x06:
        return PowerCommand.SHUTDOWN
    if low_byte & 0x8F == 0x07:
        return PowerCommand.SWITCH_ON
    if low_byte & 0x8F == 0x0F:
        return PowerCommand.ENABLE_OPERATION
    return PowerCommand.NONE


COMMANDS: Final = tuple(_command_of(low_byte) for low_byte in range(256))
"""The command of each low byte of a controlword; the other bits do not matter."""

_S: Final = PowerState
_C: Final = PowerCommand

TRANSITIONS: Final[Mapping[tuple[PowerState, PowerCommand], PowerState]] = {
    (_S.SWITCH_ON_DISABLED, _C.SHUTDOWN): _S.READY_TO_SWITCH_ON,  # 2
    (_S.READY_TO_SWITCH_ON, _C.SWITCH_ON): _S.SWITCHED_ON,  # 3
    (_S.READY_TO_SWITCH_ON, _C.ENABLE_OPERATION): _S.SWITCHED_ON,  # 3, and 4 follows
    (_S.READY_TO_SWITCH_ON, _C.QUICK_STOP): _S.SWITCH_ON_DISABLED,  # 7
    (_S.READY_TO_SWITCH_ON, _C.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 7
    (_S.SWITCHED_ON, _C.ENABLE_OPERATION): _S.OPERATION_ENABLED,  # 4
    (_S.SWITCHED_ON, _C.SHUTDOWN): _S.READY_TO_SWITCH_ON,  # 6
    (_S.SWITCHED_ON, _C.QUICK_STOP): _S.SWITCH_ON_DISABLED,  # 10
    (_S.SWITCHED_ON, _C.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 10
    (_S.OPERATION_ENABLED, _C.SWITCH_ON): _S.SWITCHED_ON,  # 5
    (_S.OPERATION_ENABLED, _C.SHUTDOWN): _S.READY_TO_SWITCH_ON,  # 8
    (_S.OPERATION_ENABLED, _C.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 9
    (_S.OPERATION_ENABLED, _C.QUICK_STOP): _S.QUICK_STOP_ACTIVE,  # 11
    (_S.QUICK_STOP_ACTIVE, _C.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 12
    (_S.QUICK_STOP_ACTIVE, _C.ENABLE_OPERATION): _S.OPERATION_ENABLED,  # 16, quick stop options 5 to 8 alone
}
"""Where a command leads; a pair that is not here changes nothing. Transitions 0, 1 and 12 to 15 have other causes."""


def next_state(state: PowerState, command: PowerCommand) -> PowerState:
    """The state after one step of a command."""
    return TRANSITIONS.get((state, command), state)


@dataclass(frozen=True, slots=True)
class PowerStateChanged(Event):
    """The drive has gone from one state of the power drive system to another."""

    node_id: int
    before: PowerState
    after: PowerState
    axis: int = 1
    """Number of the logical axis."""


@unique
class Mode(IntEnum):
    """Modes of operation 6060h that the drive has."""

    CAMMING = -2
    """The manufacturer's: the axis follows a cam table in a profile slot (other vendors use -2 for it too)."""
    NONE = 0
    PROFILE_POSITION = 1
    PROFILE_VELOCITY = 3
    PROFILE_TORQUE = 4
    HOMING = 6
    INTERPOLATED_POSITION = 7
    CYCLIC_SYNCHRONOUS_POSITION = 8
    CYCLIC_SYNCHRONOUS_VELOCITY = 9
    CYCLIC_SYNCHRONOUS_TORQUE = 10


MODES: Final = {int(mode): mode for mode in Mode}
"""Modes by the value of 6060h, for the lookup without an exception."""


@unique
class StopRamp(IntEnum):
    """How an option code (605Ah to 605Eh) stops the axis."""

    NONE = 0
    """No torque from now on."""
    SLOW_DOWN = 1
    """Profile deceleration 6084h."""
    QUICK_STOP = 2
    """Quick stop deceleration 6085h."""
    CURRENT_LIMIT = 3
    """Max deceleration 60C6h: the drive has no regulator of the current alone."""
    VOLTAGE_LIMIT = 4
    """As the current limit."""


STOP_RAMPS: Final = tuple(StopRamp)
"""The StopRamp of each value 0 to 4 of an option code."""
QUICK_STOP_STAYS: Final = 5
"""From this value of 605Ah on, the ramp is that of the value less 4, and the drive stays in Quick stop active."""


@unique
class AbortConnection(IntEnum):
    """Abort connection option code 6007h: what an enabled axis does when it loses its master."""

    NO_ACTION = 0
    FAULT = 1
    DISABLE_VOLTAGE = 2
    QUICK_STOP = 3
