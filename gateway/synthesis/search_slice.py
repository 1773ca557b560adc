"""A piece of a search: what a worker process is handed, and what it hands back.

A search is cut into slices of evaluations. Every slice begins with the state in which the one before ended, so it does
not matter which process runs it, nor how often: who loses a worker hands the same slice to another one.
"""

from dataclasses import dataclass

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


def run_slice(wanted: SearchSlice, done_before: int = 0) -> SliceResult:
    """Run one slice. ``done_before``: evaluations of the start's earlier slices. Raises as `search` does."""
    steps = search(
        wanted.task, wanted.method, wanted.seed, wanted.budget, population=wanted.population, state=wanted.state
    )
    improvements: list[tuple[int, float]] = []
    best = float("inf")
    now: Progress | None = None
    for now in steps:
        if now.best.objective < best:
            best = now.best.objective
            improvements.append((now.evaluations, best))
        if now.finished or now.evaluations - done_before >= wanted.evaluations:
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
    close = getattr(steps, "close", None)
    if close is not None:
        close()
    return result
