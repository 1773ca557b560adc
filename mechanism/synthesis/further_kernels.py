"""Kernels: the terms beyond the paper's four, of one tracked mechanism; see `Term` for what each is."""

from math import cos, inf, isfinite, sin, sqrt, tau
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mechanism.dynamics import PARAMETER_COUNT, inverse_dynamics
from mechanism.jit import kernel
from mechanism.synthesis.tracking_kernels import (
    ALPHA5,
    C_X,
    C_Y,
    DISPLACEMENT,
    IMMOBILE,
    OMEGA5,
    SINE,
    THETA2,
    THETA5,
    wrapped,
)

Float = NDArray[np.float64]

WORST: Final = 1e6
"""What stands for torque and power where a mechanism cannot be driven; finite, so that weighted sums stay numbers."""

# Layout of the machine array; the tail is that of the dynamics' own array, and the velocity of Coulomb friction.
_DENSITY: Final = 0
_WIDTH: Final = 4
_END_MASS: Final = 8
_TAIL: Final = 12
MACHINE_COUNT: Final = 22

_LINK_PARAMETERS: Final = 8
_LINK_SIZE: Final = 4
_END_EFFECTOR_MASS: Final = 24
_LENGTHS: Final = 4

ZONE_COLUMNS: Final = 5
"""Kind (0 circle, 1 box) and four values: x, y, radius, 0; or x and y minimum, x and y maximum."""


@kernel
def fill_dynamics(variables: Float, machine: Float, parameters: Float) -> None:
    """The flat array of `DynamicsParameters.to_array` for these lengths, as `MachineModel.dynamics` makes it."""
    for k in range(_LINK_PARAMETERS):
        parameters[k] = variables[k]
    for link in range(_LENGTHS):
        length = variables[link]
        bar = machine[_DENSITY + link] * length
        end = machine[_END_MASS + link]
        mass = bar + end
        com = (0.5 * bar + end) * length / mass if mass > 0.0 else 0.0
        width = machine[_WIDTH + link]
        about_first_joint = (bar / 3.0 + end) * length * length + bar * width * width / 12.0
        first = _LINK_PARAMETERS + _LINK_SIZE * link
        parameters[first] = mass
        parameters[first + 1] = com
        parameters[first + 2] = 0.0
        parameters[first + 3] = max(about_first_joint - mass * com * com, 0.0)
    for k in range(PARAMETER_COUNT - _END_EFFECTOR_MASS):
        parameters[_END_EFFECTOR_MASS + k] = machine[_TAIL + k]


@kernel
def transmission(rows: Float, count: int, r: float, servo_x: float, servo_y: float) -> float:
    """1 - the least abs sine between q and r and between r and s; 1 where immobile."""
    least = inf
    for i in range(count):
        if rows[IMMOBILE + i] > 0.0:
            return 1.0
        ux = rows[C_X + i] - servo_x
        uy = rows[C_Y + i] - servo_y
        servo = abs(cos(rows[THETA5 + i]) * uy - sin(rows[THETA5 + i]) * ux) / r
        least = min(least, abs(rows[SINE + i]), servo)
    return 1.0 - min(least, 1.0)


@kernel
def singularity(rows: Float, count: int, minimum_sine: float) -> float:
    """m^3, m the positions that are nearly singular or come after a change of closure."""
    faults = 0.0
    before = rows[SINE + count - 1]
    for i in range(count):
        sine = rows[SINE + i]
        if abs(sine) < minimum_sine:
            faults += 1.0
        if (before > 0.0) != (sine > 0.0):
            faults += 1.0
        before = sine
    return faults * faults * faults


@kernel
def _turns(rows: Float, count: int) -> float:
    closing = wrapped(rows[THETA5] - rows[THETA5 + count - 1])
    return np.floor((rows[DISPLACEMENT + count - 1] + closing) / tau + 0.5)


@kernel
def differentiate(rows: Float, count: int, first: Float, second: Float, speed: float) -> None:
    """Velocity and acceleration by the matrices (count, count) of the periodic spline through the points."""
    turns = _turns(rows, count)
    start = rows[THETA2]
    for i in range(count):
        velocity = turns
        acceleration = 0.0
        for j in range(count):
            periodic = rows[DISPLACEMENT + j] - turns * (rows[THETA2 + j] - start)
            velocity += first[i, j] * periodic
            acceleration += second[i, j] * periodic
        rows[OMEGA5 + i] = speed * velocity
        rows[ALPHA5 + i] = speed * speed * acceleration


