"""The gateway as one core: commissioning, homing, enabling, the run on the cam, and the way back to a safe standstill.

It implements ``drivers.node.Node``; the virtual-time and the real-time host drive the same object.
"""

from contextlib import suppress
from dataclasses import dataclass
from typing import Final

from drivers import cia402, objects
from drivers.cia402 import ModeOfOperation, State, Statusword, state_of
from drivers.errors import DriveError, NoAnswerError, NodeError
from drivers.frame import Frame
from drivers.master import BootUpReceived, EmergencyReceived, HeartbeatLost, Master, NodeStateChanged, Procedure
from drivers.nmt import NmtCommand, NmtState
from drivers.node import Event
from drivers.object_dictionary import DataType
from gateway.commissioning import (
    NetworkSettings,
    NodeSettings,
    commission,
    for_all,
    release_heartbeat,
    start_nodes,
)
from gateway.cycle import AxisChannel, CyclicLoop
from gateway.demand import CamDemand
from gateway.errors import CommissioningError, GatewayError
from gateway.guard import Condition, Guard, StopReason
from gateway.sample import Phase
from mechanism.motion import MasterPlan

NS_PER_S: Final = 1_000_000_000
SETTLE_S: Final = 0.1
"""Standstill under guard before the motion begins, and after it before the drives are disabled."""
WATCH_AFTER_DISABLING_S: Final = 0.02
"""For so long the cycle goes on after the drives are disabled, to see and record that they stay where they are."""
START_CYCLES: Final = 4
"""Cycles after which a drive shows what it makes of a controlword: sent, applied at SYNC, sampled, returned."""
ENABLE_TIMEOUT_S: Final = 2.0
HOMING_TIMEOUT_S: Final = 5.0
MODE_TIMEOUT_S: Final = 1.0
STANDSTILL_TIMEOUT_S: Final = 3.0
DISABLE_TIMEOUT_S: Final = 0.5
START_WINDOW_COUNTS: Final = 20
"""How far from the cam's start an axis may stand; more is a linkage that would jump."""
STANDSTILL_COUNTS: Final = 2
"""An axis that has moved no more than this in ``STANDSTILL_SPAN_S`` stands."""
STANDSTILL_SPAN_S: Final = 0.05


@dataclass(frozen=True, slots=True)
class StepReached(Event):
    """A named step of the session begins."""

    step: str


@dataclass(frozen=True, slots=True)
class AxisSetup:
    """One axis of a session: the drive, how it is homed, and the channel that the cycle uses."""

    node: NodeSettings
    channel: AxisChannel
    homing_method: int | None


class OperatorStopError(GatewayError):
    """Somebody asked for a stop before the machine was in motion."""


