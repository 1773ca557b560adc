"""Cyclic synchronous modes (CiA 402-2, clauses 14 to 16): the master gives a set-point every interpolation time."""

from math import copysign, inf
from typing import Final

from drivers import objects
from drivers.sdo import AbortCode
from sim_drive.device.cia402 import Statusword
from sim_drive.device.demand import Piece
from sim_drive.device.modes.base import OperationMode
from sim_drive.device.motion import Motion, SetPointSource, wrap_int32

_SYNC: Final = SetPointSource.SYNC
_FOLLOWS: Final = int(Statusword.FOLLOWS_COMMAND)
_LIMITED: Final = int(Statusword.INTERNAL_LIMIT_ACTIVE)


class CyclicPosition(OperationMode):
    """Cyclic synchronous position mode.

    A target that a SYNC brings into effect is reached in a straight line one interpolation time (60C2h) later. If the
    next one is missing, the line goes on for one more interpolation time, then the position is held; after as many
    interpolation times without a set-point as the watchdog 3050h says the drive faults (8700h). A target by SDO or by
    an event-driven RPDO acts at once, promises no successor, and so is neither overrun nor guarded. The position offset
    60B0h is added to the target; the velocity offset 60B1h is fed forward to the controller, from the next target on.
    """

    __slots__ = ("_is_new", "_new_target", "_offset", "_velocity_offset")

    def __init__(self, motion: Motion) -> None:
        super().__init__(motion)
        self._velocity_offset = motion.entry(objects.VELOCITY_OFFSET)
        self._new_target = 0
        self._is_new = False
        motion.entry(objects.TARGET_POSITION).on_write = self._on_target
        self._offset = motion.entry(objects.POSITION_OFFSET)

    @property
    def status_bits(self) -> int:
        """Bit 12: the drive follows the command value, which it does not in a halt."""
        return _FOLLOWS if self.is_active and not self.motion.is_halted else 0

    def enter(self, now_ns: int) -> None:
        """Hold until the first new target.

        A line that is being followed is left to run out, so that changing mode in motion does not stop the axis dead;
        a profile that would go on is brought to rest.
        """
        self.is_active = True
        self._is_new = False
        if self.motion.demand.is_planned:
            self.motion.slow_down(now_ns)

    def on_sync(self, now_ns: int) -> None:
        """Let the target that a synchronous RPDO has brought act."""
        if self._is_new:
            self._is_new = False
            motion = self.motion
            if not motion.is_halted:
                self._follow(self._new_target, now_ns, True)
                if motion.is_guarded:
                    motion.set_point_at_ns = now_ns
                else:
                    motion.expect_next(now_ns)

    def _on_target(self, value: int, now_ns: int) -> AbortCode | None:
        if self.is_active:
            if self.motion.source is _SYNC:
                self._new_target = value
                self._is_new = True
            elif not self.motion.is_halted:
                # Nobody has promised a next one, so the line ends at the target.
                self._follow(value, now_ns, False)
        return None

    def leave(self, now_ns: int) -> None:
        """Feed no velocity forward any more."""
        self.is_active = False
        self.motion.velocity_offset = 0.0

    def _follow(self, target: int, now_ns: int, is_cyclic: bool) -> None:
        motion = self.motion
        offset = self._offset.value
        if offset:
            target = wrap_int32(target + offset)
        low = motion.limit_low.value
        high = motion.limit_high.value
        # What is within the limits, as it nearly always is, is followed without a call.
        if motion.internal_bits or not low <= target <= high:
            target = motion.within_limits(target)
        demand = motion.demand
        start = demand.at(now_ns)
        shaft = motion.to_shaft(target, start)
        velocity_offset = self._velocity_offset.value
        if velocity_offset or motion.velocity_offset:
            motion.velocity_offset = velocity_offset / motion.velocity_unit
        if motion.barred and motion.is_barred(shaft - start):
            return
        overrun_s = motion.period_s if is_cyclic else 0.0
        distance = (shaft - start) * motion.unit
        if is_cyclic and not low <= target + distance <= high:
            overrun_s = motion.overrun_s(target, distance)
        demand.go_from(start, shaft, now_ns, motion.period_s, overrun_s)


