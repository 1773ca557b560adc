"""The slow way onto the cam, corner by corner: both axes in a straight line, at rest in every corner."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from gateway.record.sample import Phase
from gateway.units import AxisUnits, wrap_counts
from mechanism.approach import ApproachField, Point
from mechanism.motion import MasterPlan, plan_stop
from mechanism.smooth import bend_of_smooth, shortest_smooth_s, smooth

MASTER = 0


@dataclass(frozen=True, slots=True)
class ApproachLimits:
    """Of the faster axis: rad/s, rad/s^2, rad/s^3."""

    speed: float
    acceleration: float
    jerk: float


class ApproachDemand:
    """A `gateway.cyclic.demand.Demand` along straight lines in (theta2, theta5)."""

    def __init__(self, units: Sequence[AxisUnits], period_s: float, limits: ApproachLimits) -> None:
        self._units = tuple(units)
        self._period_s = period_s
        self._limits = limits
        self._corners: list[Point] = []
        self._held = (0, 0)
        self._start: Point = (0.0, 0.0)
        self._line = 0
        self._step = 0
        self._steps = 1
        self._stop: MasterPlan | None = None
        self._share = (0.0, 0.0, 0.0)
        """Of the line, 0 to 1: how far, velocity (1/s), acceleration (1/s^2)."""
        self.is_finished = True
        self.targets = [0, 0]
        self.torque_offsets = [0, 0]
        self.velocities = [0.0, 0.0]
        self.master_position = 0.0
        self.master_velocity = 0.0
        self.phase = Phase.STANDSTILL

    def begin(self, corners: Sequence[Point], held_targets: Sequence[int]) -> None:
        """Go from the first corner, where the axes are held at ``held_targets`` (counts), to the last one."""
        self._corners = list(corners)
        self._start = self._corners[0]
        self._held = held_targets[0], held_targets[1]
        self._stop = None
        self.targets = list(held_targets)
        self.is_finished = len(self._corners) < 2
        self._begin_line(0)

    def _begin_line(self, line: int) -> None:
        self._line = line
        self._step = 0
        self._share = (0.0, 0.0, 0.0)
        limits = self._limits
        duration_s = shortest_smooth_s(self._length(), limits.speed, limits.acceleration, limits.jerk)
        self._steps = max(int(duration_s / self._period_s) + 1, 1)

    def _length(self) -> float:
        """Of the line, by the axis that has the longer way."""
        (a2, a5), (b2, b5) = (
            self._corners[self._line : self._line + 2] if len(self._corners) > 1 else (self._start,) * 2
        )
        return max(abs(b2 - a2), abs(b5 - a5))

    def step(self) -> None:
        """Take the next step; see ``gateway.cyclic.demand.Demand``."""
        if self.is_finished:
            self.phase = Phase.STANDSTILL
            self.master_velocity = 0.0
            self.velocities = [0.0, 0.0]
            return
        self._step += 1
        # Also while it stops: it is the phases on the cam that are watched, and stopped, as such.
        self.phase = Phase.APPROACH
        self._share = self._move()
        share, rate, _ = self._share
        (a2, a5), (b2, b5) = self._corners[self._line], self._corners[self._line + 1]
        theta2, theta5 = a2 + share * (b2 - a2), a5 + share * (b5 - a5)
        self.master_position = theta2
        self.master_velocity = rate * (b2 - a2)
        self.velocities = [self.master_velocity, rate * (b5 - a5)]
        away = theta2 - self._start[0], theta5 - self._start[1]
        self.targets = [
            wrap_counts(held + units.counts_in(angle))
            for held, units, angle in zip(self._held, self._units, away, strict=True)
        ]
        self._go_on()

    def _move(self) -> tuple[float, float, float]:
        if self._stop is not None:
            return self._stop.at(self._step * self._period_s)
        duration_s = self._steps * self._period_s
        u = min(self._step / self._steps, 1.0)
        share, rate = smooth(u)
        return share, rate / duration_s, bend_of_smooth(u) / duration_s**2

    def _go_on(self) -> None:
        if self._stop is not None:
            self.is_finished = self._step * self._period_s >= self._stop.duration_s
        elif self._step >= self._steps:
            if self._line + 2 < len(self._corners):
                self._begin_line(self._line + 1)
            else:
                self.is_finished = True

    def controlled_stop(self) -> None:
        """Come to rest on the line, with limited jerk."""
        if self._stop is not None or self.is_finished:
            return
        length = max(self._length(), 1e-9)
        self._stop = plan_stop(*self._share, self._limits.acceleration / length, self._limits.jerk / length)
        self._step = 0


@dataclass(frozen=True, slots=True, eq=False)
class Approach:
    """What a session needs to start from anywhere."""

    field: ApproachField
    demand: ApproachDemand
    plan_from: Callable[[float], MasterPlan]
    """The run that begins with the master at this angle, rad."""
