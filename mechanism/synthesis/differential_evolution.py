"""Differential evolution with a success history and a population that shrinks (L-SHADE; Tanabe and Fukunaga, 2014).

Written here, because a search must be able to step, to be saved and to go on, none of which scipy's offers; it costs
about as much between two evaluations as that one does.
"""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mechanism.synthesis.crank_dyads import seeded_population
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
        count = self.values.size
        crossover, scale = self._parameters(count)
        trial = self._trials(crossover, scale)
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

    def _parameters(self, count: int) -> tuple[Float, Float]:
        """Crossover rates and scale factors around what has worked; a rate below 0 in the memory means 0 for good."""
        slots = self.random.integers(0, _MEMORY, count)
        middle = self.memory[0, slots]
        crossover = np.clip(self.random.normal(np.maximum(middle, 0.0), 0.1), 0.0, 1.0)
        crossover[middle < 0.0] = 0.0
        # Cauchy around the memory's scale; what falls below 0 is taken again in the original, mirrored here.
        scale = np.abs(self.memory[1, slots] + 0.1 * self.random.standard_cauchy(count))
        return crossover, np.clip(scale, 1e-3, 1.0)

    def _trials(self, crossover: Float, scale: Float) -> Float:
        """Current-to-best-few mutation and binomial crossover, kept inside the bounds, (m, 8) in the unit cube."""
        count = self.values.size
        order = np.argsort(self.values, kind="stable")
        few = max(round(_GREEDY_SHARE * count), 2)
        best = self.unit[order[self.random.integers(0, few, count)]]
        every = np.arange(count)
        first = self.random.integers(0, count - 1, count)
        first += first >= every
        pool = np.concatenate((self.unit, self.archive))
        second = self.random.integers(0, pool.shape[0] - 2, count)
        low, high = np.minimum(every, first), np.maximum(every, first)
        second += second >= low
        second += second >= high
        factor = scale[:, np.newaxis]
        mutant = self.unit + factor * (best - self.unit) + factor * (self.unit[first] - pool[second])
        mutant = np.where(mutant < 0.0, 0.5 * self.unit, mutant)
        mutant = np.where(mutant > 1.0, 0.5 * (1.0 + self.unit), mutant)
        take = self.random.random(mutant.shape) < crossover[:, np.newaxis]
        take[every, self.random.integers(0, VARIABLE_COUNT, count)] = True
        return np.where(take, mutant, self.unit)

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
