"""The gateway as one core: the cycle, the CANopen master and the session with the machine, behind one seam.

It implements ``drivers.node.Node``; the virtual-time and the real-time host drive the same object.
"""

from drivers.controller import ControllerChanged, ErrorState
from drivers.frame import Frame
from drivers.master import BootUpReceived, EmergencyReceived, HeartbeatLost, NodeStateChanged, Procedure
from drivers.nmt import SYNC_COB_ID, NmtState
from drivers.node import Event
from gateway.cyclic.guard import Condition, StopReason
from gateway.cyclic.operation import Operation, Order, OrderAnswered
from gateway.cyclic.sdo_pacing import SdoPacing
from gateway.errors import CommissioningError
from gateway.learning.law import LearnedTorque
from gateway.running.bus_presence import BusOffError
from gateway.running.machine_session import MachineSession, OperatorStopError


class GatewayCore:
    """Carries out one session with the machine: hands it time, frames, orders, and what the guard has found."""

    def __init__(
        self, session: MachineSession, operation: Operation | None = None, sdo_frames_a_cycle: int = 2
    ) -> None:
        """``operation`` carries out an operator's orders; None takes none.

        ``sdo_frames_a_cycle``: requests and responses that may be on the bus in each cycle.
        """
        self.session = session
        self.loop = session.loop
        self.steering = session.steering
        self.master = session.master
        self.is_done = False
        self._guard = session.guard
        self._events: list[Event] = session.events
        self._operation = operation
        self._sdo_pacing = SdoPacing(sdo_frames_a_cycle)
        self._lost: list[str] = []
        self._axis_of_node = {axis.node.node_id: number for number, axis in enumerate(session.axes)}
        self._procedure: Procedure[None] | None = None
        self._resume_at_ns: int | None = 0

    @property
    def failure(self) -> Exception | None:
        """Why the session could not be carried out; a stop that the guard called for is no failure of the session."""
        return self.session.failure

    @property
    def stopped_by(self) -> StopReason:
        """What has ended the session, once it is done."""
        return self.session.stopped_by

    @property
    def learned(self) -> LearnedTorque | None:
        """What has been learned of the demand's cam until now; None if nothing has."""
        return self.session.demand.learned

    # -- the seam ------------------------------------------------------------------------------------------------

    def receive(self, frame: Frame, now_ns: int) -> bool:
        """Take a frame: a TPDO goes to the cycle, everything else to the master; False as in ``drivers.node.Node``."""
        loop = self.loop
        cob_id, data, is_remote = frame
        number = loop.tpdo_slots.get(cob_id)
        if number is not None:
            is_closing = loop.is_running and not is_remote and loop.receive_tpdo(number, data, now_ns)
            if is_closing:
                self._resume(now_ns)
            return is_closing
        if cob_id == SYNC_COB_ID:
            if loop.is_running and loop.receive_sync(now_ns):
                self._resume(now_ns)
            return True
        self.master.receive(frame, now_ns)
        self._watch(now_ns)
        self._resume(now_ns)
        return True

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
        """Frames to send: the cycle's first, so that SDO traffic never delays a demand. None while the controller is
        bus-off: they would be stale when it is back.
        """
        loop = self.loop
        frames = loop.outbox
        if loop.is_off_bus:
            return self._lose_frames()
        if frames:
            loop.outbox = []
        if self.master.outbox or self._sdo_pacing.waiting:
            frames = frames + self._sdo_pacing.release(self.master.outbox, loop.cycle if loop.is_running else None)
            self.master.outbox = []
        return frames

    def take_events(self) -> list[Event]:
        """Events since the last call."""
        if not self._events:
            return []
        events = self._events.copy()
        self._events.clear()
        return events

    # -- commands from outside -----------------------------------------------------------------------------------

    def request_stop(self, wish: Condition = Condition.OPERATOR_STOP) -> None:
        """Stop as the guard's table says for this wish, by default on the cam; before anything is enabled, straight
        back to disabled drives. May be called repeatedly.
        """
        self.session.is_stop_requested = True
        if self.steering.is_guarding_enabled:
            self._guard.hold(wish, 0, 1, 1, self.master.now_ns)
            self.steering.react()

    def order(self, order: Order, value: float) -> None:
        """Carry out an operator's order, or refuse it; an ``OrderAnswered`` tells which."""
        now_ns = self.master.now_ns
        session = self.session
        if self._operation is None or not session.is_following or not session.may_move():
            answer = OrderAnswered(now_ns, order, value, "the machine is not in motion on its cam")
        else:
            answer = self._operation.carry_out(order, value, session.plan.end_position, now_ns)
        if answer is not None:
            self._events.append(answer)

    def request_quick_stop(self) -> None:
        """Quick stop on all drives."""
        self.session.is_stop_requested = True
        if self.loop.is_running:
            self.steering.quick_stop()

    # -- the own controller --------------------------------------------------------------------------------------

    def controller_changed(self, change: ControllerChanged) -> None:
        """The host's CAN controller has another error state; bus-off is a condition of the guard's in any phase."""
        loop = self.loop
        self._events.append(change)
        is_off = change.state is ErrorState.OFF
        if self.is_done or is_off is loop.is_off_bus:
            return
        self.session.bus.note(is_off, change.at_ns)
        if is_off:
            loop.leave_bus()
            self._guard.trip(Condition.BUS_OFF, 0, 0, 0, change.at_ns)
        else:
            loop.rejoin_bus()
        self._resume(change.at_ns)

    def tell(self, event: Event) -> None:
        """Put something of the host's among the events of the run."""
        self._events.append(event)

    def _lose_frames(self) -> list[Frame]:
        if self.loop.outbox:
            self.loop.outbox = []
            self.loop.lost()
        self.master.outbox = []
        self._sdo_pacing.forget()
        return []

    # -- inside --------------------------------------------------------------------------------------------------

    def _watch(self, now_ns: int) -> None:
        """Turn the master's events into ours, and into guarded conditions while the drives are enabled."""
        events = self.master.events
        if not events:
            return
        self.master.events = []
        self._events += events
        if not self.steering.is_guarding_enabled:
            if self.session.is_watching_nodes:
                self._lost += [
                    f"axis {self.session.axes[self._axis_of_node[event.node_id]].node.name}: node {event.node_id} "
                    + ("has restarted" if isinstance(event, BootUpReceived) else "has fallen silent")
                    for event in events
                    if isinstance(event, (BootUpReceived, HeartbeatLost))
                ]
            return
        for event in events:
            if isinstance(event, EmergencyReceived) and event.code:
                condition = self._guard.emergency_condition(event.code)
                self._guard.hold(condition, self._axis_of_node[event.node_id], event.code, 0, now_ns)
            elif isinstance(event, (HeartbeatLost, BootUpReceived)) or (
                isinstance(event, NodeStateChanged) and event.state is not NmtState.OPERATIONAL
            ):
                timeout_ms = self.session.network.heartbeat_timeout_ms
                self._guard.hold(
                    Condition.HEARTBEAT_LOST, self._axis_of_node[event.node_id], timeout_ms, timeout_ms, now_ns
                )
        self.steering.react()

    def _resume(self, now_ns: int) -> None:
        if self._guard.tripped:
            self.steering.react()
            self._events += self._guard.tripped
            self._guard.tripped = []
        if self.is_done:
            return
        self.master.now_ns = now_ns
        if self._operation is not None and self._operation.is_busy:
            answer = self._operation.go_on(now_ns)
            if answer is not None:
                self._events.append(answer)
        if self._procedure is None:
            # A procedure that has not begun could not be told why it is not to go on.
            self._procedure = self.session.run()
            self._resume_at_ns = next(self._procedure)
        session = self.session
        try:
            if session.bus.is_off and session.is_interruptible:
                self._resume_at_ns = self._procedure.throw(BusOffError())
            elif self._lost and session.is_interruptible:
                self._resume_at_ns = self._procedure.throw(CommissioningError(self._lost))
            elif session.is_stop_requested and session.is_interruptible:
                self._resume_at_ns = self._procedure.throw(OperatorStopError("stopped on request"))
            else:
                self._resume_at_ns = next(self._procedure)
        except StopIteration:
            self.is_done = True
            self._resume_at_ns = None
        if self.master.events:
            self._events += self.master.events
            self.master.events = []
