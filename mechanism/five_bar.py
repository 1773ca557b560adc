"""Kinematics of the five-bar linkage: positions, transmission angles and velocities (paper, section 2.1, Figure 2.1).

Crank end A = cv_pivot + p (cos theta2, sin theta2), joint D = servo_pivot + s (cos theta5, sin theta5), end effector
C = A + q (cos theta3, sin theta3) = D + r (cos theta4, sin theta4). Metres and radians, counter-clockwise from the x
axis.
"""

from dataclasses import dataclass
from enum import IntEnum, unique
from math import atan2, cos, hypot, nan, sin, sqrt

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mechanism.errors import ParameterError, UnreachableError, finite
from mechanism.jit import kernel

Float = NDArray[np.float64]


@unique
class Closure(IntEnum):
    """Which of the two ways the linkage is assembled: the side of the directed line A to D on which C lies."""

    LEFT = 1
    RIGHT = -1


@unique
class Elbow(IntEnum):
    """Which of the two ways the servo dyad (s, r) reaches C: the side of the directed line servo pivot to C on which
    D lies.
    """

    LEFT = 1
    RIGHT = -1


@kernel
def intersect(
    ax: float, ay: float, a_radius: float, bx: float, by: float, b_radius: float, side: int
) -> tuple[float, float, float]:
    """Intersection of the circles about a and b on the given side (+1 left, -1 right) of the line from a to b.

    Returns (x, y, gap). gap = 0 where they meet; otherwise by how many metres they miss each other (positive: too far
    apart, negative: one lies inside the other), and x, y are NaN.
    """
    dx = bx - ax
    dy = by - ay
    distance = sqrt(dx * dx + dy * dy)
    if distance > a_radius + b_radius:
        return nan, nan, distance - a_radius - b_radius
    inner = abs(a_radius - b_radius)
    if distance < inner or distance == 0.0:
        return nan, nan, distance - inner if distance < inner else -a_radius
    along = (a_radius * a_radius - b_radius * b_radius + distance * distance) / (2.0 * distance)
    height_squared = a_radius * a_radius - along * along
    height = sqrt(height_squared) if height_squared > 0.0 else 0.0
    ux = dx / distance
    uy = dy / distance
    return ax + along * ux - side * height * uy, ay + along * uy + side * height * ux, 0.0


@kernel
def assemble(
    geometry: Float, theta2: float, theta5: float, closure: int
) -> tuple[float, float, float, float, float, float, float, float, float]:
    """Unit vectors of all four links from the two inputs.

    ``geometry`` is p, q, r, s, cv pivot x, y, servo pivot x, y in metres (`FiveBar.to_array`; more may follow). Returns
    (e2x, e2y, e3x, e3y, e4x, e4y, e5x, e5y, sine) with sine = sin(theta3 - theta4); NaN where the linkage does not
    close.
    """
    e2x = cos(theta2)
    e2y = sin(theta2)
    e5x = cos(theta5)
    e5y = sin(theta5)
    q = geometry[1]
    r = geometry[2]
    ax = geometry[4] + geometry[0] * e2x
    ay = geometry[5] + geometry[0] * e2y
    dx = geometry[6] + geometry[3] * e5x
    dy = geometry[7] + geometry[3] * e5y
    cx, cy, _ = intersect(ax, ay, q, dx, dy, r, closure)
    e3x = (cx - ax) / q
    e3y = (cy - ay) / q
    e4x = (cx - dx) / r
    e4y = (cy - dy) / r
    return e2x, e2y, e3x, e3y, e4x, e4y, e5x, e5y, e4x * e3y - e4y * e3x


@kernel
def end_effector_points(geometry: Float, theta2: Float, theta5: Float, closure: int, points: Float) -> None:
    """Fill ``points`` (n, 2) with C in metres for every pair of inputs; NaN where the linkage does not close."""
    for i in range(theta2.size):
        e2x, e2y, e3x, e3y, _, _, _, _, _ = assemble(geometry, theta2[i], theta5[i], closure)
        points[i, 0] = geometry[4] + geometry[0] * e2x + geometry[1] * e3x
        points[i, 1] = geometry[5] + geometry[0] * e2y + geometry[1] * e3y


@kernel
def transmission_sines(geometry: Float, theta2: Float, theta5: Float, closure: int, sines: Float) -> None:
    """Fill ``sines`` (n, 2) with sin(theta3 - theta4) and sin(theta4 - theta5) for every pair of inputs."""
    for i in range(theta2.size):
        _, _, _, _, e4x, e4y, e5x, e5y, sine = assemble(geometry, theta2[i], theta5[i], closure)
        sines[i, 0] = sine
        sines[i, 1] = e5x * e4y - e5y * e4x


@kernel
def end_effector_jacobian(
    geometry: Float, theta2: float, theta5: float, closure: int
) -> tuple[float, float, float, float]:
    """dC/d(theta2, theta5) as (dx/dtheta2, dx/dtheta5, dy/dtheta2, dy/dtheta5), m/rad."""
    p = geometry[0]
    s = geometry[3]
    e2x, e2y, e3x, e3y, e4x, e4y, e5x, e5y, sine = assemble(geometry, theta2, theta5, closure)
    # q theta3' from the loop's velocity equation dotted with e4: the angular velocity of r drops out.
    q32 = p * (e2x * e4y - e2y * e4x) / sine
    q35 = -s * (e5x * e4y - e5y * e4x) / sine
    return -p * e2y - q32 * e3y, -q35 * e3y, p * e2x + q32 * e3x, q35 * e3x


