"""Carries out the sessions of a soak: gateway and emulated machine in virtual time, provoked as the plan says."""

import heapq
import math
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, field, replace
from functools import lru_cache
from random import Random
from typing import Any
from unittest import mock

from soak_scenario import ORDER_OF, PAPER, WISH_OF, Campaign, Mischief, Moment, Provocation, SessionPlan

from config.loading import parse_config
from config.schema import GatewayConfig
from drivers.controller import ControllerChanged
from drivers.controller_outage import ControllerOutage
from drivers.frame import Frame
from drivers.node import Event, Node
from drivers.virtual_time import VirtualBus
from gateway.record.sample import Phase
from gateway.running import assembly
from gateway.running.core import GatewayCore
from gateway.running.machine_session import StepReached
from gateway.running.operation_setup import slave_law
from gateway.running.preparation import PreparedRun, prepare
from gateway.running.preparation import plan as plan_of_run
from gateway.running.recovery import AxisRecovered
from mechanism.cam_profile import CamProfile
from mechanism.slave_law import SlaveLaw
from sim_drive.assembly import build_machine
from sim_drive.injection.faults import Fault
from sim_drive.injection.injector import Injector

SECOND = 1_000_000_000
SLICE_NS = 4_000_000
TICK_S = 1.0 / 1024.0
PATIENCE_S = 40.0
"""An operator who waits so much longer than the run's plan asks for a stop, and then for a quick stop."""
SILENT_S = 1.0
"""Looked on after the gateway has been killed."""
STANDING_S = 0.3
"""Looked on after a session."""
RETURN_STROKE_DEG = (285.0, 340.0)
MOMENT_OF_PHASE = {
    Phase.STANDSTILL: Moment.STANDSTILL,
    Phase.APPROACH: Moment.APPROACH,
    Phase.RAMP_UP: Moment.RAMP_UP,
    Phase.CAM: Moment.CAM,
    Phase.RAMP_DOWN: Moment.RAMP_DOWN,
    Phase.CONTROLLED_STOP: Moment.CONTROLLED_STOP,
    Phase.QUICK_STOP: Moment.QUICK_STOP,
}
MOMENT_OF_STEP = {"enabling the axes": Moment.ENABLING, "recovering the axes": Moment.RECOVERY}


@lru_cache(maxsize=64)
def prepared_run(text: str) -> PreparedRun:
    """A gateway's run of one machine cycle; there are few configurations, and they come back."""
    return prepare(parse_config(text, PAPER.path), 1)


@lru_cache(maxsize=64)
def proved_law(text: str) -> SlaveLaw:
    """The law of a gateway's configuration, the cam proved."""
    return slave_law(parse_config(text, PAPER.path), prepared_run(text).cam.profile)


def law_of_run(config: GatewayConfig, profile: CamProfile) -> SlaveLaw:
    """A law as it is before any order; proving the cam for each session anew would be a fifth of a soak."""
    return copy(proved_law(config.text))


class WatchedPlant:
    """The machine's plant, and the true angles of both axes at every servo tick: cheaper than the machine's records."""

    def __init__(self, plant: Any) -> None:
        self.plant = plant
        self.ticks: list[tuple[float, float]] = []
        self._advance: Callable[[Any, Any], None] = plant.advance
        self._friction = plant._settings[:, :2].copy()

    def __getattr__(self, name: str) -> Any:
        # Looked up once, save what changes with every tick.
        value = getattr(self.plant, name)
        if callable(value):
            setattr(self, name, value)
        return value

    @property
    def angles(self) -> Any:
        return self.plant.angles

    @property
    def torn_at_s(self) -> float | None:
        return self.plant.torn_at_s

    def advance(self, torques: Any, brakes: Any) -> None:
        self._advance(torques, brakes)
        values = self.plant.state
        self.ticks.append((values[0], values[1]))

    def drift(self, share: float) -> None:
        """Friction is so much more than it was."""
        self.plant._settings[:, :2] = self._friction * (1.0 + share)


class Cable(ControllerOutage):
    """The gateway's core, or its host, on a bus that it loses when told to."""

    def lose(self, now_ns: int, for_ns: int) -> None:
        """The controller goes off now, and is back after that time; if it is not off already."""
        if not self._turns:
            self._turns += [now_ns, now_ns + for_ns]


