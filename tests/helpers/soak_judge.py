"""Judges a session of a soak: figures of what the linkage went through, and which of them are beyond their bounds."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from soak_scenario import CV, IN_MOTION, ORDER_OF, SERVO, Mischief, Moment
from soak_session import SECOND, TICK_S, Rig, Session

from config.guard_section import Reaction
from gateway.cyclic.guard import GuardTripped, StopReason
from gateway.cyclic.operation import OrderAnswered
from gateway.record.sample import Phase
from gateway.running.machine_session import StepReached
from gateway.running.recovery import AxisRecovered
from mechanism.dynamics import inverse_dynamics_along
from sim_drive.injection.faults import TRIPS, Fault, FaultKind

TWO_COUNTS_RAD = 2.0 * math.tau / 4096
RUNNING_BOUND_DEG = 1.5
"""From the cam once the machine is at speed, before anything has happened."""
CONTROLLED_BOUND_DEG = 3.0
QUICK_BOUND_DEG = 16.0
"""Of a slave that has torque, sees, and is told where the master is: a brake stops a lost master faster than it can."""
LOST_BOUND_DEG = 26.0
"""20 deg of the machine that the gateway knows: one axis stands at once, the other one as fast as its limits allow."""
LOST_OF_TWO_BOUND_DEG = 35.0
"""If something else has gone wrong as well."""
DEAF_BOUND_DEG = 34.0
"""An axis whose drive hears nothing is told by `cam_window`, 20 deg, and the other one has to be stopped then."""
BOTH_LOST_BOUND_DEG = 70.0
BOTH_LOST_SINE = 0.6
"""Each axis has failed by itself: nobody is left who could follow."""
FROZEN_AT_REST_BOUND_DEG = 85.0
FROZEN_AT_REST_SINE = 0.5
"""A servo axis whose resolver dies while the demand says nothing sinks until its torque goes unanswered."""
LATE_IN_TORQUE_BOUND_DEG = 40.0
"""A position loop that is closed over the bus swings up if all that it says and hears is late, or the bus too full."""
LEAST_SINE = 0.7
SINE_LOSS = 0.15
"""With orders, or on the way onto the cam, the demand itself comes nearer to a singular position; and so much more."""
STANDING_SINE_LOSS = 0.05
CONTROLLED_REST_S = 2.5
QUICK_REST_S = 0.35
KILLED_REST_S = 0.35
QUICK_SHOWN_NS = 2_000_000
"""A sample shows a phase two cycles after the drives were told."""
TORQUE_OFF_AFTER_REST_S = 1.2
KILLED_TORQUE_OFF_S = 0.6
TORQUE_BOUND_NM = 10.0
TRUTH_BOUND_COUNTS = 8
AT_REST = (Moment.COMMISSIONING, Moment.ENABLING, Moment.STANDSTILL, Moment.APPROACH, Moment.RAMP_UP, Moment.RAMP_DOWN)
RESTARTS = (FaultKind.NODE_RESET, FaultKind.POWER_CYCLE)
SEEN = (*TRIPS, FaultKind.MUTE_HEARTBEAT, FaultKind.ERROR_PASSIVE, FaultKind.SLOW_SDO)
"""Of the CV axis: it still tells where it is."""
MUST_STOP = (*TRIPS, FaultKind.NODE_RESET, FaultKind.BUS_OFF)
SLAVE_UNABLE = {Mischief.HOST_AWAY, Mischief.HOST_LATE, Mischief.CONTROLLER_OFF}
"""Nobody tells the slave, for a while, where the master is."""
ORDERS = tuple(ORDER_OF)
FRAMES = (FaultKind.LATE_FRAMES, FaultKind.REORDERED_FRAMES, FaultKind.LOST_FRAMES, FaultKind.DOUBLED_FRAMES)
FATAL = (*TRIPS, *RESTARTS, FaultKind.BUS_OFF, FaultKind.FROZEN_RESOLVER)
"""The axis cannot be relied on afterwards."""
LOST = (*FATAL, *FRAMES, FaultKind.JUMPING_RESOLVER)
"""Nor while it shows something else, or is told only now and then: if the other axis fails then, nobody is followed."""
SEEN_LEAP_COUNTS = {CV: 26, SERVO: 45}
"""Twice the velocity limit of an axis, and noise: whatever leaps farther is known to have leapt."""


@dataclass(frozen=True, slots=True)
class Figures:
    """What the linkage went through; NaN where there was nothing to be measured."""

    stop: str
    """Which stop it was: none, controlled, quick, quick with a slave that could not follow, killed."""
    first_sine: float
    """Where the session began."""
    least_sine: float
    running_deg: float
    """Greatest distance of link s from the cam of link p's true angle, at speed, before the first provocation."""
    cam_deg: float
    """The same from the first call for a stop on."""
    effector_mm: float
    """The end effector's greatest distance from where the cam has it at link p's true angle, in the stop."""
    rest_s: float
    torque_off_s: float
    shaft_torque_Nm: float
    """Greatest of both shafts in the stop."""


