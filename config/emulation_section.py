"""What a configuration says of an emulated drive: gains of its controller, motor, amplifier, and what they move."""

import math
from enum import Enum
from typing import Annotated, Final, Self

from pydantic import Field, model_validator

from config.model import Model, NotNegative, Positive
from config.quirks import Quirk

MAX_DECAY_A_STEP: Final = 1.0
"""How far a decay may go in a step of the plant, as a multiple of its time constant."""
MAX_SWING_A_STEP: Final = 0.7
"""How far an oscillation may go in a step, rad: nine steps a period."""


class GainsSection(Model):
    """Gains of the paper's eq. (5), integers over 256 (eq. 6)."""

    K_P: Annotated[int, Field(ge=0, le=1_000_000)]
    K_I: Annotated[int, Field(ge=0, le=1_000_000)] = 0
    K_D: Annotated[int, Field(ge=0, le=1_000_000)] = 0
    K_V: Annotated[int, Field(ge=0, le=1_000_000)] = 0
    K_F: Annotated[int, Field(ge=0, le=1_000_000)] = 0


class SwitchesSection(Model):
    """Switches and index pulse of an emulated axis, by the angle of its link as the plant has it."""

    negative_limit_deg: float | None = None
    """On at and below; null for a switch that is not fitted."""
    positive_limit_deg: float | None = None
    """On at and above."""
    home_deg: tuple[float, float] | None = None
    """On from the first angle to the second."""
    index_deg: float = 0.0
    """The encoder's index pulse, once a revolution."""

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        low, high = self.negative_limit_deg, self.positive_limit_deg
        if low is not None and high is not None and low >= high:
            raise ValueError(f"negative_limit_deg: {low:g} is not below positive_limit_deg: {high:g}")
        if self.home_deg is not None and self.home_deg[0] >= self.home_deg[1]:
            raise ValueError(f"home_deg: {self.home_deg[0]:g} is not below {self.home_deg[1]:g}")
        return self


class FrictionLaw(Enum):
    """What dry friction does around standstill."""

    STICK_SLIP = "stick_slip"
    """It holds an axis that stands, exactly."""
    SMOOTHED = "smoothed"
    """It is a steep function of velocity, and an axis under load creeps."""


class DemandRounding(Enum):
    """Where the position controller rounds its demand to counts; see `sim_drive.physics.servo.DemandResolution`."""

    COUNTS = "counts"
    """In the error and in the difference that K_F multiplies: the paper's eq. (5) to the letter."""
    UNROUNDED_DIFFERENCE = "unrounded_difference"
    """In the error alone."""
    UNROUNDED = "unrounded"
    """Nowhere."""


class MotorSection(Model):
    """The electrical side of motor and amplifier: what it draws, and what bounds the torque at speed."""

    torque_constant_Nm_per_A: Positive = 0.45
    """The back-EMF constant in V s/rad too."""
    resistance_ohm: Positive = 1.5
    supply_voltage_V: Positive | None = None
    """What the amplifier can put on the motor, either way; null for as much as it takes."""
    regeneration: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    """Share of braking power that the supply takes back; the rest is heat in a brake chopper."""
    idle_W: NotNegative = 0.0
    """What the amplifier draws as long as it has its supply."""


class CouplingSection(Model):
    """A flexible coupling between motor and link; the resolver, friction and the brake are on the motor's side."""

    stiffness_Nm_per_rad: Positive
    damping_Nms_per_rad: NotNegative = 0.0
    backlash_deg: Annotated[float, Field(ge=0.0, le=45.0)] = 0.0
    """Play, from one end to the other."""
    link_side_inertia_kgm2: Positive = 2e-5
    """The coupling's half on the link; ``inertia_kgm2`` is then what turns with the motor."""


