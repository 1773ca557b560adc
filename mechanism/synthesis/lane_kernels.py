"""Kernels: the paper's four terms of many mechanisms side by side.

The same tracking as in `tracking_kernels`, with which it shares its formulas, but laid out the other way round: the
points one after the other, and at each of them all mechanisms of a block at once, so that also what is carried from
point to point (the dynamic programming, the unwrapping, the sums) is done for several mechanisms in one instruction.
All values of a block at one point stand in one flat array, `LANES` and a bit apart, for the reason given there.
"""

from math import inf, sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mechanism.jit import kernel
from mechanism.synthesis.tracking_kernels import (
    COS2,
    DEGREES_PER_RADIAN,
    MM_PER_M,
    REACH_ROUNDING,
    SIN2,
    TOLERANCE,
    X,
    Y,
    angle_of,
    harmonic_cost,
    step_cost,
    wrapped,
)

Float = NDArray[np.float64]

LANES: Final = 64
"""Mechanisms in a block."""
LANE_WIDTH: Final = 72
"""Distance of two values of one lane; no multiple of 64, as `ROW_STRIDE`."""

_VARIABLES: Final = 0
_LEFT: Final = 8 * LANE_WIDTH
_RIGHT: Final = 9 * LANE_WIDTH
_LEFT_SINE: Final = 10 * LANE_WIDTH
_RIGHT_SINE: Final = 11 * LANE_WIDTH
_BEFORE: Final = 4 * LANE_WIDTH
"""How far behind a value its value at the point before stands."""
_FIRST: Final = 8 * LANE_WIDTH
"""How far behind a value its value at the first point stands."""
# 12 to 15 the point before, 16 to 19 the first point.
_BEGUN_LEFT: Final = 20 * LANE_WIDTH
"""Least costs of being left or right, having begun left (20, 21) or right (22, 23)."""
_BITS: Final = 24 * LANE_WIDTH
_ERROR: Final = 25 * LANE_WIDTH
_IMMOBILE: Final = 26 * LANE_WIDTH
_ELBOW: Final = 27 * LANE_WIDTH
_THETA5: Final = 28 * LANE_WIDTH
_DISPLACEMENT: Final = 29 * LANE_WIDTH
_SQUARES: Final = 30 * LANE_WIDTH
_LENGTHS_SQUARED: Final = 31 * LANE_WIDTH
_HALF_PER_S: Final = 32 * LANE_WIDTH
_PER_R: Final = 33 * LANE_WIDTH
_COEFFICIENTS: Final = 34 * LANE_WIDTH
FIXED_ROWS: Final = 34


@kernel
def _assemble(w: Float, lanes: int, x: float, y: float, cosine2: float, sine2: float, tolerance: float) -> None:
    """Both closures of all lanes at one point, and what they add to error and mobility."""
    for k in range(lanes):
        q = w[1 * LANE_WIDTH + k]
        s = w[3 * LANE_WIDTH + k]
        dx = x - w[4 * LANE_WIDTH + k] - w[k] * cosine2
        dy = y - w[5 * LANE_WIDTH + k] - w[k] * sine2
        distance = sqrt(dx * dx + dy * dy)
        beyond = abs(distance - q) - tolerance
        w[_ERROR + k] += beyond if beyond > 0.0 else 0.0
        inverse = 1.0 / (distance if distance > 0.0 else 1.0)
        qx = dx * inverse if distance > 0.0 else 1.0
        qy = dy * inverse
        ux = x - dx + q * qx - w[6 * LANE_WIDTH + k]
        uy = y - dy + q * qy - w[7 * LANE_WIDTH + k]
        squared = ux * ux + uy * uy
        reach = sqrt(squared)
        per_reach = 1.0 / (reach if reach > 0.0 else 1e-300)
        cosine = (w[_LENGTHS_SQUARED + k] + squared) * w[_HALF_PER_S + k] * per_reach
        can = abs(cosine) <= REACH_ROUNDING
        w[_IMMOBILE + k] += 0.0 if can else 1.0
        cosine = cosine if can else 1.0
        cosine = min(max(cosine, -1.0), 1.0)
        sine = sqrt(1.0 - cosine * cosine)
        bx = ux * per_reach
        by = uy * per_reach
        bearing = angle_of(by, bx)
        opening = angle_of(sine, cosine)
        across = qx * uy - qy * ux
        along_x = qx * bx + qy * by
        across_b = qx * by - qy * bx
        per_r = w[_PER_R + k]
        w[_LEFT + k] = bearing + opening
        w[_RIGHT + k] = bearing - opening
        w[_LEFT_SINE + k] = (across - s * (across_b * cosine + along_x * sine)) * per_r
        w[_RIGHT_SINE + k] = (across - s * (across_b * cosine - along_x * sine)) * per_r


