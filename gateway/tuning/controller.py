"""The position controllers in the drives as the gateway knows them: eq (5) and (6) of the paper, and their gains.

The constants are the paper's, and those of drives that have its controller; the drive holds the gains in the
manufacturer's object `drivers.objects.CONTROLLER_GAINS`, whose bounds are in its EDS.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from config.emulation_section import GainsSection
from config.schema import AxisSection
from gateway.errors import UsageError

Float = NDArray[np.float64]
Complex = NDArray[np.complex128]

SERVO_RATE_HZ: Final = 1024
GAIN_SCALE: Final = 256
VOLT_PER_UNIT: Final = 10.0 / 2048.0
GAIN_NAMES: Final = ("K_P", "K_I", "K_D", "K_V", "K_F")
GAIN_MAXIMUM: Final = 1_000_000
_P, _I, _D, _V, _F = range(len(GAIN_NAMES))


@dataclass(frozen=True, slots=True)
class Gains:
    """Gains of one controller, integers over 256: K_P, K_I, K_D, K_V, K_F of eq (5).

    Raises UsageError where one is not within 0 to ``GAIN_MAXIMUM``.
    """

    K_P: int
    K_I: int = 0
    K_D: int = 0
    K_V: int = 0
    K_F: int = 0

    def __post_init__(self) -> None:
        for name, value in zip(GAIN_NAMES, self.values, strict=True):
            if not 0 <= value <= GAIN_MAXIMUM:
                raise UsageError(f"{name} is {value}, but must be 0 to {GAIN_MAXIMUM}")

    @property
    def values(self) -> tuple[int, int, int, int, int]:
        """In the order of `GAIN_NAMES`, which is that of the drive's subindices from 1."""
        return self.K_P, self.K_I, self.K_D, self.K_V, self.K_F

    @classmethod
    def of(cls, values: Sequence[float]) -> "Gains":
        """From five numbers, rounded to whole ones."""
        return cls(*(round(value) for value in values))

    @classmethod
    def from_section(cls, section: GainsSection) -> "Gains":
        """From the configuration."""
        return cls(section.K_P, section.K_I, section.K_D, section.K_V, section.K_F)

    def to_json(self) -> dict[str, int]:
        """By their names."""
        return dict(zip(GAIN_NAMES, self.values, strict=True))

    def __str__(self) -> str:
        return ", ".join(f"{name} {value}" for name, value in self.to_json().items())


GainPair = tuple[Gains, Gains]
"""Of the master (CV axis) and the slave (servo axis)."""


@dataclass(frozen=True, slots=True)
class AxisLoop:
    """What lies between an axis' controller and its torque.

    ``counts_per_rad``; ``torque_per_unit_Nm`` of the 12-bit output; the amplifier's ``time_constant_s``;
    ``output_delay_periods`` (1/1024 s) from position to output.
    """

    counts_per_rad: float
    torque_per_unit_Nm: float
    time_constant_s: float
    output_delay_periods: int


def axis_loop(axis: AxisSection) -> AxisLoop:
    """As the configuration describes the axis."""
    emulation = axis.emulation
    return AxisLoop(
        axis.counts_per_revolution / (2.0 * np.pi),
        emulation.torque_per_volt_Nm * VOLT_PER_UNIT,
        emulation.torque_time_constant_s,
        emulation.output_delay_periods,
    )


def controller_response(gains: Sequence[float], frequencies_hz: Float) -> Complex:
    """Output units by counts of position, with the sign of a negative feedback taken off; eq (5) without its demand.

    K_P + K_I z / (z - 1) + (K_D + K_V) (1 - 1/z), over 256: the sum has the present error in it.
    """
    later: Complex = np.exp(-2j * np.pi * frequencies_hz / SERVO_RATE_HZ)
    response = np.full(later.shape, complex(gains[_P]))
    response += gains[_I] / (1.0 - later)
    response += (gains[_D] + gains[_V]) * (1.0 - later)
    response /= GAIN_SCALE
    return response
