"""Learning from cycle to cycle: the correction that repeats with the master's revolution; see `learning_kernels`."""

from dataclasses import dataclass
from math import tau
from typing import Final

import numpy as np
from numpy.typing import NDArray

from config.conversion import closure_at_home, controller_gains, nominal_parameters
from config.schema import GatewayConfig
from config.torque_sections import LearnedAxisSection
from gateway.learning import kernels as kernels
from mechanism.cam_profile import CamProfile
from mechanism.dynamics import mass_matrix_and_bias

Float = NDArray[np.float64]

BOUND_SHARE: Final = 0.5
"""Share of the rated torque that a correction may reach unless the configuration says otherwise."""
MS_PER_S: Final = 1e3


@dataclass(frozen=True, slots=True)
class LearningSettings:
    """How is learned. Pairs are (master, slave).

    gain: share of the missing torque that is taken into the correction in each revolution, 0 to 1. proportional,
    integrating, derivative: torque for an error, its integral and its rate, best those of the drives' own position
    controllers. bound_Nm: greatest correction. window_s: half width of the zero-phase low pass. settle_cycles: cycles
    of constant speed before anything is learned. bins: places of the revolution for which a torque is kept.
    """

    gain: float
    proportional_Nm_per_rad: tuple[float, float]
    integrating_Nm_per_rad_s: tuple[float, float]
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
                *self.integrating_Nm_per_rad_s,
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

    __slots__ = ("_masses", "_memory", "_settings", "_state", "_taps", "_work")

    def __init__(self, settings: LearningSettings, masses: Float, learned: LearnedTorque | None = None) -> None:
        """``masses`` (3, bins): m11, m12, m22 of the machine (kg m^2) at the middle of every bin.

        ``learned``: what to begin with; its number of bins need not be the same.
        """
        bins = settings.bins
        if masses.shape != (kernels.MASSES, bins):
            raise ValueError(f"masses of shape {masses.shape} for {bins} bins")
        self._masses = masses
        self._settings = settings.to_array()
        self._memory = np.zeros((kernels.AXES, bins))
        self._work = np.zeros((kernels.ROWS, bins))
        self._taps = np.zeros((3, 2 * kernels.MAXIMUM_HALF_WINDOW + 1))
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
            self._masses,
            self._taps,
            self._state,
            self._settings,
            position,
            speed,
            is_valid,
            master_error,
            slave_error,
        )


def build_learning(config: GatewayConfig, profile: CamProfile, learned: LearnedTorque | None = None) -> Learning:
    """What the configuration's ``learning`` section describes, whether it is enabled or not.

    Raises mechanism.errors.MechanismError for a curve that cannot be read.
    """
    section = config.learning
    master, slave = (_axis_law(config, name) for name in config.axis_names)
    settings = LearningSettings(
        gain=section.gain,
        proportional_Nm_per_rad=(master[0], slave[0]),
        integrating_Nm_per_rad_s=(master[1], slave[1]),
        derivative_Nms_per_rad=(master[2], slave[2]),
        bound_Nm=(master[3], slave[3]),
        window_s=section.window_ms / MS_PER_S,
        settle_cycles=round(section.settle_ms / MS_PER_S / config.cycle_s),
        bins=section.bins,
    )
    return Learning(settings, masses_along(config, profile, section.bins), learned)


def _axis_law(config: GatewayConfig, name: str) -> tuple[float, float, float, float]:
    """Proportional, integrating and derivative part, and bound, of an axis."""
    given, axis = config.learning.axes.get(name, LearnedAxisSection()), config.axes[name]
    loop = axis.position_loop
    if loop is None:
        gains = controller_gains(axis)
        proportional, integrating = gains.proportional_Nm_per_rad, gains.integrating_Nm_per_rad_s
        rate = gains.derivative_Nms_per_rad + gains.damping_Nms_per_rad
    else:
        # The drive's own controller has no say in cyclic synchronous torque.
        proportional, integrating = loop.proportional_Nm_per_rad, loop.integrating_Nm_per_rad_s
        rate = loop.derivative_Nms_per_rad
    return (
        proportional if given.proportional_Nm_per_rad is None else given.proportional_Nm_per_rad,
        integrating if given.integrating_Nm_per_rad_s is None else given.integrating_Nm_per_rad_s,
        rate if given.derivative_Nms_per_rad is None else given.derivative_Nms_per_rad,
        BOUND_SHARE * axis.rated_torque_Nm if given.bound_Nm is None else given.bound_Nm,
    )


def masses_along(config: GatewayConfig, profile: CamProfile, bins: int) -> Float:
    """The nominal model's mass matrix in the middle of every bin: (3, bins), rows m11, m12, m22, kg m^2."""
    parameters = nominal_parameters(config).to_array()
    closure = int(closure_at_home(config))
    masses = np.empty((kernels.MASSES, bins))
    for b in range(bins):
        theta2 = (b + 0.5) * tau / bins
        masses[:, b] = mass_matrix_and_bias(parameters, theta2, profile.at(theta2)[0], 0.0, 0.0, closure)[:3]
    return masses


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
