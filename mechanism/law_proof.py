"""What a law of the slave asks of both axes while the master moves along it, against what they may do.

A proof looks at every angle of the master on a grid, and takes the master to run at a speed, or slower, and to ramp as
hard as it may at any of them. It is cut into passes of equal size: who has a cycle to keep takes one pass a cycle.
"""

from collections.abc import Generator, Sequence
from dataclasses import dataclass
from enum import IntEnum, unique
from math import degrees, inf, tau
from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from mechanism.cam_profile import CamProfile, evaluate
from mechanism.dynamics import inverse_dynamics, linkage_sine
from mechanism.jit import kernel

Float = NDArray[np.float64]
T = TypeVar("T")
Work = Generator[None, None, T]
"""Work in passes: every ``next`` is one of them."""

PASS_POINTS: Final = 128
"""Angles that are looked at in one pass, some 0.05 ms."""
TURN_POINTS: Final = 8 * PASS_POINTS
GRID_MARGIN: Final = 1.005
"""What may lie between the angles of a grid beyond what is at them."""
BISECTIONS: Final = 12


@dataclass(frozen=True, slots=True)
class LawState:
    """theta5(theta2) = (1 - w) cam(theta2 + shift) + w park, rad; w goes from ``weight`` to ``weight_to`` as theta2
    goes from ``start`` to ``end``, and stays ``weight`` where ``start`` is infinite.
    """

    shift: float = 0.0
    weight: float = 0.0
    weight_to: float = 0.0
    start: float = inf
    end: float = inf
    park: float = 0.0

    def to_array(self) -> Float:
        """For the kernel."""
        return np.array((self.shift, self.weight, self.weight_to, self.start, self.end, self.park), dtype=np.float64)


@dataclass(frozen=True, slots=True)
class Piece:
    """A law from one angle of the master on, over a span (rad)."""

    state: LawState
    start: float = 0.0
    span: float = tau
    points: int = TURN_POINTS


@dataclass(frozen=True, slots=True)
class Pace:
    """How fast: the master's speed (rad/s, either sign), and what a shift under way adds to it on the slave's side."""

    speed: float
    shift_speed: float = 0.0
    shift_acceleration: float = 0.0
    shift_jerk: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class LawLimits:
    """What both axes and the linkage may do: rad, s, N m; names and pairs are (master, slave).

    ``velocity``, ``acceleration`` and ``jerk`` are the slave's; ``ramp_acceleration`` and ``ramp_jerk`` are those with
    which the master changes its speed. ``dynamics`` is `DynamicsParameters.to_array`, ``minimum_sine`` that of the
    angle between q and r. What is infinite is not looked at.
    """

    axis_names: tuple[str, str]
    dynamics: Float
    closure: int
    coulomb_velocity: float
    minimum_sine: float
    master_velocity: float
    velocity: float
    acceleration: float
    jerk: float
    torques: tuple[float, float]
    ramp_acceleration: float
    ramp_jerk: float


@unique
class Strained(IntEnum):
    """What a proof looks at."""

    VELOCITY = 0
    ACCELERATION = 1
    JERK = 2
    MASTER_TORQUE = 3
    SLAVE_TORQUE = 4
    SINE = 5
    MASTER_VELOCITY = 6


_MASTERS: Final = frozenset({Strained.MASTER_TORQUE, Strained.MASTER_VELOCITY})
_WHAT: Final = {
    Strained.VELOCITY: ("velocity", "rad/s"),
    Strained.ACCELERATION: ("acceleration", "rad/s^2"),
    Strained.JERK: ("jerk", "rad/s^3"),
    Strained.MASTER_TORQUE: ("torque", "Nm"),
    Strained.SLAVE_TORQUE: ("torque", "Nm"),
    Strained.MASTER_VELOCITY: ("velocity", "rad/s"),
}


