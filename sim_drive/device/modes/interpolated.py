"""Interpolated position mode (CiA 402-2, clause 12) with linear interpolation and a FIFO of positions."""

from collections import deque
from typing import Final

from drivers import objects
from drivers.sdo import AbortCode
from sim_drive.communication.emcy import EmergencyCode, ErrorRegister
from sim_drive.device.cia402 import Controlword, Statusword
from sim_drive.device.modes.base import OperationMode
from sim_drive.device.motion import Motion

BUFFER_SIZE: Final = 16
"""Records that the buffer takes at most."""

_ACTUAL, _USED, _CLEAR = 2, 4, 6
_ENABLE: Final = int(Controlword.ENABLE_INTERPOLATION)
_ACTIVE: Final = int(Statusword.INTERPOLATION_ACTIVE)
_REACHED: Final = int(Statusword.TARGET_REACHED)


class InterpolatedPosition(OperationMode):
    """Writing 60C1h:01 puts a position into the buffer; with controlword bit 4 one is taken every 60C2h.

    Each is reached in a straight line that takes the interpolation time; the first line begins at the servo tick after
    the first record. When the buffer runs empty in motion the position is held and an EMCY (FF22h) is sent that is no
    fault; when it runs empty at rest, that is an end in good order. Bit 12: interpolation is active. Bit 10: all
    records have been used, and the demand rests. Leaving the mode clears the buffer; so does 60C4h:06 = 0, which also
    locks it until 1 is written. A record for which there is no room is refused (08000022h).
    """

    __slots__ = ("_due_ns", "_is_enabled", "_is_locked", "_is_moving", "_is_running", "_records", "_size", "_used")

    is_ticking = True

    def __init__(self, motion: Motion) -> None:
        super().__init__(motion)
        self._records: deque[int] = deque()
        self._size = motion.entry(objects.INTERPOLATION_DATA_CONFIGURATION, _ACTUAL)
        self._used = motion.entry(objects.INTERPOLATION_DATA_CONFIGURATION, _USED)
        motion.entry(objects.INTERPOLATION_DATA_CONFIGURATION, _CLEAR).on_write = self._on_clear
        motion.entry(objects.INTERPOLATION_DATA_RECORD, 1).on_write = self._on_record
        self._is_locked = False
        self._is_enabled = False
        self._is_running = False
        """A line is being followed, and the next record is due at its end."""
        self._is_moving = False
        self._due_ns = 0

    @property
    def status_bits(self) -> int:
        """Bit 10 target reached, bit 12 interpolation active."""
        if not self.is_active:
            return 0
        is_reached = not self._records and not self._is_running
        bits = _REACHED if is_reached else 0
        return bits | _ACTIVE if self._is_enabled and not self.motion.is_halted else bits

    def reset(self) -> None:
        """Empty the buffer, and unlock it."""
        self._is_locked = False
        self._clear()

    def enter(self, now_ns: int) -> None:
        """Come to rest; records count that have been written before."""
        self.is_active = True
        self._is_running = False
        self._is_enabled = bool(self.motion.controlword.value & _ENABLE)
        self.motion.slow_down(now_ns)

    def leave(self, now_ns: int) -> None:
        """Forget what has not been used."""
        self.is_active = False
        self._clear()

    def halt(self, now_ns: int) -> None:
        """Come to rest; the records wait."""
        self._is_running = False
        self.motion.halt(now_ns)

    def on_controlword(self, value: int, now_ns: int) -> None:
        """Take bit 4."""
        is_enabled = bool(value & _ENABLE)
        if is_enabled is self._is_enabled:
            return
        self._is_enabled = is_enabled
        if not is_enabled:
            self._is_running = False
            self.motion.slow_down(now_ns)
        self.motion.show_status()

    def on_tick(self, now_ns: int) -> None:
        """Take the records that are due."""
        motion = self.motion
        if not self._is_enabled or motion.is_halted:
            return
        was = self.status_bits
        if self._is_running:
            while self._is_running and self._due_ns <= now_ns:
                self._take_next(self._due_ns, now_ns)
        elif self._records and motion.demand.is_over(now_ns):
            motion.end_warning(EmergencyCode.INTERPOLATION_UNDERFLOW, now_ns)
            self._take_next(now_ns, now_ns)
        if self.status_bits != was:
            motion.show_status()

    def _take_next(self, from_ns: int, now_ns: int) -> None:
        motion = self.motion
        if not self._records:
            self._is_running = False
            if self._is_moving:
                motion.warn(EmergencyCode.INTERPOLATION_UNDERFLOW, int(ErrorRegister.DEVICE_PROFILE), now_ns)
            return
        target = motion.within_limits(self._records.popleft())
        self._used.value = len(self._records)
        start = motion.demand.at(from_ns)
        shaft = motion.to_shaft(target, start)
        is_barred = bool(motion.barred) and motion.is_barred(shaft - start)
        if not is_barred:
            motion.demand.go_from(start, shaft, from_ns, motion.period_s, 0.0)
        self._is_running = True
        self._is_moving = shaft != start and not is_barred
        self._due_ns = from_ns + motion.period_ns

    def _clear(self) -> None:
        self._records.clear()
        self._used.value = 0
        self._is_running = False

    def _on_record(self, value: int, now_ns: int) -> AbortCode | None:
        if self._is_locked or len(self._records) >= self._size.value:
            return AbortCode.CANNOT_STORE_DEVICE_STATE
        self._records.append(value)
        self._used.value = len(self._records)
        return None

    def _on_clear(self, value: int, now_ns: int) -> AbortCode | None:
        self._is_locked = value == 0
        if self._is_locked:
            self._clear()
            if self.is_active:
                self.motion.slow_down(now_ns)
                self.motion.show_status()
        return None
