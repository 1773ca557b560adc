"""The one converter between SI units inside and counts at the CANopen edge."""

import math
from dataclasses import dataclass
from typing import Final

HALF_RANGE: Final = 1 << 31
RANGE_MASK: Final = (1 << 32) - 1
INT16_MAX: Final = 32767


def wrap_counts(counts: int) -> int:
    """Counts as INTEGER32, modulo 2^32: an axis that turns for ever passes the range of its position objects."""
    return (counts + HALF_RANGE & RANGE_MASK) - HALF_RANGE


@dataclass(frozen=True, slots=True)
class AxisUnits:
    """Scales of one axis.

    ``counts_per_revolution``: position units of the drive a turn of the link; ``home_angle_rad``: angle of the link at
    position 0; ``rated_torque``: N m that the drive calls 1000 per mille (6076h).
    """

    counts_per_revolution: int
    home_angle_rad: float
    rated_torque: float

    def counts(self, angle_rad: float) -> int:
        """Nearest position in counts of a link angle."""
        return round((angle_rad - self.home_angle_rad) * self.counts_per_revolution / math.tau)

    def angle(self, counts: int) -> float:
        """Link angle in rad at a position in counts."""
        return self.home_angle_rad + counts * math.tau / self.counts_per_revolution

    def counts_in(self, angle_rad: float) -> int:
        """A difference in rad as counts."""
        return round(angle_rad * self.counts_per_revolution / math.tau)

    def permille(self, torque_Nm: float) -> int:
        """Nearest torque in per mille of rated torque, not bounded."""
        return round(torque_Nm * 1000.0 / self.rated_torque)
