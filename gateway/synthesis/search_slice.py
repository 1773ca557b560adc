"""A piece of a search: what a worker process is handed, and what it hands back.

A search is cut into slices of evaluations. Every slice begins with the state in which the one before ended, so it does
not matter which process runs it, nor how often: who loses a worker hands the same slice to another one.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mechanism.synthesis.candidate import Candidate
from mechanism.synthesis.search import Method, Phase, Progress, search
from mechanism.synthesis.task import SynthesisTask

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """A mechanism as it travels between processes: variables (8,) in metres, the task's terms, their weighted sum."""

    variables: tuple[float, ...]
    terms: tuple[float, ...]
    objective: float

    @classmethod
    def of(cls, candidate: Candidate) -> "Found":
        """What of a candidate is not the task's."""
        return cls(tuple(candidate.variables.tolist()), tuple(candidate.terms.tolist()), float(candidate.objective))

    def candidate(self, task: SynthesisTask) -> Candidate:
        """The candidate of this task."""
        return Candidate(task, np.array(self.variables), np.array(self.terms), self.objective)


@dataclass(frozen=True, slots=True, eq=False)
class SearchSlice:
    """What to do: go on with start number ``start`` from ``state`` (None: its beginning) for so many evaluations."""

    task: SynthesisTask
    method: Method
    start: int
    seed: int
    budget: int
    population: int | None
    state: bytes | None
    evaluations: int


@dataclass(frozen=True, slots=True, eq=False)
class SliceResult:
    """Where a start stands after a slice; improvements: (evaluations, objective) whenever its best became better."""

    start: int
    evaluations: int
    generation: int
    phase: Phase
    best: Found
    front: tuple[Found, ...]
    is_finished: bool
    state: bytes
    improvements: tuple[tuple[int, float], ...]


_REPORTS_A_SLICE: Final = 4
_USUAL_POPULATION: Final = 40
_KEPT_OPEN: Final = 8


class _OpenSearches:
    """Searches that this process may be asked to go on with: the next slice of one then begins where it stands.

    It saves taking up a saved state, which some methods can only do by telling an optimiser all it was told before; the
    result is the same.
    """

    def __init__(self) -> None:
        self._open: dict[tuple[int, bytes], Iterator[Progress]] = {}

    def take(self, wanted: SearchSlice) -> Iterator[Progress]:
        """The search of a slice: the one that stands there, or a new one that takes up the slice's state."""
        kept = None if wanted.state is None else self._open.pop((wanted.seed, wanted.state), None)
        if kept is not None:
            return kept
        generations = wanted.evaluations // (wanted.population or _USUAL_POPULATION)
        return search(
            wanted.task,
            wanted.method,
            wanted.seed,
            wanted.budget,
            population=wanted.population,
            report_every=max(generations // _REPORTS_A_SLICE, 1),
            state=wanted.state,
        )

    def keep(self, wanted: SearchSlice, result: SliceResult, steps: Iterator[Progress]) -> None:
        """Leave a search open for its next slice; of too many the oldest is given up."""
        if result.is_finished:
            return
        self._open[wanted.seed, result.state] = steps
        if len(self._open) > _KEPT_OPEN:
            self._open.pop(next(iter(self._open)))


_open_searches: Final = _OpenSearches()


def run_slice(wanted: SearchSlice) -> SliceResult:
    """Run one slice: to its number of evaluations, or to the search's end. Raises as `search` does.

    The local improvement at a search's end is one piece: a slice that has begun with it goes on to the end.
    """
    steps = _open_searches.take(wanted)
    improvements: list[tuple[int, float]] = []
    best = float("inf")
    first: int | None = None
    now: Progress | None = None
    for now in steps:
        first = now.evaluations if first is None else first
        if now.best.objective < best:
            best = now.best.objective
            improvements.append((now.evaluations, best))
        if now.finished or (now.phase is Phase.SEARCH and now.evaluations - first >= wanted.evaluations):
            break
    if now is None:
        raise RuntimeError("a search ended without a step")
    result = SliceResult(
        start=wanted.start,
        evaluations=now.evaluations,
        generation=now.generation,
        phase=now.phase,
        best=Found.of(now.best),
        front=tuple(Found.of(candidate) for candidate in now.front),
        is_finished=now.finished,
        state=now.state,
        improvements=tuple(improvements),
    )
    _open_searches.keep(wanted, result, steps)
    return result
