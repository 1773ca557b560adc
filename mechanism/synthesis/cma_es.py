"""Covariance matrix adaptation (the package cma), restarted with a doubled population whenever it has converged."""

from typing import Any, Final, cast

import numpy as np
from numpy.typing import NDArray

from mechanism.errors import SynthesisError
from mechanism.synthesis.crank_dyads import seeded_population
from mechanism.synthesis.journal import Journal
from mechanism.synthesis.run import Run, Step, Steps
from mechanism.synthesis.task import VARIABLE_COUNT

Float = NDArray[np.float64]

POPULATION: Final = 20
_FIRST_DEVIATION: Final = 0.2
_LARGEST_POPULATION: Final = 640
_SCOUTS: Final = 40
"""Mechanisms that are looked at before every start, which then begins at the best of them."""


def _package() -> Any:
    try:
        import cma  # pyright: ignore[reportMissingTypeStubs]
    except ImportError:
        raise SynthesisError(
            "the method cma-es needs the package cma: pip install 'drive-gateway[synthesis]'"
        ) from None
    return cast("Any", cma)


def cma_es_steps(run: Run) -> Steps:
    """CMA-ES from one start after the other, until the search's share of the budget is used."""
    cma = _package()
    random = np.random.default_rng(run.seed)
    journal = Journal(run, lambda terms, values: np.where(np.isfinite(values), values, 1e300)[:, np.newaxis])
    size = run.population or POPULATION
    used = 0

    def draw(*shape: int) -> Float:
        return random.standard_normal(shape)

    before = run.ledger.evaluations
    scouts = seeded_population(run, random, _SCOUTS)
    # What finding crank dyads takes counts once, also where the search goes on.
    used = run.ledger.evaluations - before
    if run.saved is not None:
        run.ledger.evaluations = before
    while used + _SCOUTS + size <= run.search_budget:
        start = scouts[int(np.argmin(journal.ask(run.spread(scouts))[:, 0]))]
        used += _SCOUTS
        # Its own random numbers come from here, and numpy's global ones are left alone (seed NaN).
        options = {"bounds": [0.0, 1.0], "popsize": size, "verbose": -9, "seed": np.nan, "randn": draw}
        strategy = cma.CMAEvolutionStrategy(start, _FIRST_DEVIATION, options)
        while not strategy.stop() and used + size <= run.search_budget:
            replayed = journal.replaying
            unit = np.array(strategy.ask(), dtype=np.float64)
            strategy.tell(list(unit), journal.ask(run.spread(unit))[:, 0].tolist())
            used += size
            if not replayed and journal.generation % run.report_every == 0:
                yield Step(journal.generation, journal.save)
        size = min(2 * size, _LARGEST_POPULATION)
        scouts = random.random((_SCOUTS, VARIABLE_COUNT))
    yield Step(journal.generation, journal.save)
