"""Learning from cycle to cycle: the correction that repeats with the master's revolution; see `learning_kernels`."""

from dataclasses import dataclass
from math import tau
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gateway import learning_kernels as kernels

Float = NDArray[np.float64]

MINIMUM_BINS: Final = 16
MAXIMUM_BINS: Final = 4096


@dataclass(frozen=True, slots=True)
class LearningSettings:
    """How is learned. Pairs are (master, slave).

    gain: share of the remaining error that is taken into the correction in each revolution, 0 to 1.
    proportional_Nm_per_rad, derivative_Nms_per_rad: torque for an error and for its rate, best those of the drives' own
    position controllers. bound_Nm: greatest correction. window_s: half width of the zero-phase low pass.
    settle_cycles: cycles of constant speed before anything is learned.
    """

    gain: float
    proportional_Nm_per_rad: tuple[float, float]
    derivative_Nms_per_rad: tuple[float, float]
    bound_Nm: tuple[float, float]
    window_s: float
    settle_cycles: int
    bins: int

    def to_array(self) -> Float:
        """The settings as the kernels take them."""
        return np.array(
            [
                self.gain,
                *self.proportional_Nm_per_rad,
                *self.derivative_Nms_per_rad,
                *self.bound_Nm,
                self.window_s,
                self.settle_cycles,
            ]
        )


@dataclass(frozen=True, slots=True)
class LearnedTorque:
    """What has been learned at one speed of the master (rad/s): torques in N m, (2, bins), read-only.

    Column b belongs to theta2 = (b + 1/2) 2 pi / bins.
    """

    speed: float
    torque: Float


class Learning:
    """The memory of one cam, and what makes it: torques out, following errors in, once a cycle each."""

    __slots__ = ("_memory", "_settings", "_state", "_taps", "_work")

    def __init__(self, settings: LearningSettings, learned: LearnedTorque | None = None) -> None:
        """``learned``: what to begin with; its number of bins need not be the same."""
        bins = settings.bins
        self._settings = settings.to_array()
        self._memory = np.zeros((kernels.AXES, bins))
        self._work = np.zeros((kernels.ROWS, bins))
        self._taps = np.zeros((2, 2 * kernels.MAXIMUM_HALF_WINDOW + 1))
        self._state = np.zeros(kernels.STATES)
        # The first call loads the machine code, which must not happen within a cycle.
        self.observe(0.0, 1.0, False, 0.0, 0.0)
        self.torques(0.0, 1.0)
        self._warm_up()
        if learned is not None:
            self._memory[:] = _resampled(learned.torque, bins)
            np.clip(self._memory, -self._settings[[[5], [6]]], self._settings[[[5], [6]]], out=self._memory)
            self._state[kernels.SPEED] = learned.speed

    def _warm_up(self) -> None:
        self._state[:] = 0.0
        self._state[kernels.BIN] = -1.0

    @property
    def learned(self) -> LearnedTorque | None:
        """What has been learned until now, a copy; None if nothing has."""
        if self._state[kernels.SPEED] <= 0.0 or not self._memory.any():
            return None
        torque = self._memory.copy()
        torque.flags.writeable = False
        return LearnedTorque(float(self._state[kernels.SPEED]), torque)

    @property
    def revolutions(self) -> float:
        """Machine cycles that have been learned from in this session."""
        return float(self._state[kernels.UPDATES]) / self._memory.shape[1]

    def torques(self, position: float, speed: float) -> tuple[float, float]:
        """The correction of both axes in N m at theta2 = ``position`` (rad) and this speed of the master (rad/s)."""
        return kernels.correction(self._memory, self._state, position, speed)

    def observe(self, position: float, speed: float, is_valid: bool, master_error: float, slave_error: float) -> None:
        """Take the following errors (rad) that the axes had at theta2 = ``position`` (rad); see ``kernels.observe``."""
        kernels.observe(
            self._memory,
            self._work,
            self._taps,
            self._state,
            self._settings,
            position,
            speed,
            is_valid,
            master_error,
            slave_error,
        )


def _resampled(torque: Float, bins: int) -> Float:
    """Torques at another number of bins, linear between them."""
    count = int(torque.shape[1])
    if count == bins:
        return torque
    at = (np.arange(bins, dtype=np.float64) + 0.5) * (tau / bins)
    known = (np.arange(count, dtype=np.float64) + 0.5) * (tau / count)
    out = np.empty((kernels.AXES, bins))
    for axis in range(kernels.AXES):
        out[axis] = np.interp(at, known, torque[axis], period=tau)
    return out
