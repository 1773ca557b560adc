"""Where the slave is for every angle of the master: on the cam, on a shifted cam, or parked beside it.

theta5(theta2) = (1 - w) cam(theta2 + shift) + w park. The shift changes in time; w goes from 0 to 1 (the slave leaves
the cam) or back within a window of theta2, so that it is the master's motion that takes the slave along, and a stop in
between stays on a path that has been looked at.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, degrees, inf, radians, tau
from typing import Final

from mechanism.cam_profile import CamProfile
from mechanism.errors import MotionError
from mechanism.law_proof import (
    GRID_MARGIN,
    PASS_POINTS,
    Excess,
    Float,
    LawLimits,
    LawProof,
    LawState,
    Pace,
    Piece,
    Strained,
    Work,
    finish,
    law_at,
)
from mechanism.motion import MasterPlan, plan_stop
from mechanism.smooth import bend_of_smooth, peaks_of_smooth, shortest_smooth_s, smooth

FADE_RAD: Final = 0.1
"""Shift at which what has been learned of the cam alone has faded out."""
WINDOW_POINTS: Final = 2 * PASS_POINTS
CAM_POINTS: Final = 32 * PASS_POINTS
WINDOWS: Final = tuple(radians(window) for window in range(10, 361, 5))
"""Where none is asked for, the narrowest of these is taken that keeps away from all limits by ``EASE``, or else the
narrowest that keeps them.
"""
EASE: Final = 1.5
SHIFTS: Final = 5
"""Shifts, from the old to the new one, of which the path is looked at."""
SLOWER: Final = (1.0, 2.0, 4.0, 8.0)
"""How much longer a shift may take than it would by its own speed, so that the slave's limits are kept."""


