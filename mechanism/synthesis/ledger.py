"""What all methods share: how mechanisms are evaluated, how many have been, and the best so far."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mechanism.errors import SynthesisError
from mechanism.synthesis.candidate import Candidate
from mechanism.synthesis.objective import EvaluatePopulation, weighted_sum
from mechanism.synthesis.task import VARIABLE_COUNT, SynthesisTask

Float = NDArray[np.float64]


class Ledger:
    """Counts evaluations against the budget and keeps the best mechanism within the bounds."""

    __slots__ = ("_terms_of", "best_objective", "best_terms", "best_variables", "budget", "evaluations", "task")

    def __init__(self, task: SynthesisTask, terms_of: EvaluatePopulation, budget: int) -> None:
        self.task = task
        self._terms_of = terms_of
        self.budget = budget
        self.evaluations = 0
        self.best_variables: Float = np.zeros(VARIABLE_COUNT)
        self.best_terms: Float = np.zeros(len(task.terms))
        self.best_objective = np.inf

    @property
    def left(self) -> int:
        """How many evaluations the budget has left."""
        return self.budget - self.evaluations

    def evaluate(self, population: Float) -> tuple[Float, Float]:
        """Terms (m, terms) and weighted sums (m,) of a population (m, 8)."""
        terms = np.asarray(self._terms_of(population), dtype=np.float64)
        expected = (population.shape[0], len(self.task.terms))
        if terms.shape != expected:
            raise SynthesisError(f"the evaluation gave an array of shape {terms.shape}, expected {expected}")
        values = weighted_sum(self.task, terms)
        self.evaluations += population.shape[0]
        if values.size:
            best = int(np.argmin(values))
            self.offer(population[best], terms[best], float(values[best]))
        return terms, values

    def offer(self, variables: Float, terms: Float, objective: float) -> bool:
        """Take a mechanism for the best if it is."""
        if not objective < self.best_objective:
            return False
        self.best_variables = variables.copy()
        self.best_terms = terms.copy()
        self.best_objective = objective
        return True

    def best(self) -> Candidate:
        """The best so far."""
        return Candidate(self.task, self.best_variables, self.best_terms, self.best_objective)

    def save(self) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        """Header and arrays for `state.pack`."""
        header = {"evaluations": self.evaluations, "best_objective": self.best_objective}
        return header, {"best_variables": self.best_variables, "best_terms": self.best_terms}

    def restore(self, header: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> None:
        """Take up what `save` gave."""
        self.evaluations = int(header["evaluations"])
        self.best_objective = float(header["best_objective"])
        self.best_variables = arrays["best_variables"]
        self.best_terms = arrays["best_terms"]
