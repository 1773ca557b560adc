"""What an axis and its modes share: the position demand, the two frames of counts, set-points in time, and limits.

Two frames meet here. The *shaft* frame is what the resolver counts since power-on; the *user* frame is that of the
60xxh objects: user = shaft + offset, as INTEGER32 with wrap, the shaft's counts being brought to user units first
(`sim_drive.device.scaling`; by default they are the same). Homing moves the offset, never the demand in shaft counts.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from enum import IntEnum, unique
from math import floor
from typing import Final

from drivers import objects
from sim_drive.communication.dictionary import Entry, LiveDictionary
from sim_drive.device.cia402 import STOP_RAMPS, Statusword, StopRamp
from sim_drive.device.demand import Demand
from sim_drive.device.scaling import IDENTITY, make_scaling
from sim_drive.logical_axes import of_axis
from sim_drive.settings import DriveSettings
from sim_drive.switches import DigitalInput

Latch = Callable[[int], tuple[int, float, int]]
"""Gives shaft position (counts), velocity (counts/s) and torque (per mille of rated torque) as of an instant in ns."""

_WRAP: Final = 1 << 32
_HALF: Final = 1 << 31
_S_PER_NS: Final = 1e-9
_TWO_TICKS_S: Final = 0.002
"""Room for the servo tick at which braking is found to be due, and the one before it."""
_LIMIT_SWITCHES: Final = int(DigitalInput.NEGATIVE_LIMIT | DigitalInput.POSITIVE_LIMIT)
_LIMITED: Final = int(Statusword.INTERNAL_LIMIT_ACTIVE)


def wrap_int32(value: int) -> int:
    """``value`` modulo 2^32 as INTEGER32: position arithmetic of the drive wraps, as its counters do."""
    return ((value + _HALF) % _WRAP) - _HALF


def _wrap(parts: float, denominator: int) -> float:
    """As ``wrap_int32``, for a number of ``denominator``-ths."""
    return (parts + _HALF * denominator) % (_WRAP * denominator) - _HALF * denominator


@unique
class SetPointSource(IntEnum):
    """By what way a value comes into the dictionary."""

    SDO = 0
    EVENT_PDO = 1
    """RPDO of transmission type 254 or 255: it acts at once."""
    SYNC = 2
    """RPDO of transmission type 0 to 240: it acts at the SYNC."""


class Motion(ABC):
    """The part of an axis that its modes see and move."""

    __slots__ = (
        "_acceleration",
        "_deceleration",
        "_halt_option",
        "_max_acceleration",
        "_max_deceleration",
        "_max_profile_velocity",
        "_max_speed",
        "_quick_stop_deceleration",
        "_scale_entries",
        "_set_point_limit",
        "barred",
        "controlword",
        "demand",
        "dictionary",
        "internal_bits",
        "is_at_switch",
        "is_guarded",
        "is_halted",
        "latch",
        "limit_high",
        "limit_low",
        "number",
        "offset",
        "period_ns",
        "period_s",
        "scaling",
        "set_point_at_ns",
        "set_point_timeout_ns",
        "settings",
        "shaft_counts",
        "source",
        "torque_demand",
        "unit",
        "velocity_offset",
        "velocity_unit",
    )

    def __init__(self, dictionary: LiveDictionary, settings: DriveSettings, number: int = 1) -> None:
        """``number``: which logical axis of its node it is, from 1."""
        self.dictionary: Final = dictionary
        self.number: Final = number
        self.settings: Final = settings
        self.demand: Final = Demand()
        self.latch: Latch = self._last_tick
        self.source = SetPointSource.SDO
        """Set by whoever writes into the dictionary, around the writing."""
        self.shaft_counts = 0
        """Resolver counts at the last servo tick."""
        self.offset = settings.initial_offset_counts
        """Position actual value minus that of shaft count 0, in user units, before the wrap to INTEGER32."""
        self.internal_bits = 0
        """Statusword bits 11 and 13, as far as they are the axis' and not a mode's."""
        self.barred = 0
        """Direction of the shaft (1 or -1) in which a limit switch stands; 0: none does, or it does not matter."""
        self.is_at_switch = False
        """Whether a limit switch has stopped the axis, or keeps it from going on."""
        self.velocity_offset = 0.0
        """Velocity offset 60B1h as far as it is to be fed forward, in counts/s."""
        self.is_guarded = False
        """Whether a set-point is expected within the time-out."""
        self.set_point_at_ns = 0
        self.set_point_timeout_ns = 0
        self.period_ns = 0
        """Interpolation time 60C2h."""
        self.period_s = 0.0
        self._set_point_limit = 0
        """Interpolation times without a set-point after which the drive faults; 0 never does."""
        self.controlword = self.entry(objects.CONTROLWORD)
        self.is_halted = False
        """Controlword bit 8 while operation is enabled: set-points wait."""
        self.torque_demand: float | None = None
        """Per mille of rated torque, from a mode that goes around the position controller; None leaves it to that."""
        self._acceleration = self.entry(objects.PROFILE_ACCELERATION)
        self._deceleration = self.entry(objects.PROFILE_DECELERATION)
        self._quick_stop_deceleration = self.entry(objects.QUICK_STOP_DECELERATION)
        self._max_acceleration = self.entry(objects.MAX_ACCELERATION)
        self._max_deceleration = self.entry(objects.MAX_DECELERATION)
        self._max_profile_velocity = self.entry(objects.MAX_PROFILE_VELOCITY)
        self._max_speed = self.entry(objects.MAX_MOTOR_SPEED)
        self._halt_option = self.entry(objects.HALT_OPTION_CODE)
        self._scale_entries = tuple(
            self.entry(index, subindex)
            for index in (
                objects.POSITION_ENCODER_RESOLUTION,
                objects.VELOCITY_ENCODER_RESOLUTION,
                objects.GEAR_RATIO,
                objects.FEED_CONSTANT,
            )
            for subindex in (1, 2)
        )
        self.scaling = IDENTITY
        """From counts to user units; the next two are parts of it."""
        self.unit = 1.0
        self.velocity_unit = 1.0
        self.limit_low = self.entry(objects.SOFTWARE_POSITION_LIMIT, 1)
        self.limit_high = self.entry(objects.SOFTWARE_POSITION_LIMIT, 2)

    def entry(self, index: int, subindex: int = 0) -> Entry:
        """The entry of an object of the axis, by its index in the first axis."""
        return self.dictionary.entry(of_axis(index, self.number), subindex)

    def measure_by(self, latch: Latch) -> None:
        """Take actual values from ``latch``, rather than from the last servo tick."""
        self.latch = latch

    def _last_tick(self, now_ns: int) -> tuple[int, float, int]:
        return self.shaft_counts, 0.0, 0

    @abstractmethod
    def trip(self, error_code: int, register_bits: int, now_ns: int, *, persists: bool = False) -> None:
        """Raise an error that leads to a fault."""

    @abstractmethod
    def warn(self, error_code: int, register_bits: int, now_ns: int) -> None:
        """Raise an error that leads to no fault."""

    @abstractmethod
    def end_warning(self, error_code: int, now_ns: int) -> None:
        """The cause of an error that has led to no fault is gone."""

    @abstractmethod
    def show_status(self) -> None:
        """Compose statusword and modes of operation display anew: something they show has changed."""

    @abstractmethod
    def forget_sample(self) -> None:
        """The frames of counts have moved: what has been sampled for this instant no longer holds."""

    def set_scaling(self, changed: Entry | None = None, value: int = 0) -> None:
        """Take the factor group as the dictionary has it, but for ``changed``, which is about to become ``value``."""
        polarity = self.entry(objects.POLARITY)
        sizes: list[int] = [value if entry is changed else entry.value for entry in self._scale_entries]
        self.scaling = make_scaling(
            value if changed is polarity else polarity.value,
            (sizes[0], sizes[1]),
            (sizes[2], sizes[3]),
            (sizes[4], sizes[5]),
            (sizes[6], sizes[7]),
        )
        self.unit = self.scaling.position_unit
        self.velocity_unit = self.scaling.velocity_unit
        self.forget_sample()

    def user_position(self, shaft_counts: int) -> int:
        """A position of the shaft in the user frame, before the wrap to INTEGER32."""
        if self.unit == 1.0:
            return shaft_counts + self.offset
        return self.scaling.position(shaft_counts) + self.offset

    def rate_of(self, value: float) -> float:
        """An amount of velocity, acceleration or jerk in user units, in counts and seconds; its sign stays."""
        return value / abs(self.velocity_unit)

    def set_period(self, value: int, exponent: int) -> None:
        """Take the interpolation time 60C2h, ``value`` times ten to the ``exponent`` seconds."""
        self.period_ns = value * 10 ** (9 + exponent)
        self.period_s = self.period_ns * _S_PER_NS
        self.set_watchdog(self._set_point_limit)

    def set_watchdog(self, limit: int) -> None:
        """Take the set-point watchdog 3050h: ``limit`` interpolation times, 0 for none."""
        self._set_point_limit = limit
        # Half a period of grace: the SYNC that is looked for may itself be a little late.
        self.set_point_timeout_ns = self.period_ns * limit + self.period_ns // 2
        self.is_guarded = self.is_guarded and limit > 0

    def expect_next(self, now_ns: int) -> None:
        """Expect the next set-point within the time-out from now on."""
        self.is_guarded = self._set_point_limit > 0
        self.set_point_at_ns = now_ns

    def set_internal_bit(self, bit: int, is_set: bool) -> None:
        """Set or clear a bit of the statusword that is the axis' own."""
        self.internal_bits = self.internal_bits | bit if is_set else self.internal_bits & ~bit
        self.show_status()

    def is_barred(self, direction: float) -> bool:
        """Whether a limit switch keeps the shaft from moving in ``direction`` (by its sign); bit 11 shows it."""
        if direction * self.barred <= 0.0:
            return False
        if not self.is_at_switch:
            self.is_at_switch = True
            self.show_status()
        return True

    def look_at_switches(self, now_ns: int, is_homing: bool) -> None:
        """Stop at a limit switch that is on, unless the axis is homing and so looks for it itself."""
        inputs = self.settings.switches.inputs(self.shaft_counts)
        if is_homing or not inputs & _LIMIT_SWITCHES:
            self.barred = 0
            if self.is_at_switch:
                self.is_at_switch = False
                self.show_status()
            return
        self.barred = 1 if inputs & DigitalInput.POSITIVE_LIMIT else -1
        demand = self.demand
        if not demand.is_over(now_ns) and self.is_barred(demand.velocity_at(now_ns)):
            demand.brake(now_ns, self.quick_stop_deceleration)

    def within_limits(self, target: int) -> int:
        """``target`` (user frame), or the software position limit 607Dh that it is beyond; bit 11 shows which."""
        low = self.limit_low.value
        high = self.limit_high.value
        is_limited = low < high and not low <= target <= high
        if is_limited:
            target = low if target < low else high
        if is_limited != bool(self.internal_bits & _LIMITED):
            self.set_internal_bit(_LIMITED, is_limited)
        return target

    @property
    def acceleration(self) -> float:
        """Profile acceleration 6083h within 60C5h, in counts/s^2."""
        return self.rate_of(min(self._acceleration.value, self._max_acceleration.value))

    @property
    def deceleration(self) -> float:
        """Profile deceleration 6084h within 60C6h, in counts/s^2."""
        return self.rate_of(min(self._deceleration.value, self._max_deceleration.value))

    @property
    def max_acceleration(self) -> float:
        """Max acceleration 60C5h in counts/s^2."""
        return self.rate_of(self._max_acceleration.value)

    @property
    def max_deceleration(self) -> float:
        """Max deceleration 60C6h in counts/s^2."""
        return self.rate_of(self._max_deceleration.value)

    @property
    def max_velocity(self) -> float:
        """What 607Fh (user units) and 6080h (revolutions of the motor a minute) both allow, in counts/s."""
        return min(
            self.rate_of(self._max_profile_velocity.value),
            self._max_speed.value * self.settings.counts_per_revolution / 60.0,
        )

    def deceleration_of(self, ramp: StopRamp) -> float:
        """The deceleration of a stop ramp in counts/s^2; max deceleration 60C6h limits the profile's alone."""
        if ramp is StopRamp.SLOW_DOWN:
            return self.deceleration
        if ramp is StopRamp.QUICK_STOP:
            return self.quick_stop_deceleration
        return self.max_deceleration

    @property
    def quick_stop_deceleration(self) -> float:
        """Quick stop deceleration 6085h in counts/s^2."""
        return self.rate_of(self._quick_stop_deceleration.value)

    def slow_down(self, now_ns: int) -> None:
        """Bring the demand to rest with the profile deceleration, if it moves."""
        if not self.demand.is_over(now_ns):
            self.brake(self.deceleration, now_ns)

    def halt(self, now_ns: int) -> None:
        """Bring the demand to rest as the halt option code 605Dh says."""
        self.is_guarded = False
        self.brake(self.deceleration_of(STOP_RAMPS[int(self._halt_option.value)]), now_ns)

    def take_over(self, now_ns: int) -> None:
        """Let the position controller have an axis again that a torque moved: from where it is, to rest."""
        self.torque_demand = None
        self.demand.launch(float(self.shaft_counts), self.latch(now_ns)[1], now_ns)
        self.brake(self.deceleration, now_ns)

    def _place(self, now_ns: int) -> float:
        """The demand in the user frame."""
        here = self.demand.at(now_ns)
        whole = floor(here)
        if self.unit == 1.0:
            return wrap_int32(whole + self.offset) + here - whole
        scaling = self.scaling
        parts = _wrap(whole * scaling.numerator + self.offset * scaling.denominator, scaling.denominator)
        return parts / scaling.denominator + (here - whole) * self.unit

    def brake(self, deceleration: float, now_ns: int) -> None:
        """Ramp the demand down to rest; more steeply, if it would else come to rest beyond a software limit 607Dh."""
        low = self.limit_low.value
        high = self.limit_high.value
        if low < high and not (low == -_HALF and high == _HALF - 1):
            velocity = self.demand.velocity_at(now_ns)
            place = self._place(now_ns)
            room = self._room(place, velocity)
            if room > 0.0:
                deceleration = max(deceleration, velocity * velocity / (2.0 * room))
        self.demand.brake(now_ns, deceleration)

    def _room(self, place: float, velocity: float) -> float:
        """Counts from ``place`` (user frame) to the software limit that ``velocity`` of the shaft leads to."""
        is_up = velocity * self.unit > 0.0
        return (self.limit_high.value - place if is_up else place - self.limit_low.value) / abs(self.unit)

    def stop_at_limits(self, now_ns: int) -> bool:
        """Brake where the demand would else leave the software position limits 607Dh; whether it had to.

        It is to be asked at every servo tick: it brakes as late as the quick stop deceleration allows, and then with
        what it takes to stand at the limit.
        """
        low = self.limit_low.value
        high = self.limit_high.value
        if low >= high or (low == -_HALF and high == _HALF - 1):
            return False
        demand = self.demand
        least, greatest = demand.span_ahead(now_ns)
        here = demand.at(now_ns)
        place = self._place(now_ns)
        ahead = ((least - here) * self.unit, (greatest - here) * self.unit)
        if place + max(ahead) <= high and place + min(ahead) >= low:
            return False
        velocity = demand.velocity_at(now_ns)
        speed = abs(velocity)
        room = self._room(place, velocity)
        stopping = speed * speed / (2.0 * self.quick_stop_deceleration)
        if speed == 0.0 or room > stopping + speed * _TWO_TICKS_S:
            return False
        if room <= 0.0:
            demand.hold(here + room if velocity > 0.0 else here - room)
        else:
            demand.brake(now_ns, speed * speed / (2.0 * room))
        if not self.internal_bits & _LIMITED:
            self.set_internal_bit(_LIMITED, True)
        return True

    def overrun_s(self, target: float, distance: float) -> float:
        """For how long a line over ``distance`` to ``target`` (user units) may go on without leaving the limits."""
        if distance == 0.0:
            return self.period_s
        low = self.limit_low.value
        high = self.limit_high.value
        if low >= high:
            return self.period_s
        room = high - target if distance > 0.0 else target - low
        return self.period_s * min(1.0, max(room, 0.0) / abs(distance))

    def to_shaft(self, position: float, demand: float) -> float:
        """The shaft position that shows as ``position`` in the user frame and is nearest to ``demand``."""
        reference = floor(demand)
        if self.unit == 1.0:
            distance = position - self.offset - reference
            return reference + ((distance + _HALF) % _WRAP) - _HALF
        # In parts of a user unit, so that the answer does not depend on where the demand is.
        scaling = self.scaling
        parts = (position - self.offset) * scaling.denominator - reference * scaling.numerator
        return reference + _wrap(parts, scaling.denominator) / scaling.numerator
