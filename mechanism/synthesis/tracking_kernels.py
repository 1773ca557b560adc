"""Kernels: both closures of a mechanism at every point, and the sequence of them with the least cost round the cycle.

All per-point values of one mechanism stand in one flat array, `ROW_STRIDE` apart and addressed by the constants below:
with one base and constant distances the compiler proves that no two rows overlap, and works on several points at once.
For the same reason angles come from a polynomial instead of the C library. Together that is worth a factor of five.
"""

from math import inf, pi, sqrt, tau
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mechanism.jit import kernel

Float = NDArray[np.float64]

ROW_STRIDE: Final = 1032
"""Room for `task.MAXIMUM_POINTS`; no multiple of 64, or one point of all rows would fall on the same cache set."""

# What the task gives: unit vector of p, desired point, tolerance (m).
COS2: Final = 0 * ROW_STRIDE
SIN2: Final = 1 * ROW_STRIDE
X: Final = 2 * ROW_STRIDE
Y: Final = 3 * ROW_STRIDE
TOLERANCE: Final = 4 * ROW_STRIDE
# What `assemble_both` fills in: error (m), 1 where immobile, unit vector of q, end effector, and for the left and the
# right elbow theta5 and sin(theta3 - theta4).
ERROR: Final = 5 * ROW_STRIDE
IMMOBILE: Final = 6 * ROW_STRIDE
Q_X: Final = 7 * ROW_STRIDE
Q_Y: Final = 8 * ROW_STRIDE
C_X: Final = 9 * ROW_STRIDE
C_Y: Final = 10 * ROW_STRIDE
LEFT: Final = 11 * ROW_STRIDE
RIGHT: Final = 12 * ROW_STRIDE
LEFT_SINE: Final = 13 * ROW_STRIDE
RIGHT_SINE: Final = 14 * ROW_STRIDE
# What `step_costs` fills in: the cost of coming to this point from the one before, from elbow to elbow.
LEFT_LEFT: Final = 15 * ROW_STRIDE
RIGHT_LEFT: Final = 16 * ROW_STRIDE
LEFT_RIGHT: Final = 17 * ROW_STRIDE
RIGHT_RIGHT: Final = 18 * ROW_STRIDE
# What `choose` fills in: theta5 within -pi to pi or a turn beyond, its sine, and theta5 unwrapped less its first value.
THETA5: Final = 19 * ROW_STRIDE
SINE: Final = 20 * ROW_STRIDE
DISPLACEMENT: Final = 21 * ROW_STRIDE
STEP: Final = 22 * ROW_STRIDE
# theta2 itself, rising, and the servo's velocity and acceleration, for who needs them.
THETA2: Final = 23 * ROW_STRIDE
OMEGA5: Final = 24 * ROW_STRIDE
ALPHA5: Final = 25 * ROW_STRIDE
ROWS: Final = 26

BLOCK: Final = 8
"""Loops without carried values run over whole blocks; what stands after the last point is worked on and never read."""

MM_PER_M: Final = 1e3
DEGREES_PER_RADIAN: Final = 57.29577951308232

_HALF_PI: Final = 0.5 * pi
_QUARTER_PI: Final = 0.25 * pi
_PER_TURN: Final = 1.0 / tau
_TAN_PI_8: Final = 0.41421356237309503
_FAULT_COST: Final = 4.0 * pi * pi
REACH_ROUNDING: Final = 1.0 + 1e-12


@kernel
def angle_of(y: float, x: float) -> float:
    """atan2(y, x) to 3e-16 rad, in arithmetic alone.

    atan(t) / t is the polynomial in t^2 that interpolates it in the 11 Chebyshev nodes of 0 to tan(pi/8)^2.
    """
    magnitude_x = abs(x)
    magnitude_y = abs(y)
    small = min(magnitude_x, magnitude_y)
    large = max(magnitude_x, magnitude_y)
    steep = small > _TAN_PI_8 * large
    numerator = small - large if steep else small
    denominator = small + large if steep else large
    t = numerator / (denominator if denominator > 0.0 else 1.0)
    z = t * t
    polynomial = 0.021135373157693243
    polynomial = polynomial * z - 0.04348052215716462
    polynomial = polynomial * z + 0.056883492268090106
    polynomial = polynomial * z - 0.06640233930429408
    polynomial = polynomial * z + 0.07689953496306857
    polynomial = polynomial * z - 0.09090773074808414
    polynomial = polynomial * z + 0.11111106180455946
    polynomial = polynomial * z - 0.14285714180976467
    polynomial = polynomial * z + 0.1999999999885511
    polynomial = polynomial * z - 0.3333333333332844
    angle = t + t * z * polynomial
    angle = angle + _QUARTER_PI if steep else angle
    angle = _HALF_PI - angle if magnitude_y > magnitude_x else angle
    angle = pi - angle if x < 0.0 else angle
    return -angle if y < 0.0 else angle


