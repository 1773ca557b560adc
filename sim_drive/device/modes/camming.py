"""Camming, the drive's own mode -2: the axis follows a master position by the cam table in the selected slot."""

from typing import Final

from drivers import objects
from drivers.sdo import AbortCode
from sim_drive.communication.emcy import EmergencyCode, ErrorRegister
from sim_drive.device.cam_slots import CamSlots
from sim_drive.device.cia402 import Statusword
from sim_drive.device.modes.base import OperationMode
from sim_drive.device.motion import Motion, SetPointSource, wrap_int32

_FOLLOWS: Final = int(Statusword.FOLLOWS_COMMAND)
_DRIVE_ERROR: Final = int(ErrorRegister.DEVICE_PROFILE)


class Camming(OperationMode):
    """Camming treats the master position as csp does its target, but takes an event-driven RPDO for a cyclic one too.

    The cam is engaged by the first master position, if it does not make the axis jump. Its positions are user units.
    """

    __slots__ = ("_is_engaged", "_is_new", "_master_counts", "_master_offset", "_new_master", "_slots")

    def __init__(self, motion: Motion, slots: CamSlots) -> None:
        super().__init__(motion)
        self._slots = slots
        self._is_engaged = False
        self._is_new = False
        self._new_master = 0
        self._master_counts = 0
        self._master_offset = motion.entry(objects.CAM_MASTER_OFFSET)
        motion.entry(objects.CAM_MASTER_POSITION).on_write = self._on_master

    @property
    def status_bits(self) -> int:
        """Bit 12: the cam is engaged."""
        return _FOLLOWS if self._is_engaged else 0

    def enter(self, now_ns: int) -> None:
        """Lock the selected slot; without a valid table in it the drive faults."""
        self.is_active = True
        self._is_new = False
        if self._slots.selected_table is None:
            self.motion.trip(EmergencyCode.CAM_NOT_VALID, _DRIVE_ERROR, now_ns)
        else:
            self._slots.is_running = True

    def leave(self, now_ns: int) -> None:
        """Disengage, and unlock the slot."""
        self.is_active = False
        self._is_engaged = False
        self._slots.is_running = False

    def halt(self, now_ns: int) -> None:
        """Disengage, and come to rest; after the halt the cam is engaged anew, if it does not make the axis jump."""
        self._is_engaged = False
        self.motion.halt(now_ns)

    def on_sync(self, now_ns: int) -> None:
        """Let the master position that a synchronous RPDO has brought act."""
        if self._is_new:
            self._is_new = False
            self._follow(self._new_master, now_ns)

    def _on_master(self, value: int, now_ns: int) -> AbortCode | None:
        if self.is_active:
            if self.motion.source is SetPointSource.SYNC:
                self._new_master = value
                self._is_new = True
            else:
                self._follow(value, now_ns)
        return None

    def _follow(self, master: int, now_ns: int) -> None:
        motion = self.motion
        if motion.is_halted:
            return
        table = self._slots.selected_table
        if table is None:
            motion.trip(EmergencyCode.CAM_NOT_VALID, _DRIVE_ERROR, now_ns)
            return
        if self._is_engaged:
            # The counter wraps, the master does not: a cam that advances by whole turns goes on.
            self._master_counts += wrap_int32(master - self._master_counts)
        else:
            self._master_counts = master
        slave = table.slave_position(self._master_counts + self._master_offset.value)
        start = motion.demand.at(now_ns)
        target = motion.to_shaft(slave, start)
        if not self._is_engaged:
            if abs(target - start) > motion.settings.cam_jump_window_counts:
                motion.trip(EmergencyCode.CAM_JUMP, _DRIVE_ERROR, now_ns)
                return
            self._is_engaged = True
            motion.show_status()
        is_cyclic = motion.source is not SetPointSource.SDO
        if not motion.barred or not motion.is_barred(target - start):
            motion.demand.go_from(start, target, now_ns, motion.period_s, motion.period_s if is_cyclic else 0.0)
        if is_cyclic:
            motion.expect_next(now_ns)
