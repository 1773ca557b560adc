"""What an operator may ask of a machine in motion: its speed, a jog, a phase shift, the slave off its cam and back.

Every order is proved against both axes' limits and the linkage's singular positions before it is taken, and carried
out with limited jerk; one that is refused changes nothing. A proof goes on beside the motion, one pass a cycle.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum, unique
from typing import Final

from drivers.node import Event
from gateway.cyclic.demand import CamDemand
from mechanism.errors import MotionError
from mechanism.law_proof import Pace, Work
from mechanism.slave_law import TooFastError

PERCENT: Final = 100.0
NARROWEST_WINDOW_DEG: Final = 1.0
WIDEST_WINDOW_DEG: Final = 360.0


@unique
class Order(IntEnum):
    """What is asked for."""

    OVERRIDE = 1
    """Per cent of the configured speed: 0 stands and waits, above 100 as far as the limits of both axes allow."""
    JOG = 2
    """rpm of the master, either sign, 0 stands; once it stands and waits."""
    PHASE_SHIFT = 3
    """Degrees of the master by which the slave is ahead on its cam."""
    DISENGAGE = 4
    """Master angle in degrees at which the slave begins to leave its cam."""
    ENGAGE = 5
    """Master angle in degrees at which it begins to return."""
    WINDOW = 6
    """Degrees of the master within which the slave leaves or is back, from the next such order on; 0 leaves it open."""


@dataclass(frozen=True, slots=True)
class OrderAnswered(Event):
    """An operator's order was taken, or refused for the reason given."""

    order: Order
    value: float
    refusal: str


@dataclass(frozen=True, slots=True)
class OperationLimits:
    """Speeds of the master in rad/s: 100 per cent, and the fastest jog; the pace at which a phase is shifted; the
    window (rad, 0: whichever fits best) within which the slave leaves its cam; and passes of a proof in a cycle.
    """

    speed: float
    jog_speed: float
    shift: Pace
    window: float = 0.0
    passes: int = 1


class Operation:
    """Carries out orders on a demand, one at a time."""

    def __init__(self, demand: CamDemand, limits: OperationLimits) -> None:
        self._demand = demand
        self._limits = limits
        self._window = limits.window
        self._speed = limits.speed
        """The speed in force, or that was before the machine was told to wait."""
        self._work: Work[None] | None = None
        self._order = Order.OVERRIDE
        self._value = 0.0

    @property
    def is_busy(self) -> bool:
        """An order is being proved: ``go_on`` is to be called once a cycle."""
        return self._work is not None

    def carry_out(self, order: Order, value: float, end: float, now_ns: int) -> OrderAnswered | None:
        """Take or refuse an order; None: it is being proved, ``go_on`` will answer it.

        ``end`` (rad) is where the run is to end, or whole revolutions later.
        """
        if self._work is not None:
            return OrderAnswered(now_ns, order, value, "the order before this one is still being looked at")
        self._order, self._value = order, value
        self._work = self._carry_out(order, value, end)
        return self.go_on(now_ns)

    def go_on(self, now_ns: int) -> OrderAnswered | None:
        """What a cycle has time for of the proof; the answer if it was the last of it."""
        refusal = ""
        try:
            if self._work is not None:
                self._refuse_a_stop()
                for _ in range(self._limits.passes):
                    next(self._work)
                return None
        except StopIteration:
            pass
        except MotionError as error:
            refusal = str(error)
        self._work = None
        return OrderAnswered(now_ns, self._order, self._value, refusal)

    def _refuse_a_stop(self) -> None:
        if self._demand.is_stopping or self._demand.is_finished:
            raise MotionError("the machine is stopping, a new run has to be started")

    def _carry_out(self, order: Order, value: float, end: float) -> Work[None]:
        match order:
            case Order.OVERRIDE:
                yield from self._override(value, end)
            case Order.JOG:
                yield from self._jog(value)
            case Order.PHASE_SHIFT:
                yield from self._at_best(lambda speed: self._shift(value, speed))
            case Order.DISENGAGE | Order.ENGAGE if self._window:
                yield from self._engage(order, value, self._chosen_speed)
            case Order.DISENGAGE | Order.ENGAGE:
                yield from self._at_best(lambda speed: self._engage(order, value, speed))
            case Order.WINDOW:
                self._set_window(value)

    @property
    def _chosen_speed(self) -> float:
        """Speed of the master that the operator has chosen, or that it still has."""
        return max(self._speed, self._demand.top_speed)

    def _at_best(self, work: Callable[[float], Work[None]]) -> Work[None]:
        """Do it so that it holds at the configured speed too, or else only up to a slower one that is in force."""
        if self._chosen_speed < self._limits.speed:
            try:
                yield from work(self._limits.speed)
            except MotionError:
                yield from work(self._chosen_speed)
        else:
            yield from work(self._chosen_speed)

    def _shift(self, degrees: float, speed: float) -> Work[None]:
        yield from self._demand.law.change_shift(math.radians(degrees), speed, self._limits.shift)

    def _engage(self, order: Order, degrees: float, speed: float) -> Work[None]:
        law, at = self._demand.law, math.radians(degrees)
        law.engage(
            (yield from law.prove_engagement(order is Order.ENGAGE, at, self._window, speed)),
            self._demand.master_position,
        )

    def _override(self, percent: float, end: float) -> Work[None]:
        if not percent >= 0.0:
            raise MotionError(
                f"an override of {percent:g} % would turn the machine back; 0 stands, and a jog turns back"
            )
        if percent == 0.0:
            self._demand.jog(0.0)
            return
        speed = self._limits.speed * percent / PERCENT
        try:
            yield from self._demand.law.prove_speed(speed)
        except TooFastError as error:
            fits = math.floor(error.fastest / self._limits.speed * PERCENT)
            raise MotionError(f"{percent:g} % is too fast, at {fits} % {error.excess.bound}") from None
        self._demand.go_on(speed, end)
        self._speed = speed

    def _jog(self, rpm: float) -> Work[None]:
        speed = rpm * math.tau / 60.0
        if not self._demand.is_paused:
            raise MotionError("a jog is for a machine that waits: override 0 first")
        if not abs(speed) <= self._limits.jog_speed:
            bound = self._limits.jog_speed * 60.0 / math.tau
            raise MotionError(f"a jog at {rpm:g} rpm is faster than it may be (bound {bound:.3g} rpm)")
        if speed:
            yield from self._demand.law.prove_speed(speed)
        self._demand.jog(speed)

    def _set_window(self, degrees: float) -> None:
        if degrees != 0.0 and not NARROWEST_WINDOW_DEG <= degrees <= WIDEST_WINDOW_DEG:
            raise MotionError(
                f"a window of {degrees:g} deg is not {NARROWEST_WINDOW_DEG:g} to {WIDEST_WINDOW_DEG:g} deg, or 0 for "
                "whichever fits best"
            )
        self._window = math.radians(degrees)
