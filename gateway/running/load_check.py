"""Whether every axis carries its load once it is enabled: its torque at rest against the model of the machine.

An axis whose resolver is dead holds nothing, and sinks without a count of error; one whose brake has not opened is held
by that. Neither shows in any position, and the guard sees it only when the axis is asked to move.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Final

from config.conversion import nominal_parameters
from config.schema import GatewayConfig
from gateway.cyclic.axis_channel import AxisChannel
from mechanism.dynamics import Dynamics
from mechanism.five_bar import Closure

LEAST_LOAD_PERMILLE: Final = 50
"""Of rated torque: less is held by friction that no model has."""
MEAN_CYCLES: Final = 8
"""Of so many cycles the torques are averaged: a count of the resolver's noise is a blow to a controller."""
LEAST_MEANS: Final = 3
"""So many of them are looked at in any case, however long a cycle is."""
SLACK: Final = 3.0
"""A load is one if it is more than so many times dry friction, and carried from the inverse of this on."""


@dataclass(slots=True)
class _Load:
    """Of an axis, per mille of rated torque."""

    channel: AxisChannel
    expected: int
    least: float
    """Torque from which on it is carried, friction helping; towards ``expected``, as the next ones."""
    sum: int = 0
    mean: float = 0.0

    @property
    def direction(self) -> int:
        """1 or -1: the sign of ``expected``."""
        return 1 if self.expected > 0 else -1


class LoadCheck:
    """What the axes of a machine that stands have to hold, and which of them do not."""

    def __init__(
        self, torques: Callable[[float, float], tuple[float, float]], friction_Nm: Sequence[float], cycles: int
    ) -> None:
        """``torques``: of both axes at rest (N m) by their angles (rad); ``friction_Nm``: dry friction of each;
        ``cycles``: within which an axis has to carry its load.
        """
        self._torques = torques
        self._friction_Nm = friction_Nm
        self._limit = max(cycles, LEAST_MEANS * MEAN_CYCLES)
        self._loads: list[_Load] = []
        self._cycles = 0

    def begin(self, channels: Sequence[AxisChannel]) -> None:
        """The axes have been enabled where they stand; master first."""
        self._loads = []
        self._cycles = 0
        torques = self._torques(*(channel.units.angle(channel.target) for channel in channels))
        for channel, torque, friction in zip(channels, torques, self._friction_Nm, strict=True):
            if not isfinite(torque):
                # The linkage does not close there, by the model.
                continue
            expected, dry = channel.units.permille(torque), channel.units.permille(friction)
            if abs(expected) > max(SLACK * dry, LEAST_LOAD_PERMILLE):
                self._loads.append(_Load(channel, expected, (abs(expected) - dry) / SLACK))

    def look(self) -> bool:
        """One cycle; returns whether every load is carried."""
        self._cycles += 1
        for load in self._loads:
            load.sum += load.channel.torque * load.direction
        if self._cycles % MEAN_CYCLES == 0:
            for load in self._loads:
                load.mean = load.sum / MEAN_CYCLES
                load.sum = 0
            self._loads = [load for load in self._loads if load.mean < load.least]
        return not self._loads

    @property
    def is_over(self) -> bool:
        """Whether the time is over in which an axis has to carry its load."""
        return self._cycles >= self._limit

    @property
    def problems(self) -> list[str]:
        """A sentence for every axis whose load has not been carried yet."""
        return [
            f"axis {load.channel.name}: holds with {round(load.mean) * load.direction} per mille of its rated torque "
            f"what takes {load.expected} by the model; look at its resolver and its brake"
            for load in self._loads
        ]


def build_load_check(config: GatewayConfig, closure: Closure) -> LoadCheck | None:
    """Of a machine whose model is good enough to be fed forward; None for any other."""
    if not config.feed_forward.tells_loads:
        return None
    parameters = nominal_parameters(config)
    model = Dynamics(parameters, closure)
    at_rest = 0.0, 0.0

    def torques(theta2: float, theta5: float) -> tuple[float, float]:
        return model.torque((theta2, theta5), at_rest, at_rest)

    cycles = round(config.feed_forward.load_check_ms * 1000.0 / config.bus.cycle_us)
    return LoadCheck(torques, parameters.coulomb_N_m, cycles)
