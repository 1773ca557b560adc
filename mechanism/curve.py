"""The desired curve: where the end effector shall be at which angle of the constant-velocity axis."""

from dataclasses import dataclass
from math import degrees, radians, tau
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mechanism.curve_csv import MAXIMUM_FILE_BYTES, MAXIMUM_ROWS, parse_table, read_text
from mechanism.errors import CurveError

__all__ = [
    "COLUMNS",
    "MAXIMUM_FILE_BYTES",
    "MAXIMUM_POINTS",
    "MINIMUM_POINTS",
    "DesiredCurve",
    "load_curve_csv",
    "parse_curve_csv",
    "read_only",
]

Float = NDArray[np.float64]

MINIMUM_POINTS: Final = 5
MAXIMUM_POINTS: Final = MAXIMUM_ROWS
COLUMNS: Final = ("theta2_deg", "x_mm", "y_mm")

_GREATEST_GAP_RAD: Final = radians(120.0)


def read_only(values: ArrayLike) -> Float:
    """A contiguous float64 copy that nobody can write to."""
    array = np.array(values, dtype=np.float64, order="C")
    array.setflags(write=False)
    return array


@dataclass(frozen=True, slots=True, eq=False)
class DesiredCurve:
    """A closed curve: theta2 in rad (rising, less than one revolution), x and y in metres; read-only, shape (n,).

    The point at theta2[0] + 2 pi is that at theta2[0] and is not repeated. ``source`` names the file in errors. Raises
    CurveError (at least 5 points, all finite, angles rising and inside one revolution, no gap above 120 deg).
    """

    theta2: Float
    x: Float
    y: Float
    source: str | None = None

    def __post_init__(self) -> None:
        for name in ("theta2", "x", "y"):
            object.__setattr__(self, name, read_only(getattr(self, name)))
        count = self.theta2.size
        if self.theta2.shape != (count,) or self.x.shape != (count,) or self.y.shape != (count,):
            raise CurveError("theta2, x and y are not three lists of the same length", self.source)
        if count < MINIMUM_POINTS:
            raise CurveError(f"{count} points are too few for a cam, at least {MINIMUM_POINTS} are needed", self.source)
        if count > MAXIMUM_POINTS:
            raise CurveError(f"{count} points are too many, at most {MAXIMUM_POINTS} are taken", self.source)
        for name, values in (("theta2", self.theta2), ("x", self.x), ("y", self.y)):
            wrong = np.flatnonzero(~np.isfinite(values))
            if wrong.size:
                raise CurveError(f"{name} is {values[wrong[0]]}, not a finite number", self.source, int(wrong[0]) + 1)
        self._check_angles()

    def _check_angles(self) -> None:
        steps = np.diff(self.theta2)
        wrong = np.flatnonzero(steps <= 0.0)
        if wrong.size:
            row = int(wrong[0]) + 1
            angle = degrees(float(self.theta2[row]))
            fault = "is repeated" if steps[row - 1] == 0.0 else "is not in rising order"
            raise CurveError(f"theta2 = {angle:g} deg {fault}", self.source, row + 1)
        span = float(self.theta2[-1] - self.theta2[0])
        if span >= tau * (1.0 - 1e-9):
            raise CurveError(
                f"theta2 spans {degrees(span):g} deg, bound less than 360 deg: the curve closes by itself, its first "
                "point is not repeated",
                self.source,
                self.theta2.size,
            )
        gaps = np.append(steps, tau - span)
        widest = int(np.argmax(gaps))
        # The gap that closes the curve is held to the same measure as the others: a curve cut off half way is open.
        bound = min(_GREATEST_GAP_RAD, max(10.0 * float(np.median(gaps)), radians(1.0)))
        if gaps[widest] > bound:
            raise CurveError(
                f"the curve does not cover one revolution: nothing between theta2 = "
                f"{degrees(float(self.theta2[widest])):g} and "
                f"{degrees(float(self.theta2[(widest + 1) % self.theta2.size])):g} deg "
                f"(a gap of {degrees(float(gaps[widest])):g} deg, bound {degrees(bound):g} deg)",
                self.source,
            )

    @property
    def points(self) -> Float:
        """x, y in metres, shape (n, 2)."""
        return np.stack((self.x, self.y), axis=1)


def parse_curve_csv(text: str, source: str) -> DesiredCurve:
    """A desired curve from the text of a CSV file with the columns theta2_deg, x_mm, y_mm. Raises CurveError."""
    _, table = parse_table(text, source, (COLUMNS,))
    return DesiredCurve(np.radians(table[:, 0]), table[:, 1] * 1e-3, table[:, 2] * 1e-3, source)


def load_curve_csv(path: Path | str) -> DesiredCurve:
    """Read a desired curve: CSV, columns theta2_deg, x_mm, y_mm, at most 4 MB and 100 000 rows. Raises CurveError."""
    path = Path(path)
    return parse_curve_csv(read_text(path), str(path))
