"""Cyclic synchronous modes (CiA 402-2, clauses 14 to 16): the master gives a set-point every interpolation time."""

from typing import Final

from drivers import objects
from drivers.sdo import AbortCode
from sim_drive.cia402 import Statusword
from sim_drive.modes.base import OperationMode
from sim_drive.motion import Motion, SetPointSource

_SYNC: Final = SetPointSource.SYNC
_FOLLOWS: Final = int(Statusword.FOLLOWS_COMMAND)


class CyclicPosition(OperationMode):
    """Cyclic synchronous position mode.

    A target that a SYNC brings into effect is reached in a straight line one interpolation time (60C2h) later. If the
    next one is missing, the line goes on for one more interpolation time, then the position is held; after
    ``missing_set_point_limit`` interpolation times without a set-point the drive faults (8700h). A target by SDO or by
    an event-driven RPDO acts at once, promises no successor, and so is neither overrun nor guarded.
    """

    __slots__ = ("_is_new", "_new_target")

    def __init__(self, motion: Motion) -> None:
        super().__init__(motion)
        self._new_target = 0
        self._is_new = False
        motion.entry(objects.TARGET_POSITION).on_write = self._on_target

    @property
    def status_bits(self) -> int:
        """Bit 12: the drive follows the command value."""
        return _FOLLOWS if self.is_active else 0

    def enter(self, now_ns: int) -> None:
        """Hold until the first new target.

        A line that is being followed is left to run out, so that changing mode in motion does not stop the axis dead.
        """
        self.is_active = True
        self._is_new = False

    def on_sync(self, now_ns: int) -> None:
        """Let the target that a synchronous RPDO has brought act."""
        if self._is_new:
            self._is_new = False
            motion = self.motion
            self._follow(self._new_target, now_ns, motion.period_s)
            motion.expect_next(now_ns)

    def _on_target(self, value: int, now_ns: int) -> AbortCode | None:
        if self.is_active:
            if self.motion.source is _SYNC:
                self._new_target = value
                self._is_new = True
            else:
                # Nobody has promised a next one, so the line ends at the target.
                self._follow(value, now_ns, 0.0)
        return None

    def _follow(self, target: int, now_ns: int, overrun_s: float) -> None:
        motion = self.motion
        target = motion.within_limits(target)
        demand = motion.demand
        start = demand.at(now_ns)
        demand.go_from(start, motion.to_shaft(target, start), now_ns, motion.period_s, overrun_s)
