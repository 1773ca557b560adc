"""The paper's global search: its genetic algorithm, with its parameters (section 2.2.4).

The paper leaves open how a mechanism is written down as a string, what its fitness is, and how far the search ranges.
Ten bits a variable are taken, whose step of about a millimetre suits the whole millimetres of its result, and the
reciprocal of the objective; one place to cut a string in, and every bit flips with the mutation rate.
"""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mechanism.errors import ParameterError
from mechanism.jit import COMPILED
from mechanism.synthesis.genetic_kernels import BITS, DRAWS, breed, decode, run_generations, scale_fitness
from mechanism.synthesis.objective import prepare
from mechanism.synthesis.run import Run, Saved, Step, Steps, load_random, save_random
from mechanism.synthesis.task import VARIABLE_COUNT

Float = NDArray[np.float64]
Integers = NDArray[np.int64]

POPULATION: Final = 40
CROSSOVER: Final = 0.85
MUTATION: Final = 0.03


class _Genetic:
    """The population and what acts on it."""

    def __init__(self, run: Run) -> None:
        size = run.population or POPULATION
        if size % 2:
            raise ParameterError("the population of the paper's method", size, "even")
        self.run = run
        self.generation = 0
        self.random = np.random.default_rng(run.seed)
        self.codes: Integers = np.zeros((size, VARIABLE_COUNT), dtype=np.int64)
        self.values: Float = np.full(size, np.inf)
        self._children = np.zeros_like(self.codes)
        self._population = np.zeros((size, VARIABLE_COUNT))
        if run.saved is not None:
            self._restore(run.saved)

    def begin(self) -> None:
        """The first population, at random."""
        self.codes = self.random.integers(0, 2**BITS, self.codes.shape, dtype=np.int64)
        self._evaluate()

    def advance(self, generations: int) -> None:
        """So many generations; in one go where kernels can evaluate as well."""
        draws = self.random.random((generations, self.codes.shape[0] // 2, DRAWS))
        prepared = prepare(self.run.task)
        if COMPILED and self.run.local and prepared.paper_only:
            self._advance_in_kernels(draws)
        else:
            fitness = np.empty(self.values.size)
            for block in draws:
                scale_fitness(self.values, fitness)
                breed(self.codes, fitness, block, CROSSOVER, MUTATION, self._children)
                self.codes, self._children = self._children, self.codes
                self._evaluate()
        self.generation += generations

    def save(self) -> Saved:
        """Everything that decides what comes next."""
        header: dict[str, Any] = {"generation": self.generation, "random": save_random(self.random)}
        return header, {"codes": self.codes, "values": self.values}

    def _restore(self, saved: Saved) -> None:
        header, arrays = saved
        self.generation = int(header["generation"])
        self.random = load_random(header["random"])
        self.codes = arrays["codes"]
        self.values = arrays["values"]

    def _evaluate(self) -> None:
        bounds = self.run.task.bounds
        decode(self.codes, bounds.lower, bounds.upper, self._population)
        _, self.values = self.run.ledger.evaluate(self._population)

    def _advance_in_kernels(self, draws: Float) -> None:
        task, ledger, prepared = self.run.task, self.run.ledger, prepare(self.run.task)
        terms = np.zeros(4)
        best = run_generations(
            self.codes,
            self.values,
            draws,
            CROSSOVER,
            MUTATION,
            task.bounds.lower,
            task.bounds.upper,
            prepared.rows,
            task.count,
            prepared.fourier,
            task.minimum_sine,
            prepared.columns,
            task.weights,
            self._population[0],
            terms,
            ledger.best_objective,
        )
        ledger.evaluations += draws.shape[0] * self.values.size
        ledger.offer(self._population[0], terms[prepared.columns], best)


def paper_steps(run: Run) -> Steps:
    """The genetic algorithm, until the search's share of the budget is used."""
    genetic = _Genetic(run)
    size = genetic.values.size
    if run.saved is None:
        genetic.begin()
    # The first population counts as the first generation.
    while True:
        left = (run.search_budget - run.ledger.evaluations) // size
        if left <= 0:
            break
        genetic.advance(min(left, run.report_every))
        yield Step(genetic.generation, genetic.save)
    yield Step(genetic.generation, genetic.save)
