"""Profile position mode (CiA 402-2, clause 9): the set-point handshake with one set-point in reserve."""

from enum import IntEnum, unique
from math import copysign, floor
from typing import Final, NamedTuple

from drivers import objects
from sim_drive.device.cia402 import Controlword, Statusword
from sim_drive.device.modes.base import OperationMode
from sim_drive.device.modes.window import Window
from sim_drive.device.motion import Motion, wrap_int32
from sim_drive.device.motion_profile import MotionProfile
from sim_drive.device.profiles import to_velocity

_NEW: Final = int(Controlword.NEW_SET_POINT)
_IMMEDIATE: Final = int(Controlword.CHANGE_IMMEDIATELY)
_RELATIVE: Final = int(Controlword.RELATIVE)
_ON_SET_POINT: Final = int(Controlword.CHANGE_ON_SET_POINT)
_REACHED: Final = int(Statusword.TARGET_REACHED)
_ACKNOWLEDGE: Final = int(Statusword.SET_POINT_ACKNOWLEDGE)


@unique
class RelativeTo(IntEnum):
    """Bits 0 and 1 of the positioning option code 60F2h: what a relative target is added to."""

    TARGET = 0
    """The target before it; the position demand if there has been none since the mode was entered."""
    DEMAND = 1
    ACTUAL = 2


class _SetPoint(NamedTuple):
    target: int
    relative_to: RelativeTo | None
    velocity: float
    acceleration: float
    deceleration: float
    end_velocity: float


