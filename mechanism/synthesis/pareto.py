"""Several terms at once (the package pymoo, NSGA-II): not one best mechanism, but the front among which to choose."""

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


def _front(algorithm: Any, run: Run) -> tuple[Float, Float]:
    """Variables (k, 8) and objectives and constraints (k, f + c) of the front, sorted by the first objective."""
    best = algorithm.opt
    unit, rows = np.asarray(best.get("X"), dtype=np.float64), np.asarray(best.get("F"), dtype=np.float64)
    violations = np.asarray(best.get("G"), dtype=np.float64).reshape(unit.shape[0], -1)
    order = np.lexsort(rows.T[::-1])
    return run.spread(unit[order]), np.concatenate((rows, violations), axis=1)[order]


def pareto_steps(run: Run) -> Steps:
    """NSGA-II, until the search's share of the budget is used; every step has the front so far."""
    objectives, constraints = objective_columns(run.task)
    columns = objectives + constraints

    def answer(terms: Float, values: Float) -> Float:
        return np.nan_to_num(terms[:, columns], nan=1e300, posinf=1e300)

    random = np.random.default_rng(run.seed)
    size = run.population or POPULATION
    before = run.ledger.evaluations
    first = seeded_population(run, random, size)
    used = run.ledger.evaluations - before
    if run.saved is not None:
        run.ledger.evaluations = before
    journal = Journal(run, answer)
    algorithm = _algorithm(run, first, len(objectives), len(constraints), size)
    while used + size <= run.search_budget:
        replayed = journal.replaying
        offspring = algorithm.ask()
        unit = np.asarray(offspring.get("X"), dtype=np.float64)
        rows = journal.ask(run.spread(unit))
        offspring.set("F", rows[:, : len(objectives)])
        if constraints:
            offspring.set("G", rows[:, len(objectives) :])
        algorithm.tell(infills=offspring)
        used += unit.shape[0]
        if not replayed and journal.generation % run.report_every == 0:
            yield Step(journal.generation, journal.save, _front(algorithm, run))
    yield Step(journal.generation, journal.save, _front(algorithm, run))
