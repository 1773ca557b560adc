"""What the drives move: the coupled five-bar, or axes of their own, with amplifiers, friction, brakes and end stops.

A plant knows neither counts nor frames: torque commands in N m go in, angles in rad come out. It is advanced one servo
period at a time in one call of a numba kernel. Between two servo periods it is extrapolated.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from mechanism.dynamics import DynamicsParameters, energy, linkage_sine
from mechanism.five_bar import Closure
from sim_drive.physics.driveline import (
    DEFAULT_SUBSTEPS,
    ENERGY_COUNT,
    SERVO_PERIOD_S,
    AxisDriveline,
    AxisEnergy,
    axis_settings,
    energy_of,
    require_substeps,
)
from sim_drive.physics.five_bar_motion import METERED_SIZE, MOTION_SIZE, AxisState, advance_five_bar

Float = NDArray[np.float64]

CV_AXIS: Final = 0
SERVO_AXIS: Final = 1


@dataclass(frozen=True, slots=True)
class PlantParameters:
    """The coupled machine. Pairs are (CV axis, servo axis); friction is that of ``dynamics``.

    ``singular_sine``: where |sin(theta3 - theta4)| falls below it, the linkage counts as torn.
    """

    dynamics: DynamicsParameters
    closure: Closure
    axes: tuple[AxisDriveline, AxisDriveline] = (AxisDriveline(), AxisDriveline())
    singular_sine: float = 0.05
    substeps: int = DEFAULT_SUBSTEPS

    def __post_init__(self) -> None:
        if not 0.0 < self.singular_sine < 1.0:
            raise ValueError(f"singular_sine = {self.singular_sine!r}, must be between 0 and 1")
        require_substeps(self.substeps)


class Plant(Protocol):
    """What the emulated machine needs of a plant; axes are counted from 0."""

    @property
    def axis_count(self) -> int: ...

    @property
    def torn_at_s(self) -> float | None:
        """Plant time at which the linkage tore, None while it is whole."""
        ...

    @property
    def angles(self) -> Sequence[float]:
        """Angles in rad at the end of the last servo period."""
        ...

    def advance(self, torque_commands_Nm: Sequence[float], brakes_engaged: Sequence[bool]) -> None:
        """One servo period (1/1024 s) under constant torque commands (N m), one of each an axis."""
        ...

    def angle(self, axis: int, offset_s: float = 0.0) -> float:
        """Angle in rad, ``offset_s`` after the last servo period."""
        ...

    def velocity(self, axis: int, offset_s: float = 0.0) -> float:
        """Angular velocity in rad/s, ``offset_s`` after the last servo period."""
        ...

    def torque(self, axis: int) -> float:
        """Torque of the amplifier in N m at the end of the last servo period."""
        ...

    def energy(self) -> float:
        """Kinetic and potential energy in J."""
        ...

    def axis_energy(self, axis: int) -> AxisEnergy:
        """What an axis has drawn, done and lost so far."""
        ...


class FiveBarPlant:
    """What every five-bar with both motors has: two axes, 0 the CV axis (theta2), 1 the servo axis (theta5).

    Where the linkage comes near a singular position, or would have to open, it tears: the plant records the time,
    stands still from then on and ignores its torques. What a torn machine does is not modelled; it has to be seen, not
    survived.

    Raises ValueError where the linkage is singular, or does not close, at the initial angles (rad).
    """

    __slots__ = ("_dynamics", "_settings", "_state", "_step_s", "_steps", "_values", "parameters", "torn_at_s")

    def __init__(self, parameters: PlantParameters, theta2_rad: float, theta5_rad: float, state_size: int) -> None:
        self.parameters = parameters
        dynamics = parameters.dynamics
        self._dynamics = dynamics.to_array()
        sine = linkage_sine(self._dynamics, theta2_rad, theta5_rad, int(parameters.closure))
        if not abs(sine) >= parameters.singular_sine:
            raise ValueError(
                f"the linkage cannot stand at theta2 = {theta2_rad!r} rad, theta5 = {theta5_rad!r} rad:"
                f" |sin(theta3 - theta4)| is {abs(sine):.3g}, the bound is {parameters.singular_sine:g}"
            )
        self._step_s = SERVO_PERIOD_S / parameters.substeps
        self._settings = np.array(
            [
                axis_settings(viscous, coulomb, 0.0, axis, self._step_s)
                for viscous, coulomb, axis in zip(
                    dynamics.viscous_N_m_s, dynamics.coulomb_N_m, parameters.axes, strict=True
                )
            ]
        )
        self._values: AxisState = (theta2_rad, theta5_rad, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        self._state = np.zeros(state_size)
        self._state[:MOTION_SIZE] = self._values
        self._steps = 0
        self.torn_at_s: float | None = None
        """Plant time (s) at which the linkage tore, None while it is whole."""

    @property
    def axis_count(self) -> int:
        """Two: the CV axis and the servo axis."""
        return 2

    @property
    def time_s(self) -> float:
        """Plant time: servo periods advanced so far, in seconds."""
        return self._steps * SERVO_PERIOD_S

    @property
    def angles(self) -> Sequence[float]:
        """theta2 and theta5 in rad at the end of the last servo period."""
        return self._values[:2]

    @property
    def state(self) -> AxisState:
        """theta2, theta5, their velocities and accelerations, and both amplifier torques (rad, s, N m)."""
        return self._values

    def set_motion(self, theta: tuple[float, float], omega: tuple[float, float]) -> None:
        """Put the axes at angles (rad) and velocities (rad/s), without torque, for tests and diagnosis; all counts
        begin anew.
        """
        self._values = (*theta, *omega, 0.0, 0.0, 0.0, 0.0)
        self._state[:] = 0.0
        self._state[:MOTION_SIZE] = self._values
        self._steps = 0
        self.torn_at_s = None

    def _take(self, after: tuple[float, float, float, float, float, float, float, float, int]) -> None:
        """Take over what a kernel has answered."""
        self._values = after[:8]
        torn = after[8]
        if torn:
            self.torn_at_s = (self._steps - 1) * SERVO_PERIOD_S + torn * self._step_s

    def angle(self, axis: int, offset_s: float = 0.0) -> float:
        """Angle in rad, ``offset_s`` after the last servo period (constant acceleration)."""
        values = self._values
        return values[axis] + offset_s * (values[axis + 2] + 0.5 * offset_s * values[axis + 4])

    def velocity(self, axis: int, offset_s: float = 0.0) -> float:
        """Angular velocity in rad/s, ``offset_s`` after the last servo period (constant acceleration)."""
        values = self._values
        return values[axis + 2] + offset_s * values[axis + 4]

    def torque(self, axis: int) -> float:
        """Torque of the amplifier in N m at the end of the last servo period."""
        return self._values[axis + 6]


class CoupledPlant(FiveBarPlant):
    """The five-bar with both motors rigidly on their links; see FiveBarPlant."""

    __slots__ = ("_constants",)

    def __init__(self, parameters: PlantParameters, theta2_rad: float, theta5_rad: float) -> None:
        super().__init__(parameters, theta2_rad, theta5_rad, METERED_SIZE)
        self._constants = (
            self._dynamics,
            self._settings,
            int(parameters.closure),
            parameters.singular_sine,
            self._step_s,
            parameters.substeps,
        )
        # Compiled here rather than in the first servo period, where it would make a real-time host seconds late.
        advance_five_bar(self._state.copy(), *self._constants, 0.0, 0.0, False, False)

    @property
    def kernel_arguments(self) -> tuple[Float, Float, int, float, float, int]:
        """What `advance_five_bar` is called with between the state and the commands."""
        return self._constants

    def advance(self, torque_commands_Nm: Sequence[float], brakes_engaged: Sequence[bool]) -> None:
        """One servo period (1/1024 s) under constant torque commands (N m) for the CV and the servo axis."""
        self._steps += 1
        if self.torn_at_s is not None:
            return
        command2, command5 = torque_commands_Nm
        brake2, brake5 = brakes_engaged
        self._take(advance_five_bar(self._state, *self._constants, command2, command5, brake2, brake5))

    def energy(self) -> float:
        """Kinetic and potential energy in J."""
        x2, x5, v2, v5 = self._values[:4]
        kinetic, potential = energy(self._dynamics, x2, x5, v2, v5, int(self.parameters.closure))
        return kinetic + potential

    def linkage_sine(self) -> float:
        """sin(theta3 - theta4): how far the linkage is from a singular position (0)."""
        return linkage_sine(self._dynamics, self._values[0], self._values[1], int(self.parameters.closure))

    def axis_energy(self, axis: int) -> AxisEnergy:
        """What an axis has drawn, done and lost so far."""
        first = MOTION_SIZE + ENERGY_COUNT * axis
        counted: list[float] = self._state[first : first + ENERGY_COUNT].tolist()
        return energy_of(counted, self.parameters.axes[axis].motor, self.time_s)
