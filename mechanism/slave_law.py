"""Where the slave is for every angle of the master: on the cam, on a shifted cam, or parked beside it.

theta5(theta2) = (1 - w) cam(theta2 + shift) + w park. The shift changes in time; w goes from 0 to 1 (the slave leaves
the cam) or back within a window of theta2, so that it is the master's motion that takes the slave along, and a stop in
between stays on a path that has been looked at.
"""

from math import degrees, inf, tau
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mechanism.cam_profile import CamProfile
from mechanism.errors import MotionError
from mechanism.five_bar import Closure, FiveBar

Float = NDArray[np.float64]

GRID: Final = 360
"""Angles of the master at which a changed law is looked at."""
FADE_RAD: Final = 0.1
"""Shift at which a feed-forward that knows the cam alone has faded out."""


def smooth(u: float) -> tuple[float, float]:
    """10 u^3 - 15 u^4 + 6 u^5 and its derivative, for u held within 0 to 1."""
    if u <= 0.0:
        return 0.0, 0.0
    if u >= 1.0:
        return 1.0, 0.0
    return u * u * u * (10.0 - u * (15.0 - 6.0 * u)), 30.0 * u * u * (1.0 - u) ** 2


class LawLimits:
    """What a changed law must keep: a five-bar's least sine between q and r, and the slave's limits (rad, s)."""

    __slots__ = ("acceleration", "closure", "five_bar", "minimum_sine", "velocity")

    def __init__(
        self, five_bar: FiveBar, closure: Closure, minimum_sine: float, velocity: float, acceleration: float
    ) -> None:
        self.five_bar = five_bar
        self.closure = closure
        self.minimum_sine = minimum_sine
        self.velocity = velocity
        self.acceleration = acceleration


