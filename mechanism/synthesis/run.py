"""What a search method is to the others: a generator of `Step`, made from a `Run`, that can be taken up again."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import Enum, unique
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mechanism.synthesis.ledger import Ledger
from mechanism.synthesis.task import SynthesisTask

Float = NDArray[np.float64]
Saved = tuple[dict[str, Any], dict[str, NDArray[Any]]]
"""Header (what JSON can hold) and arrays, as `state.pack` takes them."""

POLISH_SHARE: Final = 0.2
"""The share of the budget that is kept for the local improvement."""


@unique
class Phase(Enum):
    """What a search is doing: the global search, or the local improvement of its best."""

    SEARCH = "search"
    POLISH = "polish"


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """What a method is given. ``search_budget``: evaluations that the global search may have reached when it ends.

    ``local``: the terms are evaluated in this process, so that kernels may do it themselves. ``population``: None
    leaves it to the method. ``saved``: where to go on, None from the start.
    """

    task: SynthesisTask
    ledger: Ledger
    seed: int
    search_budget: int
    local: bool
    population: int | None
    report_every: int
    saved: Saved | None

    def spread(self, unit: Float) -> Float:
        """From the unit cube (m, 8) to metres within the bounds."""
        bounds = self.task.bounds
        return np.clip(bounds.lower + unit * (bounds.upper - bounds.lower), bounds.lower, bounds.upper)

    def unspread(self, variables: Float) -> Float:
        """From metres to the unit cube; 0 where a variable is held."""
        bounds = self.task.bounds
        span = bounds.upper - bounds.lower
        return (variables - bounds.lower) / np.where(span > 0.0, span, 1.0)


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """After a generation: its number, what to save to go on from here, and the front (k, 8) if any."""

    generation: int
    save: Callable[[], Saved]
    front: Float | None = None


Steps = Iterator[Step]


def save_random(random: np.random.Generator) -> dict[str, Any]:
    """The generator's state as JSON can hold it."""
    state: Any = random.bit_generator.state
    return dict(state)


def load_random(saved: dict[str, Any]) -> np.random.Generator:
    """The generator again."""
    bits = np.random.PCG64()
    setattr(bits, "state", saved)  # noqa: B010
    return np.random.Generator(bits)
