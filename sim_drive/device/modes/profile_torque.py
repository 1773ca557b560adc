"""Profile torque mode (CiA 402-2, clause 13)."""

from typing import Final

from drivers import objects
from sim_drive.device.cia402 import Statusword
from sim_drive.device.modes.base import OperationMode
from sim_drive.device.motion import Motion

_REACHED: Final = int(Statusword.TARGET_REACHED)
_S_PER_NS: Final = 1e-9


class ProfileTorque(OperationMode):
    """The torque goes to 6071h with the slope 6087h (per mille of rated torque a second), around the controller.

    It starts from the torque that the amplifier gives, and in a halt goes to zero with the same slope. Bit 10: the
    demand has arrived. The position demand follows the axis.
    """

    __slots__ = ("_before_ns", "_is_reached", "_max_torque", "_slope", "_target")

    is_ticking = True

    def __init__(self, motion: Motion) -> None:
        super().__init__(motion)
        self._target = motion.entry(objects.TARGET_TORQUE)
        self._slope = motion.entry(objects.TORQUE_SLOPE)
        self._max_torque = motion.entry(objects.MAX_TORQUE)
        self._before_ns = 0
        self._is_reached = False

    @property
    def status_bits(self) -> int:
        """Bit 10: target torque reached."""
        return _REACHED if self.is_active and self._is_reached else 0

    def enter(self, now_ns: int) -> None:
        """Start from the actual torque."""
        self.is_active = True
        self._is_reached = False
        self._before_ns = now_ns
        self.motion.torque_demand = float(self.motion.latch(now_ns)[2])

    def leave(self, now_ns: int) -> None:
        """Give the axis back to the position controller."""
        self.is_active = False
        self.motion.take_over(now_ns)

    def halt(self, now_ns: int) -> None:
        """The torque goes to zero at the next ticks."""

    def on_tick(self, now_ns: int) -> None:
        """Move the torque by what the slope allows since the tick before."""
        motion = self.motion
        bound = self._max_torque.value
        target = 0 if motion.is_halted else max(-bound, min(bound, self._target.value))
        demand = 0.0 if motion.torque_demand is None else motion.torque_demand
        step = self._slope.value * (now_ns - self._before_ns) * _S_PER_NS
        self._before_ns = now_ns
        demand = max(demand - step, min(demand + step, float(target)))
        motion.torque_demand = demand
        motion.demand.hold(float(motion.shaft_counts))
        is_reached = demand == target
        if is_reached is not self._is_reached:
            self._is_reached = is_reached
            motion.show_status()
