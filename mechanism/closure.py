"""Inverse kinematics over a whole closed curve, with closure tracking (paper, section 2.2.1).

At every point the servo dyad (s, r) reaches the end effector in two ways. The sequence of them that keeps the linkage
assembled and then moves link s least over the whole closed cycle is found exactly, by dynamic programming, so that no
single greedy step can lose the closure.
"""

from dataclasses import dataclass
from math import pi, tau

import numpy as np
from numpy.typing import NDArray

from mechanism.curve import DesiredCurve, read_only
from mechanism.errors import UnreachableError
from mechanism.five_bar import Closure, Elbow, FiveBar

Float = NDArray[np.float64]

_ELBOWS = (Elbow.LEFT, Elbow.RIGHT)
_FAULT_COST = 4.0 * pi**2


@dataclass(frozen=True, slots=True, eq=False)
class ClosureTrack:
    """The servo motion that goes with a desired curve; all arrays are read-only, one row a point.

    theta2, theta3, theta5: rad, theta5 and theta3 unwrapped; theta5[0] lies within -pi to pi. net_turns: whole turns
    that link s gains in a cycle. actual: the points that the crank dyad can reach, (n, 2) m; structural_error: their
    distance from the desired ones, m. elbows: +1 or -1 a point. closure: the side of the line A to D on which C lies,
    where it is the same all along, else None (the linkage would have to pass a singular position). immobile: indices
    of the points that link s cannot reach; theta5 then points at them.
    """

    theta2: Float
    theta3: Float
    theta5: Float
    net_turns: int
    actual: Float
    structural_error: Float
    elbows: NDArray[np.int8]
    closure: Closure | None
    immobile: tuple[int, ...]

    @property
    def immobile_points(self) -> int:
        """How many points link s cannot reach (the mobility penalty counts them; paper, section 2.2.2)."""
        return len(self.immobile)

    def require_mobile(self, five_bar: FiveBar) -> None:
        """Raise UnreachableError for the first point that link s cannot reach."""
        if self.immobile:
            first = self.immobile[0]
            reach = five_bar.servo_reach(float(self.actual[first, 0]), float(self.actual[first, 1]))
            what = f"links r and s cannot {'stretch far' if reach > 0.0 else 'fold close'} enough"
            raise UnreachableError(first, float(self.theta2[first]), abs(reach), 0.0, what)


def wrap(angle: Float) -> Float:
    """Angles brought into -pi (included) to pi (not included)."""
    return (angle + pi) % tau - pi


def crank_dyad(curve: DesiredCurve, five_bar: FiveBar) -> tuple[Float, Float, Float]:
    """theta3 (rad, wrapped), the points reached (n, 2) and the structural error (n,), m.

    q points from A at the desired point, and the point reached is where q ends: on the vector from A, on q's circle.
    """
    joint = five_bar.crank_end(curve.theta2)
    offset = curve.points - joint
    distance = np.hypot(offset[:, 0], offset[:, 1])
    theta3 = np.arctan2(offset[:, 1], offset[:, 0])
    direction = np.stack((np.cos(theta3), np.sin(theta3)), axis=1)
    return theta3, joint + five_bar.q * direction, np.abs(distance - five_bar.q)


def _candidates(actual: Float, five_bar: FiveBar) -> tuple[Float, NDArray[np.bool_]]:
    """theta5 by both elbows, (n, 2), and which points are out of link s' reach (both candidates then point at it)."""
    ux = actual[:, 0] - five_bar.servo_pivot[0]
    uy = actual[:, 1] - five_bar.servo_pivot[1]
    squared = ux * ux + uy * uy
    distance = np.sqrt(squared)
    with np.errstate(divide="ignore", invalid="ignore"):
        cosine = (five_bar.s**2 + squared - five_bar.r**2) / (2.0 * five_bar.s * distance)
    # A hair outside the reach is the rounding of a stretched dyad, not immobility.
    immobile = ~(np.abs(cosine) <= 1.0 + 1e-12)
    opening = np.arccos(np.clip(np.where(np.isfinite(cosine), cosine, 1.0), -1.0, 1.0))
    opening = np.where(immobile, 0.0, opening)
    bearing = np.arctan2(uy, ux)
    return np.stack([bearing + int(elbow) * opening for elbow in _ELBOWS], axis=1), immobile


