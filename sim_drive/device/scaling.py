"""The factor group of CiA 402-2: what the drive's counts are in the user's units of position and velocity.

Position in user units = counts * feed / (position encoder resolution * gear ratio), and velocity in the same way with
the velocity encoder's resolution; polarity 607Eh turns either round. By default a user unit is a count.
"""

from dataclasses import dataclass
from fractions import Fraction
from typing import Final

POSITION_REVERSED: Final = 1 << 7
"""Bit of the polarity 607Eh."""
VELOCITY_REVERSED: Final = 1 << 6


@dataclass(frozen=True, slots=True)
class Scaling:
    """Conversion from counts to user units.

    ``numerator`` and ``denominator`` are of user position units a count, ``position_unit`` is the same as a float;
    ``velocity_unit`` user velocity units a count/s. Polarity makes the numerator or the velocity unit negative.
    """

    numerator: int = 1
    denominator: int = 1
    position_unit: float = 1.0
    velocity_unit: float = 1.0

    def position(self, counts: int) -> int:
        """``counts`` in whole user units, rounded to the nearest; without any offset and wrap."""
        return (2 * counts * self.numerator + self.denominator) // (2 * self.denominator)


IDENTITY: Final = Scaling()


def make_scaling(
    polarity: int,
    position_resolution: tuple[int, int],
    velocity_resolution: tuple[int, int],
    gear_ratio: tuple[int, int],
    feed_constant: tuple[int, int],
) -> Scaling:
    """The scaling that the factor group asks for: 607Eh, and the pairs of 608Fh, 6090h, 6091h and 6092h.

    All but the polarity are positive.
    """
    feed = Fraction(*feed_constant) / Fraction(*gear_ratio)
    position = feed / Fraction(*position_resolution)
    velocity = feed / Fraction(*velocity_resolution)
    if polarity & POSITION_REVERSED:
        position = -position
    if polarity & VELOCITY_REVERSED:
        velocity = -velocity
    return Scaling(position.numerator, position.denominator, float(position), float(velocity))
