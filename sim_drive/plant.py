"""What the drives move: the coupled five-bar, or axes of their own, with amplifiers, friction, brakes and end stops.

A plant knows neither counts nor frames: torque commands in N m go in, angles in rad come out. It is advanced one servo
period at a time in one call of a numba kernel. Between two servo periods it is extrapolated.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import exp, inf, isfinite, isnan
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from mechanism.dynamics import DynamicsParameters, energy, linkage_sine, mass_matrix_and_bias
from mechanism.five_bar import Closure
from mechanism.jit import kernel
from sim_drive.friction import impulse_bounds, velocities_after_impulse, velocity_after_impulse
from sim_drive.servo import SERVO_RATE_HZ

Float = NDArray[np.float64]

SERVO_PERIOD_S: Final = 1.0 / SERVO_RATE_HZ
DEFAULT_SUBSTEPS: Final = 4

CV_AXIS: Final = 0
SERVO_AXIS: Final = 1


@dataclass(frozen=True, slots=True)
class AxisDriveline:
    """Amplifier, holding brake and end stops of one axis.

    ``torque_limit_Nm``: what the amplifier can give, either way. ``torque_time_constant_s``: first-order lag from
    torque command to torque, 0 for none. ``brake_torque_Nm``: what the engaged holding brake holds; it acts as Coulomb
    friction. End stops (rad) are fully inelastic.

    Raises ValueError where a value is negative or not finite, or the stops are reversed.
    """

    torque_limit_Nm: float = 4.5
    torque_time_constant_s: float = 0.001
    brake_torque_Nm: float = 2.0
    end_stop_minimum_rad: float = -inf
    end_stop_maximum_rad: float = inf

    def __post_init__(self) -> None:
        for name, value in (
            ("torque_limit_Nm", self.torque_limit_Nm),
            ("torque_time_constant_s", self.torque_time_constant_s),
            ("brake_torque_Nm", self.brake_torque_Nm),
        ):
            if not (isfinite(value) and value >= 0.0):
                raise ValueError(f"{name} = {value!r}, must be finite and zero or more")
        if not self.end_stop_minimum_rad < self.end_stop_maximum_rad:
            raise ValueError(
                f"end_stop_minimum_rad = {self.end_stop_minimum_rad!r} must be below"
                f" end_stop_maximum_rad = {self.end_stop_maximum_rad!r}"
            )


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
        if not 1 <= self.substeps <= 64:
            raise ValueError(f"substeps = {self.substeps!r}, must be 1 to 64")


@dataclass(frozen=True, slots=True)
class FreeAxisParameters:
    """One axis that is coupled to nothing: inertia with viscous and Coulomb friction, and a constant load torque."""

    inertia_kg_m2: float
    viscous_N_m_s: float = 0.0
    coulomb_N_m: float = 0.0
    load_torque_Nm: float = 0.0
    driveline: AxisDriveline = field(default_factory=AxisDriveline)

    def __post_init__(self) -> None:
        if not (isfinite(self.inertia_kg_m2) and self.inertia_kg_m2 > 0.0):
            raise ValueError(f"inertia_kg_m2 = {self.inertia_kg_m2!r}, must be finite and positive")
        for name, value in (("viscous_N_m_s", self.viscous_N_m_s), ("coulomb_N_m", self.coulomb_N_m)):
            if not (isfinite(value) and value >= 0.0):
                raise ValueError(f"{name} = {value!r}, must be finite and zero or more")
        if not isfinite(self.load_torque_Nm):
            raise ValueError(f"load_torque_Nm = {self.load_torque_Nm!r}, must be finite")


class Plant(Protocol):
    """What the emulated machine needs of a plant; axes are counted from 0."""

    @property
    def axis_count(self) -> int: ...

    @property
    def torn_at_s(self) -> float | None:
        """Plant time at which the linkage tore, None while it is whole."""
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


# Layout of the flat arrays; kernels see these as compile-time constants.
_SETTING_COUNT: Final = 9
_VISCOUS: Final = 0
_COULOMB: Final = 1
_BRAKE: Final = 2
_LIMIT: Final = 3
_DECAY_HALF: Final = 4
_DECAY: Final = 5
_STOP_MINIMUM: Final = 6
_STOP_MAXIMUM: Final = 7
_LOAD: Final = 8

AxisState = tuple[float, float, float, float, float, float, float, float]
"""Both angles (rad), angular velocities (rad/s), accelerations (rad/s2) and amplifier torques (N m) of the five-bar."""


def _settings(
    viscous: float, coulomb: float, load: float, driveline: AxisDriveline, step_s: float
) -> tuple[float, ...]:
    time_constant = driveline.torque_time_constant_s
    return (
        viscous,
        coulomb,
        driveline.brake_torque_Nm,
        driveline.torque_limit_Nm,
        exp(-0.5 * step_s / time_constant) if time_constant > 0.0 else 0.0,
        exp(-step_s / time_constant) if time_constant > 0.0 else 0.0,
        driveline.end_stop_minimum_rad,
        driveline.end_stop_maximum_rad,
        load,
    )


@kernel
def _smooth_acceleration(
    dynamics: Float,
    closure: int,
    theta2: float,
    theta5: float,
    omega2: float,
    omega5: float,
    torque2: float,
    torque5: float,
    viscous2: float,
    viscous5: float,
) -> tuple[float, float, float, float, float]:
    """(theta2'', theta5'', m11, m12, m22) with viscous but without dry friction."""
    m11, m12, m22, h1, h2 = mass_matrix_and_bias(dynamics, theta2, theta5, omega2, omega5, closure)
    b1 = torque2 - viscous2 * omega2 - h1
    b2 = torque5 - viscous5 * omega5 - h2
    determinant = m11 * m22 - m12 * m12
    return (m22 * b1 - m12 * b2) / determinant, (m11 * b2 - m12 * b1) / determinant, m11, m12, m22


@kernel
def advance_five_bar(
    state: Float,
    dynamics: Float,
    settings: Float,
    closure: int,
    singular_sine: float,
    step_s: float,
    substeps: int,
    command2: float,
    command5: float,
    brake2: bool,
    brake5: bool,
) -> tuple[float, float, float, float, float, float, float, float, int]:
    """Advance ``state`` (8 floats, see `AxisState`) by ``substeps`` steps of ``step_s`` in place.

    Returns the new state and the step within which the linkage tore, counted from 1; 0 while it is whole. A torn
    linkage is left standing where the step began.

    Each step: the amplifiers' lag exactly, the smooth motion by a classic Runge-Kutta step, then dry friction, brakes
    and end stops as an impulse (`sim_drive.friction`), the angles following by half a step of the change in velocity.
    """
    viscous2, viscous5 = settings[0, _VISCOUS], settings[1, _VISCOUS]
    half2, half5 = settings[0, _DECAY_HALF], settings[1, _DECAY_HALF]
    full2, full5 = settings[0, _DECAY], settings[1, _DECAY]
    command2 = min(max(command2, -settings[0, _LIMIT]), settings[0, _LIMIT])
    command5 = min(max(command5, -settings[1, _LIMIT]), settings[1, _LIMIT])
    friction2 = settings[0, _COULOMB] + (settings[0, _BRAKE] if brake2 else 0.0)
    friction5 = settings[1, _COULOMB] + (settings[1, _BRAKE] if brake5 else 0.0)

    x2, x5, v2, v5 = state[0], state[1], state[2], state[3]
    a2, a5, torque2, torque5 = state[4], state[5], state[6], state[7]
    half = 0.5 * step_s
    sixth = step_s / 6.0
    torn = 0
    for step in range(substeps):
        if full2 == 0.0:
            torque2 = command2
        if full5 == 0.0:
            torque5 = command5
        middle2 = command2 + (torque2 - command2) * half2
        middle5 = command5 + (torque5 - command5) * half5
        end2 = command2 + (torque2 - command2) * full2
        end5 = command5 + (torque5 - command5) * full5

        worst = abs(linkage_sine(dynamics, x2, x5, closure))
        p2, p5, _, _, _ = _smooth_acceleration(dynamics, closure, x2, x5, v2, v5, torque2, torque5, viscous2, viscous5)
        vb2, vb5 = v2 + half * p2, v5 + half * p5
        xb2, xb5 = x2 + half * v2, x5 + half * v5
        sine = abs(linkage_sine(dynamics, xb2, xb5, closure))
        worst = sine if sine < worst else worst
        q2, q5, _, _, _ = _smooth_acceleration(
            dynamics, closure, xb2, xb5, vb2, vb5, middle2, middle5, viscous2, viscous5
        )
        vc2, vc5 = v2 + half * q2, v5 + half * q5
        xc2, xc5 = x2 + half * vb2, x5 + half * vb5
        sine = abs(linkage_sine(dynamics, xc2, xc5, closure))
        worst = sine if sine < worst else worst
        r2, r5, _, _, _ = _smooth_acceleration(
            dynamics, closure, xc2, xc5, vc2, vc5, middle2, middle5, viscous2, viscous5
        )
        vd2, vd5 = v2 + step_s * r2, v5 + step_s * r5
        xd2, xd5 = x2 + step_s * vc2, x5 + step_s * vc5
        sine = abs(linkage_sine(dynamics, xd2, xd5, closure))
        worst = sine if sine < worst else worst
        s2, s5, m11, m12, m22 = _smooth_acceleration(
            dynamics, closure, xd2, xd5, vd2, vd5, end2, end5, viscous2, viscous5
        )
        # A stage in which the linkage does not close is NaN, and so is every stage that follows it.
        if not worst >= singular_sine or isnan(s2) or isnan(s5):
            torn = step + 1
            v2 = v5 = a2 = a5 = torque2 = torque5 = 0.0
            break
        y2 = x2 + sixth * (v2 + 2.0 * (vb2 + vc2) + vd2)
        y5 = x5 + sixth * (v5 + 2.0 * (vb5 + vc5) + vd5)
        w2 = v2 + sixth * (p2 + 2.0 * (q2 + r2) + s2)
        w5 = v5 + sixth * (p5 + 2.0 * (q5 + r5) + s5)

        # The mass matrix of the last stage stands for the one at the end of the step: they differ in third order.
        least2, greatest2 = impulse_bounds(
            y2, friction2 * step_s, settings[0, _STOP_MINIMUM], settings[0, _STOP_MAXIMUM]
        )
        least5, greatest5 = impulse_bounds(
            y5, friction5 * step_s, settings[1, _STOP_MINIMUM], settings[1, _STOP_MAXIMUM]
        )
        u2, u5 = velocities_after_impulse(m11, m12, m22, w2, w5, least2, greatest2, least5, greatest5)
        # An axis that stood and still stands has not moved: anything else would let it creep as its load varies.
        if not (v2 == 0.0 and u2 == 0.0):
            x2 = y2 + half * (u2 - w2)
        if not (v5 == 0.0 and u5 == 0.0):
            x5 = y5 + half * (u5 - w5)
        x2 = min(max(x2, settings[0, _STOP_MINIMUM]), settings[0, _STOP_MAXIMUM])
        x5 = min(max(x5, settings[1, _STOP_MINIMUM]), settings[1, _STOP_MAXIMUM])
        a2, a5 = (u2 - v2) / step_s, (u5 - v5) / step_s
        v2, v5 = u2, u5
        torque2, torque5 = end2, end5
    state[0], state[1], state[2], state[3] = x2, x5, v2, v5
    state[4], state[5], state[6], state[7] = a2, a5, torque2, torque5
    return x2, x5, v2, v5, a2, a5, torque2, torque5, torn


@kernel
def advance_free_axis(
    inertia: float,
    settings: Float,
    axis: int,
    step_s: float,
    substeps: int,
    x: float,
    v: float,
    torque: float,
    command: float,
    brake: bool,
) -> tuple[float, float, float, float]:
    """(angle, velocity, acceleration, torque) of one uncoupled axis after ``substeps`` steps; as `advance_five_bar`."""
    viscous = settings[axis, _VISCOUS]
    load = settings[axis, _LOAD]
    decay_half, decay = settings[axis, _DECAY_HALF], settings[axis, _DECAY]
    stop_minimum, stop_maximum = settings[axis, _STOP_MINIMUM], settings[axis, _STOP_MAXIMUM]
    command = min(max(command, -settings[axis, _LIMIT]), settings[axis, _LIMIT])
    friction_impulse = (settings[axis, _COULOMB] + (settings[axis, _BRAKE] if brake else 0.0)) * step_s
    half = 0.5 * step_s
    sixth = step_s / 6.0
    a = 0.0
    for _ in range(substeps):
        if decay == 0.0:
            torque = command
        middle = command + (torque - command) * decay_half
        end = command + (torque - command) * decay
        p = (torque - load - viscous * v) / inertia
        vb = v + half * p
        q = (middle - load - viscous * vb) / inertia
        vc = v + half * q
        r = (middle - load - viscous * vc) / inertia
        vd = v + step_s * r
        s = (end - load - viscous * vd) / inertia
        y = x + sixth * (v + 2.0 * (vb + vc) + vd)
        w = v + sixth * (p + 2.0 * (q + r) + s)
        least, greatest = impulse_bounds(y, friction_impulse, stop_minimum, stop_maximum)
        u = velocity_after_impulse(inertia, w, least, greatest)
        if not (v == 0.0 and u == 0.0):
            x = y + half * (u - w)
        x = min(max(x, stop_minimum), stop_maximum)
        a = (u - v) / step_s
        v = u
        torque = end
    return x, v, a, torque


class CoupledPlant:
    """The five-bar with both motors: two axes, 0 the CV axis (theta2), 1 the servo axis (theta5).

    Where the linkage comes near a singular position, or would have to open, it tears: the plant records the time,
    stands still from then on and ignores its torques. What a torn machine does is not modelled; it has to be seen, not
    survived.

    Raises ValueError where the linkage is singular, or does not close, at the initial angles (rad).
    """

    __slots__ = (
        "_constants",
        "_dynamics",
        "_settings",
        "_state",
        "_step_s",
        "_steps",
        "_torn_at_s",
        "_values",
        "parameters",
    )

    def __init__(self, parameters: PlantParameters, theta2_rad: float, theta5_rad: float) -> None:
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
                _settings(viscous, coulomb, 0.0, axis, self._step_s)
                for viscous, coulomb, axis in zip(
                    dynamics.viscous_N_m_s, dynamics.coulomb_N_m, parameters.axes, strict=True
                )
            ]
        )
        self._values: AxisState = (theta2_rad, theta5_rad, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        self._state = np.array(self._values)
        self._steps = 0
        self._torn_at_s: float | None = None
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
    def axis_count(self) -> int:
        """Two: the CV axis and the servo axis."""
        return 2

    @property
    def torn_at_s(self) -> float | None:
        """Plant time (s) at which the linkage tore, None while it is whole."""
        return self._torn_at_s

    @property
    def time_s(self) -> float:
        """Plant time: servo periods advanced so far, in seconds."""
        return self._steps * SERVO_PERIOD_S

    @property
    def kernel_arguments(self) -> tuple[Float, Float, int, float, float, int]:
        """What `advance_five_bar` is called with between the state and the commands."""
        return self._constants

    @property
    def state(self) -> AxisState:
        """theta2, theta5, their velocities and accelerations, and both amplifier torques (rad, s, N m)."""
        return self._values

    def set_motion(self, theta: tuple[float, float], omega: tuple[float, float]) -> None:
        """Put the axes at angles (rad) and velocities (rad/s), without torque, for tests and diagnosis."""
        self._values = (*theta, *omega, 0.0, 0.0, 0.0, 0.0)
        self._state[:] = self._values
        self._torn_at_s = None

    def advance(self, torque_commands_Nm: Sequence[float], brakes_engaged: Sequence[bool]) -> None:
        """One servo period (1/1024 s) under constant torque commands (N m) for the CV and the servo axis."""
        self._steps += 1
        if self._torn_at_s is not None:
            return
        command2, command5 = torque_commands_Nm
        brake2, brake5 = brakes_engaged
        after = advance_five_bar(self._state, *self._constants, command2, command5, brake2, brake5)
        self._values = after[:8]
        torn = after[8]
        if torn:
            self._torn_at_s = (self._steps - 1) * SERVO_PERIOD_S + torn * self._step_s

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

    def energy(self) -> float:
        """Kinetic and potential energy in J."""
        x2, x5, v2, v5 = self._values[:4]
        kinetic, potential = energy(self._dynamics, x2, x5, v2, v5, int(self.parameters.closure))
        return kinetic + potential

    def linkage_sine(self) -> float:
        """sin(theta3 - theta4): how far the linkage is from a singular position (0)."""
        return linkage_sine(self._dynamics, self._values[0], self._values[1], int(self.parameters.closure))


class FreeAxisPlant:
    """Any number of axes that are coupled to nothing, with the same amplifiers, friction, brakes and end stops."""

    __slots__ = ("_accelerations", "_angles", "_settings", "_step_s", "_substeps", "_torques", "_velocities", "axes")

    def __init__(
        self,
        axes: Sequence[FreeAxisParameters],
        angles_rad: Sequence[float],
        substeps: int = DEFAULT_SUBSTEPS,
    ) -> None:
        if len(axes) != len(angles_rad):
            raise ValueError(f"{len(angles_rad)} initial angles for {len(axes)} axes")
        if not 1 <= substeps <= 64:
            raise ValueError(f"substeps = {substeps!r}, must be 1 to 64")
        self.axes = tuple(axes)
        self._substeps = substeps
        self._step_s = SERVO_PERIOD_S / substeps
        self._settings = np.array(
            [_settings(a.viscous_N_m_s, a.coulomb_N_m, a.load_torque_Nm, a.driveline, self._step_s) for a in axes]
        ).reshape(len(axes), _SETTING_COUNT)
        self._angles = [float(angle) for angle in angles_rad]
        self._velocities = [0.0] * len(axes)
        self._accelerations = [0.0] * len(axes)
        self._torques = [0.0] * len(axes)
        for axis in range(len(axes)):
            self._run(axis, 0.0, False)

    def _run(self, axis: int, command: float, brake: bool) -> tuple[float, float, float, float]:
        return advance_free_axis(
            self.axes[axis].inertia_kg_m2,
            self._settings,
            axis,
            self._step_s,
            self._substeps,
            self._angles[axis],
            self._velocities[axis],
            self._torques[axis],
            command,
            brake,
        )

    @property
    def axis_count(self) -> int:
        """Number of axes."""
        return len(self.axes)

    @property
    def torn_at_s(self) -> None:
        """Always None: there is no linkage to tear."""
        return None

    def advance(self, torque_commands_Nm: Sequence[float], brakes_engaged: Sequence[bool]) -> None:
        """One servo period (1/1024 s) under constant torque commands (N m), one of each an axis."""
        for axis in range(len(self.axes)):
            (
                self._angles[axis],
                self._velocities[axis],
                self._accelerations[axis],
                self._torques[axis],
            ) = self._run(axis, torque_commands_Nm[axis], brakes_engaged[axis])

    def angle(self, axis: int, offset_s: float = 0.0) -> float:
        """Angle in rad, ``offset_s`` after the last servo period (constant acceleration)."""
        return self._angles[axis] + offset_s * (self._velocities[axis] + 0.5 * offset_s * self._accelerations[axis])

    def velocity(self, axis: int, offset_s: float = 0.0) -> float:
        """Angular velocity in rad/s, ``offset_s`` after the last servo period (constant acceleration)."""
        return self._velocities[axis] + offset_s * self._accelerations[axis]

    def torque(self, axis: int) -> float:
        """Torque of the amplifier in N m at the end of the last servo period."""
        return self._torques[axis]

    def energy(self) -> float:
        """Kinetic energy in J."""
        return sum(
            0.5 * axis.inertia_kg_m2 * velocity * velocity
            for axis, velocity in zip(self.axes, self._velocities, strict=True)
        )
