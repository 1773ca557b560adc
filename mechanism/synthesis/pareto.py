"""Several terms at once (the package pymoo, NSGA-II): not one best mechanism, but the front among which to choose."""

from collections.abc import Callable
from typing import Any, Final, cast

import numpy as np
from numpy.typing import NDArray

from mechanism.errors import SynthesisError
from mechanism.synthesis.crank_dyads import seeded_population
from mechanism.synthesis.journal import Journal
from mechanism.synthesis.run import Run, Step, Steps
from mechanism.synthesis.task import VARIABLE_COUNT, SynthesisTask, Term, WeightedTerm

Float = NDArray[np.float64]

POPULATION: Final = 100

PARETO_TERMS: Final = (
    WeightedTerm(Term.STRUCTURAL_ERROR),
    WeightedTerm(Term.MOBILITY),
    WeightedTerm(Term.SINGULARITY),
    WeightedTerm(Term.PEAK_TORQUE),
    WeightedTerm(Term.TRANSMISSION_ANGLE),
)
"""Error against the servo's peak torque against the transmission angle, of mechanisms that can move."""

CONSTRAINTS: Final = frozenset({Term.MOBILITY, Term.SINGULARITY, Term.TIMING, Term.KEEP_OUT})
"""Terms that a mechanism on the front must have at 0: what breaks them is no mechanism to choose."""


GREATEST_MEAN_ERROR: Final = 0.02
"""What misses the curve by more than so much of its size, averaged over the points, is not worth choosing either."""


def objective_columns(task: SynthesisTask) -> tuple[list[int], list[int]]:
    """Which of the task's terms are objectives of the front, and which are its constraints (weight 0: neither).

    Raises SynthesisError with fewer than two objectives.
    """
    objectives: list[int] = []
    constraints: list[int] = []
    for index, entry in enumerate(task.terms):
        if entry.weight > 0.0:
            (constraints if entry.term in CONSTRAINTS else objectives).append(index)
    if len(objectives) < 2:
        raise SynthesisError("a Pareto front needs at least two terms to weigh against each other")
    return objectives, constraints


def _algorithm(run: Run, first: Float, objectives: int, constraints: int, size: int) -> Any:
    try:
        from pymoo.algorithms.moo.nsga2 import NSGA2  # pyright: ignore[reportMissingTypeStubs]
        from pymoo.core.problem import Problem  # pyright: ignore[reportMissingTypeStubs]
        from pymoo.termination.max_gen import MaximumGenerationTermination  # pyright: ignore[reportMissingTypeStubs]
    except ImportError:
        raise SynthesisError(
            "the method pareto needs the package pymoo: pip install 'drive-gateway[synthesis]'"
        ) from None
    problem = cast("Any", Problem)(n_var=VARIABLE_COUNT, n_obj=objectives, n_ieq_constr=constraints, xl=0.0, xu=1.0)
    algorithm = cast("Any", NSGA2)(pop_size=size, sampling=first)
    algorithm.setup(
        problem,
        termination=cast("Any", MaximumGenerationTermination)(2**60),
        seed=run.seed % 2**32,
        verbose=False,
        copy_algorithm=False,
    )
    return algorithm


def _front(algorithm: Any, run: Run) -> Float:
    """The mechanisms (k, 8) of the front, sorted by the first objective."""
    best = algorithm.opt
    unit, rows = np.asarray(best.get("X"), dtype=np.float64), np.asarray(best.get("F"), dtype=np.float64)
    return run.spread(unit[np.lexsort(rows.T[::-1])])


def _answer(task: SynthesisTask) -> tuple[Callable[[Float, Float], Float], int, int]:
    """What the algorithm is told of the terms, how many of its columns are objectives, and how many constraints."""
    objectives, constraints = objective_columns(task)
    error = task.column(Term.STRUCTURAL_ERROR)
    per_size = 1e-3 / (task.count * task.size_m)

    def answer(terms: Float, values: Float) -> Float:
        table = np.nan_to_num(terms, nan=1e300, posinf=1e300)
        columns = [table[:, objectives], table[:, constraints]]
        if error is not None:
            # As a length: squared, the spread over the front would all be at its far end.
            mean_error = np.sqrt(table[:, error]) * per_size
            if error in objectives:
                columns[0][:, objectives.index(error)] = mean_error
            columns.append(mean_error[:, np.newaxis] - GREATEST_MEAN_ERROR)
        return np.concatenate(columns, axis=1)

    return answer, len(objectives), len(constraints) + (error is not None)


def pareto_steps(run: Run) -> Steps:
    """NSGA-II, until the search's share of the budget is used; every step has the front so far."""
    answer, objectives, constraints = _answer(run.task)
    random = np.random.default_rng(run.seed)
    size = run.population or POPULATION
    before = run.ledger.evaluations
    first = seeded_population(run, random, size)
    used = run.ledger.evaluations - before
    if run.saved is not None:
        run.ledger.evaluations = before
    journal = Journal(run, answer)
    algorithm = _algorithm(run, first, objectives, constraints, size)
    while used + size <= run.search_budget:
        replayed = journal.replaying
        offspring = algorithm.ask()
        unit = np.asarray(offspring.get("X"), dtype=np.float64)
        rows = journal.ask(run.spread(unit))
        offspring.set("F", rows[:, :objectives])
        if constraints:
            offspring.set("G", rows[:, objectives:])
        algorithm.tell(infills=offspring)
        used += unit.shape[0]
        if not replayed and journal.generation % run.report_every == 0:
            yield Step(journal.generation, journal.save, _front(algorithm, run))
    yield Step(journal.generation, journal.save, _front(algorithm, run))
