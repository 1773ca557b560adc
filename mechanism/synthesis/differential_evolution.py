"""Differential evolution with a success history and a population that shrinks (L-SHADE; Tanabe and Fukunaga, 2014).

Written here, because a search must be able to step, to be saved and to go on, none of which scipy's offers, and because
with kernels as fast as these the optimiser is what takes the time.
"""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mechanism.synthesis.crank_dyads import seeded_population
from mechanism.synthesis.evolution_kernels import UNIFORM_DRAWS, make_trials
from mechanism.synthesis.run import Run, Saved, Step, Steps, load_random, save_random
from mechanism.synthesis.task import VARIABLE_COUNT

Float = NDArray[np.float64]

POPULATION: Final = 144
"""18 a variable, as the authors take."""
LEAST_POPULATION: Final = 4
_MEMORY: Final = 6
_GREEDY_SHARE: Final = 0.11
_ARCHIVE: Final = 2.6


class _Evolution:
    def __init__(self, run: Run) -> None:
        self.run = run
        self.start_size = max(run.population or POPULATION, LEAST_POPULATION)
        self.random = np.random.default_rng(run.seed)
        self.generation = 0
        self.slot = 0
        self.unit: Float = np.zeros((0, VARIABLE_COUNT))
        self.values: Float = np.zeros(0)
        self.archive: Float = np.zeros((0, VARIABLE_COUNT))
        self.memory: Float = np.full((2, _MEMORY), 0.5)
        if run.saved is not None:
            self._restore(run.saved)

    def begin(self) -> None:
        """The first population: at random, part of it with crank dyads that suit the curve."""
        self.unit = seeded_population(self.run, self.random, self.start_size)
        _, self.values = self.run.ledger.evaluate(self.run.spread(self.unit))

    def advance(self) -> None:
        """One generation."""
        trial, crossover, scale = self._trials()
        _, values = self.run.ledger.evaluate(self.run.spread(trial))
        better = values < self.values
        gain = np.where(better, self.values - values, 0.0)
        self._remember(crossover[better], scale[better], gain[better])
        self._keep_losers(self.unit[better])
        accepted = values <= self.values
        self.unit[accepted] = trial[accepted]
        self.values[accepted] = values[accepted]
        self._shrink()
        self.generation += 1

    def save(self) -> Saved:
        """Everything that decides what comes next."""
        header: dict[str, Any] = {
            "generation": self.generation,
            "slot": self.slot,
            "random": save_random(self.random),
        }
        return header, {"unit": self.unit, "values": self.values, "archive": self.archive, "memory": self.memory}

    def _restore(self, saved: Saved) -> None:
        header, arrays = saved
        self.generation = int(header["generation"])
        self.slot = int(header["slot"])
        self.random = load_random(header["random"])
        self.unit, self.values = arrays["unit"], arrays["values"]
        self.archive, self.memory = arrays["archive"], arrays["memory"]

    def _trials(self) -> tuple[Float, Float, Float]:
        """Trials (m, 8) in the unit cube, and the crossover rates and scale factors that made them."""
        count = self.values.size
        trials, crossover, scale = np.empty_like(self.unit), np.empty(count), np.empty(count)
        make_trials(
            self.unit,
            np.argsort(self.values, kind="stable"),
            self.archive,
            self.memory,
            self.random.random((count, UNIFORM_DRAWS)),
            self.random.standard_normal(count),
            self.random.standard_cauchy(count),
            _GREEDY_SHARE,
            trials,
            crossover,
            scale,
        )
        return trials, crossover, scale

    def _remember(self, crossover: Float, scale: Float, gain: Float) -> None:
        """Put the gain-weighted Lehmer means of what worked into the memory."""
        finite = np.isfinite(gain)
        crossover, scale, gain = crossover[finite], scale[finite], gain[finite]
        if not gain.size or not gain.sum() > 0.0:
            return
        weights = gain / gain.sum()
        self.memory[1, self.slot] = (weights @ scale**2) / (weights @ scale)
        if self.memory[0, self.slot] >= 0.0:
            mean = weights @ crossover
            self.memory[0, self.slot] = (weights @ crossover**2) / mean if mean > 0.0 else -1.0
        self.slot = (self.slot + 1) % _MEMORY

    def _keep_losers(self, losers: Float) -> None:
        self.archive = np.concatenate((self.archive, losers))
        room = int(_ARCHIVE * self.values.size)
        if self.archive.shape[0] > room:
            keep = self.random.permutation(self.archive.shape[0])[:room]
            self.archive = self.archive[np.sort(keep)]

    def _shrink(self) -> None:
        """Fewer members as the budget is used, the best ones, down to the least."""
        share = min(self.run.ledger.evaluations / self.run.search_budget, 1.0)
        size = round(self.start_size + (LEAST_POPULATION - self.start_size) * share)
        if size < self.values.size:
            keep = np.sort(np.argsort(self.values, kind="stable")[:size])
            self.unit, self.values = self.unit[keep], self.values[keep]


def differential_evolution_steps(run: Run) -> Steps:
    """Differential evolution, until the search's share of the budget is used."""
    evolution = _Evolution(run)
    if run.saved is None:
        evolution.begin()
    while run.ledger.evaluations + evolution.values.size <= run.search_budget:
        evolution.advance()
        if evolution.generation % run.report_every == 0:
            yield Step(evolution.generation, evolution.save)
    yield Step(evolution.generation, evolution.save)