@kernel
def _advance(w: Float, lanes: int, minimum_sine: float) -> None:
    """One step of the dynamic programming of all lanes, from the point before to this; leaves its choices in bits."""
    for k in range(lanes):
        left = w[_LEFT + k]
        right = w[_RIGHT + k]
        left_sine = w[_LEFT_SINE + k]
        right_sine = w[_RIGHT_SINE + k]
        left_before = w[_LEFT + _BEFORE + k]
        right_before = w[_RIGHT + _BEFORE + k]
        left_sine_before = w[_LEFT_SINE + _BEFORE + k]
        right_sine_before = w[_RIGHT_SINE + _BEFORE + k]
        left_left = step_cost(wrapped(left - left_before), left_sine_before, left_sine, minimum_sine)
        right_left = step_cost(wrapped(left - right_before), right_sine_before, left_sine, minimum_sine)
        left_right = step_cost(wrapped(right - left_before), left_sine_before, right_sine, minimum_sine)
        right_right = step_cost(wrapped(right - right_before), right_sine_before, right_sine, minimum_sine)
        stay = w[_BEGUN_LEFT + k] + left_left
        come = w[_BEGUN_LEFT + LANE_WIDTH + k] + right_left
        cross = w[_BEGUN_LEFT + k] + left_right
        keep = w[_BEGUN_LEFT + LANE_WIDTH + k] + right_right
        bits = (1.0 if come < stay else 0.0) + (2.0 if keep < cross else 0.0)
        w[_BEGUN_LEFT + k] = min(stay, come)
        w[_BEGUN_LEFT + LANE_WIDTH + k] = min(keep, cross)
        stay = w[_BEGUN_LEFT + 2 * LANE_WIDTH + k] + left_left
        come = w[_BEGUN_LEFT + 3 * LANE_WIDTH + k] + right_left
        cross = w[_BEGUN_LEFT + 2 * LANE_WIDTH + k] + left_right
        keep = w[_BEGUN_LEFT + 3 * LANE_WIDTH + k] + right_right
        w[_BITS + k] = bits + (4.0 if come < stay else 0.0) + (8.0 if keep < cross else 0.0)
        w[_BEGUN_LEFT + 2 * LANE_WIDTH + k] = min(stay, come)
        w[_BEGUN_LEFT + 3 * LANE_WIDTH + k] = min(keep, cross)


@kernel
def _close(w: Float, lanes: int, minimum_sine: float) -> None:
    """Come round to the first point: leaves the first elbow in the bits, and the last one as the elbow."""
    for k in range(lanes):
        left = w[_LEFT + _FIRST + k]
        right = w[_RIGHT + _FIRST + k]
        left_sine = w[_LEFT_SINE + _FIRST + k]
        right_sine = w[_RIGHT_SINE + _FIRST + k]
        left_last = w[_LEFT + k]
        right_last = w[_RIGHT + k]
        left_sine_last = w[_LEFT_SINE + k]
        right_sine_last = w[_RIGHT_SINE + k]
        a_left = w[_BEGUN_LEFT + k] + step_cost(wrapped(left - left_last), left_sine_last, left_sine, minimum_sine)
        a_right = w[_BEGUN_LEFT + LANE_WIDTH + k] + step_cost(
            wrapped(left - right_last), right_sine_last, left_sine, minimum_sine
        )
        b_left = w[_BEGUN_LEFT + 2 * LANE_WIDTH + k] + step_cost(
            wrapped(right - left_last), left_sine_last, right_sine, minimum_sine
        )
        b_right = w[_BEGUN_LEFT + 3 * LANE_WIDTH + k] + step_cost(
            wrapped(right - right_last), right_sine_last, right_sine, minimum_sine
        )
        begun_right = min(b_left, b_right) < min(a_left, a_right)
        last_of_a = 1.0 if a_right < a_left else 0.0
        last_of_b = 1.0 if b_right < b_left else 0.0
        w[_BITS + k] = 1.0 if begun_right else 0.0
        w[_ELBOW + k] = last_of_b if begun_right else last_of_a


