"""The position demand between set-points: hold, straight line, or braking ramp, as a function of time."""

from typing import Final

_S_PER_NS: Final = 1e-9


class Demand:
    """A parabola in time that ends in standstill: position (counts, shaft frame), velocity, acceleration, duration."""

    __slots__ = ("acceleration", "duration_s", "position", "start_ns", "velocity")

    def __init__(self) -> None:
        self.start_ns = 0
        self.position = 0.0
        self.velocity = 0.0
        self.acceleration = 0.0
        self.duration_s = 0.0

    def at(self, now_ns: int) -> float:
        """Demand in counts at ``now_ns``; before the start it is the start's, after the end the end's."""
        t = (now_ns - self.start_ns) * _S_PER_NS
        if t >= self.duration_s:
            t = self.duration_s
        elif t < 0.0:
            t = 0.0
        return self.position + (self.velocity + 0.5 * self.acceleration * t) * t

    def velocity_at(self, now_ns: int) -> float:
        """Demand velocity in counts/s at ``now_ns``."""
        t = (now_ns - self.start_ns) * _S_PER_NS
        if t >= self.duration_s:
            return 0.0
        return self.velocity + self.acceleration * max(t, 0.0)

    def is_over(self, now_ns: int) -> bool:
        """Whether the demand has come to rest."""
        return (now_ns - self.start_ns) * _S_PER_NS >= self.duration_s

    def hold(self, position: float) -> None:
        """Stay at ``position``."""
        self.position = position
        self.velocity = 0.0
        self.acceleration = 0.0
        self.duration_s = 0.0

    def go_to(self, target: float, now_ns: int, period_s: float, overrun_s: float) -> None:
        """Go from where the demand is now to ``target`` in a straight line that takes ``period_s``.

        The line is kept up for ``overrun_s`` beyond, for the case that the next set-point is late, and held then.
        """
        self.go_from(self.at(now_ns), target, now_ns, period_s, overrun_s)

    def go_from(self, start: float, target: float, now_ns: int, period_s: float, overrun_s: float) -> None:
        """As ``go_to``, from ``start``, for a caller who knows already where the demand is now."""
        self.start_ns = now_ns
        self.position = start
        self.velocity = (target - start) / period_s
        self.acceleration = 0.0
        self.duration_s = period_s + overrun_s

    def brake(self, now_ns: int, deceleration: float) -> None:
        """Ramp the present velocity down to standstill with ``deceleration`` (counts/s^2, positive)."""
        position = self.at(now_ns)
        velocity = self.velocity_at(now_ns)
        self.start_ns = now_ns
        self.position = position
        self.velocity = velocity
        self.acceleration = -deceleration if velocity > 0.0 else deceleration
        self.duration_s = abs(velocity) / deceleration
