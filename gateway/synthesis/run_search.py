"""A whole search: several starts, each cut into slices, run by whoever there is, stopped and resumed at will.

The result depends on the settings alone: not on the number of workers, nor on who died, nor on interruptions.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gateway.errors import UsageError
from gateway.synthesis.search_slice import Found, SearchSlice, SliceResult
from gateway.synthesis.workers import Workers
from mechanism.synthesis.search import LEAST_BUDGET, Method, Phase
from mechanism.synthesis.task import SynthesisTask, Term

Float = NDArray[np.floating[Any]]

MAXIMUM_STARTS: Final = 1024
MAXIMUM_BUDGET: Final = 1_000_000_000
MAXIMUM_SEED: Final = 2**32 - 1
FAULTS: Final = frozenset({Term.TIMING, Term.MOBILITY, Term.SINGULARITY, Term.KEEP_OUT})
_SLICES_A_START: Final = 10
_LEAST_SLICE: Final = 200
_POLL_S: Final = 0.2


@dataclass(frozen=True, slots=True, eq=False)
class SearchSettings:
    """What is searched, and how; ``budget``: evaluations a start; start i has the seed ``seed`` + i."""

    task: SynthesisTask
    method: Method
    seed: int
    budget: int
    starts: int = 1
    population: int | None = None

    def __post_init__(self) -> None:
        for name, value, low, high in (
            ("--seed", self.seed, 0, MAXIMUM_SEED),
            ("--budget", self.budget, LEAST_BUDGET, MAXIMUM_BUDGET),
            ("--starts", self.starts, 1, MAXIMUM_STARTS),
            ("--population", self.population or 40, 4, 100_000),
        ):
            if not low <= value <= high:
                raise UsageError(f"{name} {value}, bound {low} to {high}")

    @property
    def slice_evaluations(self) -> int:
        """How many evaluations a slice has at least."""
        return max(self.budget // _SLICES_A_START, _LEAST_SLICE)


@dataclass(frozen=True, slots=True, eq=False)
class StartState:
    """Where one start stands. ``state`` None: not begun; improvements: (evaluations, objective), its convergence."""

    seed: int
    evaluations: int = 0
    generation: int = 0
    phase: Phase = Phase.SEARCH
    state: bytes | None = None
    best: Found | None = None
    front: tuple[Found, ...] = ()
    is_finished: bool = False
    improvements: tuple[tuple[int, float], ...] = ()

    def after(self, result: SliceResult) -> "StartState":
        """This start after one more slice."""
        least = self.improvements[-1][1] if self.improvements else float("inf")
        better = tuple(step for step in result.improvements if step[1] < least)
        return replace(
            self,
            evaluations=result.evaluations,
            generation=result.generation,
            phase=result.phase,
            state=result.state,
            best=result.best,
            front=result.front,
            is_finished=result.is_finished,
            improvements=self.improvements + better,
        )


@dataclass(frozen=True, slots=True, eq=False)
class SearchStatus:
    """Where the whole search stands."""

    settings: SearchSettings
    starts: tuple[StartState, ...]

    @classmethod
    def beginning(cls, settings: SearchSettings) -> "SearchStatus":
        """Nothing done."""
        return cls(settings, tuple(StartState(settings.seed + index) for index in range(settings.starts)))

    @property
    def evaluations(self) -> int:
        """Mechanisms evaluated by all starts."""
        return sum(start.evaluations for start in self.starts)

    @property
    def is_finished(self) -> bool:
        """Whether every start is."""
        return all(start.is_finished for start in self.starts)

    @property
    def finished_starts(self) -> int:
        """How many starts are."""
        return sum(start.is_finished for start in self.starts)

    @property
    def best_start(self) -> StartState | None:
        """The start with the best mechanism, the first of equals; None before the first slice.

        A mechanism that cannot move, or has another fault, is better than none without faults only: no weight of a
        user's makes it one to build.
        """
        task = self.settings.task
        ranked = [
            (is_faulty(task, start.best), start.best.objective, index)
            for index, start in enumerate(self.starts)
            if start.best is not None
        ]
        return self.starts[min(ranked)[2]] if ranked else None

    @property
    def best(self) -> Found | None:
        """The best mechanism of all starts."""
        start = self.best_start
        return None if start is None else start.best

    def front(self) -> tuple[Found, ...]:
        """The Pareto front over all starts' fronts, by rising first term: nobody in it is beaten in every counted term.

        Empty unless the method keeps fronts.
        """
        weights = self.settings.task.weights
        members = [found for start in self.starts for found in start.front]
        if not members:
            return ()
        costs = np.array([found.terms for found in members])[:, weights > 0.0]
        kept = [index for index in range(len(members)) if not _is_beaten(costs, index)]
        kept.sort(key=lambda index: (tuple(costs[index].tolist()), members[index].variables))
        return tuple(members[index] for index in kept)


def is_faulty(task: SynthesisTask, found: Found) -> bool:
    """Whether a mechanism cannot move, be driven, keep its order in time or out of a zone, as far as it was asked."""
    return any(entry.term in FAULTS and value > 0.0 for entry, value in zip(task.terms, found.terms, strict=True))


def _is_beaten(costs: Float, index: int) -> bool:
    no_worse = np.all(costs <= costs[index], axis=1)
    better = np.any(costs < costs[index], axis=1)
    twin = np.flatnonzero(np.all(costs == costs[index], axis=1))
    return bool(np.any(no_worse & better)) or int(twin[0]) != index


@dataclass(slots=True)
class SearchRun:
    """Carries a search on from a status. ``on_progress`` is told after every slice; ``is_stopping`` asks to end early.

    A search that was stopped stands at the end of its slices, and `run_search` goes on from there another time.
    """

    status: SearchStatus
    workers: Workers
    on_progress: Callable[[SearchStatus], None] = lambda _: None
    is_stopping: Callable[[], bool] = lambda: False
    _in_hand: set[int] = field(default_factory=set[int])

    def run(self) -> SearchStatus:
        """Go on until every start is finished, or until asked to stop. Raises WorkersLostError, SynthesisError."""
        while not self.status.is_finished:
            stopping = self.is_stopping()
            if not stopping:
                self._hand_out()
            if not self._in_hand:
                break
            for result in self.workers.collect(_POLL_S):
                self._take(result)
        return self.status

    def _hand_out(self) -> None:
        settings = self.status.settings
        for index, start in enumerate(self.status.starts):
            if len(self._in_hand) >= self.workers.capacity:
                return
            if start.is_finished or index in self._in_hand:
                continue
            self._in_hand.add(index)
            self.workers.submit(
                SearchSlice(
                    settings.task,
                    settings.method,
                    index,
                    start.seed,
                    settings.budget,
                    settings.population,
                    start.state,
                    settings.slice_evaluations,
                )
            )

    def _take(self, result: SliceResult) -> None:
        self._in_hand.discard(result.start)
        starts = list(self.status.starts)
        starts[result.start] = starts[result.start].after(result)
        self.status = SearchStatus(self.status.settings, tuple(starts))
        self.on_progress(self.status)
