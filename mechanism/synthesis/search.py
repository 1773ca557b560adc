"""Searching for a mechanism: one interface to all methods."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from enum import Enum, unique
from functools import partial
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mechanism.errors import ParameterError, SynthesisError
from mechanism.synthesis.candidate import Candidate
from mechanism.synthesis.cma_es import cma_es_steps
from mechanism.synthesis.differential_evolution import differential_evolution_steps
from mechanism.synthesis.ledger import Ledger
from mechanism.synthesis.objective import EvaluatePopulation, evaluate
from mechanism.synthesis.paper_method import paper_steps
from mechanism.synthesis.pareto import pareto_steps
from mechanism.synthesis.polish import polish, steepest_descent
from mechanism.synthesis.run import POLISH_SHARE, Phase, Run, Saved, Step, Steps
from mechanism.synthesis.state import fingerprint, pack, unpack
from mechanism.synthesis.task import SynthesisTask

__all__ = ["LEAST_BUDGET", "Method", "Phase", "Progress", "search"]

Float = NDArray[np.float64]

LEAST_BUDGET: Final = 500
LARGEST_BUDGET: Final = 10**12


@unique
class Method(Enum):
    """How to search.

    PAPER: the paper's genetic algorithm, then steepest descent; with a budget of 10 000 its 200 generations of 40.
    DIFFERENTIAL_EVOLUTION: L-SHADE, the one to take first. CMA_ES: the package cma, restarted; PARETO: the package
    pymoo, NSGA-II. All but the paper's begin part of their first population with crank dyads that suit the curve
    (`crank_dyads`), and end with gradients.
    """

    PAPER = "paper"
    DIFFERENTIAL_EVOLUTION = "differential-evolution"
    CMA_ES = "cma-es"
    PARETO = "pareto"


_STEPS: Final[dict[Method, Callable[[Run], Steps]]] = {
    Method.PAPER: paper_steps,
    Method.DIFFERENTIAL_EVOLUTION: differential_evolution_steps,
    Method.CMA_ES: cma_es_steps,
    Method.PARETO: pareto_steps,
}


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
        """What `search` needs to go on from here to the same result; take it before the search's next step.

        During the local improvement it is the state in which that began.
        """
        return self.pack_state()


def _candidates(task: SynthesisTask, front: Float | None) -> tuple[Candidate, ...]:
    if front is None:
        return ()
    terms = evaluate(task, front)
    return tuple(
        Candidate(task, variables, row, float(row @ task.weights)) for variables, row in zip(front, terms, strict=True)
    )


def _load(run_print: str, ledger: Ledger, state: bytes) -> Saved:
    """The method's saved part; the rest goes into the ledger."""
    header, arrays = unpack(state)
    try:
        if header["fingerprint"] != run_print:
            raise SynthesisError(
                "the saved state belongs to another search: curve, bounds, terms, method, seed, budget and population "
                "must be the same"
            )
        ledger.restore(header["ledger"], arrays)
        return header["method"], arrays
    except (KeyError, TypeError, ValueError):
        raise SynthesisError("the saved state is damaged") from None


def _pack(run_print: str, ledger: Ledger, step: Step) -> bytes:
    ledger_header, ledger_arrays = ledger.save()
    method_header, method_arrays = step.save()
    header: dict[str, Any] = {"fingerprint": run_print, "ledger": ledger_header, "method": method_header}
    return pack(header, {**ledger_arrays, **method_arrays})


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

    ``budget``: evaluations altogether (500 or more), local improvement included. ``evaluate_population``: where the
    terms come from (`evaluate` in this process if None); whatever it is, the result of a seed is the same. ``state``:
    go on from where a search with the same task, method, seed, budget and population stood. Close the iterator to stop.
    Raises ParameterError or SynthesisError.
    """
    for name, value, low, high in (
        ("the budget", budget, LEAST_BUDGET, LARGEST_BUDGET),
        ("the seed", seed, 0, 2**63 - 1),
        ("the population", population or 4, 4, 1_000_000),
        ("report_every", report_every, 1, 2**31),
    ):
        if not low <= value <= high:
            raise ParameterError(name, value, f"{low} to {high}")
    if population is not None and population > (1.0 - POLISH_SHARE) * budget:
        raise ParameterError("the population", population, f"at most {int((1.0 - POLISH_SHARE) * budget)}")

    def local(variables: Float) -> Float:
        return evaluate(task, variables)

    ledger = Ledger(task, evaluate_population or local, budget)
    run_print = fingerprint(task, method.value, seed, budget, population)
    saved = None if state is None else _load(run_print, ledger, state)
    run = Run(
        task,
        ledger,
        seed,
        round((1.0 - POLISH_SHARE) * budget),
        evaluate_population is None,
        population,
        report_every,
        saved,
    )
    return _search(run, method, run_print)


def _search(run: Run, method: Method, run_print: str) -> Iterator[Progress]:
    ledger = run.ledger
    generation = 0
    front: tuple[Candidate, ...] = ()
    last: Step | None = None
    for step in _STEPS[method](run):
        generation, front = step.generation, _candidates(run.task, step.front)
        pack_state = partial(_pack, run_print, ledger, step)
        yield Progress(ledger.evaluations, generation, Phase.SEARCH, ledger.best(), front, pack_state=pack_state)
        last = step
    # Every method yields once more at its end, and still stands there.
    keep = partial(bytes, b"" if last is None else _pack(run_print, ledger, last))
    for _ in steepest_descent(run) if method is Method.PAPER else polish(run):
        yield Progress(ledger.evaluations, generation, Phase.POLISH, ledger.best(), front, pack_state=keep)
    yield Progress(ledger.evaluations, generation, Phase.POLISH, ledger.best(), front, True, keep)
