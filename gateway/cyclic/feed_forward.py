"""Inverse dynamics along a cam: the torque that the model of the machine says a motion will take."""

from collections.abc import Callable
from functools import partial
from math import isfinite
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mechanism.cam_profile import CamProfile, evaluate
from mechanism.dynamics import DynamicsParameters, inverse_dynamics
from mechanism.five_bar import Closure
from mechanism.jit import kernel

Float = NDArray[np.float64]


@kernel
def feed_forward(
    dynamics: Float,
    coefficients: Float,
    net_turns: int,
    closure: int,
    coulomb_velocity: float,
    damping2: float,
    damping5: float,
    position: float,
    velocity: float,
    acceleration: float,
) -> tuple[float, float]:
    """Torques (N m) of master and slave on the cam, with the master at this position (rad, rad/s, rad/s^2).

    ``damping2``, ``damping5`` (N m s/rad) is what the drives themselves give in proportion to the demand's velocity.
    0 where the linkage does not close.
    """
    theta5, slope, curvature, _ = evaluate(coefficients, net_turns, position)
    omega5 = slope * velocity
    torque2, torque5 = inverse_dynamics(
        dynamics,
        position,
        theta5,
        velocity,
        omega5,
        acceleration,
        curvature * velocity * velocity + slope * acceleration,
        closure,
        coulomb_velocity,
    )
    torque2 -= damping2 * velocity
    torque5 -= damping5 * omega5
    if not (isfinite(torque2) and isfinite(torque5)):
        return 0.0, 0.0
    return torque2, torque5


class FeedForward:
    """Inverse dynamics of the five-bar along a cam, for both axes.

    No table is laid over theta2: the equations themselves cost a microsecond, and hold at any speed and acceleration.
    """

    __slots__ = ("torques",)

    def __init__(
        self,
        parameters: DynamicsParameters,
        closure: Closure,
        profile: CamProfile,
        coulomb_velocity: float,
        drive_damping: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        """``parameters``: nominal, they may be wrong. ``coulomb_velocity`` (rad/s): see
        ``mechanism.dynamics.friction_torque``. ``drive_damping`` (N m s/rad, master and slave): torque that the drives
        give by themselves in proportion to the demand's velocity, less what they take off in proportion to the actual
        one; it need not be sent.
        """
        self.torques: Final[Callable[[float, float, float], tuple[float, float]]] = partial(
            feed_forward,
            parameters.to_array(),
            profile.coefficients,
            profile.net_turns,
            int(closure),
            coulomb_velocity,
            *drive_damping,
        )
        """Torques of master and slave, N m, for a state of the master (rad, rad/s, rad/s^2)."""
        # The first call loads the machine code, which must not happen within a cycle.
        self.torques(0.0, 0.0, 0.0)