class SlaveLaw:
    """The law in force, and its changes; each is proved before it is taken, pass by pass."""

    def __init__(self, cam: CamProfile, limits: LawLimits | None = None, speed: float = 0.0) -> None:
        """``limits`` None: the law is the cam, for good. ``speed`` (rad/s): the cam has been proved up to there."""
        self._cam = cam
        self._proof = None if limits is None else LawProof(cam, limits)
        self.is_plain: bool = True
        """The law is the cam's own."""
        self.shift: float = 0.0
        """rad."""
        self._shift_from: float = 0.0
        self._shift_to: float = 0.0
        self.shift_velocity: float = 0.0
        """rad/s; the slave moves so much times the cam's slope by the shift alone."""
        self._shift_s: float = 0.0
        self._shift_left_s: float = 0.0
        self._halt: MasterPlan | None = None
        """Of a shift that is being stopped on its way."""
        self._weight: float = 0.0
        """w before the window."""
        self._weight_to: float = 0.0
        self._window: tuple[float, float] = (inf, inf)
        self._park: float = 0.0
        self._base: float = 0.0
        """Whole revolutions by which a slave that turns on and on has missed the cam's while it was parked, rad."""
        self._cam_speed: float = speed
        self._cam_excess = Excess(Strained.MASTER_VELOCITY, "", speed, speed, 0.0)
        if self._proof is not None:
            most = self._proof.limits.master_velocity
            fastest, excess = finish(self._proof.fastest([Piece(LawState(), points=CAM_POINTS)], most, 1.0))
            self._cam_excess = excess or Excess(
                Strained.MASTER_VELOCITY, self._proof.limits.axis_names[0], most, most, 0.0
            )
            self._cam_speed = max(speed, fastest)
        self._proved_speed: float = self._cam_speed
        self._array = LawState().to_array()
        # The first call loads the machine code, which must not happen within a cycle.
        law_at(cam.coefficients, cam.net_turns, self._array, 0.0)

    @property
    def cam(self) -> CamProfile:
        """The cam itself."""
        return self._cam

    @property
    def is_engaged(self) -> bool:
        """The slave is on its (perhaps shifted) cam, or on its way there."""
        return self._weight_to == 0.0

    @property
    def proved_speed(self) -> float:
        """Speed of the master, rad/s, up to which the law in force keeps all limits for certain."""
        return self._cam_speed if self.is_plain else self._proved_speed

    def at(self, theta2: float) -> tuple[float, float]:
        """theta5 and its derivative with respect to theta2, rad."""
        if self.is_plain:
            theta5, slope, _, _ = self._cam.at(theta2)
        else:
            theta5, slope, _, _ = law_at(self._cam.coefficients, self._cam.net_turns, self._law_array(), theta2)
        return theta5 + self._base, slope

    def motion(
        self, theta2: float, velocity: float, acceleration: float, ahead_s: float = 0.0
    ) -> tuple[float, float, float]:
        """theta5 (rad), its velocity and its acceleration with the master in this state (rad, rad/s, rad/s^2), which it
        reaches ``ahead_s`` from now: a shift under way goes on until then.
        """
        law = self._law_array()
        rate = bend = 0.0
        if self.is_shifting:
            law[0], rate, bend = self._shift_at(self._shift_s - self._shift_left_s + ahead_s)
        theta5, slope, curvature, _ = law_at(self._cam.coefficients, self._cam.net_turns, law, theta2)
        pace = velocity + rate
        return theta5 + self._base, slope * pace, curvature * pace * pace + slope * (acceleration + bend)

    def _law_array(self) -> Float:
        """The law in force as `LawState.to_array` has it; always the same array."""
        law = self._array
        law[0], law[1], law[2] = self.shift, self._weight, self._weight_to
        law[3], law[4] = self._window
        law[5] = self._park
        return law

    def plainness(self, theta2: float) -> float:
        """1 on the cam itself, 0 where what has been learned of the cam does not hold."""
        if self.is_plain:
            return 1.0
        return self.engaged_share(theta2) * max(1.0 - abs(self.shift) / FADE_RAD, 0.0)

    def engaged_share(self, theta2: float) -> float:
        """1 - w: 1 on the cam, shifted or not, 0 parked."""
        return 1.0 - self._weight_at(theta2)

    def step(self, theta2: float, period_s: float) -> tuple[float, float]:
        """``advance``, then ``at``."""
        self.advance(theta2, period_s)
        return self.at(theta2)

    def advance(self, theta2: float, period_s: float) -> None:
        """One cycle has passed, the master is at theta2 (rad)."""
        if self.is_plain:
            return
        if self._shift_left_s > 0.0:
            self._shift_left_s = max(self._shift_left_s - period_s, 0.0)
            self.shift, self.shift_velocity, _ = self._shift_at(self._shift_s - self._shift_left_s)
        if theta2 >= self._window[1]:
            self._weight = self._weight_to
            self._window = (inf, inf)
        self.is_plain = self.shift == 0.0 == self._shift_left_s and self._weight == 0.0 == self._weight_to

    @property
    def is_shifting(self) -> bool:
        """A phase shift is under way: the slave moves even if the master stands."""
        return self._shift_left_s > 0.0

    def halt_shift(self) -> None:
        """Bring a shift under way to rest where it is, within the acceleration and jerk that it has been proved for."""
        if not self.is_shifting or self._halt is not None:
            return
        away, duration_s = abs(self._shift_to - self._shift_from), self._shift_s
        now = self._shift_at(duration_s - self._shift_left_s)
        _, acceleration, jerk = peaks_of_smooth(away, duration_s)
        self._halt = plan_stop(*now, acceleration, jerk)
        self._shift_s = self._shift_left_s = self._halt.duration_s

    def _shift_at(self, t_s: float) -> tuple[float, float, float]:
        """Shift, its velocity and acceleration (rad, s) since it began, or since it was told to halt."""
        if self._halt is not None:
            return self._halt.at(t_s)
        u, change, duration_s = t_s / self._shift_s, self._shift_to - self._shift_from, self._shift_s
        share, rate = smooth(u)
        bend = bend_of_smooth(u)
        return self._shift_from + share * change, rate * change / duration_s, bend * change / duration_s**2

    def prove_speed(self, speed: float) -> Work[None]:
        """Prove the law in force for a speed of the master (rad/s, either sign) and slower ones.

        Raises TooFastError.
        """
        if 0.0 <= speed <= self.proved_speed:
            return
        proof = self._need_proof()
        if self.is_plain and speed > 0.0:
            raise TooFastError(self._cam_speed, self._cam_excess)
        if self.is_shifting and speed > 0.0:
            raise MotionError("the phase is being shifted, the master may go faster when that is done")
        fastest, excess = yield from proof.fastest(self._pieces(), speed)
        if excess is not None:
            raise TooFastError(abs(fastest), excess)
        self._proved_speed = max(speed, self._proved_speed)

    def change_shift(self, shift: float, speed: float, pace: Pace) -> Work[None]:
        """Go over to another shift (rad), no faster than the shift of ``pace`` allows, with the master at ``speed``
        (rad/s) or slower; the shift takes longer where the slave's limits ask for it.

        Raises MotionError where the shifted path comes too near a singular position or breaks a limit.
        """
        proof = self._need_proof()
        if self.is_shifting or self._weight != 0.0 or self._weight_to != 0.0:
            raise MotionError("the phase can be shifted when the slave is on its cam and no other shift is under way")
        away = abs(shift - self.shift)
        if away == 0.0:
            return
        shortest_s = shortest_smooth_s(away, pace.shift_speed, pace.shift_acceleration, pace.shift_jerk)
        path = [Piece(LawState(self.shift + n / (SHIFTS - 1) * (shift - self.shift))) for n in range(SHIFTS)]
        excess: Excess | None = None
        duration_s = shortest_s
        for slower in SLOWER:
            duration_s = slower * shortest_s
            excess = yield from proof.excess(path, Pace(speed, *peaks_of_smooth(away, duration_s)))
            if excess is None or excess.what is Strained.SINE:
                break
        if excess is not None:
            raise MotionError(f"shifted to {degrees(shift):.4g} deg, {excess}")
        self._proved_speed = speed
        self._shift_from, self._shift_to = self.shift, shift
        self._shift_s = self._shift_left_s = duration_s
        self._halt = None
        self.is_plain = False

    def prove_engagement(self, is_engaged: bool, at: float, window: float, speed: float) -> "Work[Engagement]":
        """Prove that the slave leaves its cam, or returns, from the master's angle ``at`` on and within ``window`` (all
        rad; 0: one is chosen, see ``WINDOWS``), with the master at ``speed`` (rad/s) or slower. Parked it is where the
        cam is at the window's end. `engage` makes it the law.

        Raises MotionError where the way or the parked slave comes too near a singular position or breaks a limit.
        """
        proof = self._need_proof()
        self._refuse_engagement(is_engaged)
        start = at % tau
        mildest: tuple[Excess, float] | None = None
        fitting: LawState | None = None
        for width, margin in _windows(window):
            state = self._engagement(is_engaged, start, width)
            excess = yield from proof.excess([Piece(state, start, width, WINDOW_POINTS)], Pace(speed), margin)
            if excess is None and not is_engaged:
                excess = yield from proof.excess([Piece(_arrived(state), start)], Pace(speed), margin)
            elif excess is None and (self.shift != 0.0 or speed > self._cam_speed):
                excess = yield from proof.excess([Piece(_arrived(state), start)], Pace(speed))
            if excess is None:
                fitting = state
                break
            if margin == GRID_MARGIN and (mildest is None or (not window and excess.share < mildest[0].share)):
                mildest = excess, width
        if fitting is None or (window and mildest is not None):
            raise EngagementError(is_engaged, start, window, speed, mildest, fitting)
        return Engagement(is_engaged, fitting, speed)

    def engage(self, engagement: "Engagement", theta2: float) -> None:
        """Make a proved engagement the law, the master being at theta2 (rad, unwrapped): the window begins where the
        master comes next to the angle that it was proved for. Raises MotionError if the law has changed since.
        """
        self._refuse_engagement(engagement.is_engaged)
        state = engagement.state
        turns = ceil((theta2 - state.start) / tau)
        self._window = state.start + turns * tau, state.end + turns * tau
        park = state.park + turns * self._cam.net_turns * tau
        if engagement.is_engaged:
            self._base += self._park - park
        self._proved_speed = min(engagement.speed, self.proved_speed)
        self._park = park
        self._weight_to = state.weight_to
        self.is_plain = False

    def _refuse_engagement(self, is_engaged: bool) -> None:
        if self.is_engaged is is_engaged:
            raise MotionError(f"the slave is {'on its cam' if is_engaged else 'off its cam'} already")
        if self._window[1] != inf:
            raise MotionError("the slave is still on its way, it can be sent back when it has arrived")
        if self.is_shifting:
            raise MotionError("the phase is being shifted, the slave can leave its cam when that is done")

    def _engagement(self, is_engaged: bool, start: float, width: float) -> LawState:
        cam = self._cam.at(start + width + self.shift)[0]
        if not is_engaged:
            return LawState(self.shift, 0.0, 1.0, start, start + width, cam)
        # A slave that turns on and on goes on from the revolution in which it is parked.
        missed = round((cam - self._park) / tau) * tau if self._cam.net_turns else 0.0
        return LawState(self.shift, 1.0, 0.0, start, start + width, self._park + missed)

    def _pieces(self) -> list[Piece]:
        """The law in force, from here on."""
        start, end = self._window
        state = LawState(self.shift, self._weight, self._weight_to, start, end, self._park)
        before = Piece(LawState(self.shift, self._weight, self._weight, park=self._park))
        if end == inf:
            return [before]
        return [before, Piece(state, start, end - start, WINDOW_POINTS), Piece(_arrived(state), end)]

    def _weight_at(self, theta2: float) -> float:
        start, end = self._window
        if end == inf:
            return self._weight
        return self._weight + (self._weight_to - self._weight) * smooth((theta2 - start) / (end - start))[0]

    def _need_proof(self) -> LawProof:
        if self._proof is None:
            raise MotionError("this machine's law is its cam alone")
        return self._proof


