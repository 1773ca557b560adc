"""Procedures that take one axis through CiA 402 while the cycle runs: fault reset, modes, homing, enabling, disabling.

They set the controlword that the cycle sends and watch the statusword that it receives; modes go by SDO.
"""

from dataclasses import dataclass
from typing import Final

from drivers import cia402, objects
from drivers.cia402 import Controlword, ModeOfOperation, State, Statusword, state_of
from drivers.errors import NoAnswerError
from drivers.master import Master, Procedure
from drivers.object_dictionary import DataType
from gateway.cyclic.axis_channel import AxisChannel
from gateway.cyclic.cycle import CyclicLoop
from gateway.errors import CommissioningError
from gateway.running.commissioning import NodeSettings

NS_PER_S: Final = 1_000_000_000
START_CYCLES: Final = 4
"""Cycles after which a drive shows what it makes of a controlword: sent, applied at SYNC, sampled, returned."""
ENABLE_TIMEOUT_S: Final = 2.0
HOMING_TIMEOUT_S: Final = 5.0
MODE_TIMEOUT_S: Final = 1.0
MODE_POLL_S: Final = 0.002
DISABLE_TIMEOUT_S: Final = 0.5

FAULTY: Final = (State.FAULT, State.FAULT_REACTION_ACTIVE)
_WITHOUT_TORQUE: Final = (State.READY_TO_SWITCH_ON, State.SWITCH_ON_DISABLED)


@dataclass(frozen=True, slots=True)
class AxisSetup:
    """One axis of a session: the drive, how it is homed, and the channel that the cycle uses."""

    node: NodeSettings
    channel: AxisChannel
    homing_method: int | None


class AxisPower:
    """The procedures, for any axis of one master and one cycle. All raise drivers.errors.NodeError or
    CommissioningError, and leave the axis as it then is: disabling it is the session's business.
    """

    def __init__(self, master: Master, loop: CyclicLoop) -> None:
        self._master = master
        self._loop = loop

    def cycles(self, count: int) -> Procedure[None]:
        """Let so many cycles pass."""
        yield from self._master.pause(count * self._loop.period_ns / NS_PER_S)

    def reset_fault(self, axis: AxisSetup) -> Procedure[None]:
        """Reset, once and with a real edge, a fault that is there from before the session."""
        channel = axis.channel
        if state_of(channel.statusword) not in FAULTY:
            return
        channel.controlword = cia402.COMMAND_DISABLE_VOLTAGE
        yield from self.cycles(START_CYCLES)
        channel.controlword = cia402.COMMAND_FAULT_RESET
        reset = yield from self._master.wait_for(lambda: state_of(channel.statusword) not in FAULTY, DISABLE_TIMEOUT_S)
        channel.controlword = cia402.COMMAND_DISABLE_VOLTAGE
        if not reset:
            raise CommissioningError([f"node {axis.node.node_id} has a fault that cannot be reset{self._cause(axis)}"])

    def set_mode(self, axis: AxisSetup, mode: ModeOfOperation) -> Procedure[None]:
        """Write 6060h and wait until 6061h shows the mode."""
        node_id = axis.node.node_id
        yield from self._master.write(node_id, objects.MODES_OF_OPERATION, 0, DataType.INTEGER8, int(mode))
        deadline_ns = self._master.now_ns + round(MODE_TIMEOUT_S * NS_PER_S)
        while True:
            active = yield from self._master.read_int(node_id, objects.MODES_OF_OPERATION_DISPLAY, 0, DataType.INTEGER8)
            if active == mode:
                return
            if self._master.now_ns >= deadline_ns:
                raise NoAnswerError(node_id, f"mode of operation {int(mode)} (6061h stays {active})", MODE_TIMEOUT_S)
            yield from self._master.pause(MODE_POLL_S)

    def is_homed(self, axis: AxisSetup) -> Procedure[bool]:
        """Whether the drive has a reference: bit 12 of the statusword in the homing mode, in which it is left."""
        yield from self.set_mode(axis, ModeOfOperation.HOMING)
        yield from self.cycles(START_CYCLES)
        return bool(axis.channel.statusword & Statusword.MODE_SPECIFIC_12)

    def home(self, axis: AxisSetup, is_homing_again: bool) -> Procedure[bool]:
        """Homing on the current position (CiA 402-2, methods 35 and 37); False if the drive is homed already.

        A homed drive keeps its zero unless ``is_homing_again``: to home it anew, wherever it stands, would give the
        linkage a wrong phase between its axes.
        """
        node_id, channel = axis.node.node_id, axis.channel
        yield from self._master.write(node_id, objects.HOMING_METHOD, 0, DataType.INTEGER8, axis.homing_method or 0)
        is_homed = yield from self.is_homed(axis)
        if is_homed and not is_homing_again:
            return False
        yield from self.enable(axis)
        channel.controlword = cia402.COMMAND_ENABLE_OPERATION | int(Controlword.MODE_SPECIFIC_4)
        # An earlier homing may still be shown as attained until the drive has seen the new start.
        yield from self.cycles(START_CYCLES)
        done = Statusword.TARGET_REACHED | Statusword.MODE_SPECIFIC_12
        attained = yield from self._master.wait_for(
            lambda: channel.statusword & done == done or bool(channel.statusword & Statusword.MODE_SPECIFIC_13),
            HOMING_TIMEOUT_S,
        )
        if not attained or channel.statusword & Statusword.MODE_SPECIFIC_13:
            word = f"statusword {channel.statusword:04X}h (bit 13: homing error)"
            raise CommissioningError([f"node {node_id}: homing failed, {word}{self._cause(axis)}"])
        channel.controlword = cia402.COMMAND_ENABLE_OPERATION
        yield from self.disable(axis)
        return True

    def enable(self, axis: AxisSetup) -> Procedure[None]:
        """To Operation enabled, one transition after the other. A fault on the way is never reset, it is told."""
        node_id, channel = axis.node.node_id, axis.channel
        deadline_ns = self._master.now_ns + round(ENABLE_TIMEOUT_S * NS_PER_S)
        while (state := state_of(channel.statusword)) is not State.OPERATION_ENABLED:
            if state in FAULTY:
                raise CommissioningError([f"node {node_id} went into a fault while being enabled{self._cause(axis)}"])
            if self._master.now_ns >= deadline_ns:
                stays = f"it stays in '{state.value}'" if self._loop.actuals_are_valid else "its TPDOs have stopped"
                raise NoAnswerError(node_id, f"Operation enabled, {stays}", ENABLE_TIMEOUT_S)
            command = cia402.NEXT_COMMAND_TO_ENABLE[state]
            if command is not None:
                channel.controlword = command
            yield from self._master.wait_for(
                lambda state=state: state_of(channel.statusword) is not state,
                (deadline_ns - self._master.now_ns) / NS_PER_S,
            )

    def disable(self, axis: AxisSetup) -> Procedure[None]:
        """To Ready to switch on or below: no torque, brake applied."""
        channel = axis.channel
        channel.controlword = cia402.COMMAND_SHUTDOWN
        done = yield from self._master.wait_for(
            lambda: state_of(channel.statusword) in _WITHOUT_TORQUE, DISABLE_TIMEOUT_S
        )
        if not done:
            what = f"Ready to switch on, it stays in '{state_of(channel.statusword).value}'"
            raise NoAnswerError(axis.node.node_id, what, DISABLE_TIMEOUT_S)

    def _cause(self, axis: AxisSetup) -> str:
        emergency = self._master.nodes[axis.node.node_id].last_emergency
        return f" (last EMCY {emergency.code:04X}h)" if emergency is not None and emergency.code else ""
