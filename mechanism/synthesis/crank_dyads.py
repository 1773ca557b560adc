"""Crank dyads (p, q and the CV pivot) that suit a curve with prescribed timing, found by algebra.

The structural error depends on these four variables alone: every point P must lie at the distance q from the crank's
end c + p e(theta2), so P.P = 2 P.c + 2 p P.e - 2 p c.e + (q^2 - c.c - p^2). Taken as a linear equation in c, p, p c and
the bracket it is solved by least squares at once; a curve that a five-bar has traced gives its crank dyad back.
Where the curve is no such one, the solution is a start from which least squares of the true distances goes on. With
free timing, other crank dyads suit: those that can go round at all.
"""

from collections.abc import Callable
from typing import Any, Final, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from mechanism.synthesis.run import Run
from mechanism.synthesis.task import VARIABLE_COUNT, SynthesisTask, Timing, Variable

Float = NDArray[np.float64]

_STARTS: Final = 8
_ITERATIONS: Final = 60
_TRACED: Final = 1e-9
"""A curve that a crank dyad misses by less than so much of its size has been traced by one."""
_KEPT: Final = 6
_SEEDED_SHARE: Final = 0.25
_ATTEMPTS: Final = 10
CRANK_VARIABLES: Final = (Variable.P, Variable.Q, Variable.CV_PIVOT_X, Variable.CV_PIVOT_Y)


class _Solution(Protocol):
    x: Float
    cost: float
    nfev: int


def radial_errors(task: SynthesisTask, crank: Float) -> Float:
    """Signed distance (m) by which q misses every point, of a crank dyad (p, q, CV pivot x, y)."""
    assert task.theta2 is not None
    p, q, x, y = crank
    return np.hypot(task.x - x - p * np.cos(task.theta2), task.y - y - p * np.sin(task.theta2)) - q


def _jacobian(task: SynthesisTask, crank: Float) -> Float:
    assert task.theta2 is not None
    p, _, x, y = crank
    cosine, sine = np.cos(task.theta2), np.sin(task.theta2)
    dx, dy = task.x - x - p * cosine, task.y - y - p * sine
    distance = np.maximum(np.hypot(dx, dy), 1e-300)
    ux, uy = dx / distance, dy / distance
    return np.stack((-(ux * cosine + uy * sine), np.full(ux.size, -1.0), -ux, -uy), axis=1)


def refine_crank(task: SynthesisTask, crank: Float) -> tuple[Float, float, int]:
    """The nearest crank dyad within the bounds with the least sum of squared errors, that sum (m^2), evaluations."""
    # Imported where it is needed, as scipy takes its time.
    from scipy.optimize import least_squares  # pyright: ignore[reportMissingTypeStubs, reportUnknownVariableType]

    columns = list(CRANK_VARIABLES)
    lower, upper = task.bounds.lower[columns], task.bounds.upper[columns]
    free = upper > lower
    if not np.any(free):
        return crank, float(np.sum(radial_errors(task, crank) ** 2)), 1

    def whole(part: Float) -> Float:
        full = crank.copy()
        full[free] = part
        return full

    def errors(part: Float) -> Float:
        return radial_errors(task, whole(part))

    def slopes(part: Float) -> Float:
        return _jacobian(task, whole(part))[:, free]

    solution = cast("Callable[..., _Solution]", least_squares)(
        errors,
        np.clip(crank, lower, upper)[free],
        jac=slopes,
        bounds=(lower[free], upper[free]),
        xtol=1e-15,
        ftol=1e-15,
        gtol=1e-15,
        max_nfev=_ITERATIONS,
    )
    return whole(solution.x), 2.0 * float(solution.cost), int(solution.nfev)


