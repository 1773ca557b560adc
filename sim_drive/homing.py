"""Homing mode (CiA 402-2, clause 11) with the methods that take the current position as home."""

from enum import IntEnum, unique
from typing import Final

from sim_drive.cia402 import Statusword


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


class Homing:
    """Starts on the rising edge of controlword bit 4, is interrupted by its falling, and ends at a servo tick."""

    __slots__ = ("_is_started", "status")

    def __init__(self) -> None:
        self.status = HomingStatus.IDLE
        self._is_started = False

    @property
    def status_bits(self) -> int:
        """Bits 10, 12 and 13 of the statusword; homing on the current position cannot fail, so 13 stays 0."""
        return _STATUS_BITS[self.status]

    def command(self, start: bool) -> None:
        """Take controlword bit 4, in homing mode and Operation enabled."""
        if start and not self._is_started:
            self.status = HomingStatus.IN_PROGRESS
        elif not start and self.status is HomingStatus.IN_PROGRESS:
            self.status = HomingStatus.IDLE
        self._is_started = start

    def interrupt(self) -> None:
        """The drive has left homing mode or Operation enabled; the next start is a new edge."""
        if self.status is HomingStatus.IN_PROGRESS:
            self.status = HomingStatus.IDLE
        self._is_started = False

    def reset(self) -> None:
        """Forget that the axis was homed."""
        self.status = HomingStatus.IDLE
        self._is_started = False

    def step(self, method: int, shaft_counts: int, home_offset: int, offset: int) -> int:
        """One servo tick in progress: the new offset from shaft counts to position actual value.

        With the methods on the current position the position actual value becomes the home offset 607Ch.
        """
        self.status = HomingStatus.ATTAINED
        return offset if method == HomingMethod.NONE else home_offset - shaft_counts
