"""What the paper measured on the reference machine, to stand beside one's own figures."""

from dataclasses import dataclass
from typing import Final

from gateway.record.run_constants import MechanismConstants


@dataclass(frozen=True, slots=True)
class PrecisionPoint:
    """A row of Table II: end effector in mm at a CV input in degrees."""

    cv_deg: float
    desired_mm: tuple[float, float]
    measured_mm: tuple[float, float]


TABLE_II: Final = (
    PrecisionPoint(217.0, (-46.0, 148.0), (-52.0, 147.0)),
    PrecisionPoint(102.0, (186.0, 270.0), (194.0, 262.0)),
    PrecisionPoint(4.0, (230.0, 247.0), (242.0, 246.0)),
)
SERVO_ERROR_EXTREME_COUNTS: Final = -115.0
"""Following error of the servo axis, demand - actual, at the start of the return stroke: the axis lags."""
CV_ERROR_EXTREME_COUNTS: Final = 19.0
SERVO_DISPLACEMENT_DEG: Final = 99.78
"""Theory."""
SERVO_MAXIMUM_COUNTS: Final = 1135.0
"""Measured."""
SERVO_DEMAND_VELOCITY_RAD_PER_S: Final = (4.48, -18.96)
SERVO_VELOCITY_COUNTS_PER_S: Final = (3072.0, -12288.0)
"""One-sample differences at 1024 Hz, so multiples of 1024 counts/s."""
SERVO_TORQUE_NM: Final = (0.0862, -0.0859, 0.0461)
"""Table I: max, min, RMS; it fits nearly massless links only."""
CV_TORQUE_NM: Final = (0.6107, -0.5739, 0.6043)
"""Table I: max, min, RMS."""
CV_VELOCITY_ERROR_COUNTS_PER_S: Final = 1024.0
"""At most, a one-sample difference too."""
POWER_KW: Final = (3.3429, 1.5696)
"""Drawn by the CV axis and the servo axis, measured at the amplifiers' inputs."""

_LENGTHS_MM: Final = (150.0, 250.0, 300.0, 150.0)
_PIVOT_DISTANCE_MM: Final = (250.0, 0.0)


def is_reference_machine(mechanism: MechanismConstants | None) -> bool:
    """Whether this is the paper's five-bar, so that its figures mean anything beside a run's."""
    if mechanism is None:
        return False
    m = mechanism
    between = (m.servo_pivot_m[0] - m.cv_pivot_m[0], m.servo_pivot_m[1] - m.cv_pivot_m[1])
    ours = (m.p_m, m.q_m, m.r_m, m.s_m, *between)
    return all(abs(a * 1e3 - b) < 0.5 for a, b in zip(ours, (*_LENGTHS_MM, *_PIVOT_DISTANCE_MM), strict=True))
