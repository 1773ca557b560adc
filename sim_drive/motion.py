"""What an axis and its modes share: the position demand, the two frames of counts, set-points in time, and limits.

Two frames of counts meet here. The *shaft* frame is what the resolver counts since power-on; the *user* frame is that
of the 60xxh objects: user = shaft + offset, as INTEGER32 with wrap. Homing moves the offset, never the demand in shaft
counts.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from enum import IntEnum, unique
from math import floor
from typing import Final

from drivers import objects
from sim_drive.cia402 import Statusword
from sim_drive.demand import Demand
from sim_drive.dictionary import Entry, LiveDictionary
from sim_drive.settings import DriveSettings

Latch = Callable[[int], tuple[int, float, int]]
"""Gives shaft position (counts), velocity (counts/s) and torque (per mille of rated torque) as of an instant in ns."""

_WRAP: Final = 1 << 32
_HALF: Final = 1 << 31
_S_PER_NS: Final = 1e-9
_LIMITED: Final = int(Statusword.INTERNAL_LIMIT_ACTIVE)


def wrap_int32(value: int) -> int:
    """``value`` modulo 2^32 as INTEGER32: position arithmetic of the drive wraps, as its counters do."""
    return ((value + _HALF) % _WRAP) - _HALF


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
        "_limit_high",
        "_limit_low",
        "_set_point_limit",
        "controlword",
        "demand",
        "dictionary",
        "internal_bits",
        "is_guarded",
        "latch",
        "offset",
        "period_ns",
        "period_s",
        "set_point_at_ns",
        "set_point_timeout_ns",
        "settings",
        "shaft_counts",
        "source",
    )

    def __init__(self, dictionary: LiveDictionary, settings: DriveSettings) -> None:
        self.dictionary: Final = dictionary
        self.settings: Final = settings
        self.demand: Final = Demand()
        self.latch: Latch = _no_latch
        """Set by the drive."""
        self.source = SetPointSource.SDO
        """Set by whoever writes into the dictionary, around the writing."""
        self.shaft_counts = 0
        """Resolver counts at the last servo tick."""
        self.offset = settings.initial_offset_counts
        """Position actual value minus shaft counts, before the wrap to INTEGER32."""
        self.internal_bits = 0
        """Statusword bits 11 and 13, as far as they are the axis' and not a mode's."""
        self.is_guarded = False
        """Whether a set-point is expected within the time-out."""
        self.set_point_at_ns = 0
        self.set_point_timeout_ns = 0
        self.period_ns = 0
        """Interpolation time 60C2h."""
        self.period_s = 0.0
        self._set_point_limit = settings.missing_set_point_limit
        self.controlword = self.entry(objects.CONTROLWORD)
        self._limit_low = self.entry(objects.SOFTWARE_POSITION_LIMIT, 1)
        self._limit_high = self.entry(objects.SOFTWARE_POSITION_LIMIT, 2)

    def entry(self, index: int, subindex: int = 0) -> Entry:
        """The entry of an object of the axis."""
        return self.dictionary.entry(index, subindex)

    @abstractmethod
    def trip(self, error_code: int, register_bits: int, now_ns: int, *, persists: bool = False) -> None:
        """Raise an error that leads to a fault."""

    @abstractmethod
    def show_status(self) -> None:
        """Compose statusword and modes of operation display anew: something they show has changed."""

    @abstractmethod
    def forget_sample(self) -> None:
        """The frames of counts have moved: what has been sampled for this instant no longer holds."""

    def set_period(self, value: int, exponent: int) -> None:
        """Take the interpolation time 60C2h, ``value`` times ten to the ``exponent`` seconds."""
        self.period_ns = value * 10 ** (9 + exponent)
        self.period_s = self.period_ns * _S_PER_NS
        # Half a period of grace: the SYNC that is looked for may itself be a little late.
        self.set_point_timeout_ns = self.period_ns * self._set_point_limit + self.period_ns // 2

    def expect_next(self, now_ns: int) -> None:
        """Expect the next set-point within the time-out from now on."""
        self.is_guarded = self._set_point_limit > 0
        self.set_point_at_ns = now_ns

    def set_internal_bit(self, bit: int, is_set: bool) -> None:
        """Set or clear a bit of the statusword that is the axis' own."""
        self.internal_bits = self.internal_bits | bit if is_set else self.internal_bits & ~bit
        self.show_status()

    def within_limits(self, target: int) -> int:
        """``target`` (user frame), or the software position limit 607Dh that it is beyond; bit 11 shows which."""
        low = self._limit_low.value
        high = self._limit_high.value
        is_limited = low < high and not low <= target <= high
        if is_limited:
            target = low if target < low else high
        if is_limited != bool(self.internal_bits & _LIMITED):
            self.set_internal_bit(_LIMITED, is_limited)
        return target

    def to_shaft(self, position: float, demand: float) -> float:
        """The shaft position that shows as ``position`` in the user frame and is nearest to ``demand``."""
        reference = floor(demand)
        distance = position - self.offset - reference
        return reference + ((distance + _HALF) % _WRAP) - _HALF


def _no_latch(now_ns: int) -> tuple[int, float, int]:
    return 0, 0.0, 0