class CyclicVelocity(OperationMode):
    """Cyclic synchronous velocity mode: 60FFh plus 60B1h, closed over the position demand, which is its integral.

    The demand velocity goes from what it is to a new target in a straight line over one interpolation time, and stays
    there; missing set-points are guarded as in csp. Velocities beyond 607Fh or 6080h are limited (bit 11).
    """

    __slots__ = ("_barred", "_is_new", "_new_target", "_offset")

    is_ticking = True

    def __init__(self, motion: Motion) -> None:
        super().__init__(motion)
        self._new_target = 0
        self._is_new = False
        self._barred = 0.0
        """Direction in which a software position limit has been reached; 0 for none."""
        self._offset = motion.entry(objects.VELOCITY_OFFSET)
        motion.entry(objects.TARGET_VELOCITY).on_write = self._on_target

    @property
    def status_bits(self) -> int:
        """Bit 12: the drive follows the command value, which it does not in a halt."""
        return _FOLLOWS if self.is_active and not self.motion.is_halted else 0

    def enter(self, now_ns: int) -> None:
        """Come to rest, and hold until the first new target."""
        self.is_active = True
        self._is_new = False
        self._barred = 0.0
        self.motion.slow_down(now_ns)

    def on_sync(self, now_ns: int) -> None:
        """Let the target that a synchronous RPDO has brought act."""
        if self._is_new:
            self._is_new = False
            if not self.motion.is_halted:
                self._follow(self._new_target, now_ns)
                self.motion.expect_next(now_ns)

    def on_tick(self, now_ns: int) -> None:
        """Watch the software position limits."""
        velocity = self.motion.demand.velocity_at(now_ns)
        if self.motion.stop_at_limits(now_ns):
            self._barred = copysign(1.0, velocity)

    def _on_target(self, value: int, now_ns: int) -> AbortCode | None:
        if self.is_active:
            if self.motion.source is _SYNC:
                self._new_target = value
                self._is_new = True
            elif not self.motion.is_halted:
                self._follow(value, now_ns)
        return None

    def _follow(self, target: int, now_ns: int) -> None:
        motion = self.motion
        wanted = (target + self._offset.value) / motion.velocity_unit
        bound = motion.max_velocity
        velocity = max(-bound, min(bound, wanted))
        if velocity * self._barred > 0.0 or (motion.barred and motion.is_barred(velocity)):
            return
        self._barred = 0.0
        is_limited = velocity != wanted
        if is_limited != bool(motion.internal_bits & _LIMITED):
            motion.set_internal_bit(_LIMITED, is_limited)
        demand = motion.demand
        rate = (velocity - demand.velocity_at(now_ns)) / motion.period_s
        pieces = [Piece(rate, motion.period_s)]
        if velocity != 0.0:
            pieces.append(Piece(0.0, inf))
        demand.plan(pieces, now_ns)


class CyclicTorque(OperationMode):
    """Cyclic synchronous torque mode: 6071h plus 60B2h goes to the amplifier, around the position controller.

    Until the first new target the position is held. The position demand follows the axis. Missing set-points are
    guarded as in csp; halt brings the axis to rest under the position controller.
    """

    __slots__ = ("_is_new", "_new_target", "_offset")

    is_ticking = True

    def __init__(self, motion: Motion) -> None:
        super().__init__(motion)
        self._new_target = 0
        self._is_new = False
        self._offset = motion.entry(objects.TORQUE_OFFSET)
        motion.entry(objects.TARGET_TORQUE).on_write = self._on_target

    @property
    def status_bits(self) -> int:
        """Bit 12: the drive follows the command value, which it does not in a halt."""
        return _FOLLOWS if self.is_active and not self.motion.is_halted else 0

    def enter(self, now_ns: int) -> None:
        """Come to rest, and hold until the first new target."""
        self.is_active = True
        self._is_new = False
        self.motion.slow_down(now_ns)

    def leave(self, now_ns: int) -> None:
        """Give the axis back to the position controller."""
        self.is_active = False
        if self.motion.torque_demand is not None:
            self.motion.take_over(now_ns)

    def halt(self, now_ns: int) -> None:
        """Bring the axis to rest under the position controller."""
        if self.motion.torque_demand is not None:
            self.motion.take_over(now_ns)
        self.motion.halt(now_ns)

    def on_sync(self, now_ns: int) -> None:
        """Let the target that a synchronous RPDO has brought act."""
        if self._is_new:
            self._is_new = False
            if not self.motion.is_halted:
                self._follow(self._new_target)
                self.motion.expect_next(now_ns)

    def on_tick(self, now_ns: int) -> None:
        """The position demand goes where the axis goes."""
        if self.motion.torque_demand is not None:
            self.motion.demand.hold(float(self.motion.shaft_counts))

    def _on_target(self, value: int, now_ns: int) -> AbortCode | None:
        if self.is_active:
            if self.motion.source is _SYNC:
                self._new_target = value
                self._is_new = True
            elif not self.motion.is_halted:
                self._follow(value)
        return None

    def _follow(self, target: int) -> None:
        self.motion.torque_demand = float(target + self._offset.value)
