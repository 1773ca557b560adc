"""How far a five-bar in motion is from where its demand has it."""

from math import hypot

import numpy as np
from numpy.typing import NDArray

from mechanism.five_bar import assemble
from mechanism.jit import kernel

Float = NDArray[np.float64]


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
