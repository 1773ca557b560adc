"""How far a five-bar in motion is from where its demand has it."""

from math import hypot, inf, tau
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mechanism.cam_profile import evaluate
from mechanism.five_bar import assemble
from mechanism.jit import kernel

Float = NDArray[np.float64]

COARSE_GRID: Final = 90
GRID: Final = 720
"""Angles of the master at which a box of errors is looked at: to find one, and to be sure of it."""
SAFETY: Final = 1.5
"""A box of errors is harmless where it stays this much below the limits on the grid."""
MAXIMUM_TRIALS: Final = 64
SHRINKAGE: Final = 0.85


@kernel
def end_effector_miss(
    geometry: Float, closure: int, theta2: float, theta5: float, error2: float, error5: float
) -> float:
    """Distance (m) of the end effector from where theta2 and theta5 (rad) have it, the links being off by the errors.

    The errors (rad) are demand less actual. ``geometry`` is `FiveBar.to_array`. NaN where the linkage does not close.
    """
    e2x, e2y, e3x, e3y, _, _, _, _, _ = assemble(geometry, theta2, theta5, closure)
    a2x, a2y, a3x, a3y, _, _, _, _, _ = assemble(geometry, theta2 - error2, theta5 - error5, closure)
    p, q = geometry[0], geometry[1]
    return hypot(p * (a2x - e2x) + q * (a3x - e3x), p * (a2y - e2y) + q * (a3y - e3y))


@kernel
def greatest_deviation(
    geometry: Float, closure: int, coefficients: Float, net_turns: int, error: float, grid: int
) -> tuple[float, float]:
    """The farthest that errors of ``error`` (rad) either way on either axis take a five-bar on its cam from there.

    Slave from the cam of the master's actual angle (rad), and `end_effector_miss` (m), over one turn of the master; inf
    where the linkage does not close. ``grid`` angles of the master are looked at.
    """
    window = miss = 0.0
    for step in range(grid):
        theta2 = step * (tau / grid)
        theta5 = evaluate(coefficients, net_turns, theta2)[0]
        for sign2 in range(-1, 2):
            error2 = sign2 * error
            on_cam = evaluate(coefficients, net_turns, theta2 - error2)[0]
            for sign5 in range(-1, 2):
                error5 = sign5 * error
                window = max(window, abs(theta5 - error5 - on_cam))
                here = end_effector_miss(geometry, closure, theta2, theta5, error2, error5)
                if not here <= miss:
                    miss = here if here > miss else inf
    return window, miss


def harmless_error(
    geometry: Float, closure: int, coefficients: Float, net_turns: int, window: float, miss: float
) -> float:
    """Errors (rad) on both axes up to which no limit can be exceeded anywhere on the cam; 0 if none is so small.

    ``window`` (rad) and ``miss`` (m) are the limits of what `greatest_deviation` returns; a third of them is kept free
    for what lies between the angles that are looked at.
    """
    error, grid = window, COARSE_GRID
    for _ in range(MAXIMUM_TRIALS):
        far, away = greatest_deviation(geometry, closure, coefficients, net_turns, error, grid)
        if not (far * SAFETY <= window and away * SAFETY <= miss):
            error *= SHRINKAGE
        elif grid == GRID:
            return error
        else:
            grid = GRID
    return 0.0