def _cheapest_cycle(step: Float) -> NDArray[np.intp]:
    """The candidate of every row that makes the summed cost round the closed cycle least.

    step[i, a, b] is the cost of candidate b of row i after candidate a of row i - 1; row 0 follows the last.
    """
    count = step.shape[0]
    best_cost = np.inf
    best = np.zeros(count, dtype=np.intp)
    columns = np.arange(2)
    for start in (0, 1):
        cost = np.full(2, np.inf)
        cost[start] = 0.0
        choice = np.zeros((count, 2), dtype=np.intp)
        for i in range(1, count):
            total = cost[:, np.newaxis] + step[i]
            choice[i] = np.argmin(total, axis=0)
            cost = total[choice[i], columns]
        cost = cost + step[0, :, start]
        last = int(np.argmin(cost))
        if cost[last] < best_cost:
            best_cost = float(cost[last])
            for i in range(count - 1, 0, -1):
                best[i] = last
                last = int(choice[i, last])
            best[0] = start
    return best


def track_closure(curve: DesiredCurve, five_bar: FiveBar, minimum_sine: float = 0.1) -> ClosureTrack:
    """Theta5 all along the curve, by the sequence of closures with the least summed squared step of link s.

    A sequence that keeps the linkage assembled one way, with abs(sin(theta3 - theta4)) of at least ``minimum_sine``, is
    preferred to any that does not: a change of side would have to pass a position in which the motors lose the linkage.
    Raises nothing for unreachable points: they are counted (`ClosureTrack.immobile`), and `require_mobile` raises.
    """
    theta3, actual, error = crank_dyad(curve, five_bar)
    angles, immobile = _candidates(actual, five_bar)

    along_q = np.stack((np.cos(theta3), np.sin(theta3)), axis=1)[:, np.newaxis, :]
    along_r = (actual[:, np.newaxis, :] - five_bar.servo_end(angles)) / five_bar.r
    sine = along_q[..., 0] * along_r[..., 1] - along_q[..., 1] * along_r[..., 0]
    side = np.sign(sine)

    # A fault costs more than the longest possible step, so that steps only decide between equally sound sequences.
    before = np.roll(side, 1, axis=0)[:, :, np.newaxis]
    after = side[:, np.newaxis, :]
    faults = (before != after).astype(np.float64) + (np.abs(sine) < minimum_sine)[:, np.newaxis, :]
    step = wrap(angles[:, np.newaxis, :] - np.roll(angles, 1, axis=0)[:, :, np.newaxis]) ** 2
    column = _cheapest_cycle(step + _FAULT_COST * faults)

    rows = np.arange(column.size)
    wrapped = wrap(angles[rows, column])
    theta5 = np.unwrap(wrapped)
    net_turns = round(float(theta5[-1] + wrap(wrapped[:1] - wrapped[-1:])[0] - theta5[0]) / tau)
    chosen = side[rows, column]
    closure = Closure(int(chosen[0])) if chosen[0] != 0.0 and bool(np.all(chosen == chosen[0])) else None

    elbows = np.where(column == 0, int(_ELBOWS[0]), int(_ELBOWS[1])).astype(np.int8)
    elbows.setflags(write=False)
    return ClosureTrack(
        theta2=curve.theta2,
        theta3=read_only(np.unwrap(theta3)),
        theta5=read_only(theta5),
        net_turns=net_turns,
        actual=read_only(actual),
        structural_error=read_only(error),
        elbows=elbows,
        closure=closure,
        immobile=tuple(int(i) for i in np.flatnonzero(immobile)),
    )
