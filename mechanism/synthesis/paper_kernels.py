"""Kernels: the paper's four terms of a population, eqs (1) to (4)."""

from math import inf, sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mechanism.jit import kernel
from mechanism.synthesis.tracking_kernels import (
    DISPLACEMENT,
    ERROR,
    IMMOBILE,
    assemble_both,
    cheapest_cycle,
    choose,
    step_costs,
    whole_blocks,
)

Float = NDArray[np.float64]

MM_PER_M: Final = 1e3
DEGREES_PER_RADIAN: Final = 57.29577951308232


@kernel
def track(rows: Float, choices: NDArray[np.int64], count: int, variables: Float, minimum_sine: float) -> None:
    """Everything of one mechanism at every point: both closures, the best sequence of them, the servo's motion."""
    assemble_both(rows, count, variables)
    step_costs(rows, count, minimum_sine)
    cheapest_cycle(rows, count, choices)
    choose(rows, count, choices)


@kernel
def paper_terms(
    rows: Float, count: int, s: float, fourier: Float, coefficients: Float
) -> tuple[float, float, float, float]:
    """Structural error, mobility, swept area and harmonic content of the tracked mechanism (units: `Term`).

    fourier: (count, 2 n) rows of the transform, cosine and sine of order 1, then of order 2 and so on, deg per rad;
    coefficients: room for 2 n.
    """
    error = 0.0
    immobile = 0.0
    squares = 0.0
    size = coefficients.size
    for k in range(size):
        coefficients[k] = 0.0
    for i in range(count):
        displacement = rows[DISPLACEMENT + i]
        error += rows[ERROR + i]
        immobile += rows[IMMOBILE + i]
        squares += displacement * displacement
        for k in range(size):
            coefficients[k] += fourier[i, k] * displacement
    harmonic = 0.0
    for order in range(size // 2):
        a = coefficients[2 * order]
        b = coefficients[2 * order + 1]
        amplitude = sqrt(a * a + b * b)
        power = amplitude
        for _ in range(order + 1):
            power *= amplitude
        harmonic += power
    error *= MM_PER_M
    return error * error, immobile * immobile * immobile, s * sqrt(squares) * MM_PER_M * DEGREES_PER_RADIAN, harmonic


@kernel
def weigh(terms: Float, columns: NDArray[np.int64], weights: Float, values: Float) -> None:
    """Fill ``values`` (m,) with weighted sums of columns of ``terms``, added in their order; NaN counts as inf."""
    for j in range(terms.shape[0]):
        value = 0.0
        for k in range(columns.size):
            value += weights[k] * terms[j, columns[k]]
        values[j] = value if value == value else inf


@kernel
def evaluate_paper_terms(
    population: Float, rows: Float, count: int, fourier: Float, minimum_sine: float, terms: Float
) -> None:
    """Fill ``terms`` (m, 4) for a population (m, 8); ``rows`` has the task's points (`Points.rows`)."""
    choices = np.zeros(whole_blocks(count), dtype=np.int64)
    coefficients = np.empty(fourier.shape[1])
    for j in range(population.shape[0]):
        variables = population[j]
        track(rows, choices, count, variables, minimum_sine)
        terms[j, 0], terms[j, 1], terms[j, 2], terms[j, 3] = paper_terms(
            rows, count, variables[3], fourier, coefficients
        )
