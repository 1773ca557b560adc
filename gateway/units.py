"""The one converter between SI units inside and counts and per mille at the CANopen edge."""

import math
from dataclasses import dataclass
from typing import Final

HALF_RANGE: Final = 1 << 31
RANGE_MASK: Final = (1 << 32) - 1
TORQUE_MAX_PERMILLE: Final = 32767


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

    def angle(self, counts: float) -> float:
        """Link angle in rad of a position in counts."""
        return counts * math.tau / self.counts_per_revolution + self.home_angle_rad

    def counts_in(self, angle_rad: float) -> int:
        """A difference in rad as counts."""
        return round(angle_rad * self.counts_per_revolution / math.tau)

    def degrees(self, counts: float) -> float:
        """A difference in counts as degrees."""
        return counts * 360.0 / self.counts_per_revolution

    def torque_permille(self, torque: float) -> int:
        """Torque in N m as per mille of the rated torque, clipped to INTEGER16."""
        permille = round(torque / self.rated_torque * 1000.0)
        return max(-TORQUE_MAX_PERMILLE, min(TORQUE_MAX_PERMILLE, permille))

    def torque(self, permille: float) -> float:
        """Torque in N m of a per mille figure."""
        return permille * self.rated_torque / 1000.0
