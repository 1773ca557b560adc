"""Going on with somebody else's optimiser: its answers are written down, and told to a new one of the same seed.

An optimiser that is handed the same numbers asks the same questions, so nothing is evaluated twice and nothing of its
inside has to be saved.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mechanism.errors import SynthesisError
from mechanism.synthesis.run import Run, Saved

Float = NDArray[np.float64]


class Journal:
    """Evaluates populations, or reads what they were before; ``answer`` gives the rows that the optimiser is told."""

    __slots__ = ("_answer", "_old", "_position", "_run", "_written", "generation")

    def __init__(self, run: Run, answer: Callable[[Float, Float], Float]) -> None:
        self._run = run
        self._answer = answer
        self._written: list[Float] = []
        self._old: Float = np.zeros(0)
        self._position = 0
        self.generation = 0
        if run.saved is not None:
            self._old = run.saved[1]["journal"]

    @property
    def replaying(self) -> bool:
        """Whether the next answer is read, not evaluated."""
        return self._position < self._old.size

    def ask(self, population: Float) -> Float:
        """The rows of answers for a population (m, 8), metres."""
        self.generation += 1
        if not self.replaying:
            rows = self._answer(*self._run.ledger.evaluate(population))
            self._written.append(np.ascontiguousarray(rows, dtype=np.float64).ravel())
            return rows
        width = self._answer(np.zeros((1, len(self._run.task.terms))), np.zeros(1)).shape[1]
        count = population.shape[0] * width
        rows = self._old[self._position : self._position + count]
        if rows.size != count:
            raise SynthesisError("the saved state does not fit this search")
        self._position += count
        self._written.append(rows)
        return rows.reshape(-1, width)

    def save(self) -> Saved:
        """All answers so far."""
        header: dict[str, Any] = {"generation": self.generation}
        return header, {"journal": np.concatenate(self._written) if self._written else np.zeros(0)}
