"""The steady machine cycle in the simulated loop: what both axes do with given gains, in figures."""

from dataclasses import dataclass
from math import tau
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from config.schema import GatewayConfig
from gateway.tuning.controller import SERVO_RATE_HZ
from gateway.tuning.response import SimulatedLoop
from mechanism.cam_profile import CamProfile

Float = NDArray[np.float64]
Int = NDArray[np.int64]

WARM_UP_CYCLES: Final = 1
"""Machine cycles after which what the start has stirred up is gone."""
_COMMAND: Final = 2


@dataclass(frozen=True, slots=True)
class SteadyFigures:
    """Of one steady machine cycle; pairs are (master, slave).

    ``peak_counts`` and ``rms_counts`` of the following error; ``ripple_Nm``: RMS change of the torque command from one
    servo tick to the next, most of which quantisation makes through the velocity gain.
    """

    peak_counts: tuple[float, float]
    rms_counts: tuple[float, float]
    ripple_Nm: tuple[float, float]

    def to_json(self, names: tuple[str, ...]) -> dict[str, Any]:
        """By the axes' names."""
        return {
            name: {
                "peak_counts": round(self.peak_counts[axis], 3),
                "rms_counts": round(self.rms_counts[axis], 4),
                "torque_ripple_Nm": round(self.ripple_Nm[axis], 4),
            }
            for axis, name in enumerate(names)
        }


class SteadyCycle:
    """The same machine cycles again and again, with other gains."""

    def __init__(self, loop: SimulatedLoop, config: GatewayConfig, profile: CamProfile, cycles: int = 1) -> None:
        """``cycles``: how many machine cycles are measured, after one to settle."""
        speed = config.speed_rad_per_s
        self._loop = loop
        self._per_cycle = max(1, round(tau / (speed * config.cycle_s)))
        count = (WARM_UP_CYCLES + cycles) * self._per_cycle
        theta2 = speed * config.cycle_s * np.arange(1, count + 1)
        scale = np.array([axis.counts_per_revolution for axis in config.ordered_axes]) / tau
        theta = np.stack([theta2, profile.at_many(theta2)[:, 0]], axis=1)
        self.targets: Int = np.floor(theta * scale + 0.5).astype(np.int64)
        theta5, slope = profile.at(0.0)[:2]
        self._theta = (0.0, theta5)
        self._omega = (speed, slope * speed)

    def run(self, gains: Float, seed: int = 0) -> SteadyFigures | None:
        """Figures with ``gains`` (2, 5); None if the linkage tore."""
        loop = self._loop
        loop.gains = np.ascontiguousarray(gains, dtype=np.float64)
        loop.reset(seed, self._theta, self._omega)
        run = loop.run(self.targets, record_ticks=True)
        if run.is_torn:
            return None
        first = WARM_UP_CYCLES * self._per_cycle
        error = run.error_counts[first:].astype(np.float64)
        commands = run.ticks[round(first * loop.cycle_s * SERVO_RATE_HZ) :, :, _COMMAND]
        steps = np.diff(commands, axis=0)
        return SteadyFigures(
            _pair(np.abs(error).max(axis=0)),
            _pair(np.sqrt(np.square(error).mean(axis=0))),
            _pair(np.sqrt(np.square(steps).mean(axis=0))),
        )


def _pair(values: Float) -> tuple[float, float]:
    return float(values[0]), float(values[1])
