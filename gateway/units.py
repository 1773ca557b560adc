"""The one converter between SI units inside and counts and per mille at the CANopen edge."""

import math
from dataclasses import dataclass

COUNT_MIN = -(1 << 31)
COUNT_MAX = (1 << 31) - 1
TORQUE_MAX_PERMILLE = 32767


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
