"""What sits between an axis' torque command and its link: amplifier, motor, friction, brake and end stops.

Also the flat array in which the plants' kernels have all of it, and the energies that they count on the way.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import exp, inf, isfinite, tanh
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mechanism.jit import kernel
from sim_drive.physics.servo import SERVO_RATE_HZ

Float = NDArray[np.float64]

SERVO_PERIOD_S: Final = 1.0 / SERVO_RATE_HZ
DEFAULT_SUBSTEPS: Final = 4
MAX_SUBSTEPS: Final = 100

# Layout of the settings of an axis; kernels see these as compile-time constants.
SETTING_COUNT: Final = 15
VISCOUS: Final = 0
COULOMB: Final = 1
BRAKE: Final = 2
LIMIT: Final = 3
DECAY_HALF: Final = 4
DECAY: Final = 5
STOP_MINIMUM: Final = 6
STOP_MAXIMUM: Final = 7
LOAD: Final = 8
BREAKAWAY: Final = 9
SMOOTHING: Final = 10
TORQUE_CONSTANT: Final = 11
RESISTANCE: Final = 12
SUPPLY: Final = 13
REGENERATION: Final = 14

# Layout of the energies of an axis.
ENERGY_COUNT: Final = 5
SHAFT: Final = 0
COPPER: Final = 1
DRAWN: Final = 2
VISCOUS_HEAT: Final = 3
DRY_HEAT: Final = 4


@dataclass(frozen=True, slots=True)
class MotorParameters:
    """The electrical side of motor and amplifier.

    ``torque_constant_Nm_per_A`` is the back-EMF constant in V s/rad too. The amplifier can put ``supply_voltage_V`` on
    the motor, either way: what is left of it after the back-EMF drives the current through ``resistance_ohm`` and so
    bounds the torque; inf for no such bound. ``regeneration``: the share of braking power that the supply takes back,
    the rest is turned to heat in a brake chopper. ``idle_W`` is drawn as long as the amplifier has its supply.

    Raises ValueError where a value is out of its bounds.
    """

    torque_constant_Nm_per_A: float = 0.45
    resistance_ohm: float = 1.0
    supply_voltage_V: float = inf
    regeneration: float = 0.0
    idle_W: float = 0.0

    def __post_init__(self) -> None:
        for name, value in (
            ("torque_constant_Nm_per_A", self.torque_constant_Nm_per_A),
            ("resistance_ohm", self.resistance_ohm),
        ):
            if not (isfinite(value) and value > 0.0):
                raise ValueError(f"{name} = {value!r}, must be finite and positive")
        if not self.supply_voltage_V > 0.0:
            raise ValueError(f"supply_voltage_V = {self.supply_voltage_V!r}, must be positive")
        if not 0.0 <= self.regeneration <= 1.0:
            raise ValueError(f"regeneration = {self.regeneration!r}, must be 0 to 1")
        if not (isfinite(self.idle_W) and self.idle_W >= 0.0):
            raise ValueError(f"idle_W = {self.idle_W!r}, must be finite and zero or more")


@dataclass(frozen=True, slots=True)
class AxisDriveline:
    """Amplifier, motor, dry friction's law, holding brake and end stops of one axis.

    ``torque_limit_Nm``: what the amplifier can give, either way. ``torque_time_constant_s``: first-order lag from
    torque command to torque, 1 / (2 pi bandwidth) of the current loop, 0 for none. ``brake_torque_Nm``: what the
    engaged holding brake holds; it acts as Coulomb friction. End stops (rad) are fully inelastic.

    ``friction_smoothing_rad_per_s``: 0 for Coulomb friction that sticks; above 0 it is smoothed, and reaches tanh(1) =
    76 % at that velocity. ``breakaway_N_m``: what holds an axis that stands, where it is more than Coulomb friction.

    Raises ValueError where a value is negative or not finite, or the stops are reversed.
    """

    torque_limit_Nm: float = 4.5
    torque_time_constant_s: float = 0.001
    brake_torque_Nm: float = 2.0
    end_stop_minimum_rad: float = -inf
    end_stop_maximum_rad: float = inf
    friction_smoothing_rad_per_s: float = 0.0
    breakaway_N_m: float = 0.0
    motor: MotorParameters = field(default_factory=MotorParameters)

    def __post_init__(self) -> None:
        for name, value in (
            ("torque_limit_Nm", self.torque_limit_Nm),
            ("torque_time_constant_s", self.torque_time_constant_s),
            ("brake_torque_Nm", self.brake_torque_Nm),
            ("friction_smoothing_rad_per_s", self.friction_smoothing_rad_per_s),
            ("breakaway_N_m", self.breakaway_N_m),
        ):
            if not (isfinite(value) and value >= 0.0):
                raise ValueError(f"{name} = {value!r}, must be finite and zero or more")
        if not self.end_stop_minimum_rad < self.end_stop_maximum_rad:
            raise ValueError(
                f"end_stop_minimum_rad = {self.end_stop_minimum_rad!r} must be below"
                f" end_stop_maximum_rad = {self.end_stop_maximum_rad!r}"
            )


class AxisEnergy(NamedTuple):
    """Energies of one axis since the plant began, in J.

    ``shaft``: what the motor's torque has done; ``copper``: turned to heat in its winding; ``drawn``: from the supply
    with the idle draw, less what it has taken back; ``viscous_heat`` and ``dry_heat``: what friction, with brake and
    end stops, has taken; ``coupling_heat``: what a flexible coupling has.
    """

    shaft: float
    copper: float
    drawn: float
    viscous_heat: float
    dry_heat: float
    coupling_heat: float = 0.0


NO_ENERGY: Final = AxisEnergy(0.0, 0.0, 0.0, 0.0, 0.0)


def require_substeps(substeps: int) -> None:
    """Raises ValueError unless a servo period can be divided into so many steps."""
    if not 1 <= substeps <= MAX_SUBSTEPS:
        raise ValueError(f"substeps = {substeps!r}, must be 1 to {MAX_SUBSTEPS}")


def axis_settings(
    viscous_N_m_s: float, coulomb_N_m: float, load_torque_Nm: float, driveline: AxisDriveline, step_s: float
) -> tuple[float, ...]:
    """A row of the array that the kernels take, for steps of ``step_s``."""
    time_constant = driveline.torque_time_constant_s
    motor = driveline.motor
    is_smooth = driveline.friction_smoothing_rad_per_s > 0.0
    return (
        viscous_N_m_s,
        coulomb_N_m,
        driveline.brake_torque_Nm,
        driveline.torque_limit_Nm,
        exp(-0.5 * step_s / time_constant) if time_constant > 0.0 else 0.0,
        exp(-step_s / time_constant) if time_constant > 0.0 else 0.0,
        driveline.end_stop_minimum_rad,
        driveline.end_stop_maximum_rad,
        load_torque_Nm,
        0.0 if is_smooth else max(coulomb_N_m, driveline.breakaway_N_m),
        driveline.friction_smoothing_rad_per_s,
        motor.torque_constant_Nm_per_A,
        motor.resistance_ohm,
        motor.supply_voltage_V,
        motor.regeneration,
    )


def energy_of(
    counted: Sequence[float], motor: MotorParameters, time_s: float, coupling_heat: float = 0.0
) -> AxisEnergy:
    """The energies of an axis from what a kernel has counted (`ENERGY_COUNT` values) until plant time ``time_s``."""
    return AxisEnergy(
        counted[SHAFT],
        counted[COPPER],
        counted[DRAWN] + motor.idle_W * time_s,
        counted[VISCOUS_HEAT],
        counted[DRY_HEAT],
        coupling_heat,
    )


@kernel
def smooth_resistance(settings: Float, axis: int, omega: float) -> float:
    """Torque of the friction that is a function of velocity, N m, positive with positive velocity."""
    if settings[axis, SMOOTHING] > 0.0:
        return settings[axis, VISCOUS] * omega + settings[axis, COULOMB] * tanh(omega / settings[axis, SMOOTHING])
    return settings[axis, VISCOUS] * omega


@kernel
def dry_friction(settings: Float, axis: int, omega: float, brake: bool) -> float:
    """Torque (N m) up to which dry friction and brake resist at a velocity; smoothed friction has no share in it."""
    holding = settings[axis, BRAKE] if brake else 0.0
    if omega == 0.0:
        return settings[axis, BREAKAWAY] + holding
    if settings[axis, SMOOTHING] > 0.0:
        return holding
    return settings[axis, COULOMB] + holding


@kernel
def within_limit(settings: Float, axis: int, command: float) -> float:
    """The torque command (N m) that the amplifier's limit allows."""
    return min(max(command, -settings[axis, LIMIT]), settings[axis, LIMIT])


