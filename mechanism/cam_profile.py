"""A cam as a function: theta5(theta2), four times continuously differentiable, evaluated in constant time."""

from dataclasses import dataclass
from math import floor, nan, pi, tau
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mechanism.curve import MINIMUM_POINTS, read_only
from mechanism.errors import CurveError, ParameterError
from mechanism.jit import kernel
from mechanism.spline import DEGREE, Spline, periodic_quintic

Float = NDArray[np.float64]

MINIMUM_KNOTS: Final = 8
MAXIMUM_KNOTS: Final = 65536
_FARTHEST_RAD: Final = 1e12


@kernel
def evaluate(coefficients: Float, net_turns: int, theta2: float) -> tuple[float, float, float, float]:
    """theta5 and its first three derivatives with respect to theta2 (rad); NaN where theta2 is not finite.

    ``coefficients`` is (n, 6), n a power of two: on piece i, theta5 = sum c[i, k] u^k with u = n theta2 / (2 pi) - i.
    """
    if not abs(theta2) < _FARTHEST_RAD:
        return nan, nan, nan, nan
    count = coefficients.shape[0]
    scale = count / (2.0 * pi)
    phase = theta2 * scale
    whole = floor(phase)
    u = phase - whole
    piece = int(whole) & (count - 1)
    turns = (int(whole) - piece) // count
    c0 = coefficients[piece, 0]
    c1 = coefficients[piece, 1]
    c2 = coefficients[piece, 2]
    c3 = coefficients[piece, 3]
    c4 = coefficients[piece, 4]
    c5 = coefficients[piece, 5]
    value = c0 + u * (c1 + u * (c2 + u * (c3 + u * (c4 + u * c5))))
    first = c1 + u * (2.0 * c2 + u * (3.0 * c3 + u * (4.0 * c4 + u * 5.0 * c5)))
    second = 2.0 * c2 + u * (6.0 * c3 + u * (12.0 * c4 + u * 20.0 * c5))
    third = 6.0 * c3 + u * (24.0 * c4 + u * 60.0 * c5)
    return (
        value + turns * net_turns * 2.0 * pi,
        first * scale,
        second * scale * scale,
        third * scale * scale * scale,
    )


@kernel
def evaluate_many(coefficients: Float, net_turns: int, theta2: Float, out: Float) -> None:
    """`evaluate` of every element of theta2 (n,) into ``out`` (n, 4)."""
    for i in range(theta2.size):
        out[i, 0], out[i, 1], out[i, 2], out[i, 3] = evaluate(coefficients, net_turns, theta2[i])


def periodic_spline(theta2: Float, theta5: Float, net_turns: int) -> Spline:
    """The periodic quintic spline (C4) through theta5 - net_turns (theta2 - theta2[0]), period 2 pi.

    theta2 (n,) rises within one revolution; the first point is not repeated. Raises CurveError for fewer than 5 points.
    """
    if theta2.size < MINIMUM_POINTS:
        raise CurveError(f"{theta2.size} points are too few for a cam, at least {MINIMUM_POINTS} are needed")
    drift_free = theta5 - net_turns * (theta2 - theta2[0])
    x = np.append(theta2, theta2[0] + tau)
    y = np.append(drift_free, drift_free[0])
    return periodic_quintic(x, y)


@dataclass(frozen=True, slots=True, eq=False)
class CamProfile:
    """theta5(theta2), piecewise quintic on equal knots, for theta2 of any size and sign.

    coefficients: (n, 6) read-only, ascending powers of u = n theta2 / (2 pi) - i on piece i; n is a power of two.
    net_turns: whole turns that theta5 gains in one turn of theta2. Raises ParameterError.
    """

    coefficients: Float
    net_turns: int = 0

    def __post_init__(self) -> None:
        object.__setattr__(self, "coefficients", read_only(self.coefficients))
        shape = self.coefficients.shape
        if len(shape) != 2 or shape[1] != DEGREE + 1:
            raise ParameterError("the shape of the cam's coefficients", shape, f"(knots, {DEGREE + 1})")
        check_knots(shape[0])
        if not bool(np.all(np.isfinite(self.coefficients))):
            raise ParameterError("a coefficient of the cam", "not a number", "finite")
        # The first call loads the machine code, which must not happen within a cycle.
        evaluate(self.coefficients, self.net_turns, 0.0)

    @classmethod
    def through(cls, theta2: ArrayLike, theta5: ArrayLike, net_turns: int = 0, knots: int = 1024) -> "CamProfile":
        """The profile through the points theta5(theta2) (rad, theta2 rising within one revolution).

        A periodic quintic spline through the points is sampled at the equal knots, and a second one laid through these.
        """
        check_knots(knots)
        points = np.asarray(theta2, dtype=np.float64)
        spline = periodic_spline(points, np.asarray(theta5, dtype=np.float64), net_turns)
        at = np.arange(knots) * (tau / knots)
        within = points[0] + (at - points[0]) % tau
        samples = spline(within)
        units = np.arange(knots + 1, dtype=np.float64)
        equal = periodic_quintic(units, np.append(samples, samples[0]))
        factorials = (1.0, 1.0, 2.0, 6.0, 24.0, 120.0)
        coefficients = np.stack([equal(units[:-1], nu=k) / factorials[k] for k in range(DEGREE + 1)], axis=1)
        coefficients[:, 0] += net_turns * (at - points[0])
        coefficients[:, 1] += net_turns * tau / knots
        return cls(coefficients, net_turns)

    @property
    def knots(self) -> int:
        """How many equal pieces one turn of theta2 has; a power of two."""
        return int(self.coefficients.shape[0])

    def at(self, theta2: float) -> tuple[float, float, float, float]:
        """theta5 and its first three derivatives with respect to theta2 (rad); all NaN where theta2 is not finite."""
        return evaluate(self.coefficients, self.net_turns, theta2)

    def at_many(self, theta2: ArrayLike) -> Float:
        """`at` for an array of angles: shape (..., 4), columns theta5, d1, d2, d3."""
        angles = np.ascontiguousarray(theta2, dtype=np.float64)
        out = np.empty((angles.size, 4), dtype=np.float64)
        evaluate_many(self.coefficients, self.net_turns, angles.ravel(), out)
        return out.reshape((*angles.shape, 4))

    def table_degrees(self) -> tuple[list[float], list[float]]:
        """theta2 and theta5 in degrees at the knots."""
        theta2 = np.arange(self.knots) * (360.0 / self.knots)
        return theta2.tolist(), np.degrees(self.coefficients[:, 0]).tolist()


def check_knots(knots: int) -> None:
    """Raise ParameterError unless ``knots`` is a power of two from 8 to 65536."""
    if not (MINIMUM_KNOTS <= knots <= MAXIMUM_KNOTS and knots & (knots - 1) == 0):
        raise ParameterError("knots", knots, f"a power of two from {MINIMUM_KNOTS} to {MAXIMUM_KNOTS}")