@kernel
def _choose_backwards(w: Float, lanes: int, lefts: Float, rights: Float, bits: Float, at: int) -> None:
    """Put the chosen theta5 of every point into ``lefts``, from the last point back, by the bits of the way there."""
    for i in range(at, 0, -1):
        for k in range(lanes):
            right = w[_ELBOW + k] == 1.0
            here = bits[i * LANES + k]
            # Bits 4 and 8 are of having begun right, bits 2 and 8 of being right now.
            of_right = np.floor(here * 0.25)
            of_left = here - 4.0 * of_right
            mine = of_right if w[_BITS + k] == 1.0 else of_left
            of_being_right = np.floor(mine * 0.5)
            w[_ELBOW + k] = of_being_right if right else mine - 2.0 * of_being_right
            chosen = rights[i * LANES + k]
            lefts[i * LANES + k] = chosen if right else lefts[i * LANES + k]
    for k in range(lanes):
        chosen = rights[k]
        lefts[k] = chosen if w[_BITS + k] == 1.0 else lefts[k]


@kernel
def sum_up(w: Float, lanes: int, count: int, theta5: Float, fourier: Float) -> None:
    """Unwrap the chosen theta5 of all lanes, and sum its squares and its transform."""
    for k in range(lanes):
        w[_THETA5 + k] = theta5[k]
        w[_DISPLACEMENT + k] = 0.0
        w[_SQUARES + k] = 0.0
    size = fourier.shape[1]
    for j in range(size):
        for k in range(lanes):
            w[_COEFFICIENTS + j * LANE_WIDTH + k] = 0.0
    for i in range(1, count):
        for k in range(lanes):
            here = theta5[i * LANES + k]
            displacement = w[_DISPLACEMENT + k] + wrapped(here - w[_THETA5 + k])
            w[_THETA5 + k] = here
            w[_DISPLACEMENT + k] = displacement
            w[_SQUARES + k] += displacement * displacement
        for j in range(0, size, 2):
            a = fourier[i, j]
            b = fourier[i, j + 1]
            row = _COEFFICIENTS + j * LANE_WIDTH
            for k in range(lanes):
                w[row + k] += a * w[_DISPLACEMENT + k]
                w[row + LANE_WIDTH + k] += b * w[_DISPLACEMENT + k]


@kernel
def track_block(
    w: Float, lanes: int, rows: Float, count: int, minimum_sine: float, lefts: Float, rights: Float, bits: Float
) -> None:
    """Track all lanes round the cycle; ``lefts`` (count x LANES) then has the chosen theta5 of every point."""
    for k in range(lanes):
        r = w[2 * LANE_WIDTH + k]
        s = w[3 * LANE_WIDTH + k]
        w[_LENGTHS_SQUARED + k] = s * s - r * r
        w[_HALF_PER_S + k] = 0.5 / s
        w[_PER_R + k] = 1.0 / r
        w[_ERROR + k] = 0.0
        w[_IMMOBILE + k] = 0.0
        w[_BEGUN_LEFT + k] = 0.0
        w[_BEGUN_LEFT + LANE_WIDTH + k] = inf
        w[_BEGUN_LEFT + 2 * LANE_WIDTH + k] = inf
        w[_BEGUN_LEFT + 3 * LANE_WIDTH + k] = 0.0
    for i in range(count):
        for k in range(4 * LANE_WIDTH):
            w[_LEFT + _BEFORE + k] = w[_LEFT + k]
        _assemble(w, lanes, rows[X + i], rows[Y + i], rows[COS2 + i], rows[SIN2 + i], rows[TOLERANCE + i])
        if i == 0:
            for k in range(4 * LANE_WIDTH):
                w[_LEFT + _FIRST + k] = w[_LEFT + k]
        else:
            _advance(w, lanes, minimum_sine)
        for k in range(lanes):
            lefts[i * LANES + k] = w[_LEFT + k]
            rights[i * LANES + k] = w[_RIGHT + k]
            bits[i * LANES + k] = w[_BITS + k]
    _close(w, lanes, minimum_sine)
    _choose_backwards(w, lanes, lefts, rights, bits, count - 1)


@kernel
def lane_terms(w: Float, lane: int, size: int) -> tuple[float, float, float, float]:
    """Structural error, mobility, swept area and harmonic content of one lane (units: `Term`)."""
    harmonic = 0.0
    for order in range(size // 2):
        a = w[_COEFFICIENTS + 2 * order * LANE_WIDTH + lane]
        b = w[_COEFFICIENTS + (2 * order + 1) * LANE_WIDTH + lane]
        harmonic += harmonic_cost(a, b, order + 1)
    error = w[_ERROR + lane] * MM_PER_M
    immobile = w[_IMMOBILE + lane]
    swept = w[3 * LANE_WIDTH + lane] * sqrt(w[_SQUARES + lane]) * MM_PER_M * DEGREES_PER_RADIAN
    return error * error, immobile * immobile * immobile, swept, harmonic