class GatewayCore:
    """One session with the machine, from boot-up to disabled drives."""

    def __init__(
        self,
        axes: list[AxisSetup],
        network: NetworkSettings,
        master: Master,
        loop: CyclicLoop,
        demand: CamDemand,
        plan: MasterPlan,
        guard: Guard,
        is_homing_again: bool = False,
    ) -> None:
        """``is_homing_again``: home the axes where they stand even if their drives are homed already."""
        self.loop = loop
        self.master = master
        self.is_done = False
        self.failure: Exception | None = None
        """Why the session could not be carried out; a stop that the guard called for is no failure of the session."""
        self.stopped_by = StopReason.COMPLETED
        self._axes = axes
        self._nodes = [axis.node for axis in axes]
        self._network = network
        self._demand = demand
        self._plan = plan
        self._guard = guard
        self._is_homing_again = is_homing_again
        self._is_stop_requested = False
        self._is_interruptible = True
        """Before anything is in motion a stop request ends the session where it is."""
        self._events: list[Event] = []
        self._axis_of_node = {axis.node.node_id: number for number, axis in enumerate(axes)}
        self._session: Procedure[None] | None = None
        self._resume_at_ns: int | None = 0

    # -- the seam ------------------------------------------------------------------------------------------------

    def receive(self, frame: Frame, now_ns: int) -> None:
        """Take a frame: a TPDO goes to the cycle, everything else to the master."""
        loop = self.loop
        number = loop.tpdo_slots.get(frame.cob_id)
        if number is not None:
            if loop.is_running and not frame.is_remote and loop.receive_tpdo(number, frame.data, now_ns):
                self._resume(now_ns)
            return
        self.master.receive(frame, now_ns)
        self._watch(now_ns)
        self._resume(now_ns)

    def next_wake_ns(self) -> int | None:
        """The earliest of cycle, heartbeats and the session's own time-out; None when the session is over."""
        if self.is_done:
            return None
        due = self._resume_at_ns
        heartbeat_due = self.master.next_wake_ns()
        if due is None or (heartbeat_due is not None and heartbeat_due < due):
            due = heartbeat_due
        if self.loop.is_running:
            cycle_due = self.loop.next_wake_ns()
            if due is None or cycle_due < due:
                return cycle_due
        return due

    def wake(self, now_ns: int) -> None:
        """Do what is due."""
        closed = self.loop.wake(now_ns) if self.loop.is_running else False
        heartbeat_due = self.master.next_wake_ns()
        if heartbeat_due is not None and now_ns >= heartbeat_due:
            self.master.wake(now_ns)
            self._watch(now_ns)
        if closed or (self._resume_at_ns is not None and now_ns >= self._resume_at_ns):
            self._resume(now_ns)

    def take_frames(self) -> list[Frame]:
        """Frames to send: the cycle's first, so that SDO traffic never delays a demand."""
        frames = self.loop.outbox
        if frames:
            self.loop.outbox = []
        if self.master.outbox:
            frames = frames + self.master.outbox
            self.master.outbox = []
        return frames

    def take_events(self) -> list[Event]:
        """Events since the last call."""
        if not self._events:
            return []
        events, self._events = self._events, []
        return events

    # -- commands from outside -----------------------------------------------------------------------------------

    def request_stop(self) -> None:
        """Controlled stop: on the cam if in motion, else straight back to disabled drives. May be called repeatedly."""
        self._is_stop_requested = True

    def request_quick_stop(self) -> None:
        """Quick stop on all drives."""
        self._is_stop_requested = True
        if self.loop.is_running and self.loop.phase is not Phase.QUICK_STOP:
            self.loop.quick_stop()

    # -- inside --------------------------------------------------------------------------------------------------

    def _watch(self, now_ns: int) -> None:
        """Turn the master's events into ours, and into guarded conditions while the drives are enabled."""
        events = self.master.events
        if not events:
            return
        self.master.events = []
        self._events += events
        if not self.loop.is_guarding_enabled:
            return
        for event in events:
            if isinstance(event, EmergencyReceived) and event.code:
                self._guard.hold(Condition.EMERGENCY, self._axis_of_node[event.node_id], event.code, 0, now_ns)
            elif isinstance(event, (HeartbeatLost, BootUpReceived)) or (
                isinstance(event, NodeStateChanged) and event.state is not NmtState.OPERATIONAL
            ):
                timeout_ms = self._network.heartbeat_timeout_ms
                self._guard.hold(
                    Condition.HEARTBEAT_LOST, self._axis_of_node[event.node_id], timeout_ms, timeout_ms, now_ns
                )
        self.loop.react()

    def _resume(self, now_ns: int) -> None:
        if self._guard.tripped:
            self.loop.react()
            self._events += self._guard.tripped
            self._guard.tripped = []
        if self.is_done:
            return
        self.master.now_ns = now_ns
        if self._session is None:
            self._session = self._run()
        try:
            if self._is_stop_requested and self._is_interruptible:
                self._resume_at_ns = self._session.throw(OperatorStopError("stopped on request"))
            else:
                self._resume_at_ns = next(self._session)
        except StopIteration:
            self.is_done = True
            self._resume_at_ns = None
        if self.master.events:
            self._events += self.master.events
            self.master.events = []

    def _step(self, name: str) -> None:
        self._events.append(StepReached(self.master.now_ns, name))

    def _run(self) -> Procedure[None]:
        """The whole session; whatever happens in it, it ends with the drives disabled."""
        try:
            yield from self._commission()
            yield from self._home_all()
            yield from self._enable_all()
            self._is_interruptible = False
            yield from self._move()
        except OperatorStopError:
            self.stopped_by = StopReason.OPERATOR
        except (DriveError, GatewayError) as error:
            self.failure = error
            self.stopped_by = self._guard.stopped_by or StopReason.COMMISSIONING
        self._is_interruptible = False
        yield from self._shut_down()

    def _commission(self) -> Procedure[None]:
        self._step("commissioning")
        yield from commission(self.master, self._nodes, self._network)
        self._step("starting the cycle")
        start_nodes(self.master, self._nodes)
        self.loop.start(self.master.now_ns)
        answered = yield from self.master.wait_for(lambda: self.loop.actuals_are_valid, self._network.boot_up_timeout_s)
        if not answered:
            raise CommissioningError(
                [
                    f"axis {axis.node.name}: no TPDO {axis.channel.tpdo_cob_id:03X}h arrives after SYNC"
                    for axis in self._axes
                    if axis.channel.statusword == 0
                ]
                or ["the drives do not answer every SYNC with their TPDOs"]
            )

    def _home_all(self) -> Procedure[None]:
        for axis in self._axes:
            if axis.homing_method is None:
                continue
            self._step(f"homing axis {axis.node.name}")
            yield from for_all([axis.node], lambda _, axis=axis: self._home(axis))

    def _home(self, axis: AxisSetup) -> Procedure[None]:
        """Homing on the current position (CiA 402-2, methods 35 and 37)."""
        node_id, channel = axis.node.node_id, axis.channel
        yield from self.master.write(node_id, objects.HOMING_METHOD, 0, DataType.INTEGER8, axis.homing_method or 0)
        yield from self._set_mode(axis, ModeOfOperation.HOMING)
        yield from self._cycles(START_CYCLES)
        if channel.statusword & Statusword.MODE_SPECIFIC_12 and not self._is_homing_again:
            # To home it anew, wherever it stands, would give the linkage a wrong phase between its axes.
            self._step(f"axis {axis.node.name} is homed already")
            return
        yield from self._enable(axis)
        channel.controlword = cia402.COMMAND_ENABLE_OPERATION | int(cia402.Controlword.MODE_SPECIFIC_4)
        # An earlier homing may still be shown as attained until the drive has seen the new start.
        yield from self._cycles(START_CYCLES)
        done = Statusword.TARGET_REACHED | Statusword.MODE_SPECIFIC_12
        attained = yield from self.master.wait_for(
            lambda: channel.statusword & done == done or bool(channel.statusword & Statusword.MODE_SPECIFIC_13),
            HOMING_TIMEOUT_S,
        )
        if not attained or channel.statusword & Statusword.MODE_SPECIFIC_13:
            raise CommissioningError(
                [f"node {node_id}: homing failed, statusword {channel.statusword:04X}h (bit 13: homing error)"]
            )
        channel.controlword = cia402.COMMAND_ENABLE_OPERATION
        yield from self._disable(axis)

    def _cycles(self, count: int) -> Procedure[None]:
        yield from self.master.pause(count * self.loop.period_ns / NS_PER_S)

    def _set_mode(self, axis: AxisSetup, mode: ModeOfOperation) -> Procedure[None]:
        node_id = axis.node.node_id
        yield from self.master.write(node_id, objects.MODES_OF_OPERATION, 0, DataType.INTEGER8, int(mode))
        deadline_ns = self.master.now_ns + round(MODE_TIMEOUT_S * NS_PER_S)
        while True:
            active = yield from self.master.read_int(node_id, objects.MODES_OF_OPERATION_DISPLAY, 0, DataType.INTEGER8)
            if active == mode:
                return
            if self.master.now_ns >= deadline_ns:
                raise NoAnswerError(node_id, f"mode of operation {int(mode)} (6061h stays {active})", MODE_TIMEOUT_S)
            yield from self.master.pause(0.002)

    def _enable(self, axis: AxisSetup) -> Procedure[None]:
        """To Operation enabled, one transition after the other; a fault that is there from before is reset once."""
        channel = axis.channel
        if state_of(channel.statusword) in {State.FAULT, State.FAULT_REACTION_ACTIVE}:
            channel.controlword = cia402.COMMAND_DISABLE_VOLTAGE
            yield from self._cycles(START_CYCLES)
            channel.controlword = cia402.COMMAND_FAULT_RESET
            yield from self.master.wait_for(lambda: state_of(channel.statusword) is not State.FAULT, DISABLE_TIMEOUT_S)
            channel.controlword = cia402.COMMAND_DISABLE_VOLTAGE
        deadline_ns = self.master.now_ns + round(ENABLE_TIMEOUT_S * NS_PER_S)
        while (state := state_of(channel.statusword)) is not State.OPERATION_ENABLED:
            command = cia402.NEXT_COMMAND_TO_ENABLE[state]
            if command is not None:
                channel.controlword = command
            if state is State.FAULT or self.master.now_ns >= deadline_ns:
                raise NoAnswerError(
                    axis.node.node_id, f"Operation enabled, it stays in '{state.value}'", ENABLE_TIMEOUT_S
                )
            yield from self.master.wait_for(
                lambda state=state: state_of(channel.statusword) is not state,
                (deadline_ns - self.master.now_ns) / NS_PER_S,
            )

    def _disable(self, axis: AxisSetup) -> Procedure[None]:
        """To Ready to switch on or below: no torque, brake applied."""
        channel = axis.channel
        channel.controlword = cia402.COMMAND_SHUTDOWN
        off = (State.READY_TO_SWITCH_ON, State.SWITCH_ON_DISABLED)
        done = yield from self.master.wait_for(lambda: state_of(channel.statusword) in off, DISABLE_TIMEOUT_S)
        if not done:
            state = state_of(channel.statusword)
            raise NoAnswerError(
                axis.node.node_id, f"Ready to switch on, it stays in '{state.value}'", DISABLE_TIMEOUT_S
            )

    def _enable_all(self) -> Procedure[None]:
        self._step("enabling the axes")
        mode = ModeOfOperation.CYCLIC_SYNCHRONOUS_POSITION
        yield from for_all(self._nodes, lambda node: self._set_mode(self._axes[self._axis_of_node[node.node_id]], mode))
        master, slave = (axis.channel.actual for axis in self._axes)
        targets = self._demand.align(self._plan.at(0.0)[0], (master, slave))
        problems = [
            f"axis {axis.node.name}: stands at {axis.channel.actual} counts, the cam starts at {target}, "
            f"which is more than {START_WINDOW_COUNTS} counts away; bring the linkage to its home position"
            for axis, target in zip(self._axes, targets, strict=True)
            if abs(axis.channel.actual - target) > START_WINDOW_COUNTS
        ]
        if problems:
            raise CommissioningError(problems)
        # Until now the target of each axis was its actual position; from here on it is the cam's start, held.
        yield from for_all(self._nodes, lambda node: self._enable(self._axes[self._axis_of_node[node.node_id]]))
        self.loop.is_guarding_enabled = True
        self.loop.phase = Phase.STANDSTILL

    def _move(self) -> Procedure[None]:
        # Standing under guard first: a drive that cannot hold still must not be asked to move.
        yield from self.master.pause(SETTLE_S)
        self._step("moving")
        self._demand.begin(self._plan)
        self.loop.follow(self._demand)
        loop, demand, guard = self.loop, self._demand, self._guard
        while not (demand.is_finished or loop.phase is Phase.QUICK_STOP):
            if self._is_stop_requested:
                loop.controlled_stop()
            yield self.master.now_ns + NS_PER_S
        self.stopped_by = guard.stopped_by or (StopReason.OPERATOR if self._is_stop_requested else StopReason.COMPLETED)
        if loop.phase is Phase.QUICK_STOP:
            self._step("quick stop")
        else:
            yield from self.master.pause(SETTLE_S)

    def _stands(self) -> Procedure[bool]:
        """Wait until no axis moves any more."""
        deadline_ns = self.master.now_ns + round(STANDSTILL_TIMEOUT_S * NS_PER_S)
        while self.master.now_ns < deadline_ns:
            before = [axis.channel.actual for axis in self._axes]
            yield from self.master.pause(STANDSTILL_SPAN_S)
            after = [axis.channel.actual for axis in self._axes]
            if all(abs(b - a) <= STANDSTILL_COUNTS for a, b in zip(after, before, strict=True)):
                return True
        return False

    def _shut_down(self) -> Procedure[None]:
        """Disable every drive, by RPDO while the cycle runs, and take the nodes out of NMT operational."""
        loop = self.loop
        loop.is_guarding_enabled = False
        if loop.is_running:
            self._step("disabling the axes")
            if loop.phase is Phase.QUICK_STOP:
                yield from self._stands()
            loop.command(cia402.COMMAND_DISABLE_VOLTAGE)
            loop.follow(None)
            loop.phase = Phase.DISABLED
            off = (State.SWITCH_ON_DISABLED, State.FAULT, State.NOT_READY_TO_SWITCH_ON)
            disabled = yield from self.master.wait_for(
                lambda: all(state_of(axis.channel.statusword) in off for axis in self._axes), DISABLE_TIMEOUT_S
            )
            if not disabled and self.failure is None:
                states = ", ".join(f"{a.node.name} '{state_of(a.channel.statusword).value}'" for a in self._axes)
                self.failure = GatewayError(f"the drives did not confirm that they are disabled: {states}")
            yield from self.master.pause(WATCH_AFTER_DISABLING_S)
            loop.stop()
        for node in self._nodes:
            self.master.watch_heartbeat(node.node_id, 0.0)
            self.master.command(NmtCommand.ENTER_PRE_OPERATIONAL, node.node_id)
        for node in self._nodes:
            # Else every drive would miss our heartbeat, and say so on the bus, as soon as we are gone.
            with suppress(NodeError):
                yield from release_heartbeat(self.master, node)
        self._step("done")
