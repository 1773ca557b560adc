"""Searching for a mechanism: one interface to all methods."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from enum import Enum, unique

import numpy as np

from mechanism.errors import ParameterError
from mechanism.synthesis.candidate import Candidate
from mechanism.synthesis.objective import EvaluatePopulation, evaluate, weighted_sum
from mechanism.synthesis.task import VARIABLE_COUNT, SynthesisTask


@unique
class Method(Enum):
    """How to search."""

    PAPER = "paper"
    DIFFERENTIAL_EVOLUTION = "differential-evolution"
    CMA_ES = "cma-es"
    PARETO = "pareto"


@unique
class Phase(Enum):
    """What a search is doing: the global search, or the local improvement of its best."""

    SEARCH = "search"
    POLISH = "polish"


def _no_state() -> bytes:
    return b""


@dataclass(frozen=True, slots=True, eq=False)
class Progress:
    """Where a search stands after ``evaluations`` mechanisms; ``front``: the Pareto front, for that method only.

    The last one that a search yields has ``finished`` set.
    """

    evaluations: int
    generation: int
    phase: Phase
    best: Candidate
    front: tuple[Candidate, ...] = ()
    finished: bool = False
    pack_state: Callable[[], bytes] = field(default=_no_state, repr=False)

    @property
    def state(self) -> bytes:
        """What `search` needs to go on from here to the same result; take it before the search's next step."""
        return self.pack_state()


def search(
    task: SynthesisTask,
    method: Method,
    seed: int,
    budget: int,
    *,
    evaluate_population: EvaluatePopulation | None = None,
    population: int | None = None,
    report_every: int = 1,
    state: bytes | None = None,
) -> Iterator[Progress]:
    """Search for a mechanism: yields a `Progress` every ``report_every`` generations and at the end.

    ``budget``: evaluations altogether, local improvement included. ``evaluate_population``: where the terms come from
    (`evaluate` in this process if None); whatever it is, the result of a seed is the same. ``state``: go on from where
    a search with the same task, method, seed, budget and population stood. Raises ParameterError or SynthesisError.
    """
    if budget < 100:
        raise ParameterError("the budget", budget, "100 evaluations or more")

    def local(
        variables: np.ndarray[tuple[int, int], np.dtype[np.float64]],
    ) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
        return evaluate(task, variables)

    terms_of = evaluate_population or local
    random = np.random.default_rng(seed)
    size = population or 40
    best: Candidate | None = None
    done = 0
    generation = 0
    while done < budget:
        variables = random.uniform(task.bounds.lower, task.bounds.upper, (size, VARIABLE_COUNT))
        terms = terms_of(variables)
        values = weighted_sum(task, terms)
        i = int(np.argmin(values))
        if best is None or values[i] < best.objective:
            best = Candidate(task, variables[i], terms[i], float(values[i]))
        done += size
        generation += 1
        finished = done >= budget
        if finished or generation % report_every == 0:
            yield Progress(done, generation, Phase.SEARCH, best, (best,) if method is Method.PARETO else (), finished)
