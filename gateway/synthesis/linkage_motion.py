"""The motion of a whole machine cycle, sampled: what animation and report draw."""

from dataclasses import dataclass
from math import tau
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from config.conversion import desired_curve, dynamics_parameters, five_bar
from config.schema import GatewayConfig
from gateway.errors import GatewayError, UsageError
from gateway.running.preparation import compile_config
from mechanism.cam import Cam
from mechanism.curve import DesiredCurve
from mechanism.dynamics import inverse_dynamics_along
from mechanism.errors import UnreachableError
from mechanism.five_bar import FiveBar

Float = NDArray[np.floating[Any]]

MINIMUM_SAMPLES: Final = 12
MAXIMUM_SAMPLES: Final = 7200
_FINE_SAMPLES: Final = 8192
COULOMB_VELOCITY_RAD_PER_S: Final = 0.05
"""Where the smoothed Coulomb friction of the torques reaches 76 %: far below every working speed."""


@dataclass(frozen=True, slots=True, eq=False)
class LinkageMotion:
    """One cycle at constant master speed, n samples at equal steps of theta2 from 0 on, 2 pi left out.

    theta2, theta5: rad, theta5 unwrapped; velocity, acceleration: of the servo axis, rad/s and rad/s^2; joint_a,
    joint_d, end_effector: (n, 2) m; torque: (n, 2) N m of the CV and the servo motor, friction included;
    displacement_rad: how far link s swings, between the samples too.
    """

    name: str
    five_bar: FiveBar
    curve: DesiredCurve
    speed_rad_per_s: float
    theta2: Float
    theta5: Float
    velocity: Float
    acceleration: Float
    joint_a: Float
    joint_d: Float
    end_effector: Float
    torque: Float
    displacement_rad: float

    def extent(self, margin: float = 0.06) -> tuple[float, float, float, float]:
        """Least x, least y, greatest x, greatest y of everything that moves or stands, metres, with a margin."""
        pivots = np.array([self.five_bar.cv_pivot, self.five_bar.servo_pivot])
        points = np.concatenate((pivots, self.joint_a, self.joint_d, self.end_effector, self.curve.points))
        low, high = points.min(axis=0), points.max(axis=0)
        border = margin * float((high - low).max())
        return (
            float(low[0]) - border,
            float(low[1]) - border,
            float(high[0]) + border,
            float(high[1]) + border,
        )


def linkage_motion(config: GatewayConfig, samples: int, cam: Cam | None = None) -> LinkageMotion:
    """The motion of a configuration's machine on ``cam``, or on the cam of its own curve, limits or no limits.

    Raises UsageError for a bad number of samples, mechanism.errors.MechanismError for a curve that cannot be read,
    UnreachableError or GatewayError where the linkage does not close.
    """
    if not MINIMUM_SAMPLES <= samples <= MAXIMUM_SAMPLES:
        raise UsageError(f"{samples} samples a cycle, bound {MINIMUM_SAMPLES} to {MAXIMUM_SAMPLES}")
    linkage = five_bar(config)
    if cam is None:
        compiled = compile_config(config)
        for violation in compiled.violations:
            if isinstance(violation, UnreachableError) and compiled.report.immobile_points:
                raise violation
        cam = compiled.cam
    theta2 = np.arange(samples) * (tau / samples)
    speed = config.speed_rad_per_s
    profile = cam.profile.at_many(theta2)
    theta5, velocity, acceleration = profile[:, 0], profile[:, 1] * speed, profile[:, 2] * speed**2
    end_effector = linkage.end_effector(theta2, theta5, cam.closure)
    open_at = np.flatnonzero(~np.isfinite(end_effector).all(axis=1))
    if open_at.size:
        raise GatewayError(
            f"{config.path}: links q and r do not meet at theta2 = {np.degrees(theta2[open_at[0]]):.2f} deg"
        )
    torque = np.empty((samples, 2))
    inverse_dynamics_along(
        dynamics_parameters(config).to_array(),
        np.stack((theta2, theta5), axis=1, dtype=np.float64),
        np.stack((np.full(samples, speed), velocity), axis=1),
        np.stack((np.zeros(samples), acceleration), axis=1),
        int(cam.closure),
        COULOMB_VELOCITY_RAD_PER_S,
        torque,
    )
    return LinkageMotion(
        name=config.name,
        five_bar=linkage,
        curve=desired_curve(config),
        speed_rad_per_s=speed,
        theta2=theta2,
        theta5=theta5,
        velocity=velocity,
        acceleration=acceleration,
        joint_a=linkage.crank_end(theta2),
        joint_d=linkage.servo_end(theta5),
        end_effector=end_effector,
        torque=torque,
        displacement_rad=float(np.ptp(cam.profile.at_many(np.arange(_FINE_SAMPLES) * (tau / _FINE_SAMPLES))[:, 0])),
    )
