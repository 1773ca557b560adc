"""What is wanted of a mechanism: the curve and its tolerances, the bounds of the variables, and the terms to weigh."""

from dataclasses import dataclass, field
from enum import Enum, IntEnum, unique
from math import hypot, tau
from typing import Final, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mechanism.curve import MINIMUM_POINTS, DesiredCurve, read_only
from mechanism.errors import CurveError, ParameterError, SynthesisError, finite
from mechanism.five_bar import FiveBar
from mechanism.synthesis.machine_model import MachineModel

Float = NDArray[np.float64]

MAXIMUM_POINTS: Final = 1000
MAXIMUM_HARMONICS: Final = 64
VARIABLE_COUNT: Final = 8
_LENGTHS: Final = 4


@unique
class Variable(IntEnum):
    """The columns of a population; metres. The same order as `FiveBar.to_array`."""

    P = 0
    Q = 1
    R = 2
    S = 3
    CV_PIVOT_X = 4
    CV_PIVOT_Y = 5
    SERVO_PIVOT_X = 6
    SERVO_PIVOT_Y = 7


@unique
class Term(Enum):
    """A term of the objective; every one is a cost that is 0 or more, and less is better.

    The first four are the paper's, eqs (1) to (4) with the slips put right. Its units are not given; lengths in mm and
    angles in degrees are taken, because only with angles well above 1 do the rising exponents of eq (2) weigh the high
    harmonics, as the text wants, and because all four terms are then of like magnitude under the paper's weights. One
    immobile position more costs little then: who needs them all mobile gives mobility and singularity weights of 1e4.

    STRUCTURAL_ERROR: (sum of the points' errors beyond their tolerances)^2, mm^2, eq (1). A point's error is what the
        crank dyad misses it by: q is laid from the crank's end A towards the desired point, so it is abs(AP - q).
    MOBILITY: m^3, m the number of positions in which links r and s cannot close, eq (4).
    SWEPT_AREA: s sqrt(sum theta5^2), mm deg, theta5 measured from the first point (the motor's displacement), eq (3).
    HARMONIC_CONTENT: sum over the orders h of sqrt(a_h^2 + b_h^2)^(h + 1), a_h and b_h in degrees, eq (2).
    TRANSMISSION_ANGLE: 1 - the least abs sine of the angles between q and r and between r and s; 1 where immobile.
    SINGULARITY: m^3, m the number of positions in which the sine between q and r is below the task's minimum, or before
        which the linkage would have to change its closure; such a mechanism cannot be driven by its two motors.
    PEAK_TORQUE: the servo motor's greatest abs torque, N m, by the dynamic model at the task's speed.
    CV_PEAK_TORQUE: the same of the CV motor.
    POWER: mean over the cycle of what both motors deliver (what flows back is lost), W.
    SERVO_VELOCITY, SERVO_ACCELERATION: greatest abs value, rad/s and rad/s^2, at the task's speed.
    KEEP_OUT: length of links inside keep-out zones, summed over the positions, m.
    TIMING: m^3, m the number of steps by which theta2 does not rise, or rises too far for a curve (free timing only).
    """

    STRUCTURAL_ERROR = "structural error"
    MOBILITY = "mobility"
    SWEPT_AREA = "swept area"
    HARMONIC_CONTENT = "harmonic content"
    TRANSMISSION_ANGLE = "transmission angle"
    SINGULARITY = "singularity"
    PEAK_TORQUE = "peak torque"
    CV_PEAK_TORQUE = "CV peak torque"
    POWER = "power"
    SERVO_VELOCITY = "servo velocity"
    SERVO_ACCELERATION = "servo acceleration"
    KEEP_OUT = "keep-out zones"
    TIMING = "timing"


@unique
class Timing(Enum):
    """Whether every point has its crank angle, or only the order of the points counts and theta2 is solved for."""

    PRESCRIBED = "prescribed"
    FREE = "free"


@dataclass(frozen=True, slots=True)
class WeightedTerm:
    """One term and its weight in the weighted sum; weight 0 reports the term without counting it."""

    term: Term
    weight: float = 1.0

    def __post_init__(self) -> None:
        if not (finite(self.weight) and self.weight >= 0.0):
            raise ParameterError(f"the weight of {self.term.value}", self.weight, "finite and 0 or more")


PAPER_TERMS: Final = (
    WeightedTerm(Term.STRUCTURAL_ERROR, 1.0),
    WeightedTerm(Term.MOBILITY, 1.0),
    WeightedTerm(Term.SWEPT_AREA, 0.75),
    WeightedTerm(Term.HARMONIC_CONTENT, 0.5),
)
"""The paper's four terms with the paper's weights."""