@kernel
def differentiate_by_parabolas(rows: Float, count: int, speed: float) -> None:
    """Velocity and acceleration by the parabola through every point and its two neighbours, however they are spaced."""
    net = tau * _turns(rows, count)
    for i in range(count):
        after = rows[THETA2 + i + 1] if i + 1 < count else rows[THETA2] + tau
        before = rows[THETA2 + i - 1] if i > 0 else rows[THETA2 + count - 1] - tau
        there = rows[DISPLACEMENT + i + 1] if i + 1 < count else net
        back = rows[DISPLACEMENT + i - 1] if i > 0 else rows[DISPLACEMENT + count - 1] - net
        ahead = max(after - rows[THETA2 + i], 1e-9)
        behind = max(rows[THETA2 + i] - before, 1e-9)
        slope_ahead = (there - rows[DISPLACEMENT + i]) / ahead
        slope_behind = (rows[DISPLACEMENT + i] - back) / behind
        rows[OMEGA5 + i] = speed * (slope_ahead * behind + slope_behind * ahead) / (ahead + behind)
        rows[ALPHA5 + i] = speed * speed * 2.0 * (slope_ahead - slope_behind) / (ahead + behind)


@kernel
def greatest(rows: Float, row: int, count: int) -> float:
    """The greatest abs value of a row."""
    worst = 0.0
    for i in range(count):
        worst = max(worst, abs(rows[row + i]))
    return worst


@kernel
def drive_terms(
    rows: Float, count: int, parameters: Float, coulomb_velocity: float, speed: float
) -> tuple[float, float, float]:
    """Peak torque of the servo motor and of the CV motor (N m), and the mean of what both deliver (W)."""
    servo_peak = 0.0
    cv_peak = 0.0
    energy = 0.0
    for i in range(count):
        closure = 1 if rows[SINE + i] > 0.0 else -1
        cv, servo = inverse_dynamics(
            parameters,
            rows[THETA2 + i],
            rows[THETA5 + i],
            speed,
            rows[OMEGA5 + i],
            0.0,
            rows[ALPHA5 + i],
            closure,
            coulomb_velocity,
        )
        if rows[IMMOBILE + i] > 0.0 or not (isfinite(cv) and isfinite(servo)):
            return WORST, WORST, WORST
        servo_peak = max(servo_peak, abs(servo))
        cv_peak = max(cv_peak, abs(cv))
        after = rows[THETA2 + i + 1] if i + 1 < count else rows[THETA2] + tau
        before = rows[THETA2 + i - 1] if i > 0 else rows[THETA2 + count - 1] - tau
        energy += (max(cv * speed, 0.0) + max(servo * rows[OMEGA5 + i], 0.0)) * 0.5 * (after - before)
    return min(servo_peak, WORST), min(cv_peak, WORST), min(energy / tau, WORST)


@kernel
def _inside_circle(x: float, y: float, dx: float, dy: float, cx: float, cy: float, radius: float) -> float:
    """The share of the segment from x, y by dx, dy that lies within the circle, 0 to 1."""
    fx = x - cx
    fy = y - cy
    a = dx * dx + dy * dy
    b = fx * dx + fy * dy
    c = fx * fx + fy * fy - radius * radius
    discriminant = b * b - a * c
    if discriminant <= 0.0 or a == 0.0:
        return 0.0
    root = sqrt(discriminant)
    return max(min((-b + root) / a, 1.0) - max((-b - root) / a, 0.0), 0.0)


@kernel
def _clip(start: float, delta: float, low: float, high: float) -> tuple[float, float]:
    if delta == 0.0:
        return (0.0, 1.0) if low < start < high else (1.0, 0.0)
    first = (low - start) / delta
    second = (high - start) / delta
    return min(first, second), max(first, second)


@kernel
def _inside_box(
    x: float, y: float, dx: float, dy: float, x_low: float, y_low: float, x_high: float, y_high: float
) -> float:
    x_in, x_out = _clip(x, dx, x_low, x_high)
    y_in, y_out = _clip(y, dy, y_low, y_high)
    return max(min(x_out, y_out, 1.0) - max(x_in, y_in, 0.0), 0.0)


@kernel
def _segment_inside(x: float, y: float, to_x: float, to_y: float, zones: Float) -> float:
    dx = to_x - x
    dy = to_y - y
    share = 0.0
    for k in range(zones.shape[0]):
        if zones[k, 0] == 0.0:
            share += _inside_circle(x, y, dx, dy, zones[k, 1], zones[k, 2], zones[k, 3])
        else:
            share += _inside_box(x, y, dx, dy, zones[k, 1], zones[k, 2], zones[k, 3], zones[k, 4])
    return share * sqrt(dx * dx + dy * dy)


@kernel
def keep_out(rows: Float, count: int, variables: Float, zones: Float) -> float:
    """Length of links inside the zones, summed over the positions, m."""
    inside = 0.0
    for i in range(count):
        ax = variables[4] + variables[0] * cos(rows[THETA2 + i])
        ay = variables[5] + variables[0] * sin(rows[THETA2 + i])
        ex = variables[6] + variables[3] * cos(rows[THETA5 + i])
        ey = variables[7] + variables[3] * sin(rows[THETA5 + i])
        inside += _segment_inside(variables[4], variables[5], ax, ay, zones)
        inside += _segment_inside(ax, ay, rows[C_X + i], rows[C_Y + i], zones)
        inside += _segment_inside(ex, ey, rows[C_X + i], rows[C_Y + i], zones)
        inside += _segment_inside(variables[6], variables[7], ex, ey, zones)
    return inside
