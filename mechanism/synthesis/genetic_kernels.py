"""Kernels: the paper's genetic algorithm, a simple one as Goldberg describes it (roulette wheel, linear scaling).

A mechanism is a string of 8 times `BITS` bits, kept as 8 integers; each stands for its place between the bounds. All
chance comes in as uniform random numbers, so that who calls keeps the state of the generator.
"""

from math import inf
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mechanism.jit import kernel
from mechanism.synthesis.paper_kernels import evaluate_paper_terms, weigh

Float = NDArray[np.float64]
Integers = NDArray[np.int64]

BITS: Final = 10
"""Bits a variable: a step of a thousandth of its range."""
STRING: Final = 8 * BITS
DRAWS: Final = 4 + 2 * STRING
"""Random numbers that a pair of children takes: two parents, crossover or not, where, and every bit of both."""
_LEAST_OBJECTIVE: Final = 1e-9
SCALING: Final = 2.0
"""How much fitter than the average the fittest counts after scaling."""


@kernel
def decode(codes: Integers, lower: Float, upper: Float, population: Float) -> None:
    """Fill ``population`` (m, 8), metres, from the strings."""
    for j in range(codes.shape[0]):
        for k in range(codes.shape[1]):
            share = codes[j, k] / (2**BITS - 1)
            population[j, k] = lower[k] + share * (upper[k] - lower[k])


@kernel
def scale_fitness(values: Float, fitness: Float) -> None:
    """Fitness from objectives (0 or more): their reciprocals, scaled linearly so that the average stays and the best
    counts `SCALING` times the average, or less where the worst would fall below 0.
    """
    total = 0.0
    best = 0.0
    least = inf
    for j in range(values.size):
        fitness[j] = 1.0 / max(values[j], _LEAST_OBJECTIVE)
        total += fitness[j]
        best = max(best, fitness[j])
        least = min(least, fitness[j])
    average = total / values.size
    if not best > average:
        for j in range(values.size):
            fitness[j] = 1.0
        return
    if least > (SCALING * average - best) / (SCALING - 1.0):
        slope = (SCALING - 1.0) * average / (best - average)
        offset = average * (best - SCALING * average) / (best - average)
    else:
        slope = average / (average - least)
        offset = -least * slope
    for j in range(values.size):
        fitness[j] = max(slope * fitness[j] + offset, 0.0)


@kernel
def _spin(fitness: Float, total: float, draw: float) -> int:
    """The roulette wheel."""
    mark = draw * total
    reached = 0.0
    for j in range(fitness.size):
        reached += fitness[j]
        if mark < reached:
            return j
    return fitness.size - 1


@kernel
def breed(codes: Integers, fitness: Float, draws: Float, crossover: float, mutation: float, children: Integers) -> None:
    """Fill ``children`` (m, 8), m even, pair by pair: two parents from the wheel, one cut, bits that flip.

    draws: (m / 2, DRAWS), uniform.
    """
    total = 0.0
    for j in range(fitness.size):
        total += fitness[j]
    variables = codes.shape[1]
    for pair in range(children.shape[0] // 2):
        mother = _spin(fitness, total, draws[pair, 0])
        father = _spin(fitness, total, draws[pair, 1])
        cut = STRING
        if draws[pair, 2] < crossover:
            cut = 1 + int(draws[pair, 3] * (STRING - 1))
        for k in range(variables):
            # Bits of this variable that come before the cut, the most significant first.
            kept = min(max(cut - k * BITS, 0), BITS)
            tail = (1 << (BITS - kept)) - 1
            head = (1 << BITS) - 1 - tail
            first = (codes[mother, k] & head) | (codes[father, k] & tail)
            second = (codes[father, k] & head) | (codes[mother, k] & tail)
            for bit in range(BITS):
                if draws[pair, 4 + k * BITS + bit] < mutation:
                    first ^= 1 << bit
                if draws[pair, 4 + STRING + k * BITS + bit] < mutation:
                    second ^= 1 << bit
            children[2 * pair, k] = first
            children[2 * pair + 1, k] = second


@kernel
def run_generations(
    codes: Integers,
    values: Float,
    draws: Float,
    crossover: float,
    mutation: float,
    lower: Float,
    upper: Float,
    rows: Float,
    count: int,
    fourier: Float,
    minimum_sine: float,
    columns: Integers,
    weights: Float,
    best_variables: Float,
    best_terms: Float,
    best_objective: float,
) -> float:
    """Several generations in one go, one for each block of ``draws`` (generations, m / 2, DRAWS).

    Updates codes (m, 8), values (m,), best_variables (8,) and best_terms (4,), and returns the best objective.
    """
    size = codes.shape[0]
    fitness = np.empty(size)
    children = np.empty_like(codes)
    population = np.empty((size, codes.shape[1]))
    terms = np.empty((size, 4))
    for generation in range(draws.shape[0]):
        scale_fitness(values, fitness)
        breed(codes, fitness, draws[generation], crossover, mutation, children)
        codes[:, :] = children
        decode(codes, lower, upper, population)
        evaluate_paper_terms(population, rows, count, fourier, minimum_sine, terms)
        weigh(terms, columns, weights, values)
        for j in range(size):
            if values[j] < best_objective:
                best_objective = values[j]
                best_variables[:] = population[j]
                best_terms[:] = terms[j]
    return best_objective
