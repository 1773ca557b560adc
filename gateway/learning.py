"""Learning from cycle to cycle: the correction that repeats with the master's revolution; see `learning_kernels`."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import tau
from typing import Final

import numpy as np
from numpy.typing import NDArray

from config.conversion import controller_gains
from config.schema import GatewayConfig
from config.torque_sections import LearnedAxisSection
from gateway import learning_kernels as kernels
from gateway.units import AxisUnits

Float = NDArray[np.float64]

BOUND_SHARE: Final = 0.5
"""Share of the rated torque that a correction may reach unless the configuration says otherwise."""
MS_PER_S: Final = 1e3


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
        self._state[:] = 0.0
        self._state[kernels.BIN] = -1.0
        if learned is not None:
            bound = np.array(settings.bound_Nm)[:, np.newaxis]
            self._memory[:] = np.clip(_resampled(learned.torque, bins), -bound, bound)
            self._state[kernels.SPEED] = learned.speed

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


class LearningObserver:
    """Shows the cycle's following errors, which are counts, to what learns from them."""

    __slots__ = ("_learning", "_rad_per_count")

    def __init__(self, learning: Learning, units: tuple[AxisUnits, AxisUnits]) -> None:
        self._learning = learning
        self._rad_per_count = tuple(tau / unit.counts_per_revolution for unit in units)

    @property
    def learned(self) -> LearnedTorque | None:
        """What has been learned until now, a copy; None if nothing has."""
        return self._learning.learned

    def observe(self, master_position: float, master_velocity: float, errors: Sequence[int], is_steady: bool) -> None:
        """Following errors of one cycle; see `gateway.cycle.ErrorObserver`."""
        master, slave = self._rad_per_count
        self._learning.observe(master_position, master_velocity, is_steady, master * errors[0], slave * errors[1])


def build_learning(config: GatewayConfig, learned: LearnedTorque | None = None) -> Learning:
    """What the configuration's ``learning`` section describes, whether it is enabled or not."""
    section = config.learning
    master, slave = (_axis_law(config, name) for name in config.axis_names)
    return Learning(
        LearningSettings(
            gain=section.gain,
            proportional_Nm_per_rad=(master[0], slave[0]),
            derivative_Nms_per_rad=(master[1], slave[1]),
            bound_Nm=(master[2], slave[2]),
            window_s=section.window_ms / MS_PER_S,
            settle_cycles=round(section.settle_ms / MS_PER_S / config.cycle_s),
            bins=section.bins,
        ),
        learned,
    )


def _axis_law(config: GatewayConfig, name: str) -> tuple[float, float, float]:
    """Proportional part, derivative part and bound of an axis."""
    given, axis = config.learning.axes.get(name, LearnedAxisSection()), config.axes[name]
    gains = controller_gains(axis)
    rate = gains.derivative_Nms_per_rad + gains.damping_Nms_per_rad
    return (
        gains.proportional_Nm_per_rad if given.proportional_Nm_per_rad is None else given.proportional_Nm_per_rad,
        rate if given.derivative_Nms_per_rad is None else given.derivative_Nms_per_rad,
        BOUND_SHARE * axis.rated_torque_Nm if given.bound_Nm is None else given.bound_Nm,
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
