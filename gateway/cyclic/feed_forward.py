"""Inverse dynamics, along a cam and off it: the torque that the model of the machine says a motion will take."""

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
def torques_of_motion(
    dynamics: Float,
    closure: int,
    coulomb_velocity: float,
    damping2: float,
    damping5: float,
    theta2: float,
    theta5: float,
    omega2: float,
    omega5: float,
    alpha2: float,
    alpha5: float,
) -> tuple[float, float]:
    """Torques (N m) of master and slave in any motion (rad, rad/s, rad/s^2); 0 where the linkage does not close.

    ``damping2``, ``damping5`` (N m s/rad) is what the drives themselves give in proportion to the demand's velocity.
    """
    torque2, torque5 = inverse_dynamics(
        dynamics, theta2, theta5, omega2, omega5, alpha2, alpha5, closure, coulomb_velocity
    )
    torque2 -= damping2 * omega2
    torque5 -= damping5 * omega5
    if not (isfinite(torque2) and isfinite(torque5)):
        return 0.0, 0.0
    return torque2, torque5


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
    """`torques_of_motion` on the cam, with the master at this position (rad, rad/s, rad/s^2)."""
    theta5, slope, curvature, _ = evaluate(coefficients, net_turns, position)
    return torques_of_motion(
        dynamics,
        closure,
        coulomb_velocity,
        damping2,
        damping5,
        position,
        theta5,
        velocity,
        slope * velocity,
        acceleration,
        curvature * velocity * velocity + slope * acceleration,
    )


class FeedForward:
    """Inverse dynamics of the five-bar along a cam and off it, for both axes.

    No table is laid over theta2: the equations themselves cost a microsecond, and hold at any speed and acceleration.
    """

    __slots__ = ("torques", "torques_of_motion")

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
        dynamics = parameters.to_array()
        self.torques: Final[Callable[[float, float, float], tuple[float, float]]] = partial(
            feed_forward,
            dynamics,
            profile.coefficients,
            profile.net_turns,
            int(closure),
            coulomb_velocity,
            *drive_damping,
        )
        """Torques of master and slave, N m, for a state of the master (rad, rad/s, rad/s^2)."""
        self.torques_of_motion: Final[Callable[[float, float, float, float, float, float], tuple[float, float]]] = (
            partial(torques_of_motion, dynamics, int(closure), coulomb_velocity, *drive_damping)
        )
        """The same for a motion: theta2, theta5, omega2, omega5, alpha2, alpha5 (rad, rad/s, rad/s^2)."""
        # The first calls load the machine code, which must not happen within a cycle.
        self.torques(0.0, 0.0, 0.0)
        self.torques_of_motion(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