@dataclass(frozen=True, slots=True)
class FiveBar:
    """Link lengths in metres and the two motor pivots (x, y) in metres.

    Raises ParameterError where a length is not positive and finite, or a pivot is not finite.
    """

    p: float
    q: float
    r: float
    s: float
    cv_pivot: tuple[float, float]
    servo_pivot: tuple[float, float]

    def __post_init__(self) -> None:
        for name, length in (("p", self.p), ("q", self.q), ("r", self.r), ("s", self.s)):
            if not (finite(length) and length > 0.0):
                raise ParameterError(f"link length {name}", f"{length * 1e3:g} mm", "positive and finite")
        for name, pivot in (("cv_pivot", self.cv_pivot), ("servo_pivot", self.servo_pivot)):
            if len(pivot) != 2 or not finite(*pivot):
                raise ParameterError(name, pivot, "two finite coordinates")

    def to_array(self) -> Float:
        """p, q, r, s, cv pivot x, y, servo pivot x, y as the kernels take them, metres."""
        return np.array([self.p, self.q, self.r, self.s, *self.cv_pivot, *self.servo_pivot], dtype=np.float64)

    def crank_end(self, theta2: ArrayLike) -> Float:
        """A, shape (..., 2), metres."""
        angle = np.asarray(theta2, dtype=np.float64)
        return np.stack((self.cv_pivot[0] + self.p * np.cos(angle), self.cv_pivot[1] + self.p * np.sin(angle)), axis=-1)

    def servo_end(self, theta5: ArrayLike) -> Float:
        """D, shape (..., 2), metres."""
        angle = np.asarray(theta5, dtype=np.float64)
        return np.stack(
            (self.servo_pivot[0] + self.s * np.cos(angle), self.servo_pivot[1] + self.s * np.sin(angle)), axis=-1
        )

    def forward(self, theta2: float, theta5: float, closure: Closure) -> tuple[float, float, tuple[float, float]]:
        """theta3, theta4 (rad, within -pi to pi) and C (m). Raises UnreachableError where q and r cannot meet."""
        ax, ay = self.cv_pivot[0] + self.p * cos(theta2), self.cv_pivot[1] + self.p * sin(theta2)
        dx, dy = self.servo_pivot[0] + self.s * cos(theta5), self.servo_pivot[1] + self.s * sin(theta5)
        x, y, gap = intersect(ax, ay, self.q, dx, dy, self.r, int(closure))
        if gap != 0.0:
            apart = "too far apart" if gap > 0 else "too close"
            raise UnreachableError(None, theta2, abs(gap), 0.0, f"joints A and D are {apart} for links q and r to meet")
        return atan2(y - ay, x - ax), atan2(y - dy, x - dx), (x, y)

    def end_effector(self, theta2: ArrayLike, theta5: ArrayLike, closure: Closure) -> Float:
        """C of every pair of inputs: the broadcast shape plus (2,), metres; NaN where the linkage does not close."""
        first, second = np.broadcast_arrays(np.asarray(theta2, dtype=np.float64), np.asarray(theta5, dtype=np.float64))
        points = np.empty((first.size, 2), dtype=np.float64)
        end_effector_points(self.to_array(), first.ravel(), second.ravel(), int(closure), points)
        return points.reshape((*first.shape, 2))

    def transmission_sines(self, theta2: ArrayLike, theta5: ArrayLike, closure: Closure) -> Float:
        """sin(theta3 - theta4), the angle between q and r at C, and sin(theta4 - theta5), between r and s at D.

        Shape: the broadcast shape plus (2,). The first is zero where the linkage loses its grip on C, the second
        where the servo loses its grip on r.
        """
        first, second = np.broadcast_arrays(np.asarray(theta2, dtype=np.float64), np.asarray(theta5, dtype=np.float64))
        sines = np.empty((first.size, 2), dtype=np.float64)
        transmission_sines(self.to_array(), first.ravel(), second.ravel(), int(closure), sines)
        return sines.reshape((*first.shape, 2))

    def servo_angle(self, x: float, y: float, elbow: Elbow) -> float:
        """theta5 (rad, within -pi to pi) that brings the dyad (s, r) to the point x, y (m); NaN where it cannot."""
        dx, dy, gap = intersect(self.servo_pivot[0], self.servo_pivot[1], self.s, x, y, self.r, int(elbow))
        if gap != 0.0:
            return nan
        return atan2(dy - self.servo_pivot[1], dx - self.servo_pivot[0])

    def servo_reach(self, x: float, y: float) -> float:
        """0 where the dyad (s, r) reaches x, y (m); else by how much it misses (m; positive too far, negative too
        near).
        """
        distance = hypot(x - self.servo_pivot[0], y - self.servo_pivot[1])
        return max(distance - self.r - self.s, 0.0) + min(distance - abs(self.r - self.s), 0.0)

    def jacobian(self, theta2: float, theta5: float, closure: Closure) -> Float:
        """dC/d(theta2, theta5), shape (2, 2), m/rad; infinite or NaN in a singular position."""
        return np.array(end_effector_jacobian(self.to_array(), theta2, theta5, int(closure)), dtype=np.float64).reshape(
            2, 2
        )

    def closure_at(self, theta2: float, theta5: float, x: float, y: float) -> Closure:
        """The closure in which C is (nearly) at x, y (m) for these inputs."""
        (ax, ay), (dx, dy) = self.crank_end(theta2), self.servo_end(theta5)
        side = (dx - ax) * (y - ay) - (dy - ay) * (x - ax)
        return Closure.LEFT if side >= 0.0 else Closure.RIGHT
