"""Local improvement of the best that a global search has found."""

from collections.abc import Callable, Iterator
from typing import Any, Final, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from mechanism.synthesis.crank_dyads import CRANK_VARIABLES, refine_crank
from mechanism.synthesis.run import Run
from mechanism.synthesis.task import VARIABLE_COUNT, Term, Timing

Float = NDArray[np.float64]

_DIFFERENCE: Final = 1e-7
_FIRST_STEP: Final = 0.1
_LEAST_STEP: Final = 1e-10
_STEP_LENGTHS: Final = 16
_NARROWINGS: Final = (1e-5, 1e-7, 1e-9)


class _Minimum(Protocol):
    x: Float


def _gradient(run: Run, unit: Float, step: float) -> Float:
    """Central differences of the objective in the unit cube, (8,), from 16 mechanisms at once."""
    offsets = np.concatenate((np.eye(VARIABLE_COUNT), -np.eye(VARIABLE_COUNT))) * step
    probes = np.clip(unit + offsets, 0.0, 1.0)
    _, values = run.ledger.evaluate(run.spread(probes))
    width = np.diagonal(probes[:VARIABLE_COUNT] - probes[VARIABLE_COUNT:])
    difference = values[:VARIABLE_COUNT] - values[VARIABLE_COUNT:]
    gradient = np.where(width > 0.0, difference / np.where(width > 0.0, width, 1.0), 0.0)
    # A held variable has no direction.
    gradient[run.task.bounds.upper <= run.task.bounds.lower] = 0.0
    return np.where(np.isfinite(gradient), gradient, 0.0)


def steepest_descent(run: Run) -> Iterator[None]:
    """The paper's hill climbing from the best: along the gradient, as far as that helps (section 2.2.4)."""
    unit = run.unspread(run.ledger.best_variables)
    length = _FIRST_STEP
    while run.ledger.left >= 2 * VARIABLE_COUNT + _STEP_LENGTHS and length > _LEAST_STEP:
        before = run.ledger.best_objective
        gradient = _gradient(run, unit, _DIFFERENCE)
        norm = float(np.linalg.norm(gradient))
        if norm == 0.0:
            return
        lengths = length * 2.0 ** np.arange(2, 2 - _STEP_LENGTHS, -1)
        along = np.clip(unit - lengths[:, np.newaxis] * (gradient / norm), 0.0, 1.0)
        _, values = run.ledger.evaluate(run.spread(along))
        best = int(np.argmin(values))
        if values[best] < before:
            unit, length = along[best], float(lengths[best])
        else:
            unit, length = run.unspread(run.ledger.best_variables), float(lengths[-1])
        yield


def _fit_crank(run: Run) -> None:
    """Bring the best's crank dyad to the least structural error; kept only where the whole objective gains."""
    if run.task.timing is not Timing.PRESCRIBED or run.task.column(Term.STRUCTURAL_ERROR) is None:
        return
    variables = run.ledger.best_variables.copy()
    columns = list(CRANK_VARIABLES)
    variables[columns], _, evaluations = refine_crank(run.task, variables[columns])
    run.ledger.evaluations += evaluations
    # Part of the way may be worth more than all of it.
    shares = np.linspace(0.0, 1.0, 9)[1:, np.newaxis]
    run.ledger.evaluate(run.ledger.best_variables + shares * (variables - run.ledger.best_variables))


class _SpentError(Exception):
    """The budget is used."""


def _minimise(run: Run, step: float) -> None:
    """Quasi-Newton (L-BFGS-B) from the best, with differences of ``step``."""

    # Imported where it is needed, as scipy takes its time.
    from scipy.optimize import minimize  # pyright: ignore[reportMissingTypeStubs, reportUnknownVariableType]

    def value_and_gradient(unit: Float) -> tuple[float, Float]:
        if run.ledger.left < 2 * VARIABLE_COUNT + 1:
            raise _SpentError
        _, values = run.ledger.evaluate(run.spread(unit[np.newaxis]))
        value = float(values[0]) if np.isfinite(values[0]) else 1e300
        return value, _gradient(run, unit, step)

    start = np.clip(run.unspread(run.ledger.best_variables), 0.0, 1.0)
    call = cast("Callable[..., _Minimum]", minimize)
    options: dict[str, Any] = {"maxiter": 200, "maxls": 40, "ftol": 1e-15, "gtol": 1e-12}
    call(value_and_gradient, start, jac=True, method="L-BFGS-B", bounds=[(0.0, 1.0)] * VARIABLE_COUNT, options=options)


def polish(run: Run) -> Iterator[None]:
    """Gradients from the best: its crank dyad by least squares, then all variables by a quasi-Newton method."""
    try:
        _fit_crank(run)
        yield
        for step in _NARROWINGS:
            _minimise(run, step)
            yield
        _fit_crank(run)
    except _SpentError:
        return
