"""The figures of the paper's section 3.2 from the servo ticks of a run, as its own data logger had them.

Everything is worked out from one sample a servo period (1024 Hz): the following error is the demand, rounded to counts,
less the resolver's counts, which is what the controller of eq. (5) sees; a velocity is the difference of two samples
that follow each other, and so a multiple of 1024 counts/s.
"""

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gateway.reporting import paper_reference as paper
from mechanism.five_bar import Closure, FiveBar

FloatArray = NDArray[np.float64]

SERVO_RATE_HZ: Final = 1024.0
LAG_SPAN: Final = 8
"""Samples on either side of one over which the demand's direction is found: rounded targets have none in between."""
_MASTER: Final = 0
_SLAVE: Final = 1


@dataclass(frozen=True, slots=True)
class ServoTicks:
    """n servo ticks; columns are master and slave, counts start at 0 at the home position."""

    demand_counts: FloatArray
    counts: FloatArray
    torque_Nm: FloatArray
    drawn_J: FloatArray
    """(n, 2): energy drawn since power-on; (0, 2) where nobody has counted it."""
    counts_per_revolution: float = 4096.0

    @property
    def errors(self) -> FloatArray:
        """Following errors (n, 2) in counts."""
        return np.floor(self.demand_counts + 0.5) - self.counts

    @property
    def revolutions(self) -> FloatArray:
        """theta2 demanded, in revolutions since the start (n,)."""
        return self.demand_counts[:, _MASTER] / self.counts_per_revolution

    def between(self, first: float, last: float) -> slice:
        """The ticks from one number of revolutions of the master on to before another."""
        turned = self.revolutions
        start, end = np.searchsorted(turned, [first, last])
        return slice(max(1, int(start)), int(end))


@dataclass(frozen=True, slots=True)
class AxisReproduction:
    """An axis over some revolutions."""

    error_extreme_counts: float
    """The error of the greatest absolute value, with its sign."""
    error_extreme_at_deg: float
    """theta2 demanded there."""
    error_max_counts: float
    error_min_counts: float
    velocity_max_counts_per_s: float
    velocity_min_counts_per_s: float
    torque_max_Nm: float
    torque_min_Nm: float
    torque_rms_Nm: float
    energy_per_cycle_J: float | None


@dataclass(frozen=True, slots=True)
class Reproduction:
    """What section 3.2, Table I and Table II of the paper have, over some revolutions."""

    revolutions: int
    master: AxisReproduction
    slave: AxisReproduction
    slave_maximum_counts: float
    master_velocity_error_counts_per_s: float
    """Greatest difference of the one-sample velocity from the constant demand."""
    lag_share: float
    """Share of the cycle in which the slave's error has the sign of its demand's velocity."""
    return_from_deg: float
    return_to_deg: float
    """theta2 between which the slave's demand goes back, from its maximum to its minimum."""
    points_mm: tuple[tuple[float, float], ...]
    """The end effector where the master *is* at the angles of Table II, mean over the revolutions."""
    distances_mm: tuple[float, ...]
    """From the paper's measured points."""

    @property
    def power_ratio(self) -> float | None:
        """Energy that the master's amplifier draws for each joule of the slave's."""
        master, slave = self.master.energy_per_cycle_J, self.slave.energy_per_cycle_J
        return None if master is None or not slave else master / slave

    def to_json(self) -> dict[str, Any]:
        """Plain values, rounded to what means something."""
        return {
            "revolutions": self.revolutions,
            "cv": _axis_json(self.master),
            "servo": {
                **_axis_json(self.slave),
                "position_max_counts": self.slave_maximum_counts,
                "lag_share": round(self.lag_share, 3),
                "return_from_deg": round(self.return_from_deg, 1),
                "return_to_deg": round(self.return_to_deg, 1),
            },
            "cv_velocity_error_counts_per_s": self.master_velocity_error_counts_per_s,
            "power_ratio_cv_to_servo": None if self.power_ratio is None else round(self.power_ratio, 2),
            "table_ii": [
                {
                    "cv_deg": point.cv_deg,
                    "actual_mm": [round(value, 1) for value in here],
                    "paper_measured_mm": list(point.measured_mm),
                    "distance_mm": round(distance, 1),
                }
                for point, here, distance in zip(paper.TABLE_II, self.points_mm, self.distances_mm, strict=True)
            ],
        }


