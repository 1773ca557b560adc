"""The session with the machine: commissioning, homing, enabling, the run on the cam, and the way back to standstill.

It is a procedure that says until when it waits; ``gateway.running.core`` resumes it.
"""

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Final

from drivers import cia402
from drivers.cia402 import ModeOfOperation, State, state_of
from drivers.errors import DriveError, NodeError
from drivers.master import Master, Procedure
from drivers.nmt import NmtCommand
from drivers.node import Event
from gateway.cyclic.approach import Approach, ApproachDemand
from gateway.cyclic.cycle import CyclicLoop
from gateway.cyclic.demand import CamDemand
from gateway.cyclic.guard import Guard, StopReason
from gateway.errors import CommissioningError, GatewayError
from gateway.record.sample import Phase
from gateway.running.bus_presence import BusGivenUpError, BusPresence
from gateway.running.commissioning import (
    NetworkSettings,
    NodeSettings,
    commission,
    for_all,
    release_heartbeat,
    start_nodes,
)
from gateway.running.load_check import LoadCheck
from gateway.running.powering import DISABLE_TIMEOUT_S, AxisPower, AxisSetup
from gateway.running.recovery import Recovery
from mechanism.approach import Point
from mechanism.errors import MechanismError
from mechanism.motion import MasterPlan

NS_PER_S: Final = 1_000_000_000
SETTLE_S: Final = 0.1
"""Standstill under guard before the motion begins, and after it before the drives are disabled."""
WATCH_AFTER_DISABLING_S: Final = 0.02
"""For so long the cycle goes on after the drives are disabled, to see and record that they stay where they are."""
STANDSTILL_TIMEOUT_S: Final = 10.0
"""An axis without torque and brake may swing for long."""
START_WINDOW_RAD: Final = math.radians(1.75)
"""How far from the cam's start an axis may stand; more is a linkage that would jump."""
STANDSTILL_RAD: Final = math.radians(0.18)
STANDSTILL_COUNTS: Final = 2
"""An axis that has moved no more than the larger of these in ``STANDSTILL_SPAN_S`` stands."""
STANDSTILL_SPAN_S: Final = 0.05


@dataclass(frozen=True, slots=True)
class StepReached(Event):
    """A named step of the session begins."""

    step: str


class OperatorStopError(GatewayError):
    """Somebody asked for a stop before the machine was in motion."""


def _cyclic_mode(node: NodeSettings) -> ModeOfOperation:
    if node.is_torque_controlled:
        return ModeOfOperation.CYCLIC_SYNCHRONOUS_TORQUE
    return ModeOfOperation.CYCLIC_SYNCHRONOUS_POSITION


