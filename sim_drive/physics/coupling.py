"""A flexible coupling between a motor and its link: spring, damper and play."""

from dataclasses import dataclass
from math import inf, isfinite
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mechanism.jit import kernel

Float = NDArray[np.float64]

# Layout of the couplings' array, a row an axis.
STIFFNESS: Final = 0
"""inf: none, the motor sits on its link."""
DAMPING: Final = 1
HALF_PLAY: Final = 2
MOTOR_INERTIA: Final = 3


@dataclass(frozen=True, slots=True)
class Coupling:
    """What joins a motor to its link: a spring and a damper in parallel, behind some play.

    ``backlash_rad`` is the play from one end to the other. Within it nothing is passed on; at its ends the spring
    pushes and never pulls. ``link_side_inertia_kg_m2`` is the half that turns with the link.

    Raises ValueError where a value is out of its bounds.
    """

    stiffness_N_m_per_rad: float
    damping_N_m_s_per_rad: float = 0.0
    backlash_rad: float = 0.0
    link_side_inertia_kg_m2: float = 2e-5

    def __post_init__(self) -> None:
        for name, value in (
            ("stiffness_N_m_per_rad", self.stiffness_N_m_per_rad),
            ("link_side_inertia_kg_m2", self.link_side_inertia_kg_m2),
        ):
            if not (isfinite(value) and value > 0.0):
                raise ValueError(f"{name} = {value!r}, must be finite and positive")
        for name, value in (
            ("damping_N_m_s_per_rad", self.damping_N_m_s_per_rad),
            ("backlash_rad", self.backlash_rad),
        ):
            if not (isfinite(value) and value >= 0.0):
                raise ValueError(f"{name} = {value!r}, must be finite and zero or more")


@kernel
def coupling_torques(couplings: Float, axis: int, twist: float, rate: float) -> tuple[float, float]:
    """(torque, its elastic part) that a coupling passes on to the link at a twist (rad) and its rate (rad/s), N m."""
    half_play = couplings[axis, HALF_PLAY]
    stiffness = couplings[axis, STIFFNESS]
    damping = couplings[axis, DAMPING]
    if half_play == 0.0:
        elastic = stiffness * twist
        return elastic + damping * rate, elastic
    if twist > half_play:
        elastic = stiffness * (twist - half_play)
        return max(elastic + damping * rate, 0.0), elastic
    if twist < -half_play:
        elastic = stiffness * (twist + half_play)
        return min(elastic + damping * rate, 0.0), elastic
    return 0.0, 0.0


def coupling_row(coupling: Coupling | None, motor_inertia: float) -> tuple[float, float, float, float]:
    """An axis' row of the array that the kernels take."""
    if coupling is None:
        return (inf, 0.0, 0.0, motor_inertia)
    return (
        coupling.stiffness_N_m_per_rad,
        coupling.damping_N_m_s_per_rad,
        0.5 * coupling.backlash_rad,
        motor_inertia,
    )