@kernel
def _within_voltage(settings: Float, axis: int, command: float, omega: float) -> float:
    """The torque command (N m) that the supply voltage allows at a velocity: what the back-EMF leaves, through R."""
    supply = settings[axis, SUPPLY]
    if supply == inf:
        return command
    constant = settings[axis, TORQUE_CONSTANT]
    back_emf = constant * omega
    scale = constant / settings[axis, RESISTANCE]
    return min(max(command, scale * (-supply - back_emf)), scale * (supply - back_emf))


@kernel
def torques_of_step(
    settings: Float, axis: int, wanted: float, torque: float, omega: float
) -> tuple[float, float, float]:
    """Torque (N m) of the amplifier at the start, in the middle and at the end of a step that begins at ``omega``.

    It lags behind the command ``wanted`` (`within_limit`), as far as the voltage allows that, from ``torque`` on; an
    amplifier without lag is there at once.
    """
    command = _within_voltage(settings, axis, wanted, omega)
    start = command if settings[axis, DECAY] == 0.0 else torque
    return (
        start,
        command + (start - command) * settings[axis, DECAY_HALF],
        command + (start - command) * settings[axis, DECAY],
    )


@kernel
def count_motor(
    energies: Float,
    first: int,
    settings: Float,
    axis: int,
    step_s: float,
    torque: float,
    middle: float,
    end: float,
    work: float,
) -> None:
    """Add a step's motor energies to ``energies`` from place ``first``: ``work`` (J) done, torques (N m) on the way."""
    scale = settings[axis, RESISTANCE] / (settings[axis, TORQUE_CONSTANT] * settings[axis, TORQUE_CONSTANT])
    copper = scale * (step_s / 6.0) * (torque * torque + 4.0 * middle * middle + end * end)
    drawn = work + copper
    energies[first + SHAFT] += work
    energies[first + COPPER] += copper
    energies[first + DRAWN] += drawn if drawn > 0.0 else settings[axis, REGENERATION] * drawn