def algebraic_crank(task: SynthesisTask) -> Float | None:
    """The crank dyad (p, q, CV pivot x, y) of the linear equation, or None where it gives no lengths."""
    if task.theta2 is None or task.timing is not Timing.PRESCRIBED:
        return None
    cosine, sine = np.cos(task.theta2), np.sin(task.theta2)
    # In units of the curve's size about its middle, so that the columns are of like magnitude.
    size = task.size_m
    middle = np.array([task.x.mean(), task.y.mean()])
    x, y = (task.x - middle[0]) / size, (task.y - middle[1]) / size
    columns = (2 * x, 2 * y, 2 * (x * cosine + y * sine), -2 * cosine, -2 * sine, np.ones(x.size))
    solution = cast("Any", np.linalg.lstsq(np.stack(columns, axis=1), x * x + y * y, rcond=None))[0]
    pivot_x, pivot_y, p, _, _, bracket = (float(value) for value in cast("Float", solution))
    q_squared = bracket + pivot_x**2 + pivot_y**2 + p**2
    if p <= 0.0 or q_squared <= 0.0:
        return None
    crank = np.array([p, np.sqrt(q_squared), pivot_x, pivot_y]) * size
    crank[2:] += middle
    return crank


def suitable_cranks(task: SynthesisTask, random: np.random.Generator) -> tuple[list[Float], int]:
    """The best distinct crank dyads within the bounds, best first, and how many evaluations they took.

    From the algebraic one and from starts at random; none with free timing.
    """
    if task.theta2 is None or task.timing is not Timing.PRESCRIBED:
        return [], 0
    columns = list(CRANK_VARIABLES)
    lower, upper = task.bounds.lower[columns], task.bounds.upper[columns]
    starts = [random.uniform(lower, upper) for _ in range(_STARTS)]
    algebraic = algebraic_crank(task)
    if algebraic is not None:
        inside = np.clip(algebraic, lower, upper)
        if float(np.max(np.abs(radial_errors(task, inside)))) < _TRACED * task.size_m:
            return [refine_crank(task, inside)[0]], _ITERATIONS
        starts.insert(0, inside)
    found: list[tuple[float, Float]] = []
    evaluations = 0
    for start in starts:
        crank, cost, count = refine_crank(task, start)
        evaluations += count
        if all(float(np.max(np.abs(crank - other))) > 1e-6 * task.size_m for _, other in found):
            found.append((cost, crank))
    found.sort(key=lambda entry: entry[0])
    return [crank for _, crank in found[:_KEPT]], evaluations


def _cranks_that_go_round(task: SynthesisTask, random: np.random.Generator, count: int) -> list[Float]:
    """Crank dyads for free timing with their pivot somewhere beside the curve.

    Such a crank can go round only if p and q come in line, stretched, where the curve is farthest from the pivot, and
    folded where it is nearest: p + q and q - p are these distances.
    """
    columns = list(CRANK_VARIABLES)
    lower, upper = task.bounds.lower[columns], task.bounds.upper[columns]
    found: list[Float] = []
    for pivot in random.uniform(lower[2:], upper[2:], (_ATTEMPTS * count, 2)):
        distance = np.hypot(task.x - pivot[0], task.y - pivot[1])
        nearest, farthest = float(distance.min()), float(distance.max())
        crank = np.array([0.5 * (farthest - nearest), 0.5 * (farthest + nearest), *pivot])
        if np.all(crank >= lower) and np.all(crank <= upper):
            found.append(crank)
        if len(found) == count:
            break
    return found


def seeded_population(run: Run, random: np.random.Generator, size: int) -> Float:
    """A first population (m, 8) in the unit cube: at random, a quarter of it with crank dyads that suit the curve."""
    unit = random.random((size, VARIABLE_COUNT))
    if run.task.timing is Timing.FREE:
        cranks, evaluations = _cranks_that_go_round(run.task, random, int(_SEEDED_SHARE * size)), 0
    else:
        cranks, evaluations = suitable_cranks(run.task, random)
    run.ledger.evaluations += evaluations
    if cranks:
        variables = run.spread(unit)
        for index in range(int(_SEEDED_SHARE * size)):
            variables[index, list(CRANK_VARIABLES)] = cranks[index % len(cranks)]
        unit = np.clip(run.unspread(variables), 0.0, 1.0)
    return unit