@dataclass(frozen=True, slots=True)
class Circle:
    """A keep-out zone: no link may enter it. Metres."""

    x: float
    y: float
    radius: float

    def __post_init__(self) -> None:
        if not (finite(self.x, self.y, self.radius) and self.radius > 0.0):
            raise ParameterError("a keep-out circle", self, "finite, with a positive radius")


@dataclass(frozen=True, slots=True)
class Box:
    """A keep-out zone with sides along the axes. Metres."""

    x_minimum: float
    y_minimum: float
    x_maximum: float
    y_maximum: float

    def __post_init__(self) -> None:
        if not finite(self.x_minimum, self.y_minimum, self.x_maximum, self.y_maximum):
            raise ParameterError("a keep-out box", self, "finite")
        if self.x_minimum >= self.x_maximum or self.y_minimum >= self.y_maximum:
            raise ParameterError("a keep-out box", self, "larger than nothing: minimum below maximum")


KeepOutZone = Circle | Box


@dataclass(frozen=True, slots=True, eq=False)
class Bounds:
    """Least and greatest value of every variable, (8,) each, metres, in the order of `Variable`. Raises ParameterError.

    A variable whose two bounds are equal is held.
    """

    lower: Float
    upper: Float

    def __post_init__(self) -> None:
        for name in ("lower", "upper"):
            object.__setattr__(self, name, read_only(getattr(self, name)))
        if self.lower.shape != (VARIABLE_COUNT,) or self.upper.shape != (VARIABLE_COUNT,):
            raise ParameterError("the bounds", f"{self.lower.size} and {self.upper.size} values", "8 and 8")
        for variable in Variable:
            low, high = float(self.lower[variable]), float(self.upper[variable])
            name = f"the bounds of {variable.name}"
            text = f"{low * 1e3:g} to {high * 1e3:g} mm"
            if not finite(low, high):
                raise ParameterError(name, text, "finite")
            if low > high:
                raise ParameterError(name, text, "in rising order")
            if variable < _LENGTHS and low <= 0.0:
                raise ParameterError(name, text, "positive")

    @classmethod
    def for_curve(cls, x: ArrayLike, y: ArrayLike) -> Self:
        """Bounds that suit a curve of this size: lengths 0.05 to 2.5 times its diagonal, pivots within 1.5 diagonals of
        its middle.
        """
        xs, ys = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
        size = hypot(float(np.ptp(xs)), float(np.ptp(ys)))
        if not (finite(size) and size > 0.0):
            raise CurveError(f"the curve's size is {size * 1e3:g} mm, but must be positive and finite")
        middle = (0.5 * float(xs.min() + xs.max()), 0.5 * float(ys.min() + ys.max()))
        pivots = np.array([*middle, *middle])
        return cls(
            np.concatenate((np.full(_LENGTHS, 0.05 * size), pivots - 1.5 * size)),
            np.concatenate((np.full(_LENGTHS, 2.5 * size), pivots + 1.5 * size)),
        )

    def contains(self, variables: Float) -> bool:
        """Whether all variables, (8,), lie within (to rounding)."""
        slack = 1e-12
        return bool(np.all(variables >= self.lower - slack) and np.all(variables <= self.upper + slack))


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SynthesisTask:
    """What the synthesis is to do; arrays are read-only, shape (n,), n from 5 to 1000.

    theta2 in rad (rising, less than one revolution) or None with free timing; x and y in m, the closed curve's points
    in order; tolerances in m or None. ``speed_rad_per_s``: the CV axis'. ``harmonics``: how many orders eq (2) takes
    (at most as many as so many points determine). ``minimum_sine``: below it the linkage counts as singular
    (`mechanism.closure`). ``machine``: masses and friction,
    for torque and power. Raises CurveError, ParameterError or SynthesisError.
    """

    theta2: Float | None
    x: Float
    y: Float
    bounds: Bounds
    terms: tuple[WeightedTerm, ...] = PAPER_TERMS
    tolerances: Float | None = None
    timing: Timing = Timing.PRESCRIBED
    keep_out: tuple[KeepOutZone, ...] = ()
    machine: MachineModel = field(default_factory=MachineModel)
    speed_rad_per_s: float = tau
    harmonics: int = 6
    minimum_sine: float = 0.1
    source: str | None = None

    def __post_init__(self) -> None:
        for name in ("theta2", "x", "y", "tolerances"):
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, read_only(value))
        self._check_points()
        self._check_settings()
        self._check_terms()

    @classmethod
    def from_curve(
        cls, curve: DesiredCurve, bounds: Bounds | None = None, terms: tuple[WeightedTerm, ...] = PAPER_TERMS
    ) -> Self:
        """The task of a curve with prescribed crank angles; use `dataclasses.replace` for everything else."""
        if bounds is None:
            bounds = Bounds.for_curve(curve.x, curve.y)
        return cls(theta2=curve.theta2, x=curve.x, y=curve.y, bounds=bounds, terms=terms, source=curve.source)

    @property
    def count(self) -> int:
        """How many points the curve has."""
        return self.x.size

    @property
    def size_m(self) -> float:
        """The diagonal of the curve's bounding box, m."""
        return hypot(float(np.ptp(self.x)), float(np.ptp(self.y)))

    @property
    def weights(self) -> Float:
        """The weights of the terms, in their order."""
        return np.array([entry.weight for entry in self.terms], dtype=np.float64)

    def column(self, term: Term) -> int | None:
        """Where a term stands among the task's terms."""
        for index, entry in enumerate(self.terms):
            if entry.term is term:
                return index
        return None

    def five_bar(self, variables: Float) -> FiveBar:
        """The mechanism that a row of a population stands for."""
        p, q, r, s, cv_x, cv_y, servo_x, servo_y = (float(value) for value in variables)
        return FiveBar(p, q, r, s, (cv_x, cv_y), (servo_x, servo_y))

    def _check_points(self) -> None:
        count = self.x.size
        if self.timing is Timing.PRESCRIBED:
            if self.theta2 is None:
                raise CurveError("prescribed timing needs a theta2 for every point", self.source)
            DesiredCurve(self.theta2, self.x, self.y, self.source)
        if self.x.shape != (count,) or self.y.shape != (count,):
            raise CurveError("x and y are not two lists of the same length", self.source)
        if count < MINIMUM_POINTS:
            raise CurveError(
                f"{count} points are too few for a synthesis, at least {MINIMUM_POINTS} are needed", self.source
            )
        if count > MAXIMUM_POINTS:
            raise CurveError(f"{count} points are too many for a synthesis, at most {MAXIMUM_POINTS}", self.source)
        for name, values in (("x", self.x), ("y", self.y)):
            wrong = np.flatnonzero(~np.isfinite(values))
            if wrong.size:
                raise CurveError(f"{name} is {values[wrong[0]]}, not a finite number", self.source, int(wrong[0]) + 1)
        if self.size_m <= 0.0:
            raise CurveError("all points of the curve are the same", self.source)
        if self.tolerances is not None:
            if self.tolerances.shape != (count,):
                raise CurveError(f"{self.tolerances.size} tolerances for {count} points", self.source)
            wrong = np.flatnonzero(~(np.isfinite(self.tolerances) & (self.tolerances >= 0.0)))
            if wrong.size:
                raise CurveError(
                    f"the tolerance is {self.tolerances[wrong[0]] * 1e3:g} mm, but must be finite and 0 or more",
                    self.source,
                    int(wrong[0]) + 1,
                )

    def _check_settings(self) -> None:
        if not (finite(self.speed_rad_per_s) and self.speed_rad_per_s > 0.0):
            raise ParameterError("the CV axis' speed", f"{self.speed_rad_per_s:g} rad/s", "positive and finite")
        if not 1 <= self.harmonics <= MAXIMUM_HARMONICS:
            raise ParameterError("harmonics", self.harmonics, f"1 to {MAXIMUM_HARMONICS}")
        if not (finite(self.minimum_sine) and 0.0 <= self.minimum_sine < 1.0):
            raise ParameterError("minimum_sine", self.minimum_sine, "0 or more and below 1")

    def _check_terms(self) -> None:
        if not self.terms:
            raise SynthesisError("no term is to be weighed, at least one is needed")
        kinds = [entry.term for entry in self.terms]
        for term in kinds:
            if kinds.count(term) > 1:
                raise SynthesisError(f"the term {term.value} is given twice", term.value)
        if not any(entry.weight > 0.0 for entry in self.terms):
            raise SynthesisError("every term has weight 0, at least one must be positive")
        if Term.KEEP_OUT in kinds and not self.keep_out:
            raise SynthesisError("the term keep-out zones is asked for, but no zone is given", Term.KEEP_OUT.value)
