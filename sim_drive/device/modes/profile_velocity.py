"""Profile velocity mode (CiA 402-2, clause 10)."""

from typing import Final

from drivers import objects
from sim_drive.device.cia402 import Statusword
from sim_drive.device.modes.base import OperationMode
from sim_drive.device.modes.window import Window
from sim_drive.device.motion import Motion
from sim_drive.device.motion_profile import MotionProfile

_REACHED: Final = int(Statusword.TARGET_REACHED)
_SPEED_ZERO: Final = int(Statusword.SPEED_ZERO)
_LIMITED: Final = int(Statusword.INTERNAL_LIMIT_ACTIVE)


class ProfileVelocity(OperationMode):
    """The demand velocity goes to 60FFh with 6083h and 6084h; the position demand is its integral.

    60FFh acts as it stands at every servo tick, from the moment that the mode is active. Bit 10: the actual velocity
    has been within 606Dh of the target for 606Eh, or, in a halt, the axis stands. Bit 12: it has been below 606Fh for
    6070h. A software position limit (bit 11) is kept until 60FFh leads away from it.
    """

    __slots__ = ("_barred", "_planned_target", "_profile", "_standing", "_target", "_window")

    is_ticking = True

    def __init__(self, motion: Motion) -> None:
        super().__init__(motion)
        self._target = motion.entry(objects.TARGET_VELOCITY)
        self._window = Window(motion.entry(objects.VELOCITY_WINDOW), motion.entry(objects.VELOCITY_WINDOW_TIME))
        self._standing = Window(motion.entry(objects.VELOCITY_THRESHOLD), motion.entry(objects.VELOCITY_THRESHOLD_TIME))
        self._profile = MotionProfile(motion)
        self._planned_target: float | None = None
        self._barred = 0.0

    @property
    def status_bits(self) -> int:
        """Bit 10 target reached, bit 12 speed zero."""
        if not self.is_active:
            return 0
        bits = _SPEED_ZERO if self._standing.is_met else 0
        is_reached = self._standing.is_met if self.motion.is_halted else self._window.is_met
        return bits | _REACHED if is_reached else bits

    def enter(self, now_ns: int) -> None:
        """Take the target as it stands, from the velocity that the axis has."""
        self.is_active = True
        self._planned_target = None
        self._barred = 0.0
        self._window.reset()
        self._standing.reset()

    def resume(self, now_ns: int) -> None:
        """Go on to the target."""
        self._planned_target = None

    def on_tick(self, now_ns: int) -> None:
        """Plan anew if the target has changed, and watch windows and limits."""
        motion = self.motion
        demand = motion.demand
        wanted = self._target.value / motion.velocity_unit
        bound = motion.max_velocity
        target = max(-bound, min(bound, wanted))
        if not motion.is_halted:
            is_barred = target * self._barred > 0.0 or (bool(motion.barred) and motion.is_barred(target))
            if target != self._planned_target and not is_barred:
                self._planned_target = target
                self._barred = 0.0
                motion.set_internal_bit(_LIMITED, target != wanted)
                demand.plan(self._profile.to_velocity(target, now_ns), now_ns)
            velocity = demand.velocity_at(now_ns)
            if motion.stop_at_limits(now_ns):
                self._barred = 1.0 if velocity > 0.0 else -1.0
                self._planned_target = None
        actual = motion.latch(now_ns)[1]
        has_changed = self._window.update((wanted - actual) * motion.velocity_unit, now_ns)
        if self._standing.update(actual * motion.velocity_unit, now_ns) or has_changed:
            motion.show_status()