class Judge:
    """One session's figures and violations."""

    def __init__(self, rig: Rig, session: Session) -> None:
        self.rig, self.session = rig, session
        self.fired = session.fired
        self.faults = [(p.what, moment) for p, moment, _ in self.fired if isinstance(p.what, Fault)]
        self.violations: list[str] = []
        self.trip = next(
            (e for e in session.events if isinstance(e, GuardTripped) and e.reaction is not Reaction.WARN), None
        )
        calls = [session.asked_ns, session.killed_ns, None if self.trip is None else self.trip.at_ns]
        self.stop_ns = min((at_ns for at_ns in calls if at_ns is not None), default=None)
        self.phases = {phase for _, phase in session.phases}
        self.stop = self._stop()
        self.unheld = self._unheld()
        """Why nothing that any gateway does could keep the linkage within the bounds; empty where it can."""
        self.is_frozen_at_rest = any(
            fault.kind is FaultKind.FROZEN_RESOLVER and moment in AT_REST for fault, moment in self.faults
        )
        low, high = rig.config.ordered_axes[1].limits.position_deg or (-math.inf, math.inf)
        self._ends_within_limits = low < math.degrees(float(rig.plant.ticks[-1][1])) < high
        """Where a slave was lost near the end of its range, its link may stand beyond it."""
        self.figures = self._measure()

    @property
    def leaves_a_start(self) -> bool:
        """Whether the linkage was held well enough for a next run to begin where it stands."""
        return self._ends_within_limits and not (self.unheld or self.is_frozen_at_rest)

    def judge(self) -> list[str]:
        """What is beyond its bound, each in a sentence."""
        self._judge_end()
        self._judge_outcome()
        self._judge_linkage()
        return self.violations

    # -- figures ---------------------------------------------------------------------------------------------------

    def _stop(self) -> str:
        if self.session.killed_ns is not None:
            return "killed"
        if self.stop_ns is None:
            return "none"
        if Phase.QUICK_STOP not in self.phases:
            return "controlled"
        others = [p.what for p, _, _ in self.fired if not isinstance(p.what, Fault)]
        is_able = all(fault.node_id == CV and fault.kind in SEEN for fault, _ in self.faults)
        return "quick" if is_able and not set(others) & SLAVE_UNABLE else "quick, slave unable"

    def _measure(self) -> Figures:
        session, plant = self.session, self.rig.plant
        angles = np.array(plant.ticks)
        times_ns = session.started_ns + np.arange(len(angles)) * TICK_S * SECOND
        parameters = plant.plant.parameters
        closure = parameters.closure
        five_bar = parameters.dynamics.five_bar
        sines = np.abs(five_bar.transmission_sines(angles[:, 0], angles[:, 1], closure)[:, 0])
        least_sine = float(sines.min()) if np.isfinite(sines).all() else 0.0
        away = np.abs(self._wrapped(angles[:, 1] - session.prepared.cam.profile.at_many(angles[:, 0])[:, 0]))
        on_cam = self._on_cam_from_ns()
        first_ns = min((at_ns for _, _, at_ns in self.fired), default=math.inf)
        at_speed = next((at_ns for at_ns, phase in session.phases if phase is Phase.CAM), math.inf)
        calm = away[(times_ns >= at_speed) & (times_ns < min(first_ns, self.stop_ns or math.inf, session.ended_ns))]
        running = math.degrees(float(calm.max())) if len(calm) else math.nan
        if self.stop_ns is None:
            return Figures(
                self.stop, float(sines[0]), least_sine, running, math.nan, math.nan, math.nan, math.nan, math.nan
            )
        stopped = times_ns >= self.stop_ns
        angles, away = angles[stopped], away[stopped]
        cam_deg = effector_mm = math.nan
        if session.is_law_plain and on_cam < self.stop_ns:
            cam_deg = math.degrees(float(away.max()))
            wanted = session.prepared.cam.profile.at_many(angles[:, 0])[:, 0]
            real, ideal = (five_bar.end_effector(angles[:, 0], theta5, closure) for theta5 in (angles[:, 1], wanted))
            effector_mm = float(np.linalg.norm(real - ideal, axis=1).max()) * 1e3
        elif not session.is_law_plain:
            after = [value for at_ns, value in session.off_cam if at_ns >= self.stop_ns]
            cam_deg = math.degrees(max(after, default=math.nan))
        if self.stop.startswith("quick"):
            # From a controlled stop it may be gone over to a quick one late.
            quick_ns = next(at_ns for at_ns, phase in session.phases if phase is Phase.QUICK_STOP)
            angles = angles[times_ns[stopped] >= quick_ns - QUICK_SHOWN_NS]
        called_ns = self.stop_ns
        if session.killed_ns is not None:
            # It may be in the middle of a controlled stop, which takes longer than the drives do.
            called_ns = session.killed_ns
            angles = angles[times_ns[stopped] >= called_ns]
        moving = np.abs(angles - angles[-1]).max(axis=1) > TWO_COUNTS_RAD
        rest_s = float((np.flatnonzero(moving)[-1] + 1) * TICK_S) if moving.any() else 0.0
        torque_off_s = max((session.powered_until_ns - called_ns) / SECOND, 0.0)
        torque = self._shaft_torque(angles, parameters)
        return Figures(
            self.stop, float(sines[0]), least_sine, running, cam_deg, effector_mm, rest_s, torque_off_s, torque
        )

    @staticmethod
    def _wrapped(angles: Any) -> Any:
        return np.remainder(angles + math.pi, math.tau) - math.pi

    def _on_cam_from_ns(self) -> float:
        """When the motion on the cam begins, or began to be guarded as one that may."""
        moving = (Phase.RAMP_UP, Phase.CAM, Phase.RAMP_DOWN)
        return next((at_ns for at_ns, phase in self.session.phases if phase in moving), math.inf)

    @staticmethod
    def _shaft_torque(angles: Any, parameters: Any) -> float:
        """Inverse dynamics of the true motion, N m; the tick at which a brake stops a shaft dead counts as motion."""
        if len(angles) < 5:
            return math.nan
        omega = np.gradient(angles, TICK_S, axis=0)
        alpha = np.gradient(omega, TICK_S, axis=0)
        torques = np.empty_like(angles)
        values = parameters.dynamics.to_array()
        inverse_dynamics_along(values, angles, omega, alpha, int(parameters.closure), 0.0, torques)
        return float(np.abs(torques).max())

    # -- bounds ----------------------------------------------------------------------------------------------------

    def _say(self, what: str) -> None:
        self.violations.append(what)

    def _judge_end(self) -> None:
        session = self.session
        if session.killed_ns is None and not session.is_done:
            self._say("the session does not end")
        if self.rig.is_powered:
            self._say("a drive has torque after the session")
        angles = np.array(self.rig.plant.ticks[-200:])
        if float(np.abs(angles - angles[-1]).max()) > TWO_COUNTS_RAD and not self.unheld:
            self._say("an axis moves after the session")
        started = [
            n for n, (_, phase) in enumerate(session.phases) if phase in (Phase.QUICK_STOP, Phase.CONTROLLED_STOP)
        ]
        if started and {Phase.RAMP_UP, Phase.CAM, Phase.APPROACH} & {p for _, p in session.phases[started[0] :]}:
            self._say("motion begins again after a stop")

    def _unheld(self) -> str:
        if any(fault.kind is FaultKind.BROKEN_BRAKE for fault, _ in self.faults):
            # As soon as the drives are without torque, the axis falls.
            return "broken brake"
        if any(f.kind is FaultKind.JUMPING_RESOLVER and moment is Moment.ENABLING for f, moment in self.faults):
            # Nobody has looked before: what the resolver then shows is where the axis is taken to be.
            return "wrong from the start"
        return ""

    def _judge_outcome(self) -> None:
        session, core = self.session, self.session.core
        if session.killed_ns is not None:
            return
        harmful = [p for p, _, _ in self.fired if p.what not in ORDERS]
        if not harmful and session.is_expected_ready:
            if core.failure is not None:
                self._say(f"a session in which nothing happened failed: {core.failure}")
            elif core.stopped_by is not StopReason.COMPLETED:
                self._say(f"a session in which nothing happened was stopped by {core.stopped_by.value}")
        if core.stopped_by is StopReason.COMPLETED and core.failure is None:
            for fault, moment in self.faults:
                if fault.kind in MUST_STOP and moment in IN_MOTION:
                    self._say(f"{fault.kind.value} in {moment.value} did not stop the run")
        recovered = [event for event in session.events if isinstance(event, AxisRecovered)]
        recovers = any(isinstance(e, StepReached) and e.step == "recovering the axes" for e in session.events)
        if recovers and len(recovered) != 2:
            self._say(f"{len(recovered)} of 2 axes told what has become of them")
        if len(set(map(id, session.events))) != len(session.events):
            self._say("an event was told twice")
        answered = sum(isinstance(e, OrderAnswered) for e in session.events)
        ordered = sum(p.what in ORDERS for p, _, _ in self.fired)
        if answered != ordered:
            self._say(f"{answered} answers to {ordered} orders")

    def judge_truth(self) -> list[str]:
        """After the machine has been settled: do its drives know where they are, and has the gateway told the truth."""
        found: list[str] = []
        if self.session.is_torn and not self.unheld:
            found.append("the linkage is torn")
        away = self.session.truth_error_counts
        if away > TRUTH_BOUND_COUNTS and not self.rig.is_reference_doubtful:
            found.append(f"a homed axis is {away} counts from where its drive says that it is")
        names = self.rig.config.axis_names
        for event in self.session.events:
            if isinstance(event, AxisRecovered) and event.is_ready:
                number = names.index(event.axis)
                if number in self.session.unhomed and not self._has_restarted(number + 1, event.at_ns):
                    found.append(f"axis {event.axis} was called ready for a new run, and has no reference")
        return found

    def _has_restarted(self, node_id: int, since_ns: int) -> bool:
        return any(
            isinstance(p.what, Fault) and p.what.kind in RESTARTS and p.what.node_id == node_id and at_ns >= since_ns
            for p, _, at_ns in self.fired
        )

    def _judge_linkage(self) -> None:
        figures = self.figures
        if figures.running_deg > RUNNING_BOUND_DEG:
            self._say(f"{figures.running_deg:.1f} deg from the cam with nothing amiss (bound {RUNNING_BOUND_DEG:g})")
        if self.unheld:
            return
        least = self._least_sine()
        if not figures.least_sine > least:
            self._say(f"least sine {figures.least_sine:.3f} (bound {least:.2f})")
        if self.stop == "none":
            return
        bounds = {"controlled": CONTROLLED_BOUND_DEG, "quick": QUICK_BOUND_DEG}
        bound = bounds.get(self.stop, self._lost_bound_deg()) + self._jumped_deg()
        if figures.cam_deg > bound:
            self._say(f"{figures.cam_deg:.1f} deg from the cam in a {self.stop} stop (bound {bound:.1f})")
        rest = {"controlled": CONTROLLED_REST_S, "killed": KILLED_REST_S}.get(self.stop, QUICK_REST_S)
        if figures.rest_s > rest:
            self._say(f"at rest {figures.rest_s:.2f} s after a {self.stop} stop was called for (bound {rest:g})")
        off = KILLED_TORQUE_OFF_S if self.stop == "killed" else rest + TORQUE_OFF_AFTER_REST_S
        if figures.torque_off_s > off:
            self._say(
                f"without torque {figures.torque_off_s:.2f} s after a {self.stop} stop was called for (bound {off:g})"
            )
        if figures.shaft_torque_Nm > TORQUE_BOUND_NM:
            self._say(f"{figures.shaft_torque_Nm:.1f} N m on a shaft in a {self.stop} stop (bound {TORQUE_BOUND_NM:g})")

    def _least_sine(self) -> float:
        least = min(LEAST_SINE, self.figures.first_sine - STANDING_SINE_LOSS)
        if not self.session.is_law_plain or Phase.APPROACH in self.phases:
            least = min(LEAST_SINE, self._least_commanded_sine() - SINE_LOSS)
        if self.is_frozen_at_rest:
            least = min(least, FROZEN_AT_REST_SINE)
        if self._are_both_lost():
            least = min(least, BOTH_LOST_SINE)
        return least

    def _lost_bound_deg(self) -> float:
        bound = LOST_BOUND_DEG if len(self.fired) < 2 else LOST_OF_TWO_BOUND_DEG
        if self.is_frozen_at_rest:
            bound = FROZEN_AT_REST_BOUND_DEG
        if self._are_both_lost():
            bound = BOTH_LOST_BOUND_DEG
        if any(fault.kind in FRAMES for fault, _ in self.faults):
            bound = max(bound, DEAF_BOUND_DEG)
        return max(bound, LATE_IN_TORQUE_BOUND_DEG) if self._is_late_in_torque() else bound

    def _are_both_lost(self) -> bool:
        return {CV, SERVO} <= {fault.node_id for fault, _ in self.faults if fault.kind in LOST}

    def _is_in_torque(self) -> bool:
        return any(axis.position_loop is not None for axis in self.rig.config.ordered_axes)

    def _is_late_in_torque(self) -> bool:
        return self._is_in_torque() and any(fault.kind in FRAMES for fault, _ in self.faults)

    def _jumped_deg(self) -> float:
        """How far drives have carried their links whose resolvers leapt by less than can be known."""
        slope = float(np.abs(self.session.prepared.cam.profile.at_many(np.linspace(0.0, math.tau, 360))[:, 1]).max())
        return sum(
            abs(fault.counts or 0) * 360.0 / 4096 * (slope if fault.node_id == CV else 1.0)
            for fault, _ in self.faults
            if fault.kind is FaultKind.JUMPING_RESOLVER and abs(fault.counts or 0) <= SEEN_LEAP_COUNTS[fault.node_id]
        )

    def _least_commanded_sine(self) -> float:
        """Of the way that was demanded, wherever it led."""
        parameters = self.rig.plant.plant.parameters
        angles = np.array(self.session.demanded, dtype=np.float64) * (math.tau / 4096)
        sines = np.abs(parameters.dynamics.five_bar.transmission_sines(*angles.T, parameters.closure)[:, 0])
        return float(np.nanmin(sines))
