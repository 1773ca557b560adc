"""What an operator may ask of a machine in motion: its speed, a jog, a phase shift, the slave off its cam and back.

Every command is proved against the axes' limits and the linkage's singular positions before it is taken, and carried
out with limited jerk; one that is refused changes nothing.
"""

import math
from dataclasses import dataclass
from enum import IntEnum, unique
from typing import Final

from drivers.node import Event
from gateway.cyclic.demand import CamDemand
from mechanism.errors import MotionError

DISENGAGE_WINDOW_RAD: Final = math.radians(60.0)
"""Of the master, within which the slave leaves its cam or is back on it."""


@unique
class Order(IntEnum):
    """What is asked for."""

    OVERRIDE = 1
    """Per cent of the configured speed, 0 (stand and wait) to 100."""
    JOG = 2
    """rpm of the master, either sign, 0 stands; once it stands and waits."""
    PHASE_SHIFT = 3
    """Degrees of the master by which the slave is ahead on its cam."""
    DISENGAGE = 4
    """Master angle in degrees at which the slave begins to leave its cam."""
    ENGAGE = 5
    """Master angle in degrees at which it begins to return."""


@dataclass(frozen=True, slots=True)
class OrderAnswered(Event):
    """An operator's order was taken, or refused for the reason given."""

    order: Order
    value: float
    refusal: str


class Operation:
    """Carries out orders on a demand."""

    def __init__(self, demand: CamDemand, speed: float, shift_speed: float, jog_limit: float) -> None:
        """``speed`` (rad/s) is 100 per cent; ``shift_speed`` and ``jog_limit`` (rad/s) bound shifts and jogs."""
        self._demand = demand
        self._speed = speed
        self._shift_speed = shift_speed
        self._jog_limit = jog_limit

    def carry_out(self, order: Order, value: float, end: float, now_ns: int) -> OrderAnswered:
        """Take or refuse an order; ``end`` (rad) is where the run is to end, or whole revolutions later."""
        refusal = ""
        try:
            self._carry_out(order, value, end)
        except MotionError as error:
            refusal = str(error)
        return OrderAnswered(now_ns, order, value, refusal)

    def _carry_out(self, order: Order, value: float, end: float) -> None:
        demand = self._demand
        if demand.is_stopping or demand.is_finished:
            raise MotionError("the machine is stopping, a new run has to be started")
        match order:
            case Order.OVERRIDE:
                self._override(value, end)
            case Order.JOG:
                self._jog(value)
            case Order.PHASE_SHIFT:
                demand.law.change_shift(math.radians(value), self._speed, self._shift_speed)
            case Order.DISENGAGE | Order.ENGAGE:
                is_engaged = order is Order.ENGAGE
                at = math.radians(value)
                demand.law.change_engagement(is_engaged, at, demand.master_position, DISENGAGE_WINDOW_RAD, self._speed)

    def _override(self, percent: float, end: float) -> None:
        if not 0.0 <= percent <= 100.0:
            raise MotionError(f"an override of {percent:g} % is not 0 to 100 %, for which the limits are proved")
        if percent == 0.0:
            self._demand.jog(0.0)
        else:
            self._demand.go_on(self._speed * percent / 100.0, end)

    def _jog(self, rpm: float) -> None:
        speed = rpm * math.tau / 60.0
        if not self._demand.is_paused:
            raise MotionError("a jog is for a machine that waits: override 0 first")
        if not abs(speed) <= self._jog_limit:
            bound = self._jog_limit * 60.0 / math.tau
            raise MotionError(f"a jog at {rpm:g} rpm is faster than it may be (bound {bound:.3g} rpm)")
        self._demand.jog(speed)