@kernel
def wrapped(angle: float) -> float:
    """The angle within -pi (included) to pi (not included), to rounding."""
    return angle - tau * np.floor(angle * _PER_TURN + 0.5)


@kernel
def whole_blocks(count: int) -> int:
    """``count`` rounded up to a multiple of `BLOCK`."""
    return (count + BLOCK - 1) // BLOCK * BLOCK


@kernel
def assemble_both(rows: Float, count: int, variables: Float) -> None:
    """Place both dyads at every point; where r and s cannot close, s points at the end effector."""
    p = variables[0]
    q = variables[1]
    r = variables[2]
    s = variables[3]
    cv_x = variables[4]
    cv_y = variables[5]
    servo_x = variables[6]
    servo_y = variables[7]
    squares = s * s - r * r
    half_per_s = 0.5 / s
    per_r = 1.0 / r
    for i in range(whole_blocks(count)):
        dx = rows[X + i] - cv_x - p * rows[COS2 + i]
        dy = rows[Y + i] - cv_y - p * rows[SIN2 + i]
        distance = sqrt(dx * dx + dy * dy)
        beyond = abs(distance - q) - rows[TOLERANCE + i]
        rows[ERROR + i] = beyond if beyond > 0.0 else 0.0
        inverse = 1.0 / (distance if distance > 0.0 else 1.0)
        qx = dx * inverse if distance > 0.0 else 1.0
        qy = dy * inverse
        # From the servo pivot to where q ends.
        ux = rows[X + i] - dx + q * qx - servo_x
        uy = rows[Y + i] - dy + q * qy - servo_y
        squared = ux * ux + uy * uy
        reach = sqrt(squared)
        per_reach = 1.0 / (reach if reach > 0.0 else 1e-300)
        cosine = (squares + squared) * half_per_s * per_reach
        can = abs(cosine) <= REACH_ROUNDING
        cosine = cosine if can else 1.0
        cosine = min(max(cosine, -1.0), 1.0)
        sine = sqrt(1.0 - cosine * cosine)
        bx = ux * per_reach
        by = uy * per_reach
        bearing = angle_of(by, bx)
        opening = angle_of(sine, cosine)
        # sin(theta3 - theta4) = q x r; r = (u - s e5) / r, e5 = b turned by the opening.
        across = qx * uy - qy * ux
        along_x = qx * bx + qy * by
        across_b = qx * by - qy * bx
        rows[IMMOBILE + i] = 0.0 if can else 1.0
        rows[Q_X + i] = qx
        rows[Q_Y + i] = qy
        rows[C_X + i] = ux + servo_x
        rows[C_Y + i] = uy + servo_y
        rows[LEFT + i] = bearing + opening
        rows[RIGHT + i] = bearing - opening
        rows[LEFT_SINE + i] = (across - s * (across_b * cosine + along_x * sine)) * per_r
        rows[RIGHT_SINE + i] = (across - s * (across_b * cosine - along_x * sine)) * per_r


@kernel
def step_cost(step: float, sine_before: float, sine: float, minimum_sine: float) -> float:
    """What a step of theta5 (rad) costs between two positions with these sines of theta3 - theta4, rad^2."""
    # A fault costs more than the longest possible step, so that steps only decide between equally sound sequences.
    cost = step * step
    cost = cost + _FAULT_COST if (sine_before > 0.0) != (sine > 0.0) else cost
    return cost + _FAULT_COST if abs(sine) < minimum_sine else cost


