"""One axis of the emulated machine, between a drive's axis and the plant's: resolver, scaling and servo loop."""

from dataclasses import dataclass
from math import floor, isfinite, pi, sin
from random import Random
from typing import Final

from sim_drive.machine_seam import AxisTap, DriveAxis, Latch
from sim_drive.physics.driveline import SERVO_PERIOD_S
from sim_drive.physics.plant import Plant
from sim_drive.physics.servo import SERVO_RATE_HZ, DemandResolution, ServoLoop

LINKAGE_TORN_ERROR_CODE: Final = 0xFF10
"""EMCY error code of a drive whose linkage has torn: of the device-specific range FF00h to FFFFh (CiA 301, 7.2.7.1)."""
LINKAGE_TORN_REGISTER_BITS: Final = 0x81
"""Generic and manufacturer-specific error (CiA 301, object error register)."""


@dataclass(frozen=True, slots=True)
class MachineAxis:
    """Resolver and scaling of one axis.

    ``torque_per_volt`` in N m / V is the amplifier's; ``rated_torque_Nm`` is what 1000 per mille are;
    ``resolver_noise_counts`` the standard deviation of the resolver's noise before it is quantised, 0 for none;
    ``output_delay_periods``: 1 where the controller's output acts one servo period after the position it was made from,
    as in a drive that computes in between, 0 where it acts at once; ``resolver_eccentricity_counts``: amplitude of an
    error once a revolution, of a rotor that does not run true, which passes zero rising at
    ``resolver_eccentricity_rad``.

    Raises ValueError where a value is out of its bounds.
    """

    counts_per_revolution: int = 4096
    torque_per_volt: float = 0.45
    rated_torque_Nm: float = 1.0
    resolver_noise_counts: float = 0.0
    demand_resolution: DemandResolution = DemandResolution.UNROUNDED_DIFFERENCE
    output_delay_periods: int = 0
    resolver_eccentricity_counts: float = 0.0
    resolver_eccentricity_rad: float = 0.0

    def __post_init__(self) -> None:
        if self.counts_per_revolution < 1:
            raise ValueError(f"counts_per_revolution = {self.counts_per_revolution!r}, must be 1 or more")
        for name, value in (("torque_per_volt", self.torque_per_volt), ("rated_torque_Nm", self.rated_torque_Nm)):
            if not (isfinite(value) and value > 0.0):
                raise ValueError(f"{name} = {value!r}, must be finite and positive")
        for name, value in (
            ("resolver_noise_counts", self.resolver_noise_counts),
            ("resolver_eccentricity_counts", self.resolver_eccentricity_counts),
        ):
            if not (isfinite(value) and value >= 0.0):
                raise ValueError(f"{name} = {value!r}, must be finite and zero or more")
        if self.output_delay_periods not in (0, 1):
            raise ValueError(f"output_delay_periods = {self.output_delay_periods!r}, must be 0 or 1")


