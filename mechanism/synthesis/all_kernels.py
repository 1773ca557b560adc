"""Kernels: every term of a population, for tasks that weigh more than the paper's four."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from mechanism.dynamics import PARAMETER_COUNT
from mechanism.jit import kernel
from mechanism.synthesis.further_kernels import (
    MACHINE_COUNT,
    differentiate,
    differentiate_by_parabolas,
    drive_terms,
    fill_dynamics,
    greatest,
    keep_out,
    singularity,
    transmission,
)
from mechanism.synthesis.paper_kernels import paper_terms, track
from mechanism.synthesis.timing_kernels import fill_fourier, solve_timing
from mechanism.synthesis.tracking_kernels import ALPHA5, OMEGA5, whole_blocks

Float = NDArray[np.float64]

ALL_TERMS: Final = 13
"""Columns of the result, in the order of `Term`'s members."""


@kernel
def evaluate_all_terms(
    population: Float,
    rows: Float,
    count: int,
    fourier: Float,
    minimum_sine: float,
    first: Float,
    second: Float,
    machine: Float,
    zones: Float,
    speed: float,
    free: bool,
    motion: bool,
    torque: bool,
    terms: Float,
) -> None:
    """Fill ``terms`` (m, 13) for a population (m, 8).

    first and second: (count, count) matrices of derivatives, (0, 0) with free timing; free: solve for theta2; motion
    and torque: whether velocities, and torques, are wanted.
    """
    choices = np.zeros(whole_blocks(count), dtype=np.int64)
    coefficients = np.empty(fourier.shape[1])
    parameters = np.empty(PARAMETER_COUNT)
    for j in range(population.shape[0]):
        variables = population[j]
        if free:
            faults = solve_timing(rows, count, variables)
            terms[j, 12] = faults * faults * faults
            fill_fourier(rows, count, fourier)
        else:
            terms[j, 12] = 0.0
        track(rows, choices, count, variables, minimum_sine)
        terms[j, 0], terms[j, 1], terms[j, 2], terms[j, 3] = paper_terms(
            rows, count, variables[3], fourier, coefficients
        )
        terms[j, 4] = transmission(rows, count, variables[2], variables[6], variables[7])
        terms[j, 5] = singularity(rows, count, minimum_sine)
        if motion or torque:
            if free:
                differentiate_by_parabolas(rows, count, speed)
            else:
                differentiate(rows, count, first, second, speed)
            terms[j, 9] = greatest(rows, OMEGA5, count)
            terms[j, 10] = greatest(rows, ALPHA5, count)
        if torque:
            fill_dynamics(variables, machine, parameters)
            terms[j, 6], terms[j, 7], terms[j, 8] = drive_terms(
                rows, count, parameters, machine[MACHINE_COUNT - 1], speed
            )
        terms[j, 11] = keep_out(rows, count, variables, zones) if zones.shape[0] > 0 else 0.0