@kernel
def _step_costs_at(rows: Float, before: int, i: int, minimum_sine: float) -> None:
    left_before = rows[LEFT + before]
    right_before = rows[RIGHT + before]
    left_sine_before = rows[LEFT_SINE + before]
    right_sine_before = rows[RIGHT_SINE + before]
    left = rows[LEFT + i]
    right = rows[RIGHT + i]
    left_sine = rows[LEFT_SINE + i]
    right_sine = rows[RIGHT_SINE + i]
    rows[LEFT_LEFT + i] = step_cost(wrapped(left - left_before), left_sine_before, left_sine, minimum_sine)
    rows[RIGHT_LEFT + i] = step_cost(wrapped(left - right_before), right_sine_before, left_sine, minimum_sine)
    rows[LEFT_RIGHT + i] = step_cost(wrapped(right - left_before), left_sine_before, right_sine, minimum_sine)
    rows[RIGHT_RIGHT + i] = step_cost(wrapped(right - right_before), right_sine_before, right_sine, minimum_sine)


@kernel
def step_costs(rows: Float, count: int, minimum_sine: float) -> None:
    """What every step from elbow to elbow costs, as `mechanism.closure.track_closure` weighs it."""
    # Point 0 is worked on with what stands before its row, so that the blocks are whole, and then done right.
    for i in range(whole_blocks(count)):
        _step_costs_at(rows, i - 1, i, minimum_sine)
    _step_costs_at(rows, count - 1, 0, minimum_sine)


@kernel
def cheapest_cycle(rows: Float, count: int, choices: NDArray[np.int64]) -> int:
    """Fill ``choices``, 0 left and 1 right, with the sequence of elbows of least cost round the closed cycle.

    Dynamic programming with both first elbows side by side. Returns the first elbow.
    """
    # Cost of being left or right, having begun left (a) or right (b).
    a_left = 0.0
    a_right = inf
    b_left = inf
    b_right = 0.0
    for i in range(1, count):
        left_left = rows[LEFT_LEFT + i]
        right_left = rows[RIGHT_LEFT + i]
        left_right = rows[LEFT_RIGHT + i]
        right_right = rows[RIGHT_RIGHT + i]
        bits = 0
        stay, come = a_left + left_left, a_right + right_left
        cross, keep = a_left + left_right, a_right + right_right
        bits |= 1 if come < stay else 0
        bits |= 2 if keep < cross else 0
        a_left = min(stay, come)
        a_right = min(keep, cross)
        stay, come = b_left + left_left, b_right + right_left
        cross, keep = b_left + left_right, b_right + right_right
        bits |= 4 if come < stay else 0
        bits |= 8 if keep < cross else 0
        b_left = min(stay, come)
        b_right = min(keep, cross)
        choices[i] = bits
    a_left += rows[LEFT_LEFT]
    a_right += rows[RIGHT_LEFT]
    b_left += rows[LEFT_RIGHT]
    b_right += rows[RIGHT_RIGHT]
    first = 1 if min(b_left, b_right) < min(a_left, a_right) else 0
    last = (1 if b_right < b_left else 0) if first == 1 else (1 if a_right < a_left else 0)
    shift = 2 * first
    for i in range(count - 1, 0, -1):
        bits = choices[i] >> shift
        choices[i] = last
        last = (bits >> last) & 1
    choices[0] = first
    return first


@kernel
def choose(rows: Float, count: int, choices: NDArray[np.int64]) -> None:
    """Take theta5 and its sine from the chosen elbows, and unwrap the servo's displacement from its first point."""
    padded = whole_blocks(count)
    for i in range(padded):
        right = choices[i] == 1
        rows[THETA5 + i] = rows[RIGHT + i] if right else rows[LEFT + i]
        rows[SINE + i] = rows[RIGHT_SINE + i] if right else rows[LEFT_SINE + i]
    for i in range(padded):
        rows[STEP + i] = wrapped(rows[THETA5 + i] - rows[THETA5 + i - 1])
    displacement = 0.0
    rows[DISPLACEMENT] = 0.0
    for i in range(1, count):
        displacement += rows[STEP + i]
        rows[DISPLACEMENT + i] = displacement


@kernel
def harmonic_cost(a: float, b: float, order: int) -> float:
    """What the harmonic of an order (1 and up) with these coefficients adds to eq (2): its amplitude^(order + 1)."""
    amplitude = sqrt(a * a + b * b)
    power = amplitude
    for _ in range(order):
        power *= amplitude
    return power
