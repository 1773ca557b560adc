"""Axes that are coupled to nothing: a plant for drives without a configured machine, and for tests in closed form."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import isfinite

import numpy as np
from numpy.typing import NDArray

from mechanism.jit import kernel
from sim_drive.physics.driveline import (
    DEFAULT_SUBSTEPS,
    DRY_HEAT,
    ENERGY_COUNT,
    LOAD,
    SERVO_PERIOD_S,
    SETTING_COUNT,
    STOP_MAXIMUM,
    STOP_MINIMUM,
    VISCOUS_HEAT,
    AxisDriveline,
    AxisEnergy,
    axis_settings,
    count_motor,
    dry_friction,
    energy_of,
    require_substeps,
    smooth_resistance,
    torques_of_step,
    within_limit,
)
from sim_drive.physics.friction import impulse_bounds, velocity_after_impulse

Float = NDArray[np.float64]


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
    energies: Float,
) -> tuple[float, float, float, float]:
    """(angle, velocity, acceleration, torque) of one uncoupled axis after ``substeps`` steps; as `advance_five_bar`.

    Its energies are added to the row ``axis`` of ``energies``, whose columns are those of `driveline`.
    """
    load = settings[axis, LOAD]
    stop_minimum, stop_maximum = settings[axis, STOP_MINIMUM], settings[axis, STOP_MAXIMUM]
    wanted = within_limit(settings, axis, command)
    half = 0.5 * step_s
    sixth = step_s / 6.0
    a = 0.0
    for _ in range(substeps):
        torque, middle, end = torques_of_step(settings, axis, wanted, torque, v)
        f = smooth_resistance(settings, axis, v)
        p = (torque - load - f) / inertia
        vb = v + half * p
        fb = smooth_resistance(settings, axis, vb)
        q = (middle - load - fb) / inertia
        vc = v + half * q
        fc = smooth_resistance(settings, axis, vc)
        r = (middle - load - fc) / inertia
        vd = v + step_s * r
        fd = smooth_resistance(settings, axis, vd)
        s = (end - load - fd) / inertia
        y = x + sixth * (v + 2.0 * (vb + vc) + vd)
        w = v + sixth * (p + 2.0 * (q + r) + s)
        least, greatest = impulse_bounds(y, dry_friction(settings, axis, v, brake) * step_s, stop_minimum, stop_maximum)
        u = velocity_after_impulse(inertia, w, least, greatest)
        d = u - w
        work = sixth * (torque * v + 2.0 * middle * (vb + vc) + end * vd) + half * end * d
        count_motor(energies[axis], 0, settings, axis, step_s, torque, middle, end, work)
        energies[axis, VISCOUS_HEAT] += sixth * (f * v + 2.0 * (fb * vb + fc * vc) + fd * vd) + half * fd * d
        energies[axis, DRY_HEAT] -= 0.5 * inertia * d * (v + u)
        if not (v == 0.0 and u == 0.0):
            x = y + half * d
        x = min(max(x, stop_minimum), stop_maximum)
        a = (u - v) / step_s
        v = u
        torque = end
    return x, v, a, torque


class FreeAxisPlant:
    """Any number of axes that are coupled to nothing, with the same amplifiers, friction, brakes and end stops."""

    __slots__ = (
        "_accelerations",
        "_angles",
        "_energies",
        "_settings",
        "_step_s",
        "_steps",
        "_substeps",
        "_torques",
        "_velocities",
        "axes",
    )

    def __init__(
        self,
        axes: Sequence[FreeAxisParameters],
        angles_rad: Sequence[float],
        substeps: int = DEFAULT_SUBSTEPS,
    ) -> None:
        if len(axes) != len(angles_rad):
            raise ValueError(f"{len(angles_rad)} initial angles for {len(axes)} axes")
        require_substeps(substeps)
        self.axes = tuple(axes)
        self._substeps = substeps
        self._step_s = SERVO_PERIOD_S / substeps
        self._settings = np.array(
            [axis_settings(a.viscous_N_m_s, a.coulomb_N_m, a.load_torque_Nm, a.driveline, self._step_s) for a in axes]
        ).reshape(len(axes), SETTING_COUNT)
        self._angles = [float(angle) for angle in angles_rad]
        self._velocities = [0.0] * len(axes)
        self._accelerations = [0.0] * len(axes)
        self._torques = [0.0] * len(axes)
        self._energies = np.zeros((len(axes), ENERGY_COUNT))
        self._steps = 0
        # Compiled here rather than in the first servo period, where it would make a real-time host seconds late.
        for axis in range(len(axes)):
            self._run(axis, 0.0, True)
        self._energies[:] = 0.0

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
            self._energies,
        )

    @property
    def axis_count(self) -> int:
        """Number of axes."""
        return len(self.axes)

    @property
    def torn_at_s(self) -> None:
        """Always None: there is no linkage to tear."""
        return None

    @property
    def angles(self) -> Sequence[float]:
        """Angles in rad at the end of the last servo period."""
        return self._angles

    def advance(self, torque_commands_Nm: Sequence[float], brakes_engaged: Sequence[bool]) -> None:
        """One servo period (1/1024 s) under constant torque commands (N m), one of each an axis."""
        self._steps += 1
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

    def axis_energy(self, axis: int) -> AxisEnergy:
        """What an axis has drawn, done and lost so far."""
        counted: list[float] = self._energies[axis].tolist()
        return energy_of(counted, self.axes[axis].driveline.motor, self._steps * SERVO_PERIOD_S)
