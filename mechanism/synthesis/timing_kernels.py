"""Kernels: the crank angles that free timing solves for.

With free timing only the order of the points counts. The crank's end A must lie on p's circle about its pivot and on
q's circle about the point, so theta2 has two values at each point, one on either side of the line from the pivot to the
point. The crank can only go on turning if they are taken in one of a few ways, of which the one with the fewest faults
and the most even steps is kept: always the one, always the other (a curve round the pivot), or behind the line while
the points recede from the pivot and ahead of it while they approach (a curve beside the pivot: at the farthest point p
and q come in line), the nearest and the farthest point themselves being taken either way.
"""

from math import cos, inf, pi, sin, sqrt, tau
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mechanism.jit import kernel
from mechanism.synthesis.tracking_kernels import (
    COS2,
    LEFT,
    RIGHT,
    SIN2,
    STEP,
    THETA2,
    X,
    Y,
    angle_of,
    wrapped,
)

Float = NDArray[np.float64]

# As `mechanism.curve` holds its curves to, less a hair, since its median may lie between two steps.
_GREATEST_GAP: Final = tau / 3.0
_GREATEST_RATIO: Final = 9.0
_LEAST_BOUND: Final = tau / 360.0

ALWAYS_BEHIND: Final = 0
IN_TURN: Final = 2
WAYS: Final = 6
"""0 always behind the line, 1 always ahead of it; from 2 on in turn, bit 0 with the nearest point taken behind it, bit
1 with the farthest taken ahead of it.
"""


@kernel
def _both_angles(rows: Float, count: int, variables: Float) -> tuple[int, int]:
    """Fill theta2 behind the line (LEFT) and ahead of it (RIGHT); returns the nearest and the farthest point."""
    p = variables[0]
    q = variables[1]
    nearest = 0
    farthest = 0
    least = inf
    greatest = -inf
    for i in range(count):
        dx = rows[X + i] - variables[4]
        dy = rows[Y + i] - variables[5]
        squared = dx * dx + dy * dy
        distance = sqrt(squared)
        cosine = (p * p + squared - q * q) / (2.0 * p * (distance if distance > 0.0 else 1e-300))
        cosine = min(max(cosine, -1.0), 1.0)
        bearing = angle_of(dy, dx)
        opening = angle_of(sqrt(1.0 - cosine * cosine), cosine)
        rows[LEFT + i] = bearing - opening
        rows[RIGHT + i] = bearing + opening
        if distance < least:
            least = distance
            nearest = i
        if distance > greatest:
            greatest = distance
            farthest = i
    return nearest, farthest


@kernel
def _is_behind(i: int, count: int, way: int, nearest: int, farthest: int) -> bool:
    if way < IN_TURN:
        return way == ALWAYS_BEHIND
    if i == nearest:
        return (way - IN_TURN) & 1 == 1
    if i == farthest:
        return (way - IN_TURN) & 2 == 0
    return (i - nearest) % count < (farthest - nearest) % count


@kernel
def _take(rows: Float, count: int, way: int, nearest: int, farthest: int) -> tuple[float, float]:
    """Fill theta2 (unwrapped) one of the ways; returns how many steps do not rise or are too wide, and the sum of
    the squared steps.
    """
    turned = 0.0
    faults = 0.0
    squares = 0.0
    before = 0.0
    for k in range(count + 1):
        i = k % count
        angle = rows[LEFT + i] if _is_behind(i, count, way, nearest, farthest) else rows[RIGHT + i]
        if k == 0:
            rows[THETA2] = angle
        else:
            step = wrapped(angle - before)
            # A long step forward is a step, not a step back.
            if step < -0.5 * pi:
                step += tau
            if step <= 1e-9:
                faults += 1.0
            rows[STEP + k - 1] = step
            turned += step
            squares += step * step
            if k < count:
                rows[THETA2 + i] = rows[THETA2] + turned
        before = angle
    if abs(turned - tau) > 1e-6:
        faults = max(faults, 1.0)
    elif faults == 0.0:
        faults = _gaps(rows, count)
    return faults, squares


@kernel
def _gaps(rows: Float, count: int) -> float:
    """How many steps are too wide for a `DesiredCurve` to be taken for a whole revolution."""
    middle = np.sort(rows[STEP : STEP + count])[count // 2]
    bound = min(_GREATEST_GAP, max(_GREATEST_RATIO * middle, _LEAST_BOUND))
    gaps = 0.0
    for i in range(count):
        if rows[STEP + i] > bound:
            gaps += 1.0
    return gaps


@kernel
def solve_timing(rows: Float, count: int, variables: Float) -> float:
    """Fill theta2 and its unit vector at every point; returns the number of faults (`Term.TIMING`)."""
    nearest, farthest = _both_angles(rows, count, variables)
    best = 0
    fewest = inf
    least = inf
    for way in range(WAYS):
        faults, squares = _take(rows, count, way, nearest, farthest)
        if faults < fewest or (faults == fewest and squares < least):
            fewest = faults
            least = squares
            best = way
    _take(rows, count, best, nearest, farthest)
    for i in range(count):
        rows[COS2 + i] = cos(rows[THETA2 + i])
        rows[SIN2 + i] = sin(rows[THETA2 + i])
    return fewest


@kernel
def fill_fourier(rows: Float, count: int, fourier: Float) -> None:
    """Rows of the transform over theta2 as it stands, (count, 2 n), deg per rad: trapezoids between the points."""
    for i in range(count):
        after = rows[THETA2 + i + 1] if i + 1 < count else rows[THETA2] + tau
        before = rows[THETA2 + i - 1] if i > 0 else rows[THETA2 + count - 1] - tau
        weight = 0.5 * (after - before) / pi * (180.0 / pi)
        real = 1.0
        imaginary = 0.0
        for order in range(fourier.shape[1] // 2):
            real, imaginary = (
                real * rows[COS2 + i] - imaginary * rows[SIN2 + i],
                real * rows[SIN2 + i] + imaginary * rows[COS2 + i],
            )
            fourier[i, 2 * order] = weight * real
            fourier[i, 2 * order + 1] = weight * imaginary
