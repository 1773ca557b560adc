"""Where the demand comes from: the master's plan, the cam, and their conversion into counts, one step a cycle."""

from collections.abc import Sequence
from typing import Final, Protocol

from gateway.cyclic.torque_offsets import TorqueOffsets
from gateway.learning.law import LearnedTorque
from gateway.record.sample import Phase
from gateway.units import AxisUnits, wrap_counts
from mechanism.cam_profile import CamProfile
from mechanism.motion import MasterPhase, MasterPlan, plan_change, plan_jog, plan_stop
from mechanism.slave_law import SlaveLaw

APPROACH_S: Final = 0.25
MASTER: Final = 0
SLAVE: Final = 1

PHASE_OF_PLAN: Final = {
    MasterPhase.RAMP_UP: Phase.RAMP_UP,
    MasterPhase.CRUISE: Phase.CAM,
    MasterPhase.RAMP_DOWN: Phase.RAMP_DOWN,
    MasterPhase.FINISHED: Phase.STANDSTILL,
}


class Demand(Protocol):
    """What the cycle asks for its targets; all attributes are those of the last step taken.

    The lists are new ones after every step, so that whoever keeps one keeps that step's values.
    """

    targets: list[int]
    """Counts, one an axis."""
    torque_offsets: list[int]
    """Per mille of rated torque, one an axis."""
    velocities: list[float]
    """rad/s of each link."""
    master_position: float
    """theta2, unwrapped, rad."""
    master_velocity: float
    """rad/s."""
    phase: Phase

    def step(self) -> None:
        """Take the next step of one cycle; at the plan's end stay where it ended, in phase STANDSTILL."""
        ...

    def controlled_stop(self) -> None:
        """Ramp the master down from where it is; the slaves stay on the cam."""
        ...