class HostedCore:
    """The gateway's core on a host that may be away, or late with all that it sends."""

    def __init__(self, core: GatewayCore) -> None:
        self.core = core
        self.away_until_ns = self.late_until_ns = 0
        self.take_frames, self.take_events = core.take_frames, core.take_events

    def receive(self, frame: Frame, now_ns: int) -> None:
        if now_ns >= self.away_until_ns:
            self.core.receive(frame, now_ns)
            self._be_late(now_ns)

    def next_wake_ns(self) -> int | None:
        due_ns = self.core.next_wake_ns()
        return None if due_ns is None else max(due_ns, self.away_until_ns)

    def wake(self, now_ns: int) -> None:
        self.core.wake(now_ns)
        self._be_late(now_ns)

    def controller_changed(self, change: ControllerChanged) -> None:
        self.core.controller_changed(change)

    def _be_late(self, now_ns: int) -> None:
        if now_ns < self.late_until_ns:
            self.core.loop.sent(now_ns + self.core.loop.period_ns)


@dataclass
class Session:
    """What happened in a session, for the judge; instants are the bus' in ns."""

    plan: SessionPlan
    prepared: PreparedRun
    started_ns: int
    first_tick: int
    """Of the ticks kept: the one at which the session began."""
    is_expected_ready: bool
    """The machine was left, or brought, where a run may begin."""
    core: GatewayCore
    ended_ns: int = 0
    fired: list[tuple[Provocation, Moment, int]] = field(default_factory=list)
    """What has happened, in which phase of the run, and when."""
    events: list[Event] = field(default_factory=list)
    phases: list[tuple[int, Phase]] = field(default_factory=list)
    """From when on which phase was in force."""
    cycles_in: dict[Phase, int] = field(default_factory=dict)
    off_cam: list[tuple[int, float]] = field(default_factory=list)
    """With the slave shifted or off its cam: how far from where its law has it, rad."""
    asked_ns: int | None = None
    """When somebody first asked for a stop."""
    killed_ns: int | None = None
    powered_until_ns: int = 0
    is_law_plain: bool = True
    is_done: bool = False
    truth_error_counts: int = 0
    """Greatest difference between a homed axis' count and where it really is, after the session."""
    is_torn: bool = False
    """The linkage, in the session or while its last faults came to their end."""
    unhomed: tuple[int, ...] = ()
    """Axes that have no reference after the session."""
    demanded: list[tuple[int, int]] = field(default_factory=list)
    """What was demanded of both axes, counts."""

    def append(self, *values: Any) -> None:
        """One sample of the cycle."""
        phase = values[12]
        count = self.cycles_in
        if not self.phases or self.phases[-1][1] is not phase:
            self.phases.append((values[1], phase))
        count[phase] = count.get(phase, 0) + 1
        self.demanded.append(values[14:16])


