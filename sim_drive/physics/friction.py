"""Dry friction, holding brakes and end stops as impulses at the end of a step: they stick exactly.

A friction force that is a function of velocity either creeps or vibrates at standstill. Here the smooth motion is
integrated without dry friction to the velocity v*, and the impulse that friction gives within the step is then found
from its own law (maximum dissipation): with W the inverse of the mass matrix,

    v+ = v* + W lambda,   lambda_i = -bound_i where v+_i > 0, +bound_i where v+_i < 0, anything between where v+_i = 0

which is the optimum of a convex quadratic over a box, found exactly for two axes. Jean and Moreau's time stepping
(B. Brogliato, "Nonsmooth Mechanics", ch. 5) in its smallest form.
"""

from math import inf
from typing import Final

from mechanism.jit import kernel

STOP_IMPULSE: Final = 1.0e6
"""Impulse in N m s that stands for "as much as it takes" at an end stop."""


@kernel
def impulse_bounds(
    theta: float, friction_impulse: float, stop_minimum: float, stop_maximum: float
) -> tuple[float, float]:
    """Least and greatest impulse (N m s) that friction, and an end stop it stands at, can give an axis at ``theta``.

    ``friction_impulse`` is (Coulomb torque + torque of an engaged brake) times the step. An end stop only pushes back:
    it widens the bounds to one side, which makes the contact fully inelastic.
    """
    least = -friction_impulse
    greatest = friction_impulse
    if theta >= stop_maximum:
        least = -STOP_IMPULSE
    if theta <= stop_minimum:
        greatest = STOP_IMPULSE
    return least, greatest


@kernel
def velocity_after_impulse(inertia: float, velocity: float, least: float, greatest: float) -> float:
    """Velocity of a single axis after the impulse within its bounds; exactly 0.0 where it sticks."""
    impulse = -inertia * velocity
    if impulse < least:
        return velocity + least / inertia
    if impulse > greatest:
        return velocity + greatest / inertia
    return 0.0


@kernel
def _clip(value: float, least: float, greatest: float) -> float:
    return min(max(value, least), greatest)


@kernel
def velocities_after_impulse(
    m11: float,
    m12: float,
    m22: float,
    v1: float,
    v2: float,
    least1: float,
    greatest1: float,
    least2: float,
    greatest2: float,
) -> tuple[float, float]:
    """Velocities of two coupled axes after the impulses within their bounds; exactly 0.0 where an axis sticks.

    ``m11, m12, m22`` is the mass matrix (kg m2), ``v1, v2`` the velocities before (rad/s), the bounds in N m s.
    """
    impulse1 = -(m11 * v1 + m12 * v2)
    impulse2 = -(m12 * v1 + m22 * v2)
    if least1 <= impulse1 <= greatest1 and least2 <= impulse2 <= greatest2:
        return 0.0, 0.0
    determinant = m11 * m22 - m12 * m12
    w11 = m22 / determinant
    w12 = -m12 / determinant
    w22 = m11 / determinant
    # The optimum lies on an edge of the box. The edge with the lowest cost is taken rather than the one whose signs are
    # right: a comparison of costs always has a winner, whatever the rounding.
    best = inf
    best1 = v1
    best2 = v2
    for edge in range(4):
        if edge < 2:
            i1 = least1 if edge == 0 else greatest1
            free = -(v2 + w12 * i1) / w22
            i2 = _clip(free, least2, greatest2)
            sticks1 = False
            sticks2 = i2 == free
        else:
            i2 = least2 if edge == 2 else greatest2
            free = -(v1 + w12 * i2) / w11
            i1 = _clip(free, least1, greatest1)
            sticks1 = i1 == free
            sticks2 = False
        cost = i1 * (v1 + 0.5 * (w11 * i1 + w12 * i2)) + i2 * (v2 + 0.5 * (w12 * i1 + w22 * i2))
        if cost < best:
            best = cost
            best1 = 0.0 if sticks1 else v1 + w11 * i1 + w12 * i2
            best2 = 0.0 if sticks2 else v2 + w12 * i1 + w22 * i2
    return best1, best2