@dataclass(frozen=True, slots=True)
class Excess:
    """A limit that would be passed: by what, where (theta2, rad), and whose it is (empty: the linkage's)."""

    what: Strained
    axis: str
    value: float
    limit: float
    theta2: float

    @property
    def share(self) -> float:
        """By what factor the limit is passed."""
        if self.what is Strained.SINE:
            return self.limit / max(self.value, 1e-9)
        return self.value / self.limit

    @property
    def bound(self) -> str:
        """The limit itself."""
        if self.what is Strained.SINE:
            return f"the linkage's transmission sine is at its bound of {self.limit:g}"
        name, unit = _WHAT[self.what]
        where = (
            "" if self.what is Strained.MASTER_VELOCITY else f" where theta2 = {degrees(self.theta2) % 360.0:.0f} deg"
        )
        return f"axis {self.axis}'s {name} is at its limit of {self.limit:g} {unit}{where}"

    def __str__(self) -> str:
        at = f"at theta2 = {degrees(self.theta2) % 360.0:.0f} deg"
        if self.what is Strained.SINE:
            return f"the linkage would come to a transmission sine of {self.value:.3f} {at} (bound {self.limit:g})"
        name, unit = _WHAT[self.what]
        where = "" if self.what is Strained.MASTER_VELOCITY else f" {at}"
        return f"axis {self.axis}'s {name} would reach {self.value:.4g} {unit}{where} (limit {self.limit:g})"


@kernel
def law_at(coefficients: Float, net_turns: int, law: Float, theta2: float) -> tuple[float, float, float, float]:
    """theta5 and its first three derivatives with respect to theta2 (rad) of a `LawState`."""
    y, y1, y2, y3 = evaluate(coefficients, net_turns, theta2 + law[0])
    weight = law[1]
    w1 = w2 = w3 = 0.0
    if theta2 >= law[4]:
        weight = law[2]
    elif theta2 > law[3]:
        change = law[2] - law[1]
        window = law[4] - law[3]
        u = (theta2 - law[3]) / window
        weight += change * u * u * u * (10.0 - u * (15.0 - 6.0 * u))
        w1 = change * 30.0 * u * u * (1.0 - u) * (1.0 - u) / window
        w2 = change * 60.0 * u * (1.0 - u) * (1.0 - 2.0 * u) / (window * window)
        w3 = change * (60.0 - 360.0 * u * (1.0 - u)) / (window * window * window)
    if weight == 0.0 and w3 == 0.0:
        return y, y1, y2, y3
    away = law[5] - y
    on = 1.0 - weight
    return (
        y + weight * away,
        on * y1 + w1 * away,
        on * y2 - 2.0 * w1 * y1 + w2 * away,
        on * y3 - 3.0 * w1 * y2 - 3.0 * w2 * y1 + w3 * away,
    )


@kernel
def raise_worst(worst: Float, row: int, value: float, theta2: float) -> None:
    """Keep the greatest value, and where it was."""
    if not value <= worst[row, 0]:
        worst[row, 0] = value
        worst[row, 1] = theta2


@kernel
def strain_pass(
    dynamics: Float,
    closure: int,
    coulomb_velocity: float,
    coefficients: Float,
    net_turns: int,
    law: Float,
    pace: Float,
    start: float,
    step: float,
    count: int,
    worst: Float,
) -> None:
    """Take ``count`` angles from ``start`` on into ``worst`` (6, 2): rows `Strained`, columns value and theta2.

    ``pace``: the master's speed, acceleration and jerk, and what a shift adds to each of them on the slave's side.
    """
    speed = pace[0]
    fast = abs(speed) + pace[3]
    ramp = pace[1] + pace[4]
    jerk = pace[2] + pace[5]
    for i in range(count):
        theta2 = start + i * step
        theta5, slope, bend, twist = law_at(coefficients, net_turns, law, theta2)
        raise_worst(worst, 0, abs(slope) * fast, theta2)
        raise_worst(worst, 1, abs(bend) * fast * fast + abs(slope) * ramp, theta2)
        raise_worst(
            worst, 2, abs(twist) * fast * fast * fast + 3.0 * abs(bend) * fast * ramp + abs(slope) * jerk, theta2
        )
        sine = abs(linkage_sine(dynamics, theta2, theta5, closure))
        if not sine >= worst[5, 0]:
            worst[5, 0] = sine
            worst[5, 1] = theta2
        # Torque is linear in the acceleration and, but for friction, in the square of the speed: the ends are enough.
        for is_moving in range(2):
            v2 = speed * is_moving
            v5 = slope * (fast if speed >= 0.0 else -fast) * is_moving
            bent = bend * fast * fast * is_moving
            for side in range(4):
                a2 = pace[1] if side & 1 else -pace[1]
                a5 = bent + slope * (a2 + (pace[4] if side & 2 else -pace[4]))
                torque2, torque5 = inverse_dynamics(dynamics, theta2, theta5, v2, v5, a2, a5, closure, coulomb_velocity)
                raise_worst(worst, 3, abs(torque2), theta2)
                raise_worst(worst, 4, abs(torque5), theta2)
                if pace[4] == 0.0 and side == 1:
                    break


