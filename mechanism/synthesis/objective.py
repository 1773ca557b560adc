"""The objective: the terms of whole populations, and their weighted sum.

`evaluate` is what search methods call, and what a worker process may be given: it depends on the task alone. With
numba it runs in kernels; without, the paper's four terms are evaluated in vectors of numpy (`vectorised`), and the
further ones by the kernels as plain Python.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from math import degrees, pi, tau
from typing import Final, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mechanism.errors import ParameterError
from mechanism.jit import COMPILED
from mechanism.synthesis.all_kernels import ALL_TERMS, evaluate_all_terms
from mechanism.synthesis.further_kernels import ZONE_COLUMNS
from mechanism.synthesis.machine_model import MachineModel
from mechanism.synthesis.paper_kernels import evaluate_paper_terms, weigh
from mechanism.synthesis.task import VARIABLE_COUNT, Circle, KeepOutZone, SynthesisTask, Term, Timing
from mechanism.synthesis.tracking_kernels import COS2, ROW_STRIDE, ROWS, SIN2, THETA2, TOLERANCE, X, Y
from mechanism.synthesis.vectorised import vectorised_paper_terms

Float = NDArray[np.float64]

EvaluatePopulation = Callable[[Float], Float]
"""From a population (m, 8) in metres to the values of the task's terms (m, terms), each row by itself."""

_COLUMNS: Final = {term: column for column, term in enumerate(Term)}
_PAPER: Final = (Term.STRUCTURAL_ERROR, Term.MOBILITY, Term.SWEPT_AREA, Term.HARMONIC_CONTENT)
_OF_MOTION: Final = frozenset({Term.SERVO_VELOCITY, Term.SERVO_ACCELERATION})
_OF_TORQUE: Final = frozenset({Term.PEAK_TORQUE, Term.CV_PEAK_TORQUE, Term.POWER})


@dataclass(frozen=True, slots=True, eq=False)
class Prepared:
    """What the kernels need of a task. ``rows`` is their workspace as well: one evaluation at a time."""

    rows: Float
    fourier: Float
    first: Float
    second: Float
    machine: Float
    zones: Float
    columns: NDArray[np.intp]
    paper_only: bool
    motion: bool
    torque: bool


def _fourier(theta2: Float, harmonics: int) -> Float:
    """Cosine and sine rows of every order, (n, 2 orders), deg per rad, trapezoids between the points."""
    gaps = np.diff(np.append(theta2, theta2[0] + tau))
    weights = 0.5 * (gaps + np.roll(gaps, 1)) / pi
    angles = np.outer(theta2, np.arange(1, harmonics + 1))
    rows = np.empty((theta2.size, 2 * harmonics))
    rows[:, 0::2] = np.cos(angles)
    rows[:, 1::2] = np.sin(angles)
    return rows * weights[:, np.newaxis] * degrees(1.0)


def _derivatives(theta2: Float) -> tuple[Float, Float]:
    """The matrices that take values at theta2 to the first and second derivative there of their periodic spline."""
    # scipy takes longer to import than the paper's whole search: only where it is needed.
    from mechanism.spline import periodic_quintic

    closed = np.append(theta2, theta2[0] + tau)
    identity = np.eye(theta2.size)
    spline = periodic_quintic(closed, np.vstack((identity, identity[:1])))
    return np.ascontiguousarray(spline(theta2, 1)), np.ascontiguousarray(spline(theta2, 2))


def _machine(model: MachineModel) -> Float:
    return np.array(
        [
            *model.linear_density_kg_per_m,
            *model.width_m,
            *model.end_mass_kg,
            model.end_effector_mass_kg,
            *model.rotor_inertia_kg_m2,
            *model.gravity_m_s2,
            *model.viscous_N_m_s,
            *model.coulomb_N_m,
            model.coulomb_velocity_rad_per_s,
        ]
    )