class SlaveLaw:
    """The law in force, and its changes; each is proved before it is taken."""

    def __init__(self, cam: CamProfile, limits: LawLimits | None = None) -> None:
        """``limits`` None: the law is the cam, for good."""
        self._cam = cam
        self._limits = limits
        self.is_plain: bool = True
        """The law is the cam's own."""
        self.shift = 0.0
        """rad."""
        self._shift_from = 0.0
        self._shift_to = 0.0
        self._shift_s = 0.0
        self._shift_left_s = 0.0
        self._weight = 0.0
        """w before the window."""
        self._weight_to = 0.0
        self._window: tuple[float, float] = (inf, inf)
        self._park: float = 0.0

    @property
    def cam(self) -> CamProfile:
        """The cam itself."""
        return self._cam

    @property
    def is_engaged(self) -> bool:
        """The slave is on its (perhaps shifted) cam, or on its way there."""
        return self._weight_to == 0.0

    def at(self, theta2: float) -> tuple[float, float]:
        """theta5 and its derivative with respect to theta2, rad."""
        theta5, slope, _, _ = self._cam.at(theta2 + self.shift)
        if self.is_plain or (self._weight == 0.0 and self._weight_to == 0.0):
            return theta5, slope
        weight, rate = self._weight_at(theta2)
        return theta5 + weight * (self._park - theta5), slope * (1.0 - weight) + rate * (self._park - theta5)

    def plainness(self, theta2: float) -> float:
        """1 on the cam itself, 0 where what is known of the cam does not hold: a factor for feed-forward."""
        if self.is_plain:
            return 1.0
        return (1.0 - self._weight_at(theta2)[0]) * max(1.0 - abs(self.shift) / FADE_RAD, 0.0)

    def step(self, theta2: float, period_s: float) -> tuple[float, float, float]:
        """``advance``, then ``at`` and ``plainness`` there."""
        if self.is_plain:
            theta5, slope, _, _ = self._cam.at(theta2)
            return theta5, slope, 1.0
        self.advance(theta2, period_s)
        theta5, slope = self.at(theta2)
        return theta5, slope, self.plainness(theta2)

    def advance(self, theta2: float, period_s: float) -> None:
        """One cycle has passed, the master is at theta2 (rad)."""
        if self.is_plain:
            return
        if self._shift_left_s > 0.0:
            self._shift_left_s = max(self._shift_left_s - period_s, 0.0)
            share, _ = smooth(1.0 - self._shift_left_s / self._shift_s)
            self.shift = self._shift_from + share * (self._shift_to - self._shift_from)
        if theta2 >= self._window[1]:
            self._weight = self._weight_to
            self._window = (inf, inf)
        self.is_plain = self.shift == 0.0 == self._shift_left_s and self._weight == 0.0 == self._weight_to

    def change_shift(self, shift: float, speed: float, shift_speed: float) -> None:
        """Go over to another shift (rad), no faster than ``shift_speed`` (rad/s), with the master at ``speed`` (rad/s).

        Raises MotionError where the shifted path comes too near a singular position or breaks the slave's limits.
        """
        limits = self._need_limits()
        if self._shift_left_s > 0.0 or self._weight != 0.0 or self._weight_to != 0.0:
            raise MotionError("the phase can be shifted when the slave is on its cam and no other shift is under way")
        away = abs(shift - self.shift)
        if away == 0.0:
            return
        theta2: Float = np.arange(GRID, dtype=np.float64) * (tau / GRID)
        shifts = np.linspace(self.shift, shift, 5)[:, np.newaxis]
        track = self._cam.at_many(theta2[np.newaxis, :] + shifts)
        self._prove(limits, theta2 + 0.0 * shifts, track[..., 0], f"a shift to {degrees(shift):.1f} deg")
        duration_s = 1.875 * away / shift_speed
        fastest = abs(speed) + shift_speed
        steepest, sharpest = float(np.abs(track[..., 1]).max()), float(np.abs(track[..., 2]).max())
        _bound("velocity", steepest * fastest, limits.velocity, "rad/s")
        gain = 5.774 * away / duration_s**2
        _bound("acceleration", sharpest * fastest**2 + steepest * gain, limits.acceleration, "rad/s^2")
        self._shift_from, self._shift_to = self.shift, shift
        self._shift_s = self._shift_left_s = duration_s
        self.is_plain = False

    def change_engagement(self, is_engaged: bool, at: float, theta2: float, window: float, speed: float) -> None:
        """Leave the cam, or return to it, beginning when the master (now at theta2) is next at angle ``at``, within
        ``window`` (all rad), at the master's ``speed`` (rad/s). Parked it is where the cam is at the window's end.

        Raises MotionError where the way or the parked slave comes too near a singular position or breaks a limit.
        """
        limits = self._need_limits()
        if self.is_engaged is is_engaged:
            raise MotionError(f"the slave is {'on its cam' if is_engaged else 'off its cam'} already")
        if self._window[1] != inf:
            raise MotionError("the slave is still on its way, it can be sent back when it has arrived")
        start = theta2 + (at - theta2) % tau
        before = (self._weight, self._weight_to, self._window, self._park, self.is_plain)
        self._window = start, start + window
        if not is_engaged:
            self._park = self._cam.at(start + window + self.shift)[0]
        self._weight_to = 0.0 if is_engaged else 1.0
        self.is_plain = False
        try:
            self._prove_engagement(limits, start, window, speed)
        except MotionError:
            self._weight, self._weight_to, self._window, self._park, self.is_plain = before
            raise

    def _prove_engagement(self, limits: LawLimits, start: float, window: float, speed: float) -> None:
        what = f"leaving the cam at {degrees(start) % 360.0:.1f} deg" if self._weight_to else "returning to the cam"
        turn: Float = start + np.arange(GRID + 1, dtype=np.float64) * (tau / GRID)
        u = np.clip((turn - start) / window, 0.0, 1.0)
        weight = self._weight + (self._weight_to - self._weight) * u**3 * (10.0 - u * (15.0 - 6.0 * u))
        cam = self._cam.at_many(turn + self.shift)[:, 0]
        theta5 = cam + weight * (self._park - cam)
        parked = np.full(GRID + 1, self._park)
        self._prove(limits, np.stack((turn, turn)), np.stack((theta5, parked)), what)
        slope = np.gradient(theta5, tau / GRID)
        _bound("velocity", float(np.abs(slope).max()) * abs(speed), limits.velocity, "rad/s")
        bend = np.gradient(slope, tau / GRID)
        _bound("acceleration", float(np.abs(bend).max()) * speed**2, limits.acceleration, "rad/s^2")

    @staticmethod
    def _prove(limits: LawLimits, theta2: Float, theta5: Float, what: str) -> None:
        sines = np.abs(limits.five_bar.transmission_sines(theta2, theta5, limits.closure)[..., 0])
        least = float(sines.min())
        if not least >= limits.minimum_sine:
            raise MotionError(
                f"{what} would bring the linkage to a transmission sine of {least:.3f} (bound {limits.minimum_sine:g})"
            )

    def _weight_at(self, theta2: float) -> tuple[float, float]:
        start, end = self._window
        if end == inf:
            return self._weight, 0.0
        share, rate = smooth((theta2 - start) / (end - start))
        change = self._weight_to - self._weight
        return self._weight + change * share, change * rate / (end - start)

    def _need_limits(self) -> LawLimits:
        if self._limits is None:
            raise MotionError("this machine's law is its cam alone")
        return self._limits


def _bound(name: str, value: float, limit: float, unit: str) -> None:
    if value > limit:
        raise MotionError(f"the slave's {name} would reach {value:.3g} {unit} (bound {limit:g})")