class Rig:
    """The machine of a campaign, which lives through all of its sessions."""

    def __init__(self, campaign: Campaign) -> None:
        self.campaign = campaign
        self.config: GatewayConfig = parse_config(campaign.gateway_text, PAPER.path)
        self.machine = build_machine(parse_config(campaign.machine_text, PAPER.path), campaign.seed)
        self.plant = WatchedPlant(self.machine.plant)
        self.machine.plant = self.plant  # pyright: ignore
        self.injector = Injector(self.machine, (), campaign.seed)
        self.now_ns = 0
        self.is_ready = True
        """A run may begin where the linkage stands."""
        self.is_homing_again = False
        self.is_reference_doubtful = False
        """An axis may have been homed where it was not, and has not been homed again since."""
        self._source = Random(campaign.seed)

    def run(self, plan: SessionPlan) -> Session:
        """Carry out one session, and look on for a while."""
        self.plant.ticks.clear()
        prepared = prepared_run(self.config.text)
        prepared = replace(prepared, plan=plan_of_run(self.config, plan.machine_cycles))
        session = Session(plan, prepared, self.now_ns, 0, self.is_ready, None)  # type: ignore[arg-type]
        with mock.patch.object(assembly, "slave_law", law_of_run):
            session.core = core = assembly.build_core(
                self.config,
                prepared.cam.profile,
                prepared.plan,
                session,
                is_homing_again=self.is_homing_again,
                approach_cycles=plan.machine_cycles,
            )
        host = HostedCore(core)
        planned = {p.what for p in plan.provocations if isinstance(p.what, Mischief)}
        node: Any = host if planned & {Mischief.HOST_AWAY, Mischief.HOST_LATE} else core
        cable = Cable(node, ())
        bus = self._bus(cable if Mischief.CONTROLLER_OFF in planned else node, session.events)
        Conductor(self, session, bus, host, cable).conduct()
        self.now_ns = bus.now_ns
        session.ended_ns = self.now_ns
        session.is_done = core.is_done
        if session.killed_ns is not None:
            self._look_on(session, SILENT_S)
        self._look_on(session, STANDING_S)
        return session

    def _bus(self, node: Node | None, events: list[Event]) -> VirtualBus:
        nodes = [self.injector] if node is None else [node, self.injector]
        return VirtualBus(
            nodes,
            self.config.bus.bit_rate,
            self.campaign.seed,
            start_ns=self.now_ns,
            on_event=lambda number, event: events.append(event) if number < len(nodes) - 1 else None,
        )

    def _look_on(self, session: Session | None, span_s: float) -> None:
        bus = self._bus(None, [])
        until_ns = self.now_ns + round(span_s * SECOND)
        while bus.now_ns < until_ns:
            bus.run_until(min(bus.now_ns + SLICE_NS, until_ns))
            if session is not None and self.is_powered:
                session.powered_until_ns = bus.now_ns
        self.now_ns = bus.now_ns

    @property
    def is_powered(self) -> bool:
        return any(drive.is_powered for drive in self.machine.drives)

    def settle(self, session: Session, is_reference_doubtful: bool) -> float:
        """Wait until no fault is at work any more, and bring the linkage home by hand where a run could not go on, or
        where nobody could know that a reference was wrong; returns how long that took, s.
        """
        since_ns = self.now_ns
        while self.injector.active and self.now_ns < since_ns + 10 * SECOND:
            self._look_on(None, 0.1)
        self._look_on(None, 0.5)
        session.truth_error_counts = self._truth_error()
        session.is_torn = self.plant.torn_at_s is not None
        outcomes = [event for event in session.events if isinstance(event, AxisRecovered)]
        session.unhomed = tuple(n for n, axis in enumerate(self.machine.drive_axes) if not axis.is_homed)
        is_ready = session.core.failure is None and all(event.is_ready for event in outcomes)
        is_homed_anew = self.is_homing_again and any(
            isinstance(event, StepReached) and event.step == "enabling the axes" for event in session.events
        )
        self.is_reference_doubtful = is_reference_doubtful or (self.is_reference_doubtful and not is_homed_anew)
        self.is_homing_again = not is_ready or bool(session.unhomed) or self.is_reference_doubtful
        if self.is_homing_again:
            turns = round(self.plant.angle(0) / math.tau) * math.tau
            self.plant.set_motion((turns, 0.0), (0.0, 0.0))
            self._look_on(None, 0.1)
        self.plant.ticks.clear()
        return (self.now_ns - since_ns) / SECOND

    def _truth_error(self) -> int:
        """Of drives that say they know where they are."""
        worst = 0
        for number, axis in enumerate(self.machine.drive_axes):
            if axis.is_homed:
                counts = self.config.ordered_axes[number].counts_per_revolution
                real = self.plant.angle(number) / math.tau * counts
                away = math.remainder(axis.shaft_counts + axis.offset_counts - real, counts)
                worst = max(worst, abs(round(away)))
        return worst


