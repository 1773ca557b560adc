"""What a user types for a synthesis task - weights, bounds, keep-out zones - as the values the task takes."""

from collections.abc import Sequence
from typing import Final

import numpy as np

from gateway.errors import UsageError
from mechanism.errors import ParameterError
from mechanism.synthesis.pareto import PARETO_TERMS
from mechanism.synthesis.search import Method
from mechanism.synthesis.task import (
    PAPER_TERMS,
    Bounds,
    Box,
    Circle,
    KeepOutZone,
    Term,
    Timing,
    Variable,
    WeightedTerm,
)

MAXIMUM_ZONES: Final = 32


def slug(term: Term) -> str:
    """A term's name as it is typed."""
    return term.name.lower().replace("_", "-")


TERM_NAMES: Final = {slug(term): term for term in Term}
VARIABLE_NAMES: Final = {variable.name.lower(): variable for variable in Variable}


_USUAL_WEIGHTS: Final = {
    Term.STRUCTURAL_ERROR: 100.0,
    Term.MOBILITY: 1e6,
    Term.SWEPT_AREA: 0.05,
    Term.HARMONIC_CONTENT: 0.5,
    Term.TRANSMISSION_ANGLE: 20_000.0,
    Term.SINGULARITY: 1e6,
    Term.PEAK_TORQUE: 3000.0,
}
"""The curve comes first, and a linkage that cannot move or be driven is none. The less the servo sweeps, the more its
errors are magnified and the heavier it works: so transmission angle and torque stand against the swept area."""
_FAULT_WEIGHT: Final = 1e6


def default_weights(method: Method, timing: Timing, has_zones: bool) -> dict[Term, float]:
    """What a method weighs if nothing else is asked for: the paper's the paper's terms, with the paper's weights."""
    if method is Method.PAPER:
        weights = {entry.term: entry.weight for entry in PAPER_TERMS}
    elif method is Method.PARETO:
        weights = {entry.term: entry.weight for entry in PARETO_TERMS}
    else:
        weights = dict(_USUAL_WEIGHTS)
    if timing is Timing.FREE:
        weights[Term.TIMING] = _FAULT_WEIGHT
    if has_zones:
        weights[Term.KEEP_OUT] = _FAULT_WEIGHT
    return weights


def weighted_terms(texts: Sequence[str], defaults: dict[Term, float]) -> tuple[WeightedTerm, ...]:
    """``defaults`` changed by texts like "power=20,swept-area=0,peak-torque=off".

    A term with weight 0 is evaluated and reported without counting, one that is off is not evaluated.

    The terms come in the order of `Term`. Raises UsageError.
    """
    weights = dict(defaults)
    for name, text in _pairs(texts, "--weights"):
        term = TERM_NAMES.get(name)
        if term is None:
            raise UsageError(f"--weights: {name[:40]} is no term (there are: {', '.join(TERM_NAMES)})")
        if text == "off":
            weights.pop(term, None)
            continue
        weights[term] = _number(text, f"--weights: {name}")
        if not 0.0 <= weights[term] <= 1e12:
            raise UsageError(f"--weights: {name} is {text}, bound 0 to 1e12")
    if not any(weights.values()):
        raise UsageError("--weights: every term has weight 0, at least one must be positive")
    return tuple(WeightedTerm(term, weights[term]) for term in Term if term in weights)


def bounds_with(texts: Sequence[str], base: Bounds) -> Bounds:
    """``base`` changed by texts like "p=100:200,cv_pivot_x=0" in mm; a single number holds a variable.

    Raises UsageError.
    """
    lower, upper = base.lower.copy(), base.upper.copy()
    for name, text in _pairs(texts, "--bounds"):
        variable = VARIABLE_NAMES.get(name.replace("-", "_"))
        if variable is None:
            raise UsageError(f"--bounds: {name[:40]} is no variable (there are: {', '.join(VARIABLE_NAMES)})")
        low, _, high = text.partition(":")
        lower[variable] = _number(low, f"--bounds: {name}") * 1e-3
        upper[variable] = _number(high or low, f"--bounds: {name}") * 1e-3
    try:
        return Bounds(lower, upper)
    except ParameterError as error:
        raise UsageError(f"--bounds: {error}") from None


def keep_out_zones(texts: Sequence[str]) -> tuple[KeepOutZone, ...]:
    """Zones from texts like "circle:100,50,30" (middle, radius) and "box:0,-80,60,-20" (two corners), mm.

    Raises UsageError.
    """
    if len(texts) > MAXIMUM_ZONES:
        raise UsageError(f"--keep-out: {len(texts)} zones, bound {MAXIMUM_ZONES}")
    return tuple(_zone(text) for text in texts)


def _zone(text: str) -> KeepOutZone:
    kind, _, rest = text.partition(":")
    values = [_number(part, f"--keep-out: {text[:60]}") * 1e-3 for part in rest.split(",")]
    try:
        if kind == "circle" and len(values) == 3:
            return Circle(*values)
        if kind == "box" and len(values) == 4:
            return Box(
                min(values[0], values[2]),
                min(values[1], values[3]),
                max(values[0], values[2]),
                max(values[1], values[3]),
            )
    except ParameterError as error:
        raise UsageError(f"--keep-out: {error}") from None
    raise UsageError(f"--keep-out: '{text[:60]}' is neither circle:X,Y,RADIUS nor box:X1,Y1,X2,Y2 (mm)")


def _pairs(texts: Sequence[str], option: str) -> list[tuple[str, str]]:
    pairs: list[tuple[str, str]] = []
    for part in ",".join(texts).split(","):
        if not part.strip():
            continue
        name, equals, value = part.partition("=")
        if not equals:
            raise UsageError(f"{option}: '{part[:60]}' is not NAME=VALUE")
        pairs.append((name.strip().lower(), value.strip()))
    return pairs


def _number(text: str, where: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise UsageError(f"{where}: '{text[:40]}' is not a number") from None
    if not np.isfinite(value):
        raise UsageError(f"{where}: {text[:40]} is not finite")
    return value
