"""Kernels: the paper's four terms, eqs (1) to (4), of one tracked mechanism and of a whole population."""

from math import inf, sqrt

import numpy as np
from numpy.typing import NDArray

from mechanism.jit import kernel
from mechanism.synthesis.lane_kernels import FIXED_ROWS, LANE_WIDTH, LANES, lane_terms, sum_up, track_block
from mechanism.synthesis.tracking_kernels import (
    DEGREES_PER_RADIAN,
    DISPLACEMENT,
    ERROR,
    IMMOBILE,
    MM_PER_M,
    assemble_both,
    cheapest_cycle,
    choose,
    harmonic_cost,
    step_costs,
    whole_blocks,
)

Float = NDArray[np.float64]


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
        harmonic += harmonic_cost(a, b, order + 1)
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
    """Fill ``terms`` (m, 4) for a population (m, 8); ``rows`` has the task's points (`objective.prepare`)."""
    size = fourier.shape[1]
    w = np.zeros((FIXED_ROWS + size) * LANE_WIDTH)
    lefts = np.empty(count * LANES)
    rights = np.empty(count * LANES)
    bits = np.empty(count * LANES)
    for start in range(0, population.shape[0], LANES):
        used = min(LANES, population.shape[0] - start)
        lanes = whole_blocks(used)
        # What fills up the last lanes is the last mechanism again.
        for k in range(lanes):
            row = start + min(k, used - 1)
            for v in range(8):
                w[v * LANE_WIDTH + k] = population[row, v]
        track_block(w, lanes, rows, count, minimum_sine, lefts, rights, bits)
        sum_up(w, lanes, count, lefts, fourier)
        for k in range(used):
            terms[start + k, 0], terms[start + k, 1], terms[start + k, 2], terms[start + k, 3] = lane_terms(w, k, size)