class Conductor:
    """Lets a session run, and has happen in it what its plan says, at its moments."""

    def __init__(self, rig: Rig, session: Session, bus: VirtualBus, host: HostedCore, cable: Cable) -> None:
        self.rig, self.session, self.bus, self.host, self.cable = rig, session, bus, host, cable
        self.core = session.core
        self.waiting = list(session.plan.provocations)
        self.due: list[tuple[int, int, Provocation]] = []
        self.moment = Moment.COMMISSIONING
        self.seen_events = 0

    def conduct(self) -> None:
        session, bus, core = self.session, self.bus, self.core
        self._reach(Moment.COMMISSIONING)
        patience_ns = round((session.prepared.plan.duration_s + PATIENCE_S) * SECOND)
        limit_ns = session.started_ns + patience_ns
        asked = 0
        while not core.is_done and session.killed_ns is None:
            end_ns = bus.now_ns + SLICE_NS
            if self.due and self.due[0][0] < end_ns:
                end_ns = max(self.due[0][0], bus.now_ns)
            bus.run_until(end_ns)
            self._look()
            while self.due and self.due[0][0] <= bus.now_ns:
                self._let_happen(heapq.heappop(self.due)[2])
            if bus.now_ns > limit_ns:
                if asked == 2:
                    return
                asked += 1
                limit_ns += patience_ns
                self._ask(core.request_stop if asked == 1 else core.request_quick_stop)
                bus.refresh()

    def _look(self) -> None:
        session, core = self.session, self.core
        for event in session.events[self.seen_events :]:
            if isinstance(event, StepReached) and event.step in MOMENT_OF_STEP:
                self._reach(MOMENT_OF_STEP[event.step])
        self.seen_events = len(session.events)
        phase = core.loop.steering.phase
        moment = MOMENT_OF_PHASE.get(phase)
        if moment is not None and moment is not self.moment and self.moment is not Moment.RECOVERY:
            self._reach(moment)
        if phase is Phase.CAM:
            degrees = math.degrees(core.loop.steering._demand.master_position) % 360.0  # type: ignore[union-attr]
            if RETURN_STROKE_DEG[0] < degrees < RETURN_STROKE_DEG[1]:
                self._arm(Moment.RETURN_STROKE)
        law, demand = core._operation._demand.law, core.loop.steering._demand  # type: ignore[union-attr]
        if not law.is_plain and demand is not None and Phase.RAMP_UP <= phase <= Phase.QUICK_STOP:
            session.is_law_plain = False
            # The law counts whole turns as the demand does.
            theta2 = demand.master_position + math.remainder(self.rig.plant.angle(0) - demand.master_position, math.tau)
            away = math.remainder(self.rig.plant.angle(1) - law.at(theta2)[0], math.tau)
            session.off_cam.append((self.bus.now_ns, abs(away)))
        if self.rig.is_powered:
            session.powered_until_ns = self.bus.now_ns
        self.rig.plant.drift(self.rig.campaign.friction_drift * math.sin(math.tau * self.bus.now_ns / (20 * SECOND)))

    def _reach(self, moment: Moment) -> None:
        self.moment = moment
        self._arm(moment)

    def _arm(self, moment: Moment) -> None:
        if not self.waiting:
            return
        reached = [provocation for provocation in self.waiting if provocation.moment is moment]
        self.waiting = [provocation for provocation in self.waiting if provocation.moment is not moment]
        for provocation in reached:
            due_ns = self.bus.now_ns + round(provocation.delay_s * SECOND)
            heapq.heappush(self.due, (due_ns, len(self.due) + len(self.waiting), provocation))

    def _let_happen(self, provocation: Provocation) -> None:
        what, core, now_ns = provocation.what, self.core, self.bus.now_ns
        self.session.fired.append((provocation, self._moment_now(), now_ns))
        if isinstance(what, Fault):
            self.rig.injector.inject(what, now_ns)
        elif what in ORDER_OF:
            core.order(ORDER_OF[what], provocation.value)
        elif what in WISH_OF:
            self._ask(lambda: core.request_stop(WISH_OF[what]))
        elif what is Mischief.QUICK_STOP:
            self._ask(core.request_quick_stop)
        elif what is Mischief.HOST_AWAY:
            self.host.away_until_ns = now_ns + round(provocation.value * SECOND)
        elif what is Mischief.HOST_LATE:
            self.host.late_until_ns = now_ns + round(provocation.value * SECOND)
        elif what is Mischief.CONTROLLER_OFF:
            self.cable.lose(now_ns, round(provocation.value * SECOND))
        else:
            self.session.killed_ns = now_ns
        self.bus.refresh()

    def _moment_now(self) -> Moment:
        if self.moment is Moment.CAM:
            degrees = math.degrees(self.rig.plant.angle(0)) % 360.0
            if RETURN_STROKE_DEG[0] < degrees < RETURN_STROKE_DEG[1]:
                return Moment.RETURN_STROKE
        return self.moment

    def _ask(self, how: Callable[[], None]) -> None:
        if self.session.asked_ns is None:
            self.session.asked_ns = self.bus.now_ns
        how()