class LawProof:
    """Proofs for the laws of one cam."""

    def __init__(self, cam: CamProfile, limits: LawLimits) -> None:
        self._cam = cam
        self.limits = limits
        self._worst = np.zeros((6, 2), dtype=np.float64)
        self._bounds = (limits.velocity, limits.acceleration, limits.jerk, *limits.torques)
        # The first call loads the machine code, which must not happen within a cycle.
        self._take(Piece(LawState(), points=1), self._pace(Pace(0.0)), LawState().to_array(), 0, 1)

    def excess(self, pieces: Sequence[Piece], pace: Pace, margin: float = GRID_MARGIN) -> Work[Excess | None]:
        """The limit that is passed most in any of the pieces at this pace or slower; None if all are kept.

        ``margin`` is the factor by which everything has to stay away from its limit.
        """
        limits = self.limits
        if abs(pace.speed) > limits.master_velocity:
            limit = limits.master_velocity
            return Excess(Strained.MASTER_VELOCITY, limits.axis_names[0], abs(pace.speed), limit, 0.0)
        self._worst[:] = 0.0
        self._worst[Strained.SINE] = inf
        speeds = self._pace(pace)
        for piece in pieces:
            law = piece.state.to_array()
            for first in range(0, piece.points, PASS_POINTS):
                self._take(piece, speeds, law, first, min(PASS_POINTS, piece.points - first))
                yield
        return self._judge(margin)

    def fastest(
        self, pieces: Sequence[Piece], up_to: float, margin: float = GRID_MARGIN
    ) -> Work[tuple[float, Excess | None]]:
        """The greatest speed (rad/s) of the master up to ``up_to`` (either sign) that keeps all limits, and which one
        is in the way of a greater one.
        """
        over = yield from self.excess(pieces, Pace(up_to), margin)
        if over is None:
            return up_to, None
        low, high = 0.0, up_to
        for _ in range(BISECTIONS if over.what is not Strained.SINE else 0):
            middle = 0.5 * (low + high)
            found = yield from self.excess(pieces, Pace(middle), margin)
            if found is None:
                low = middle
            else:
                high, over = middle, found
        return low, over

    def _pace(self, pace: Pace) -> Float:
        limits = self.limits
        return np.array(
            (
                pace.speed,
                limits.ramp_acceleration,
                limits.ramp_jerk,
                pace.shift_speed,
                pace.shift_acceleration,
                pace.shift_jerk,
            ),
            dtype=np.float64,
        )

    def _take(self, piece: Piece, pace: Float, law: Float, first: int, count: int) -> None:
        limits, step = self.limits, piece.span / piece.points
        strain_pass(
            limits.dynamics,
            limits.closure,
            limits.coulomb_velocity,
            self._cam.coefficients,
            self._cam.net_turns,
            law,
            pace,
            piece.start + first * step,
            step,
            count,
            self._worst,
        )

    def _judge(self, margin: float) -> Excess | None:
        limits = self.limits
        least, at = self._worst[Strained.SINE].tolist()
        # The sine's own minimum lies between the angles by less than it matters: it is a distance, no end stop.
        if not least >= limits.minimum_sine * max(margin / GRID_MARGIN, 1.0):
            return Excess(Strained.SINE, "", least if least == least else 0.0, limits.minimum_sine, at)
        worst: Excess | None = None
        share = 1.0
        for row, bound in zip(Strained, self._bounds, strict=False):
            value, at = self._worst[row].tolist()
            over = value * margin / bound
            if not over <= share:
                share = over
                worst = Excess(row, limits.axis_names[0 if row in _MASTERS else 1], value, bound, at)
        return worst


def finish(work: Work[T]) -> T:
    """All passes at once, for who has no cycle to keep."""
    while True:
        try:
            next(work)
        except StopIteration as done:
            return done.value
