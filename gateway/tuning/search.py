"""Search for the gains of both axes together, in a simulated loop, under what is asked of the margins.

What is searched are six bandwidths, from which the gains follow: of each axis the crossover of its velocity loop (K_V),
of its position loop (K_P), and of its integral part (K_I). They are the same for machines of any size, so that the
search needs no gains to start from; the gains that are there take part in it, so that it never ends with worse ones.
K_F is K_V: a demand that is followed exactly then asks nothing of the controller, and feed-forward has nothing to
fight. K_D is left at 0: in eq (5) it does what K_V and K_F do together.
"""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Final, cast

import numpy as np
import scipy.optimize  # pyright: ignore[reportMissingTypeStubs]
from numpy.typing import NDArray

from gateway.errors import GatewayError
from gateway.tuning.controller import GAIN_MAXIMUM, GAIN_SCALE, SERVO_RATE_HZ, GainPair, Gains
from gateway.tuning.margins import (
    ASKED_DELAY_S,
    ASKED_GAIN_MARGIN_DB,
    LoopModel,
    Robustness,
    gain_array,
    loop_transfer,
    margins_of,
    robustness,
    spectral_radius,
)
from gateway.tuning.steady_cycle import SteadyCycle, SteadyFigures

Float = NDArray[np.float64]

DEFAULT_EVALUATIONS: Final = 1200
BANDWIDTH_BOUNDS_HZ: Final = ((2.0, 120.0), (1.0, 50.0), (0.1, 20.0))
"""Of velocity loop, position loop and integral part."""
_PARAMETERS: Final = 6
_POPULATION: Final = 30
_UNSTABLE: Final = 1e3
_TORN: Final = 1e2
_SLACK_DB: Final = 0.3
_SLACK_PEAK: Final = 0.03
"""What the search keeps of the bounds, because it looks at fewer positions than the statement that follows it."""
_COST_OF_DECIBEL: Final = 2.0
_COST_OF_PEAK: Final = 5.0
_WEIGHT_OF_PEAKS: Final = 0.2
_WEIGHT_OF_RMS: Final = 0.3
_MUTATION: Final = (0.4, 0.9)
_RECOMBINATION: Final = 0.85


@dataclass(frozen=True, slots=True)
class TuningGoals:
    """What is asked: pairs are (master, slave).

    ``peak_counts`` of the following error in the steady cycle set the scale on which both axes are weighed;
    ``gain_margin_dB``, ``delay_s`` (stable with that much additional delay) and ``sensitivity_peak`` are bounds;
    ``ripple_weight`` is what RMS torque steps of the rated torque cost beside errors of their goals' size.
    """

    peak_counts: tuple[float, float] = (8.0, 15.0)
    gain_margin_dB: float = ASKED_GAIN_MARGIN_DB
    delay_s: float = ASKED_DELAY_S
    sensitivity_peak: float = 2.1
    ripple_weight: float = 1.0


@dataclass(frozen=True, slots=True)
class Tuning:
    """Gains, and what they do."""

    gains: GainPair
    figures: SteadyFigures | None
    """None where the linkage tore."""
    robustness: Robustness

    def to_json(self, names: tuple[str, ...]) -> dict[str, Any]:
        """Plain values, by the axes' names."""
        return {
            "gains": {name: gains.to_json() for name, gains in zip(names, self.gains, strict=True)},
            "steady_cycle": None if self.figures is None else self.figures.to_json(names),
            "margins": self.robustness.to_json(),
        }


@dataclass(frozen=True, slots=True)
class SearchProgress:
    """Told after every evaluation."""

    evaluations: int
    total: int
    best_cost: float
    best_figures: SteadyFigures | None


class _Stopped(Exception):  # noqa: N818 - it is no error
    pass