class EmulatedDriveSection(Model):
    """Motor and amplifier of the emulated drive; a gateway against real drives does not read it."""

    gains: GainsSection
    torque_per_volt_Nm: Positive
    torque_time_constant_s: Annotated[float, Field(ge=1e-5, le=1.0)]
    """1 / (2 pi bandwidth) of the current loop."""
    torque_limit_Nm: Positive
    inertia_kgm2: Positive
    coulomb_Nm: NotNegative = 0.0
    viscous_Nms: NotNegative = 0.0
    friction_law: FrictionLaw = FrictionLaw.STICK_SLIP
    friction_smoothing_rad_per_s: Annotated[float, Field(ge=1e-4, le=100.0)] = 0.05
    """Smoothed friction reaches tanh(1) = 76 % at this velocity."""
    breakaway_Nm: NotNegative = 0.0
    """What holds an axis that stands, where that is more than ``coulomb_Nm``; with stick_slip alone."""
    brake_torque_Nm: NotNegative
    motor: MotorSection = MotorSection()
    coupling: CouplingSection | None = None
    """null for a motor that sits on its link rigidly."""
    resolver_noise_counts: Annotated[float, Field(ge=0.0, le=1000.0)] = 0.0
    resolver_eccentricity_counts: Annotated[float, Field(ge=0.0, le=1000.0)] = 0.0
    """Amplitude of an error once a revolution, of a rotor that does not run true."""
    resolver_eccentricity_deg: float = 0.0
    """Angle at which that error passes zero, rising."""
    demand_rounding: DemandRounding = DemandRounding.UNROUNDED_DIFFERENCE
    output_delay_periods: Annotated[int, Field(ge=0, le=1)] = 0
    """Servo periods (1/1024 s) between the position and the output that the controller makes of it."""
    switches: SwitchesSection = SwitchesSection()
    quirks: frozenset[Quirk] = frozenset()
    """Habits of real drives that the emulated one is to have."""

    def check_steps(self, key: str, link_inertia_kgm2: float, step_s: float) -> None:
        """Raise ValueError where the plant's steps of ``step_s`` cannot follow what the axis does by itself.

        ``link_inertia_kgm2``: of its link alone about its pivot, which is the least that it has in any position.
        """
        coupling = self.coupling
        inertia = self.inertia_kgm2 + (link_inertia_kgm2 if coupling is None else 0.0)
        slope = self.viscous_Nms
        friction_key = f"{key}.viscous_Nms: {self.viscous_Nms:g}"
        if self.friction_law is FrictionLaw.SMOOTHED:
            slope += self.coulomb_Nm / self.friction_smoothing_rad_per_s
            friction_key = f"{key}.friction_smoothing_rad_per_s: {self.friction_smoothing_rad_per_s:g}"
        _require_steps(friction_key, "stops the axis", slope / inertia, step_s, MAX_DECAY_A_STEP)
        if coupling is None:
            return
        mobility = 1.0 / self.inertia_kgm2 + 1.0 / (link_inertia_kgm2 + coupling.link_side_inertia_kgm2)
        _require_steps(
            f"{key}.coupling.damping_Nms_per_rad: {coupling.damping_Nms_per_rad:g}",
            "stops the motor against its link",
            coupling.damping_Nms_per_rad * mobility,
            step_s,
            MAX_DECAY_A_STEP,
        )
        rate = math.sqrt(coupling.stiffness_Nm_per_rad * mobility)
        _require_steps(
            f"{key}.coupling.stiffness_Nm_per_rad: {coupling.stiffness_Nm_per_rad:g}",
            f"makes the motor swing at {rate / (2.0 * math.pi):.0f} Hz against its link",
            rate,
            step_s,
            MAX_SWING_A_STEP,
        )


def _require_steps(what: str, effect: str, rate: float, step_s: float, bound: float) -> None:
    if rate * step_s > bound:
        times = rate * step_s / bound
        raise ValueError(
            f"{what} {effect} too fast for steps of {step_s * 1e6:.0f} us (bound {bound / rate * 1e6:.3g} us), "
            f"emulator.sub_steps would have to be {math.ceil(times)} times as many"
        )