class ProfilePosition(OperationMode):
    """Takes 607Ah, 6081h to 6084h at the rising edge of bit 4, and moves in the profile that 6086h chooses.

    Bit 5 lets a set-point act at once; else it waits for the end of the one in work. One can wait: while it does,
    bit 12 stays set, and another is ignored. With bit 9 the one in work is not brought to rest at its target, but
    passed at its profile velocity. A target beyond the software position limits is moved to the limit (bit 11). Bit 10:
    all is done, and the actual position has been within 6067h of the target for 6068h; or, in a halt, the demand rests.
    After a halt the motion goes on. With an end velocity 6082h it passes the target with that velocity, and goes on
    with it until the next set-point, a halt or a limit.
    """

    __slots__ = (
        "_acknowledge",
        "_active",
        "_direction",
        "_end",
        "_entries",
        "_goes_on",
        "_is_set",
        "_option",
        "_profile",
        "_target",
        "_waiting",
        "_was_resting",
        "_window",
    )

    is_ticking = True

    def __init__(self, motion: Motion) -> None:
        super().__init__(motion)
        self._entries = [
            motion.entry(index)
            for index in (
                objects.TARGET_POSITION,
                objects.PROFILE_VELOCITY,
                objects.PROFILE_ACCELERATION,
                objects.PROFILE_DECELERATION,
                objects.END_VELOCITY,
            )
        ]
        self._option = motion.entry(objects.POSITIONING_OPTION_CODE)
        self._window = Window(motion.entry(objects.POSITION_WINDOW), motion.entry(objects.POSITION_WINDOW_TIME))
        self._profile = MotionProfile(motion)
        self._goes_on = False
        """A target has been passed with an end velocity, and the motion goes on."""
        self._is_set = False
        self._acknowledge = False
        self._active: _SetPoint | None = None
        self._waiting: _SetPoint | None = None
        self._target: int | None = None
        self._end = 0.0
        """Target of the set-point in work, or of the last one, in the shaft frame."""
        self._direction = 0.0
        """Not 0 while the target is to be passed: on which side of it that is."""
        self._was_resting = False

    @property
    def status_bits(self) -> int:
        """Bit 10 target reached, bit 12 set-point acknowledge."""
        if not self.is_active:
            return 0
        bits = _ACKNOWLEDGE if self._acknowledge else 0
        is_reached = (
            self._was_resting
            if self.motion.is_halted
            else self._goes_on or (self._active is None and self._window.is_met)
        )
        return bits | _REACHED if is_reached else bits

    def enter(self, now_ns: int) -> None:
        """Come to rest, and wait for a set-point."""
        motion = self.motion
        self.is_active = True
        self._is_set = bool(motion.controlword.value & _NEW)
        self._acknowledge = False
        self._active = None
        self._waiting = None
        self._target = None
        self._direction = 0.0
        self._goes_on = False
        self._was_resting = False
        self._window.reset()
        motion.slow_down(now_ns)
        self._end = sum(motion.demand.span_ahead(now_ns)) - motion.demand.at(now_ns)

    def resume(self, now_ns: int) -> None:
        """Go on to the target."""
        if self._active is not None:
            self._plan(self._active, now_ns)

    def on_controlword(self, value: int, now_ns: int) -> None:
        """Take bits 4, 5, 6 and 9."""
        is_set = bool(value & _NEW)
        if is_set is self._is_set:
            return
        self._is_set = is_set
        if is_set:
            self._take(value, now_ns)
        elif self._waiting is None:
            self._acknowledge = False
        self.motion.show_status()

    def _take(self, value: int, now_ns: int) -> None:
        target, velocity, acceleration, deceleration, end_velocity = (entry.value for entry in self._entries)
        relative_to = RelativeTo(self._option.value & 3) if value & _RELATIVE else None
        rates = (self.motion.rate_of(value) for value in (velocity, acceleration, deceleration, end_velocity))
        set_point = _SetPoint(target, relative_to, *rates)
        if self._active is None or value & _IMMEDIATE:
            self._waiting = None
            self._begin(set_point, now_ns)
        elif self._waiting is None:
            self._waiting = set_point
            if value & _ON_SET_POINT and not self.motion.is_halted:
                self._pass(self._active, now_ns)
        else:
            return
        self._acknowledge = True

    def _begin(self, set_point: _SetPoint, now_ns: int) -> None:
        motion = self.motion
        here = motion.demand.at(now_ns)
        target = set_point.target
        if set_point.relative_to is RelativeTo.TARGET and self._target is not None:
            target += self._target
        elif set_point.relative_to is RelativeTo.ACTUAL:
            target += motion.user_position(motion.latch(now_ns)[0])
        elif set_point.relative_to is not None:
            target += motion.user_position(floor(here + 0.5))
        self._target = motion.within_limits(wrap_int32(target))
        self._end = motion.to_shaft(self._target, here)
        self._active = set_point
        self._window.reset()
        self._direction = 0.0
        self._goes_on = False
        if not motion.is_halted:
            self._plan(set_point, now_ns)

    def _plan(self, set_point: _SetPoint, now_ns: int) -> None:
        motion = self.motion
        demand = motion.demand
        self._direction = 0.0
        distance = self._end - demand.at(now_ns)
        if motion.barred and motion.is_barred(distance):
            return
        cruise = min(set_point.velocity, motion.max_velocity)
        limits = self._limits(set_point)
        end = min(set_point.end_velocity, cruise) if distance else 0.0
        pieces = self._profile.to_position(distance, cruise, limits, end, now_ns)
        demand.plan(pieces, now_ns, None if end else self._end)
        if end:
            self._direction = copysign(1.0, distance)

    def _limits(self, set_point: _SetPoint) -> tuple[float, float]:
        motion = self.motion
        return (
            min(set_point.acceleration, motion.max_acceleration),
            min(set_point.deceleration, motion.max_deceleration),
        )

    def _pass(self, set_point: _SetPoint, now_ns: int) -> None:
        """Do not stop at the target in work."""
        motion = self.motion
        demand = motion.demand
        direction = 1.0 if self._end >= demand.at(now_ns) else -1.0
        velocity = demand.velocity_at(now_ns)
        if velocity * direction < 0.0 or (motion.barred and motion.is_barred(direction)):
            return
        self._direction = direction
        cruise = min(set_point.velocity, motion.max_velocity)
        demand.plan(to_velocity(velocity, direction * cruise, *self._limits(set_point)), now_ns)

    def on_tick(self, now_ns: int) -> None:
        """See whether the set-point in work is done, and begin the one that waits."""
        motion = self.motion
        demand = motion.demand
        was = self.status_bits
        if self._goes_on and (motion.stop_at_limits(now_ns) or demand.is_over(now_ns)):
            self._goes_on = False
        if self._active is not None and not motion.is_halted:
            motion.stop_at_limits(now_ns)
            here = demand.at(now_ns)
            if self._direction != 0.0 and (here - self._end) * self._direction >= 0.0:
                self._finish(now_ns)
            elif demand.is_over(now_ns):
                if abs(here - self._end) > 0.5:
                    self._plan(self._active, now_ns)
                else:
                    self._finish(now_ns)
        self._was_resting = demand.is_over(now_ns)
        self._window.update((self._end - motion.shaft_counts) * motion.unit, now_ns)
        if self.status_bits != was:
            motion.show_status()

    def _finish(self, now_ns: int) -> None:
        waiting = self._waiting
        self._goes_on = waiting is None and self._direction != 0.0
        self._active = None
        self._direction = 0.0
        if waiting is not None:
            self._waiting = None
            self._begin(waiting, now_ns)
            self._acknowledge = self._is_set