class GainSearch:
    """The objective, with the best gains that it has met."""

    def __init__(
        self, cycle: SteadyCycle, coarse: LoopModel, rated_torque_Nm: tuple[float, float], goals: TuningGoals
    ) -> None:
        """``coarse``: the loop at as few positions and frequencies as are looked at in every evaluation."""
        self._cycle = cycle
        self._model = coarse
        self._rated = np.array(rated_torque_Nm)
        self._goals = goals
        self._inertia: Float = np.array([_inertia(coarse, axis) for axis in (0, 1)])
        self.evaluations = 0
        self.best_cost = np.inf
        self.best: Float | None = None
        self.best_figures: SteadyFigures | None = None

    def gains(self, bandwidths_hz: Float) -> Float:
        """(2, 5) whole gains with these bandwidths: velocity, position, integral of the master, then of the slave."""
        gains = np.zeros((2, 5))
        for axis, loop in enumerate(self._model.axes):
            velocity, position, integral = 2.0 * np.pi * bandwidths_hz[3 * axis : 3 * axis + 3]
            scale = loop.torque_per_unit_Nm / GAIN_SCALE * loop.counts_per_rad
            k_v = self._inertia[axis] * velocity / scale * SERVO_RATE_HZ
            k_p = k_v * position / SERVO_RATE_HZ
            gains[axis] = k_p, k_p * integral / SERVO_RATE_HZ, 0.0, k_v, k_v
        whole: Float = np.minimum(np.round(gains), float(GAIN_MAXIMUM))
        return whole

    def bandwidths(self, gains: Float) -> Float:
        """The inverse of ``gains``, within the bounds of the search."""
        found: list[float] = []
        for axis, loop in enumerate(self._model.axes):
            scale = loop.torque_per_unit_Nm / GAIN_SCALE * loop.counts_per_rad
            k_p, k_i, k_d, k_v, _ = np.maximum(gains[axis], 1e-9)
            damping = k_d + k_v
            rates = damping / SERVO_RATE_HZ * scale / self._inertia[axis], k_p / damping * SERVO_RATE_HZ
            found += [*rates, k_i / k_p * SERVO_RATE_HZ]
        low, high = np.array(BANDWIDTH_BOUNDS_HZ * 2).T
        return np.clip(np.array(found) / (2.0 * np.pi), low, high)

    def cost(self, gains: Float) -> float:
        """What is to become small; gains that do not keep the bounds cost more the further they are from it."""
        self.evaluations += 1
        goals = self._goals
        radius = float(spectral_radius(self._model, gains, goals.delay_s).max())
        if radius >= 1.0:
            return _UNSTABLE * radius
        margins = margins_of(loop_transfer(self._model, gains), self._model.frequencies_hz, self._model.theta2)
        short_dB = goals.gain_margin_dB + _SLACK_DB - margins.gain_dB.value
        over = margins.sensitivity_peak.value - goals.sensitivity_peak + _SLACK_PEAK
        cost = _COST_OF_DECIBEL * max(0.0, short_dB) + _COST_OF_PEAK * max(0.0, over)
        figures = self._cycle.run(gains)
        if figures is None:
            return _TORN + cost
        asked = np.array(goals.peak_counts)
        peaks = np.array(figures.peak_counts) / asked
        rms = np.array(figures.rms_counts) / asked
        ripple = np.array(figures.ripple_Nm) / self._rated
        cost += float(peaks.max() + _WEIGHT_OF_PEAKS * peaks.sum() + _WEIGHT_OF_RMS * rms.sum())
        cost += goals.ripple_weight * float(ripple.sum())
        if cost < self.best_cost:
            self.best_cost, self.best, self.best_figures = cost, gains.copy(), figures
        return cost


def _inertia(model: LoopModel, axis: int) -> float:
    """Greatest inertia that an axis feels on its own over the cycle, kg m^2."""
    return float((1.0 / model.a[:, 2 + axis, 4 + axis]).max())


def search_gains(
    search: GainSearch,
    present: Float,
    evaluations: int = DEFAULT_EVALUATIONS,
    seed: int = 1,
    on_progress: Callable[[SearchProgress], None] | None = None,
    is_stopped: Callable[[], bool] = lambda: False,
) -> Float:
    """The best gains (2, 5) of about ``evaluations``: differential evolution, the same for the same ``seed``.

    ``is_stopped`` is asked after every evaluation; what has been found until then is kept. Raises GatewayError if no
    gains that were tried are stable.
    """
    low, high = np.log(np.array(BANDWIDTH_BOUNDS_HZ * 2)).T

    def objective(x: Float) -> float:
        if search.evaluations >= evaluations or is_stopped():
            raise _Stopped
        cost = search.cost(search.gains(np.exp(x)))
        if on_progress is not None:
            on_progress(SearchProgress(search.evaluations, evaluations, search.best_cost, search.best_figures))
        return cost

    search.cost(present)
    start = np.random.default_rng(seed).uniform(low, high, (_POPULATION, _PARAMETERS))
    start[0] = np.log(search.bandwidths(present))
    start[1] = np.log([12.0, 8.0, 1.0, 30.0, 10.0, 2.0])
    optimise = cast("Callable[..., Any]", scipy.optimize.differential_evolution)  # pyright: ignore[reportUnknownMemberType]
    with suppress(_Stopped):
        optimise(
            objective,
            list(zip(low, high, strict=True)),
            init=start,
            rng=seed,
            maxiter=10_000,
            polish=False,
            strategy="currenttobest1bin",
            tol=1e-3,
            mutation=_MUTATION,
            recombination=_RECOMBINATION,
        )
    if search.best is None:
        raise GatewayError("no gains that were tried are stable with the delay that is asked for")
    return search.best


def state_tuning(cycle: SteadyCycle, model: LoopModel, gains: Float) -> Tuning:
    """What ``gains`` (2, 5) do, over all positions of ``model``."""
    stated = robustness(model, gains)
    # An unstable loop is not simulated: what it did would say nothing.
    figures = cycle.run(gains) if stated.is_stable else None
    return Tuning((Gains.of(gains[0].tolist()), Gains.of(gains[1].tolist())), figures, stated)


def gains_of(pair: GainPair) -> Float:
    """(2, 5), as the search and the margins have them."""
    return gain_array(pair)
