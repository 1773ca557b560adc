"""Which mechanism of a finished search is taken, and whether it is of use."""

from typing import Final

import numpy as np

from gateway.errors import UsageError
from gateway.synthesis.run_search import SearchStatus, is_faulty
from gateway.synthesis.search_slice import Found
from mechanism.errors import CurveError
from mechanism.synthesis.candidate import Candidate
from mechanism.synthesis.search import Method
from mechanism.synthesis.task import SynthesisTask

BEST: Final = "best"
KNEE: Final = "knee"


def choose(status: SearchStatus, choice: str | None, front: tuple[Found, ...], error_limit_m: float) -> Found:
    """The best by weighted sum, or of a Pareto front: "best", "knee", or a number from 1 on. Raises UsageError.

    The knee is, among the mechanisms without faults that meet every point (within its tolerance, or the limit in m),
    the one nearest to the best of every term; with none that does, the one with the least structural error.
    """
    best = status.best
    if best is None:
        raise UsageError("the search was interrupted before it had found anything")
    check_choice(choice, status.settings.method)
    if not front:
        return best
    if choice is None or choice == KNEE:
        return _knee(status.settings.task, front, error_limit_m)
    if choice == BEST:
        return min(front, key=lambda found: found.objective)
    if int(choice) > len(front):
        raise UsageError(f"--pareto {choice[:20]}: the front has {len(front)} mechanisms")
    return front[int(choice) - 1]


def check_choice(choice: str | None, method: Method) -> None:
    """Refuse a choice that no outcome can meet before the search begins. Raises UsageError."""
    if choice is None:
        return
    if method is not Method.PARETO:
        raise UsageError(f"--pareto {choice[:20]}: only --method pareto has a front to choose from")
    if choice not in {BEST, KNEE} and not (choice.isascii() and choice.isdigit() and int(choice) >= 1):
        raise UsageError(f"--pareto {choice[:20]}: neither knee nor best nor a number from 1 on")


def _knee(task: SynthesisTask, front: tuple[Found, ...], error_limit_m: float) -> Found:
    sound = [found for found in front if not is_faulty(task, found)] or list(front)
    met = [found for found in sound if _greatest_miss(found.candidate(task), error_limit_m) <= 0.0]
    if not met:
        return min(sound, key=lambda found: _greatest_miss(found.candidate(task), error_limit_m))
    counted = [index for index, entry in enumerate(task.terms) if entry.weight > 0.0]
    costs = np.array([found.terms for found in met])[:, counted]
    span = np.ptp(costs, axis=0)
    scaled = (costs - costs.min(axis=0)) / np.where(span > 0.0, span, 1.0)
    return met[int(np.argmin(np.sum(scaled**2, axis=1)))]


def _greatest_miss(candidate: Candidate, error_limit_m: float) -> float:
    """By how much (m) the worst point is missed beyond its tolerance, or beyond the limit where there are none."""
    tolerances = candidate.task.tolerances
    try:
        error = candidate.servo_motion().structural_error
    except CurveError:
        return float("inf")
    return float((error - (error_limit_m if tolerances is None else tolerances)).max())
