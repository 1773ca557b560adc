"""How far a five-bar in motion is from where its cam has it."""

from math import hypot

import numpy as np
from numpy.typing import NDArray

from mechanism.cam_profile import evaluate
from mechanism.five_bar import assemble
from mechanism.jit import kernel

Float = NDArray[np.float64]


@kernel
def deviation(
    geometry: Float,
    closure: int,
    coefficients: Float,
    net_turns: int,
    theta2: float,
    error2: float,
    error5: float,
) -> tuple[float, float]:
    """(distance of link s from the cam, distance of the end effector from its demand), rad and m.

    theta2 (rad) is the demand of link p, that of link s is the cam's; error2 and error5 (rad) are demand less actual.
    The first is signed, the actual theta5 less the cam at the *actual* theta2. ``geometry`` is `FiveBar.to_array`,
    ``coefficients`` and ``net_turns`` are a `CamProfile`'s. Both are NaN where the linkage does not close.
    """
    theta5 = evaluate(coefficients, net_turns, theta2)[0]
    actual2 = theta2 - error2
    actual5 = theta5 - error5
    window = actual5 - evaluate(coefficients, net_turns, actual2)[0]
    e2x, e2y, e3x, e3y, _, _, _, _, _ = assemble(geometry, theta2, theta5, closure)
    a2x, a2y, a3x, a3y, _, _, _, _, _ = assemble(geometry, actual2, actual5, closure)
    p, q = geometry[0], geometry[1]
    miss = hypot(p * (a2x - e2x) + q * (a3x - e3x), p * (a2y - e2y) + q * (a3y - e3y))
    return window if miss == miss else miss, miss