class MachineSession:
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
        approach: Approach | None = None,
        recovery_timeout_s: float = 0.0,
        bus_off_timeout_s: float = 5.0,
        load_check: LoadCheck | None = None,
    ) -> None:
        """``is_homing_again``: home the axes where they stand even if their drives are homed already.

        ``approach``: how a machine that does not stand where the plan begins gets onto its cam; None refuses it.
        ``recovery_timeout_s``: how long a node may be away after a stop before it is given up; 0 recovers nothing.
        ``bus_off_timeout_s``: how long the own controller may be bus-off before the bus is given up.
        ``load_check``: of the axes at rest; None looks at no torque.
        """
        self.axes = axes
        self.network = network
        self.master = master
        self.loop = loop
        self.steering = loop.steering
        self.demand = demand
        self.plan = plan
        """Of the master; an approach replaces it by one from where it has ended."""
        self.guard = guard
        self.power = AxisPower(master, loop)
        self.bus = BusPresence(master, bus_off_timeout_s)
        self.events: Final[list[Event]] = []
        """What has happened, until the core hands it out; the list is never replaced."""
        self.failure: Exception | None = None
        """Why the session could not be carried out; a stop that the guard called for is no failure of the session."""
        self.stopped_by = StopReason.COMPLETED
        self.is_following = False
        """The demand on the cam is, or has been, followed."""
        self.is_stop_requested = False
        self.is_watching_nodes = False
        """Set once the drives are configured: one that restarts or falls silent after that is not what it was."""
        self.is_interruptible = True
        """Before anything is in motion a stop request ends the session where it is."""
        self._nodes = [axis.node for axis in axes]
        self._axis_of_node = {axis.node.node_id: axis for axis in axes}
        self._is_homing_again = is_homing_again
        self._approach = approach
        self._load_check = load_check
        self._way: tuple[Point, ...] = ()
        """Corners of the approach; none where the machine stands at the plan's start."""
        self._recovery = (
            Recovery(master, self.power, axes, network, recovery_timeout_s) if recovery_timeout_s > 0.0 else None
        )

    def run(self) -> Procedure[None]:
        """The whole session; whatever happens in it, it ends with the drives disabled."""
        try:
            yield from self._commission()
            yield from self._home_all()
            yield from self._enable_all()
            if self._load_check is not None:
                yield from self._await_loads(self._load_check)
            self.is_interruptible = False
            yield from self._move()
        except OperatorStopError:
            self.stopped_by = StopReason.OPERATOR
        except (DriveError, GatewayError) as error:
            self.failure = error
            self.stopped_by = self.guard.stopped_by or StopReason.COMMISSIONING
        self.is_interruptible = False
        try:
            # What is told to nobody disables no drive; and where they are is not known either.
            yield from self.bus.wait()
        except BusGivenUpError as error:
            self.failure = error
            self.stopped_by = StopReason.BUS_LOST
            self.loop.stop()
            self._step("done")
            return
        yield from self._shut_down()

    def _axis(self, node: NodeSettings) -> AxisSetup:
        return self._axis_of_node[node.node_id]

    def _step(self, name: str) -> None:
        self.events.append(StepReached(self.master.now_ns, name))

    def _commission(self) -> Procedure[None]:
        self._step("commissioning")
        yield from commission(self.master, self._nodes, self.network)
        self.is_watching_nodes = True
        if self._recovery is not None:
            self._recovery.note_commissioned()
        self._step("starting the cycle")
        start_nodes(self.master, self._nodes)
        self.loop.start(self.master.now_ns)
        answered = yield from self.master.wait_for(lambda: self.loop.actuals_are_valid, self.network.boot_up_timeout_s)
        if not answered:
            raise CommissioningError(
                [
                    f"axis {axis.node.name}: no TPDO {axis.channel.tpdo_cob_id:03X}h arrives after SYNC"
                    for axis in self.axes
                    if axis.channel.statusword == 0
                ]
                or ["the drives do not answer every SYNC with their TPDOs"]
            )
        yield from for_all(self._nodes, lambda node: self.power.reset_fault(self._axis(node)))

    def _home_all(self) -> Procedure[None]:
        if not self._is_homing_again:
            yield from self._refuse_half_a_reference()
        for axis in self.axes:
            if axis.homing_method is not None:
                yield from for_all([axis.node], lambda _, axis=axis: self._home(axis))

    def _refuse_half_a_reference(self) -> Procedure[None]:
        """To home one axis where it stands while the others know where they are is right at home alone."""
        homing = [axis for axis in self.axes if axis.homing_method is not None]
        homed: list[AxisSetup] = []
        for axis in homing:
            if (yield from self.power.is_homed(axis)):
                homed.append(axis)  # noqa: PERF401 - a comprehension cannot wait
        problems: list[str] = []
        for axis in homed if len(homed) < len(homing) else ():
            units = axis.channel.units
            away = math.remainder(axis.channel.actual, units.counts_per_revolution)
            if abs(away) > units.counts_in(START_WINDOW_RAD):
                lost = ", ".join(other.node.name for other in homing if other not in homed)
                problems.append(
                    f"axis {lost} has lost its reference while axis {axis.node.name} stands {away:.0f} counts from "
                    "home; bring the linkage to its home position"
                )
        if problems:
            raise CommissioningError(problems)

    def _home(self, axis: AxisSetup) -> Procedure[None]:
        self._step(f"homing axis {axis.node.name}")
        homed = yield from self.power.home(axis, self._is_homing_again)
        if not homed:
            self._step(f"axis {axis.node.name} is homed already")

    def _enable_all(self) -> Procedure[None]:
        self._step("enabling the axes")
        yield from for_all(self._nodes, lambda node: self.power.set_mode(self._axis(node), _cyclic_mode(node)))
        before = [axis.channel.actual for axis in self.axes]
        problems = self._away_from_start(before)
        if problems and self._approach is not None:
            self._way = self._find_way(self._approach)
        elif problems:
            raise CommissioningError(problems)
        # Until now the target of each axis was its actual position; from here on it is held where it then is.
        yield from for_all(self._nodes, lambda node: self.power.enable(self._axis(node)))
        held = [axis.channel.target for axis in self.axes]
        # Not from the cam's start again: an axis at the edge of that window sinks by a count as its brake opens.
        problems = self._moved_apart(before, held) or self._moved_apart(
            held, [axis.channel.actual for axis in self.axes]
        )
        if problems:
            raise CommissioningError(problems)
        self.steering.begin_guarding()
        self.steering.phase = Phase.STANDSTILL

    def _away_from_start(self, positions: Sequence[int]) -> list[str]:
        """What is wrong with ``positions`` (counts) as a place to begin the plan from: a sentence an axis."""
        master, slave = positions
        problems: list[str] = []
        for axis, position, target in zip(
            self.axes, positions, self.demand.align(self.plan.at(0.0)[0], (master, slave)), strict=True
        ):
            window = axis.channel.units.counts_in(START_WINDOW_RAD)
            if abs(position - target) > window:
                problems.append(
                    f"axis {axis.node.name}: stands at {position} counts, the cam starts at {target}, which is more "
                    f"than {window} counts away; bring the linkage to its home position, or start from where it stands "
                    "(--from-here)"
                )
        return problems

    def _moved_apart(self, before: Sequence[int], after: Sequence[int]) -> list[str]:
        """Axes that are not where they were to be when all of them were enabled: a sentence each."""
        return [
            f"axis {axis.node.name}: was to be held at {stood} counts and is at {position} after enabling, more than "
            f"{window} counts away; look at its resolver and its brake"
            for axis, stood, position in zip(self.axes, before, after, strict=True)
            if abs(position - stood) > (window := axis.channel.units.counts_in(START_WINDOW_RAD))
        ]

    def _await_loads(self, check: LoadCheck) -> Procedure[None]:
        """Standing under guard, for as long as it takes the axes to show that they carry their loads."""
        check.begin([axis.channel for axis in self.axes])
        while self.guard.reaction is None and not check.look():
            if check.is_over:
                raise CommissioningError(check.problems)
            yield from self.power.cycles(1)
        self.steering.trust_loads()

    def _move(self) -> Procedure[None]:
        # Standing under guard first: a drive that cannot hold still must not be asked to move.
        yield from self.master.pause(SETTLE_S)
        demand, guard = self.demand, self.guard
        # What has called for a stop since the drives were commissioned has called for no motion at all.
        if self.may_move() and self._approach is not None and self._way:
            yield from self._go_onto_cam(self._approach)
        if self.may_move():
            self._step("moving")
            demand.begin(self.plan, [axis.channel.target for axis in self.axes])
            self.steering.follow(demand, demand.observer)
            self.is_following = True
            yield from self._until_finished(demand)
        self.stopped_by = guard.stopped_by or (StopReason.OPERATOR if self.is_stop_requested else StopReason.COMPLETED)
        if self.steering.phase is not Phase.QUICK_STOP:
            yield from self.master.pause(SETTLE_S)
            # Guarded until the end; but a wish to stop that comes now finds the run completed.
            reason = guard.stopped_by
            if reason is not None and reason is not StopReason.OPERATOR:
                self.stopped_by = reason
        if self.stopped_by is StopReason.COMPLETED and not demand.law.is_plain:
            self._step("the slave ends off its cam: give the next run --from-here")
        if self.steering.phase is Phase.QUICK_STOP:
            self._step("quick stop")

    def _until_finished(self, demand: CamDemand | ApproachDemand) -> Procedure[None]:
        """Let the cycle follow its demand until that, or a stop that leaves it, is over."""
        while not (demand.is_finished or self.steering.phase is Phase.QUICK_STOP or self.bus.is_given_up):
            if self.is_stop_requested:
                self.steering.controlled_stop()
            yield self.master.now_ns + NS_PER_S

    def may_move(self) -> bool:
        """Whether nothing has called for a stop."""
        return self.guard.reaction is None and not self.is_stop_requested

    def _find_way(self, approach: Approach) -> tuple[Point, ...]:
        """From where the linkage stands onto the cam; raises CommissioningError with a sentence if there is no way."""
        theta2, theta5 = (axis.channel.units.angle(axis.channel.actual) for axis in self.axes)
        try:
            return approach.field.path(theta2, theta5)
        except MechanismError as error:
            raise CommissioningError([str(error)]) from None

    def _go_onto_cam(self, approach: Approach) -> Procedure[None]:
        self._step("approaching the cam")
        demand = approach.demand
        demand.begin(self._way, [axis.channel.target for axis in self.axes])
        self.steering.follow(demand)
        yield from self._until_finished(demand)
        if self.may_move():
            yield from self.master.pause(SETTLE_S)
            self.plan = approach.plan_from(self._way[-1][0])

    def _stands(self) -> Procedure[bool]:
        """Wait until no axis moves any more."""
        deadline_ns = self.master.now_ns + round(STANDSTILL_TIMEOUT_S * NS_PER_S)
        while self.master.now_ns < deadline_ns:
            before = [axis.channel.actual for axis in self.axes]
            yield from self.master.pause(STANDSTILL_SPAN_S)
            after = [axis.channel.actual for axis in self.axes]
            limits = [max(STANDSTILL_COUNTS, axis.channel.units.counts_in(STANDSTILL_RAD)) for axis in self.axes]
            if all(abs(b - a) <= limit for a, b, limit in zip(after, before, limits, strict=True)):
                return True
        return False

    def _shut_down(self) -> Procedure[None]:
        """Disable every drive, by RPDO while the cycle runs, and take the nodes out of NMT operational."""
        loop = self.loop
        self.steering.is_guarding_enabled = False
        disabled = True
        if loop.is_running:
            self._step("disabling the axes")
            if self.steering.phase is Phase.QUICK_STOP:
                yield from self._stands()
            self.steering.command(cia402.COMMAND_DISABLE_VOLTAGE)
            self.steering.follow(None)
            self.steering.phase = Phase.DISABLED
            off = (State.SWITCH_ON_DISABLED, State.FAULT, State.NOT_READY_TO_SWITCH_ON)

            def is_off() -> bool:
                return all(state_of(axis.channel.statusword) in off for axis in self.axes)

            disabled = yield from self.master.wait_for(is_off, DISABLE_TIMEOUT_S)
            if self._recovery is not None and self.guard.stopped_by not in {None, StopReason.OPERATOR}:
                self._step("recovering the axes")
                self.events.extend((yield from self._recovery.run()))
                disabled = is_off()
            if not disabled and self.failure is None:
                states = ", ".join(f"{a.node.name} '{state_of(a.channel.statusword).value}'" for a in self.axes)
                self.failure = GatewayError(f"the drives did not confirm that they are disabled: {states}")
            yield from self.master.pause(WATCH_AFTER_DISABLING_S)
            loop.stop()
        for node in self._nodes:
            self.master.watch_heartbeat(node.node_id, 0.0)
            self.master.command(NmtCommand.ENTER_PRE_OPERATIONAL, node.node_id)
        # A drive that may still be enabled must miss our heartbeat.
        for node in self._nodes if disabled else ():
            # Else every drive would miss our heartbeat, and say so on the bus, as soon as we are gone.
            with suppress(NodeError):
                yield from release_heartbeat(self.master, node)
        self._step("done")