def _windows(window: float) -> Sequence[tuple[float, float]]:
    """Windows to be looked at, and by what factor each has to stay away from the limits."""
    if window:
        return [(window, GRID_MARGIN), *((wider, GRID_MARGIN) for wider in WINDOWS if wider > window)]
    return [(width, margin) for margin in (EASE, GRID_MARGIN) for width in WINDOWS]


def _arrived(state: LawState) -> LawState:
    """The law behind its window."""
    return LawState(state.shift, state.weight_to, state.weight_to, park=state.park)


class TooFastError(MotionError):
    """The law in force does not allow a speed of the master; ``fastest`` (rad/s) is what it allows."""

    def __init__(self, fastest: float, excess: Excess) -> None:
        super().__init__(str(excess))
        self.fastest = fastest
        self.excess = excess


class EngagementError(MotionError):
    """The slave cannot leave its cam, or return, as asked; ``fitting`` (rad) is a wider window that would do."""

    def __init__(
        self,
        is_engaged: bool,
        start: float,
        window: float,
        speed: float,
        refused: tuple[Excess, float] | None,
        fitting: LawState | None,
    ) -> None:
        """``refused``: what is in the way of the window that was asked for, or of the best of all, and its width."""
        what = "returning to" if is_engaged else "leaving"
        excess, width_rad = refused or ("", window)
        width = f"{degrees(window):.4g} deg" if window else f"any window, {degrees(width_rad):.0f} deg being the best,"
        wider = "no wider window fits" if fitting is None else f"{degrees(fitting.end - start):.0f} deg would fit"
        super().__init__(
            f"{what} the cam at {degrees(start):.4g} deg within {width} at {speed * 60.0 / tau:.4g} rpm: {excess}"
            + (f"; {wider}" if window else "")
        )
        self.fitting = None if fitting is None else fitting.end - start


@dataclass(frozen=True, slots=True)
class Engagement:
    """A proved way off the cam or back; the window's angles are those of the master's first revolution."""

    is_engaged: bool
    state: LawState
    speed: float
