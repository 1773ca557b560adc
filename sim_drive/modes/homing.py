"""Homing mode (CiA 402-2, clause 11) with the methods that take the current position as home."""

from enum import IntEnum, unique
from typing import Final

from drivers import objects
from drivers.sdo import AbortCode
from sim_drive.cia402 import Controlword, Statusword
from sim_drive.modes.base import OperationMode
from sim_drive.motion import Motion


@unique
class HomingMethod(IntEnum):
    """Values of 6098h that the drive has."""

    NONE = 0
    """Nothing is to be done: the drive's zero stays where it is, and homing is attained at once."""
    CURRENT_POSITION_OLD = 35
    CURRENT_POSITION = 37


HOMING_METHODS: Final = frozenset(int(method) for method in HomingMethod)


@unique
class HomingStatus(IntEnum):
    """Progress of homing."""

    IDLE = 0
    """Not started, or interrupted."""
    IN_PROGRESS = 1
    ATTAINED = 2


_STATUS_BITS: Final = (
    int(Statusword.TARGET_REACHED),
    0,
    int(Statusword.TARGET_REACHED | Statusword.HOMING_ATTAINED),
)
_START: Final = int(Controlword.HOMING_START)


class Homing(OperationMode):
    """Starts on the rising edge of controlword bit 4, is interrupted by its falling, and ends at a servo tick."""

    __slots__ = ("_home_offset", "_is_started", "_method", "status")

    is_ticking = True
    owns_bit_13 = True

    def __init__(self, motion: Motion) -> None:
        super().__init__(motion)
        self._method = motion.entry(objects.HOMING_METHOD)
        self._method.on_write = _check_method
        self._home_offset = motion.entry(objects.HOME_OFFSET)
        self.status = HomingStatus.IDLE
        self._is_started = False

    @property
    def status_bits(self) -> int:
        """Bits 10, 12 and 13 of the statusword; homing on the current position cannot fail, so 13 stays 0."""
        return _STATUS_BITS[self.status]

    def reset(self) -> None:
        """Forget that the axis was homed."""
        self.status = HomingStatus.IDLE

    def enter(self, now_ns: int) -> None:
        """Wait for a rising edge of bit 4."""
        self.is_active = True
        self._is_started = bool(self.motion.controlword.value & _START)

    def leave(self, now_ns: int) -> None:
        """Interrupt what is in progress."""
        self.is_active = False
        if self.status is HomingStatus.IN_PROGRESS:
            self.status = HomingStatus.IDLE

    def on_controlword(self, value: int, now_ns: int) -> None:
        """Take bit 4."""
        start = bool(value & _START)
        if start is self._is_started:
            return
        self._is_started = start
        if start:
            self.status = HomingStatus.IN_PROGRESS
        elif self.status is HomingStatus.IN_PROGRESS:
            self.status = HomingStatus.IDLE
        self.motion.show_status()

    def on_tick(self, now_ns: int) -> None:
        """With the methods on the current position the position actual value becomes the home offset 607Ch."""
        if self.status is not HomingStatus.IN_PROGRESS:
            return
        motion = self.motion
        self.status = HomingStatus.ATTAINED
        if self._method.value != HomingMethod.NONE:
            motion.offset = self._home_offset.value - motion.shaft_counts
        motion.forget_sample()
        motion.show_status()


def _check_method(value: int, now_ns: int) -> AbortCode | None:
    return None if value in HOMING_METHODS else AbortCode.VALUE_RANGE_EXCEEDED
