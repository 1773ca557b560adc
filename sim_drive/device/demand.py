"""The position demand between set-points: hold, line, braking ramp, or a planned sequence, as a function of time.

All in counts of the shaft and their derivatives.
"""

from collections.abc import Sequence
from math import inf
from typing import Final, NamedTuple

_S_PER_NS: Final = 1e-9


class Piece(NamedTuple):
    """A span of constant acceleration (counts/s^2), or, with a jerk (counts/s^3), of one that changes evenly.

    An infinite one, which has no jerk, never ends.
    """

    acceleration: float
    duration_s: float
    jerk: float = 0.0


class _Planned(NamedTuple):
    start_s: float
    position: float
    velocity: float
    acceleration: float
    jerk: float


class Demand:
    """A parabola in time that ends in standstill: position (counts, shaft frame), velocity, acceleration, duration.

    A plan has more of them, one after the other; the first is then as if it were alone.
    """

    __slots__ = ("_end", "_end_s", "_planned", "acceleration", "duration_s", "position", "start_ns", "velocity")

    def __init__(self) -> None:
        self.start_ns = 0
        self.position = 0.0
        self.velocity = 0.0
        self.acceleration = 0.0
        self.duration_s = 0.0
        self._planned: tuple[_Planned, ...] = ()
        self._end = 0.0
        self._end_s = 0.0

    def at(self, now_ns: int) -> float:
        """Demand in counts at ``now_ns``; before the start it is the start's, after the end the end's."""
        t = (now_ns - self.start_ns) * _S_PER_NS
        if t >= self.duration_s:
            if self._planned:
                return self._beyond(t)[0]
            t = self.duration_s
        elif t < 0.0:
            t = 0.0
        return self.position + (self.velocity + 0.5 * self.acceleration * t) * t

    def velocity_at(self, now_ns: int) -> float:
        """Demand velocity in counts/s at ``now_ns``."""
        t = (now_ns - self.start_ns) * _S_PER_NS
        if t >= self.duration_s:
            return self._beyond(t)[1] if self._planned else 0.0
        return self.velocity + self.acceleration * max(t, 0.0)

    def is_over(self, now_ns: int) -> bool:
        """Whether the demand has come to rest."""
        return (now_ns - self.start_ns) * _S_PER_NS >= (self._end_s if self._planned else self.duration_s)

    @property
    def is_planned(self) -> bool:
        """Whether it is a plan, rather than a line or a ramp that will soon be over."""
        return bool(self._planned)

    def _beyond(self, t: float) -> tuple[float, float]:
        """Position and velocity of a plan after its first piece, or in that if it has a jerk."""
        if t >= self._end_s:
            return self._end, 0.0
        for start_s, position, velocity, acceleration, jerk in reversed(self._planned):
            if t >= start_s:
                t -= start_s
                if jerk == 0.0:
                    return position + (velocity + 0.5 * acceleration * t) * t, velocity + acceleration * t
                return (
                    position + (velocity + (0.5 * acceleration + jerk * t / 6.0) * t) * t,
                    velocity + (acceleration + 0.5 * jerk * t) * t,
                )
        return self.position, self.velocity

    def acceleration_at(self, now_ns: int) -> float:
        """Demand acceleration in counts/s^2 at ``now_ns``."""
        t = (now_ns - self.start_ns) * _S_PER_NS
        if not self._planned:
            return self.acceleration if 0.0 <= t < self.duration_s else 0.0
        if t < self._end_s:
            for piece in reversed(self._planned):
                if t >= piece.start_s:
                    return piece.acceleration + piece.jerk * (t - piece.start_s)
        return 0.0

    def span_ahead(self, now_ns: int) -> tuple[float, float]:
        """Least and greatest position from ``now_ns`` on, in counts; infinite if it never comes to rest."""
        t = (now_ns - self.start_ns) * _S_PER_NS
        positions = [self.at(now_ns)]
        if self._planned:
            positions += [piece.position for piece in self._planned if piece.start_s > t]
            last = self._planned[-1]
            positions.append(inf * last.velocity if self._end_s == inf and last.velocity != 0.0 else self._end)
        else:
            positions.append(
                self.position + (self.velocity + 0.5 * self.acceleration * self.duration_s) * self.duration_s
            )
        return min(positions), max(positions)

    def hold(self, position: float) -> None:
        """Stay at ``position``."""
        self.position = position
        self.velocity = 0.0
        self.acceleration = 0.0
        self.duration_s = 0.0
        self._planned = ()

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
        self._planned = ()

    def brake(self, now_ns: int, deceleration: float) -> None:
        """Ramp the present velocity down to standstill with ``deceleration`` (counts/s^2, positive)."""
        position = self.at(now_ns)
        velocity = self.velocity_at(now_ns)
        self.start_ns = now_ns
        self.position = position
        self.velocity = velocity
        self.acceleration = -deceleration if velocity > 0.0 else deceleration
        self.duration_s = abs(velocity) / deceleration
        self._planned = ()

    def launch(self, position: float, velocity: float, now_ns: int) -> None:
        """Be at ``position`` with ``velocity`` (counts/s) now, and go on so."""
        self.position = position
        self.start_ns = now_ns
        self.velocity = velocity
        self.acceleration = 0.0
        self.duration_s = inf
        self._planned = ()
        self.plan([Piece(0.0, inf)], now_ns)

    def plan(self, pieces: Sequence[Piece], now_ns: int, end: float | None = None) -> None:
        """Go on from where the demand is now, with the velocity it has, in ``pieces``.

        After the last one, unless that is infinite, it rests: at ``end`` if given, which is then where the pieces lead.
        """
        position = self.at(now_ns)
        velocity = self.velocity_at(now_ns)
        planned: list[_Planned] = []
        start_s = 0.0
        for acceleration, duration_s, jerk in pieces:
            planned.append(_Planned(start_s, position, velocity, acceleration, jerk))
            start_s += duration_s
            if jerk != 0.0:
                position += (velocity + (0.5 * acceleration + jerk * duration_s / 6.0) * duration_s) * duration_s
                velocity += (acceleration + 0.5 * jerk * duration_s) * duration_s
            elif duration_s < inf:
                position += (velocity + 0.5 * acceleration * duration_s) * duration_s
                velocity += acceleration * duration_s
        if not planned:
            self.hold(position if end is None else end)
            return
        self.start_ns = now_ns
        _, self.position, self.velocity, self.acceleration, jerk = planned[0]
        # The parabola that is looked at first has no jerk: a piece that has one is looked up like the later ones.
        self.duration_s = pieces[0].duration_s if jerk == 0.0 else 0.0
        self._planned = tuple(planned)
        self._end = position if end is None else end
        self._end_s = start_s