class CamDemand:
    """Two axes of a five-bar: the master follows its plan in theta2, the slave the cam theta5(theta2)."""

    def __init__(
        self,
        cam: CamProfile,
        units: tuple[AxisUnits, AxisUnits],
        period_s: float,
        acceleration_limit: float,
        jerk_limit: float,
        torques: TorqueOffsets | None = None,
        law: SlaveLaw | None = None,
    ) -> None:
        """``acceleration_limit`` (rad/s^2) and ``jerk_limit`` (rad/s^3) bound the master's controlled stop.

        ``torques`` makes the torque offsets, which are all 0 without it. ``law`` is where the slave is for every angle
        of the master; None is the cam itself.
        """
        self._cam = cam
        self.law = SlaveLaw(cam) if law is None else law
        self._units = units
        self._period_s = period_s
        self._limits = (acceleration_limit, jerk_limit)
        self._torques = torques
        self._plan: MasterPlan | None = None
        self._step = 0
        self._acceleration = 0.0
        self._is_stopping = False
        self.is_paused = False
        """The master stands, or jogs, before the plan's end, and somebody will say how it goes on."""
        self._turns = (0, 0)
        """Whole revolutions, in counts, that each axis stands away from the plan's: see ``align``."""
        self._approach = (0, 0)
        self._approach_left = 0
        """Steps until the axes are wholly on the plan, and their torque offsets wholly in force."""
        self._approach_steps = 1
        self.targets = [0, 0]
        self.torque_offsets = [0, 0]
        self.velocities = [0.0, 0.0]
        self.master_position = 0.0
        self.master_velocity = 0.0
        self.phase = Phase.STANDSTILL

    def begin(self, plan: MasterPlan, held_targets: Sequence[int]) -> None:
        """Follow ``plan`` from its start with the next step.

        ``held_targets`` (counts) is where the axes are held now: what they are away from the plan's start is taken back
        smoothly within ``APPROACH_S``, so that no target ever jumps. Over the same time the torque offsets come in: the
        position controllers hold the axes until then, and a whole offset at once would push them.
        """
        self._follow(plan)
        start = self.align(self.master_position, (held_targets[MASTER], held_targets[SLAVE]))
        self._approach = (held_targets[MASTER] - start[MASTER], held_targets[SLAVE] - start[SLAVE])
        is_approaching = any(self._approach) or self._torques is not None
        self._approach_left = round(APPROACH_S / self._period_s) if is_approaching else 0
        self._approach_steps = max(self._approach_left, 1)

    def _follow(self, plan: MasterPlan) -> None:
        self._plan = plan
        self._step = 0
        self._is_stopping = False
        self.master_position, self.master_velocity, self._acceleration = plan.at(0.0)

    @property
    def observer(self) -> "CamDemand | None":
        """Who is to be shown the following errors, see ``observe``; None if nothing is learned from them."""
        return self if self._torques is not None and self._torques.is_learning else None

    @property
    def learned(self) -> LearnedTorque | None:
        """What has been learned of the cam until now; None if nothing has."""
        return None if self._torques is None else self._torques.learned

    def observe(self, master_position: float, master_velocity: float, errors: Sequence[int], is_steady: bool) -> None:
        """Learn from the following errors of a cycle (see `listeners.ErrorObserver`), if they are the cam's alone.

        They are not while the axes are still being brought onto the plan, or the slave is moved apart from the cam.
        """
        if self._torques is not None:
            is_plain = not self._approach_left and self.law.plainness(master_position) >= 1.0
            self._torques.observe(master_position, master_velocity, errors, is_steady and is_plain)

    @property
    def is_finished(self) -> bool:
        """Whether the plan has been followed to its end."""
        is_over = self._plan is not None and self._step * self._period_s >= self._plan.duration_s
        return is_over and not self.is_paused and not self.law.is_shifting

    def align(self, master_position: float, actuals: tuple[int, int]) -> tuple[int, int]:
        """Counts of both axes with the master at this theta2: where they must stand before a plan begins there.

        An axis that turns without end is asked for the revolution in which it stands (``actuals``), so that an earlier
        run, which left it some revolutions on, needs no new homing.
        """
        theta5 = self._cam.at(master_position)[0]
        targets = self._units[MASTER].counts(master_position), self._units[SLAVE].counts(theta5)
        turns = [0, 0]
        for number in (MASTER, SLAVE) if self._cam.net_turns else (MASTER,):
            revolution = self._units[number].counts_per_revolution
            turns[number] = round((actuals[number] - targets[number]) / revolution) * revolution
        self._turns = (turns[MASTER], turns[SLAVE])
        return targets[MASTER] + turns[MASTER], targets[SLAVE] + turns[SLAVE]

    def step(self) -> None:
        """Take the next step; see ``Demand``."""
        plan = self._plan
        if plan is None:
            return
        self._step += 1
        at_s = self._step * self._period_s
        position, velocity, self._acceleration = plan.at(at_s)
        theta5, slope = self.law.step(position, self._period_s)
        self.master_position = position
        self.master_velocity = velocity
        self.velocities = [velocity, slope * (velocity + self.law.shift_velocity)]
        master_turns, slave_turns = self._turns
        self.targets = [
            wrap_counts(self._units[MASTER].counts(position) + master_turns),
            wrap_counts(self._units[SLAVE].counts(theta5) + slave_turns),
        ]
        share = 0.0
        if self._approach_left:
            self._approach_left -= 1
            left = self._approach_left / self._approach_steps
            share = left * left * (3.0 - 2.0 * left)
            for number, away in enumerate(self._approach):
                self.targets[number] = wrap_counts(self.targets[number] + round(share * away))
        if self._torques is not None:
            self.torque_offsets = self._torques.at(position, velocity, self._acceleration, self.law, 1.0 - share)
        phase = PHASE_OF_PLAN[plan.phase_at(at_s)]
        if phase is Phase.STANDSTILL and self.law.is_shifting:
            # The slave moves even so, and is to be guarded.
            phase = Phase.RAMP_UP
        self.phase = phase
        if self._is_stopping and phase is not Phase.STANDSTILL:
            self.phase = Phase.CONTROLLED_STOP

    def go_on(self, speed: float, end: float) -> None:
        """Change the master's speed (rad/s, positive) from the next step on, or start it again, and end at ``end``, or
        so many whole revolutions later. Raises mechanism.errors.MotionError.
        """
        state = self.master_position, self.master_velocity, self._acceleration
        self._follow(plan_change(*state, speed, end, *self._limits))
        self.is_paused = False

    def jog(self, speed: float) -> None:
        """Go at this speed (rad/s, either sign; 0 stands) until told otherwise. Raises mechanism.errors.MotionError."""
        state = self.master_position, self.master_velocity, self._acceleration
        plan = plan_jog(*state, speed, *self._limits) if speed else plan_stop(*state, *self._limits)
        self._follow(plan)
        self.is_paused = True

    @property
    def top_speed(self) -> float:
        """Speed that the master does not exceed from here on unless told otherwise, rad/s."""
        cruise = 0.0 if self._plan is None else abs(self._plan.cruise_speed)
        # An acceleration that has to be taken back first still adds a^2 / (2 j).
        return max(cruise, abs(self.master_velocity) + 0.5 * self._acceleration**2 / self._limits[1])

    @property
    def is_stopping(self) -> bool:
        """A controlled stop is under way, or done: nothing goes on after it."""
        return self._is_stopping

    def controlled_stop(self) -> None:
        """Ramp the master down from where it is; see ``Demand``."""
        if self._is_stopping or self._plan is None:
            return
        self.is_paused = False
        plan = plan_stop(self.master_position, self.master_velocity, self._acceleration, *self._limits)
        self._follow(plan)
        self.law.halt_shift()
        self._is_stopping = True
