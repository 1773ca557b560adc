"""The objective: the terms of whole populations, and their weighted sum.

`evaluate` is what search methods call, and what a worker process may be given: it depends on the task alone.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mechanism.closure import track_closure
from mechanism.curve import DesiredCurve
from mechanism.errors import ParameterError
from mechanism.synthesis.task import VARIABLE_COUNT, SynthesisTask, Term

Float = NDArray[np.float64]

EvaluatePopulation = Callable[[Float], Float]
"""From a population (m, 8) in metres to the values of the task's terms (m, terms), each row by itself."""


def check_population(variables: ArrayLike) -> Float:
    """A population as contiguous (m, 8) float64. Raises ParameterError."""
    population = np.ascontiguousarray(np.atleast_2d(np.asarray(variables, dtype=np.float64)))
    if population.ndim != 2 or population.shape[1] != VARIABLE_COUNT:
        raise ParameterError("the shape of a population", population.shape, f"(m, {VARIABLE_COUNT})")
    return population


def evaluate(task: SynthesisTask, variables: ArrayLike) -> Float:
    """The values of the task's terms, (m, terms), of a population (m, 8) in metres."""
    population = check_population(variables)
    out = np.zeros((population.shape[0], len(task.terms)))
    for index, row in enumerate(population):
        out[index] = _slow_terms(task, row)
    return out


def weighted_sum(task: SynthesisTask, terms: Float) -> Float:
    """The objective, (m,), of the terms' values (m, terms)."""
    return terms @ task.weights


def _slow_terms(task: SynthesisTask, row: Float) -> Float:
    assert task.theta2 is not None
    five_bar = task.five_bar(row)
    track = track_closure(DesiredCurve(task.theta2, task.x, task.y), five_bar, task.minimum_sine)
    values = np.zeros(len(task.terms))
    for index, entry in enumerate(task.terms):
        if entry.term is Term.STRUCTURAL_ERROR:
            values[index] = float(np.sum(track.structural_error) * 1e3) ** 2
        elif entry.term is Term.MOBILITY:
            values[index] = float(track.immobile_points**3)
        elif entry.term is Term.SWEPT_AREA:
            displacement = np.degrees(track.theta5 - track.theta5[0])
            values[index] = five_bar.s * 1e3 * float(np.sqrt(np.sum(displacement**2)))
    return values
