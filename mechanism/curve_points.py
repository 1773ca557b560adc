"""The points of a wanted curve as a designer gives them: with or without crank angles, with or without tolerances."""

from dataclasses import dataclass
from math import degrees, hypot, tau
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mechanism.curve import COLUMNS, MINIMUM_POINTS, DesiredCurve, read_only
from mechanism.curve_csv import parse_table, read_text
from mechanism.errors import CurveError

Float = NDArray[np.float64]

MAXIMUM_POINTS: Final = 1000
POINT_COLUMNS: Final = ("x_mm", "y_mm")
TOLERANCE_COLUMN: Final = "tolerance_mm"
KNOWN_COLUMNS: Final = (COLUMNS, (*COLUMNS, TOLERANCE_COLUMN), POINT_COLUMNS, (*POINT_COLUMNS, TOLERANCE_COLUMN))

_JUMP_OVER_LONGEST: Final = 3.0
_JUMP_OVER_MEDIAN: Final = 10.0
_REPEATED_M: Final = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class CurvePoints:
    """A closed curve's points in order, x and y in metres, (n,), 5 to 1000 of them, the first not repeated; read-only.

    theta2: rad, rising within one revolution, None where only the order of the points is given; tolerances: m, (n,), 0
    or more, or None. Raises CurveError: too few or many points, something not finite, angles that do not rise, a point
    given twice running, an open curve.
    """

    x: Float
    y: Float
    theta2: Float | None = None
    tolerances: Float | None = None
    source: str | None = None

    def __post_init__(self) -> None:
        for name in ("x", "y", "theta2", "tolerances"):
            values = getattr(self, name)
            if values is not None:
                object.__setattr__(self, name, read_only(values))
        count = self.x.size
        if count < MINIMUM_POINTS:
            raise CurveError(
                f"{count} points are too few for a curve, at least {MINIMUM_POINTS} are needed", self.source
            )
        if count > MAXIMUM_POINTS:
            raise CurveError(f"{count} points are too many for a synthesis, at most {MAXIMUM_POINTS}", self.source)
        for name, values in (("x", self.x), ("y", self.y), ("tolerance", self.tolerances)):
            if values is None:
                continue
            if values.shape != (count,):
                raise CurveError(f"{values.size} values of {name} for {count} points", self.source)
            wrong = np.flatnonzero(~np.isfinite(values))
            if wrong.size:
                raise CurveError(f"{name} is {values[wrong[0]]}, not a finite number", self.source, int(wrong[0]) + 1)
        if self.theta2 is not None:
            DesiredCurve(self.theta2, self.x, self.y, self.source)
        if self.tolerances is not None and float(self.tolerances.min()) < 0.0:
            row = int(np.argmin(self.tolerances))
            value = float(self.tolerances[row]) * 1e3
            raise CurveError(f"{TOLERANCE_COLUMN} is {value:g}, bound 0 or more", self.source, row + 1)
        self._check_steps()

    def _check_steps(self) -> None:
        steps = np.hypot(np.diff(self.x), np.diff(self.y))
        repeated = np.flatnonzero(steps < _REPEATED_M)
        # With crank angles a point given twice is a dwell, and that is a wish like any other.
        if self.theta2 is None and repeated.size:
            raise CurveError("the point is that of the row before", self.source, int(repeated[0]) + 2)
        if not steps.any():
            raise CurveError("all points of the curve are the same", self.source)
        closing = hypot(float(self.x[0] - self.x[-1]), float(self.y[0] - self.y[-1]))
        bound = max(_JUMP_OVER_LONGEST * float(steps.max()), _JUMP_OVER_MEDIAN * float(np.median(steps)))
        if closing > bound:
            raise CurveError(
                f"the curve is open: its last point lies {closing * 1e3:.4g} mm from its first (bound "
                f"{bound * 1e3:.4g} mm, by the distances of the others), and a machine's cycle closes it",
                self.source,
            )

    @property
    def count(self) -> int:
        """How many points."""
        return self.x.size

    def timed_evenly(self) -> "CurvePoints":
        """The same points at equal steps of theta2 from 0 on."""
        theta2 = np.arange(self.count, dtype=np.float64) * (tau / self.count)
        return CurvePoints(self.x, self.y, theta2, self.tolerances, self.source)

    def untimed(self) -> "CurvePoints":
        """The same points without their crank angles."""
        return CurvePoints(self.x, self.y, None, self.tolerances, self.source)


def parse_curve_points(text: str, source: str) -> CurvePoints:
    """Points from CSV: x_mm, y_mm, before them theta2_deg if prescribed, after them tolerance_mm if wanted.

    A last row that repeats the first one of a curve without angles is left out. Raises CurveError.
    """
    columns, table = parse_table(text, source, KNOWN_COLUMNS)
    named = dict(zip(columns, table.T, strict=True))
    x, y = named["x_mm"] * 1e-3, named["y_mm"] * 1e-3
    theta2 = np.radians(named["theta2_deg"]) if "theta2_deg" in named else None
    tolerances = named[TOLERANCE_COLUMN] * 1e-3 if TOLERANCE_COLUMN in named else None
    if theta2 is None and x.size > 1 and hypot(x[-1] - x[0], y[-1] - y[0]) < _REPEATED_M:
        x, y = x[:-1], y[:-1]
        tolerances = None if tolerances is None else tolerances[:-1]
    return CurvePoints(x, y, theta2, tolerances, source)


def load_curve_points(path: Path | str) -> CurvePoints:
    """Read `parse_curve_points`' CSV from a file of at most 4 MB. Raises CurveError."""
    path = Path(path)
    return parse_curve_points(read_text(path), str(path))


def curve_csv(curve: DesiredCurve) -> str:
    """The CSV that `mechanism.curve.load_curve_csv` reads back, angles and lengths to 1e-9 of their units."""
    rows = (
        f"{round(degrees(theta2), 9):.12g},{round(x * 1e3, 9):.12g},{round(y * 1e3, 9):.12g}"
        for theta2, x, y in zip(curve.theta2.tolist(), curve.x.tolist(), curve.y.tolist(), strict=True)
    )
    return "\n".join((",".join(COLUMNS), *rows, ""))
