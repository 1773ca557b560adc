"""The paper's four terms of a population in plain numpy: the path where numba is missing, and the kernels' yardstick.

Arrays are (n, m), n points and m mechanisms, or (n, 2, m) with both elbows; the closures are tracked as in
`mechanism.closure`, for all mechanisms at once.
"""

from math import pi, tau

import numpy as np
from numpy.typing import NDArray

from mechanism.closure import wrap
from mechanism.errors import SynthesisError
from mechanism.synthesis.task import SynthesisTask, Timing

Float = NDArray[np.float64]

_FAULT_COST = 4.0 * pi**2


def _cheapest_cycles(cost: Float) -> NDArray[np.intp]:
    """The elbow (0 or 1) of every point, (n, m), with the least summed cost round the cycle.

    cost[i, a, b] is that of elbow b at point i after elbow a at point i - 1, (n, 2, 2, m).
    """
    count, _, _, mechanisms = cost.shape
    best = np.zeros((count, mechanisms), dtype=np.intp)
    best_cost = np.full(mechanisms, np.inf)
    every = np.arange(mechanisms, dtype=np.intp)
    for start in (0, 1):
        total = np.full((2, mechanisms), np.inf)
        total[start] = 0.0
        come_from = np.zeros((count, 2, mechanisms), dtype=np.intp)
        for i in range(1, count):
            ways = total[:, np.newaxis] + cost[i]
            come_from[i] = np.argmin(ways, axis=0)
            total = ways.min(axis=0)
        closed = total + cost[0, :, start]
        elbow = np.argmin(closed, axis=0)
        closed_cost = closed.min(axis=0)
        chosen = np.empty((count, mechanisms), dtype=np.intp)
        for i in range(count - 1, 0, -1):
            chosen[i] = elbow
            elbow = come_from[i, elbow, every]
        chosen[0] = start
        better = closed_cost < best_cost
        best = np.where(better, chosen, best)
        best_cost = np.where(better, closed_cost, best_cost)
    return best


def _both_elbows(ux: Float, uy: Float, r: Float, s: Float) -> tuple[Float, NDArray[np.bool_]]:
    """theta5 with both elbows, (n, 2, m), u being from servo pivot to end effector, and where r and s cannot close."""
    reach = np.hypot(ux, uy)
    with np.errstate(divide="ignore", invalid="ignore"):
        cosine = (s * s + reach * reach - r * r) / (2.0 * s * reach)
    immobile = ~(np.abs(cosine) <= 1.0 + 1e-12)
    opening = np.arccos(np.clip(np.where(immobile, 1.0, cosine), -1.0, 1.0))
    bearing = np.arctan2(uy, ux)
    return np.stack((bearing + opening, bearing - opening), axis=1), immobile


def vectorised_paper_terms(task: SynthesisTask, population: Float, fourier: Float, terms: Float) -> None:
    """Fill ``terms`` (m, 4) of a population (m, 8) with prescribed timing; fourier as `objective.prepare` makes it."""
    if task.theta2 is None or task.timing is Timing.FREE:
        raise SynthesisError("free timing is evaluated point by point, not in vectors")
    p, q, r, s, cv_x, cv_y, servo_x, servo_y = population.T
    theta2, x, y = (values[:, np.newaxis] for values in (task.theta2, task.x, task.y))
    ax, ay = cv_x + p * np.cos(theta2), cv_y + p * np.sin(theta2)
    distance = np.hypot(x - ax, y - ay)
    theta3 = np.arctan2(y - ay, x - ax)
    error = np.abs(distance - q)
    if task.tolerances is not None:
        error = np.maximum(error - task.tolerances[:, np.newaxis], 0.0)

    ux, uy = ax + q * np.cos(theta3) - servo_x, ay + q * np.sin(theta3) - servo_y
    angles, immobile = _both_elbows(ux, uy, r, s)
    along_r_x = ux[:, np.newaxis] - s * np.cos(angles)
    along_r_y = uy[:, np.newaxis] - s * np.sin(angles)
    sine = (np.cos(theta3)[:, np.newaxis] * along_r_y - np.sin(theta3)[:, np.newaxis] * along_r_x) / r
    side = sine > 0.0
    changes = (np.roll(side, 1, axis=0)[:, :, np.newaxis] != side[:, np.newaxis]).astype(np.float64)
    faults = changes + (np.abs(sine) < task.minimum_sine)[:, np.newaxis]
    steps = wrap(angles[:, np.newaxis] - np.roll(angles, 1, axis=0)[:, :, np.newaxis])
    elbow = _cheapest_cycles(steps**2 + _FAULT_COST * faults)

    theta5 = np.take_along_axis(angles, elbow[:, np.newaxis], axis=1)[:, 0]
    displacement = np.unwrap(theta5, axis=0, period=tau)
    displacement = displacement - displacement[0]
    coefficients = (fourier.T @ displacement).reshape(-1, 2, population.shape[0])
    amplitude = np.hypot(coefficients[:, 0], coefficients[:, 1])
    exponents = np.arange(2, amplitude.shape[0] + 2, dtype=np.float64)[:, np.newaxis]
    terms[:, 0] = (1e3 * error.sum(axis=0)) ** 2
    terms[:, 1] = immobile.sum(axis=0) ** 3
    terms[:, 2] = 1e3 * s * np.degrees(np.sqrt((displacement**2).sum(axis=0)))
    terms[:, 3] = (amplitude**exponents).sum(axis=0)
