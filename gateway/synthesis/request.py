"""What a user asks of a synthesis, and the search settings that follow from it."""

from dataclasses import dataclass
from enum import Enum, unique
from math import pi
from pathlib import Path
from typing import Final

import numpy as np

from config.schema import GatewayConfig
from gateway.errors import UsageError
from gateway.synthesis.machine_files import machine_model
from gateway.synthesis.run_search import SearchSettings
from gateway.synthesis.task_options import bounds_with, default_weights, keep_out_zones, weighted_terms
from mechanism.curve_drawing import DRAWING_SUFFIXES, load_drawing
from mechanism.curve_points import CurvePoints, load_curve_points
from mechanism.errors import finite
from mechanism.synthesis.search import Method
from mechanism.synthesis.task import Bounds, SynthesisTask, Timing

DEFAULT_POINTS: Final = 36
DEFAULT_BUDGET: Final = {
    Method.PAPER: 10_000,
    Method.DIFFERENTIAL_EVOLUTION: 60_000,
    Method.CMA_ES: 20_000,
    Method.PARETO: 20_000,
}
"""Evaluations a start."""
DEFAULT_STARTS: Final = {
    Method.PAPER: 8,
    Method.DIFFERENTIAL_EVOLUTION: 4,
    Method.CMA_ES: 4,
    Method.PARETO: 1,
}
DEFAULT_POPULATION: Final = 40
"""The paper's, for turning generations into a budget."""


@unique
class TimingChoice(Enum):
    """Where the crank angles of the points come from: the file, equal steps, or the search."""

    PRESCRIBED = "prescribed"
    EVEN = "even"
    FREE = "free"


@dataclass(frozen=True, slots=True)
class SynthesisRequest:
    """A synthesis as the command line has it; None leaves a choice to the program; lengths in mm."""

    curve: Path
    template: GatewayConfig
    method: Method
    seed: int = 0
    budget: int | None = None
    generations: int | None = None
    population: int | None = None
    starts: int | None = None
    weights: tuple[str, ...] = ()
    bounds: tuple[str, ...] = ()
    keep_out: tuple[str, ...] = ()
    tolerance_mm: float | None = None
    timing: TimingChoice | None = None
    points: int = DEFAULT_POINTS
    mm_per_unit: float | None = None
    speed_rpm: float | None = None

    def settings(self) -> SearchSettings:
        """The search that is asked for. Raises UsageError, and CurveError or ParameterError for the curve."""
        points, timing = self._curve()
        zones = keep_out_zones(self.keep_out)
        bounds = bounds_with(self.bounds, Bounds.for_curve(points.x, points.y))
        speed = self.template.speed_rad_per_s if self.speed_rpm is None else self.speed_rpm * pi / 30.0
        if not (finite(speed) and 0.0 < speed <= self.template.ordered_axes[0].limits.velocity_rad_per_s):
            limit = self.template.ordered_axes[0].limits.velocity_rad_per_s * 30.0 / pi
            raise UsageError(f"--speed-rpm {self.speed_rpm}, bound above 0 to {limit:.4g}, the CV axis' limit")
        task = SynthesisTask(
            theta2=points.theta2,
            x=points.x,
            y=points.y,
            tolerances=self._tolerances(points),
            bounds=bounds,
            terms=weighted_terms(self.weights, default_weights(self.method, timing, bool(zones))),
            timing=timing,
            keep_out=zones,
            machine=machine_model(self.template),
            speed_rad_per_s=speed,
            minimum_sine=self.template.machine.minimum_transmission_sine,
            source=str(self.curve),
        )
        return SearchSettings(
            task=task,
            method=self.method,
            seed=self.seed,
            budget=self._budget(),
            starts=DEFAULT_STARTS[self.method] if self.starts is None else self.starts,
            population=self.population,
        )

    def _curve(self) -> tuple[CurvePoints, Timing]:
        is_drawing = self.curve.suffix.lower() in DRAWING_SUFFIXES
        points = (
            load_drawing(self.curve, self.points, self.mm_per_unit) if is_drawing else load_curve_points(self.curve)
        )
        choice = self.timing
        if choice is None:
            choice = TimingChoice.FREE if points.theta2 is None else TimingChoice.PRESCRIBED
        if choice is TimingChoice.PRESCRIBED and points.theta2 is None:
            raise UsageError(f"{self.curve}: has no theta2_deg to prescribe (--timing even or free needs none)")
        if choice is TimingChoice.EVEN:
            return points.timed_evenly(), Timing.PRESCRIBED
        return (points, Timing.PRESCRIBED) if choice is TimingChoice.PRESCRIBED else (points.untimed(), Timing.FREE)

    def _tolerances(self, points: CurvePoints) -> "np.ndarray[tuple[int], np.dtype[np.float64]] | None":
        if self.tolerance_mm is None:
            return points.tolerances
        if not (finite(self.tolerance_mm) and self.tolerance_mm >= 0.0):
            raise UsageError(f"--tolerance {self.tolerance_mm}, bound 0 or more")
        return np.full(points.count, self.tolerance_mm * 1e-3)

    def _budget(self) -> int:
        if self.generations is None:
            return DEFAULT_BUDGET[self.method] if self.budget is None else self.budget
        if self.budget is not None:
            raise UsageError("--budget and --generations say the same thing: give one of them")
        if self.generations < 1:
            raise UsageError(f"--generations {self.generations}, bound 1 or more")
        return self.generations * (self.population or DEFAULT_POPULATION)