def _zones(zones: tuple[KeepOutZone, ...]) -> Float:
    table = np.zeros((len(zones), ZONE_COLUMNS))
    for row, zone in zip(table, zones, strict=True):
        if isinstance(zone, Circle):
            row[:4] = 0.0, zone.x, zone.y, zone.radius
        else:
            row[:] = 1.0, zone.x_minimum, zone.y_minimum, zone.x_maximum, zone.y_maximum
    return table


@lru_cache(maxsize=8)
def prepare(task: SynthesisTask) -> Prepared:
    """What the kernels need of a task, made once."""
    count = task.count
    rows = np.zeros(ROWS * ROW_STRIDE)
    rows[X : X + count] = task.x
    rows[Y : Y + count] = task.y
    if task.tolerances is not None:
        rows[TOLERANCE : TOLERANCE + count] = task.tolerances
    terms = [entry.term for entry in task.terms]
    torque = not _OF_TORQUE.isdisjoint(terms)
    motion = torque or not _OF_MOTION.isdisjoint(terms)
    orders = min(task.harmonics, (count - 1) // 2)
    free = task.timing is Timing.FREE or task.theta2 is None
    fourier = np.zeros((count, 2 * orders))
    first = second = np.zeros((0, 0))
    if not free:
        theta2 = cast("Float", task.theta2)
        rows[THETA2 : THETA2 + count] = theta2
        rows[COS2 : COS2 + count] = np.cos(theta2)
        rows[SIN2 : SIN2 + count] = np.sin(theta2)
        fourier = _fourier(theta2, orders)
        if motion:
            first, second = _derivatives(theta2)
    return Prepared(
        rows,
        fourier,
        first,
        second,
        _machine(task.machine),
        _zones(task.keep_out),
        np.array([_COLUMNS[term] for term in terms], dtype=np.intp),
        not free and all(term in _PAPER for term in terms),
        motion,
        torque,
    )


def check_population(variables: ArrayLike) -> Float:
    """A population as contiguous (m, 8) float64. Raises ParameterError."""
    population = np.ascontiguousarray(np.atleast_2d(np.asarray(variables, dtype=np.float64)))
    if population.ndim != 2 or population.shape[1] != VARIABLE_COUNT:
        raise ParameterError("the shape of a population", population.shape, f"(m, {VARIABLE_COUNT})")
    return population


def evaluate(task: SynthesisTask, variables: ArrayLike) -> Float:
    """The values of the task's terms, (m, terms), of a population (m, 8) in metres.

    Not bound by the task's bounds; lengths must be positive. Not for several threads at once. Raises ParameterError.
    """
    population = check_population(variables)
    prepared = prepare(task)
    if prepared.paper_only:
        terms = np.empty((population.shape[0], len(_PAPER)))
        if COMPILED:
            evaluate_paper_terms(population, prepared.rows, task.count, prepared.fourier, task.minimum_sine, terms)
        else:
            vectorised_paper_terms(task, population, prepared.fourier, terms)
    else:
        terms = np.zeros((population.shape[0], ALL_TERMS))
        evaluate_all_terms(
            population,
            prepared.rows,
            task.count,
            prepared.fourier,
            task.minimum_sine,
            prepared.first,
            prepared.second,
            prepared.machine,
            prepared.zones,
            task.speed_rad_per_s,
            task.timing is Timing.FREE,
            prepared.motion,
            prepared.torque,
            terms,
        )
    return terms[:, prepared.columns]


def weighted_sum(task: SynthesisTask, terms: Float) -> Float:
    """The objective, (m,), of the terms' values (m, terms)."""
    values = np.empty(terms.shape[0])
    weigh(np.ascontiguousarray(terms), np.arange(terms.shape[1], dtype=np.int64), task.weights, values)
    return values


def solved_timing(task: SynthesisTask, variables: Float) -> Float:
    """theta2 at every point, rising, rad: the task's own, or what free timing is solved to for this mechanism."""
    if task.timing is Timing.PRESCRIBED and task.theta2 is not None:
        return task.theta2
    rows = prepare(task).rows
    evaluate(task, variables)
    return rows[THETA2 : THETA2 + task.count].copy()