class Motor:
    """One axis of the machine between a drive's axis and the plant's: resolver, scaling and servo loop.

    `run` is its servo tick. An axis that is not powered gets no torque, and its servo loop starts anew, without a jump,
    when it is. ``tap`` may stand between it and its drive's axis (`put_tap`).
    """

    __slots__ = (
        "_counts_per_rad",
        "_eccentricity",
        "_has_tripped",
        "_is_plain",
        "_is_powered",
        "_noise",
        "_noise_source",
        "_permille_per_Nm",
        "_steps",
        "_tap",
        "_ticked_at_ns",
        "axis",
        "counts",
        "delayed_torque",
        "drive_axis",
        "index",
        "is_braked",
        "servo",
    )

    def __init__(
        self, index: int, drive_axis: DriveAxis, axis: MachineAxis, plant: Plant, noise_source: Random, start_ns: int
    ) -> None:
        """``index``: of the plant's axis; ``noise_source`` is asked once a tick if the resolver has noise."""
        self.index = index
        self.drive_axis = drive_axis
        self.axis = axis
        self.servo = ServoLoop(axis.demand_resolution)
        self._noise_source = noise_source
        self._counts_per_rad = axis.counts_per_revolution / (2.0 * pi)
        self._permille_per_Nm = 1000.0 / axis.rated_torque_Nm
        self._noise = 0.0
        self._eccentricity = axis.resolver_eccentricity_counts
        self._steps = (0, 0, 0)
        """Counts gone in each of the last servo periods."""
        self._is_powered = False
        self._has_tripped = False
        self.delayed_torque = 0.0
        """Torque command of the last servo tick, with an output delay."""
        self.is_braked = True
        """Whether the holding brake holds."""
        self._tap: AxisTap | None = None
        self._is_plain = not self._eccentricity
        """Whether the resolver shows no more than the angle and its noise."""
        self._ticked_at_ns = start_ns
        self.counts = self.quantise(plant.angle(index))
        """What the resolver has shown at the last servo tick."""
        drive_axis.measure_by(self._latch_of(plant))

    def put_tap(self, tap: AxisTap) -> None:
        """Put ``tap`` between the axis and its motor, for good."""
        self._tap = tap
        self._is_plain = False

    def quantise(self, angle_rad: float) -> int:
        """What the resolver shows at this angle."""
        reading = angle_rad * self._counts_per_rad + self._noise + 0.5
        if self._eccentricity:
            reading += self._eccentricity * sin(angle_rad - self.axis.resolver_eccentricity_rad)
        counts = floor(reading)
        return counts if self._tap is None else self._tap.show(counts)

    def run(self, now_ns: int, angle: float) -> float:
        """Show the axis its resolver at ``angle`` (rad); gives the torque (N m) for the coming servo period."""
        self._ticked_at_ns = now_ns
        drive_axis = self.drive_axis
        axis = self.axis
        if axis.resolver_noise_counts > 0.0:
            self._noise = self._noise_source.gauss(0.0, axis.resolver_noise_counts)
        tap = self._tap
        plain = angle * self._counts_per_rad + self._noise + 0.5
        counts = floor(plain) if self._is_plain else self.quantise(angle)
        _, before, last = self._steps
        self._steps = (before, last, counts - self.counts)
        self.counts = counts
        drive_axis.on_tick(now_ns, counts)
        self.is_braked = not drive_axis.is_brake_released and (tap is None or not tap.is_brake_broken)
        if not drive_axis.is_powered:
            self._is_powered = False
            self.delayed_torque = 0.0
            return 0.0
        demand = drive_axis.position_demand_counts
        if not self._is_powered:
            self._power_on(demand, now_ns)
        torque = None if drive_axis.torque_demand is None else drive_axis.torque_demand_Nm
        if torque is None:
            torque = self.servo.update(
                demand,
                counts,
                drive_axis.gains,
                drive_axis.torque_offset_Nm,
                axis.torque_per_volt,
                drive_axis.torque_limit_Nm,
                drive_axis.negative_torque_limit_Nm,
                drive_axis.velocity_offset,
            )
        else:
            # The controller is to start without a bump when it gets the axis back.
            self.servo.reset(demand, counts)
        if axis.output_delay_periods:
            torque, self.delayed_torque = self.delayed_torque, torque
        return torque

    def _median_step(self) -> int:
        """Of the last three servo periods: a single leap of the resolver is not taken for a velocity."""
        first, second, third = self._steps
        return max(min(first, second), min(max(first, second), third))

    def _power_on(self, demand_counts: float, now_ns: int) -> None:
        """The drive has switched its amplifier on since the tick before."""
        self._is_powered = True
        self.servo.reset(demand_counts, self.counts)
        if self._has_tripped:
            # Neither a fault reset nor switching the drive off and on mends a torn linkage.
            self.trip(now_ns)

    def trip(self, now_ns: int) -> None:
        """The linkage is torn: the drive's axis faults, and faults again whenever it is switched on."""
        self._has_tripped = True
        self.drive_axis.trip(LINKAGE_TORN_ERROR_CODE, LINKAGE_TORN_REGISTER_BITS, now_ns, persists=True)

    def _latch_of(self, plant: Plant) -> Latch:
        index = self.index
        angle = plant.angle
        torque = plant.torque

        def latch(now_ns: int) -> tuple[int, float, int]:
            offset_s = (now_ns - self._ticked_at_ns) * 1e-9
            if offset_s < 0.0:
                offset_s = 0.0
            elif offset_s > SERVO_PERIOD_S:
                offset_s = SERVO_PERIOD_S
            radians = angle(index, offset_s)
            return (
                floor(radians * self._counts_per_rad + self._noise + 0.5) if self._is_plain else self.quantise(radians),
                float(self._median_step() * SERVO_RATE_HZ),
                floor(torque(index) * self._permille_per_Nm + 0.5),
            )

        return latch