def reproduce(ticks: ServoTicks, window: slice, five_bar: FiveBar, closure: Closure) -> Reproduction:
    """The figures of the ticks in ``window``, which are whole revolutions at constant speed of the master.

    Raises ValueError where the window is empty.
    """
    if window.stop - window.start < 2 * LAG_SPAN:
        raise ValueError("a reproduction needs a whole revolution at constant speed")
    turned = ticks.revolutions[window]
    revolutions = max(1, round(float(turned[-1] - turned[0])))
    demand = ticks.demand_counts[window, _SLAVE]
    # The one cycle of demand that its extremes are sought in begins with the window, which is a whole revolution.
    one = demand[: len(demand) // revolutions]
    top = int(np.argmax(one))
    bottom = top + int(np.argmin(one[top:]))
    in_turn = (turned - math.floor(turned[0] + 0.5)) * 360.0
    demand_velocity = np.mean(_one_sample_velocity(ticks.demand_counts, window, _MASTER))
    velocity_error = _one_sample_velocity(ticks.counts, window, _MASTER) - round(float(demand_velocity))
    points = _points(ticks, window, five_bar, closure)
    return Reproduction(
        revolutions=revolutions,
        master=_axis(ticks, window, _MASTER, revolutions),
        slave=_axis(ticks, window, _SLAVE, revolutions),
        slave_maximum_counts=float(ticks.counts[window, _SLAVE].max()),
        master_velocity_error_counts_per_s=float(np.abs(velocity_error).max()),
        lag_share=_lag_share(ticks, window),
        return_from_deg=float(in_turn[top]),
        return_to_deg=float(in_turn[bottom]),
        points_mm=points,
        distances_mm=tuple(
            math.dist(here, point.measured_mm) for here, point in zip(points, paper.TABLE_II, strict=True)
        ),
    )


def _axis(ticks: ServoTicks, window: slice, axis: int, revolutions: int) -> AxisReproduction:
    error = ticks.errors[window, axis]
    worst = int(np.argmax(np.abs(error)))
    velocity = _one_sample_velocity(ticks.counts, window, axis)
    torque = ticks.torque_Nm[window, axis]
    energy = ticks.drawn_J
    return AxisReproduction(
        error_extreme_counts=float(error[worst]),
        error_extreme_at_deg=float(ticks.revolutions[window][worst] % 1.0 * 360.0),
        error_max_counts=float(error.max()),
        error_min_counts=float(error.min()),
        velocity_max_counts_per_s=float(velocity.max()),
        velocity_min_counts_per_s=float(velocity.min()),
        torque_max_Nm=float(torque.max()),
        torque_min_Nm=float(torque.min()),
        torque_rms_Nm=float(np.sqrt(np.mean(np.square(torque)))),
        energy_per_cycle_J=(
            float(energy[window.stop - 1, axis] - energy[window.start - 1, axis]) / revolutions if len(energy) else None
        ),
    )


def _one_sample_velocity(counts: FloatArray, window: slice, axis: int) -> FloatArray:
    """Differences to the sample before, counts/s; the first one reaches back out of the window."""
    return np.diff(counts[window.start - 1 : window.stop, axis]) * SERVO_RATE_HZ


def _lag_share(ticks: ServoTicks, window: slice) -> float:
    demand = ticks.demand_counts[:, _SLAVE]
    index: NDArray[np.int64] = np.arange(window.start, window.stop, dtype=np.int64)
    behind = np.maximum(index - LAG_SPAN, 0)
    ahead = np.minimum(index + LAG_SPAN, len(demand) - 1)
    direction = np.sign(demand[ahead] - demand[behind])
    return float(np.mean(ticks.errors[window, _SLAVE] * direction > 0.0))


def _points(ticks: ServoTicks, window: slice, five_bar: FiveBar, closure: Closure) -> tuple[tuple[float, float], ...]:
    """The end effector (mm) where the master's counts pass each angle of Table II, mean over all times it does."""
    scale = math.tau / ticks.counts_per_revolution
    theta2 = ticks.counts[window, _MASTER] * scale
    theta5 = ticks.counts[window, _SLAVE] * scale
    path = five_bar.end_effector(theta2, theta5, closure) * 1e3
    # The resolver trembles by a count: interpolation wants angles that only grow.
    rising = np.maximum.accumulate(theta2)
    found: list[tuple[float, float]] = []
    for point in paper.TABLE_II:
        wanted = math.radians(point.cv_deg)
        first = math.ceil((rising[0] - wanted) / math.tau)
        last = math.floor((rising[-1] - wanted) / math.tau)
        at = [wanted + turn * math.tau for turn in range(first, last + 1)]
        x, y = (float(np.interp(at, rising, path[:, k]).mean()) if at else math.nan for k in (0, 1))
        found.append((x, y))
    return tuple(found)


def _axis_json(axis: AxisReproduction) -> dict[str, Any]:
    energy = axis.energy_per_cycle_J
    return {
        "error_extreme_counts": axis.error_extreme_counts,
        "error_extreme_at_deg": round(axis.error_extreme_at_deg, 1),
        "error_max_counts": axis.error_max_counts,
        "error_min_counts": axis.error_min_counts,
        "velocity_max_counts_per_s": axis.velocity_max_counts_per_s,
        "velocity_min_counts_per_s": axis.velocity_min_counts_per_s,
        "torque_max_Nm": round(axis.torque_max_Nm, 3),
        "torque_min_Nm": round(axis.torque_min_Nm, 3),
        "torque_rms_Nm": round(axis.torque_rms_Nm, 3),
        "energy_per_cycle_J": None if energy is None else round(energy, 2),
    }
