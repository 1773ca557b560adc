"""The desired curve: where the end effector shall be at which angle of the constant-velocity axis."""

import csv
import io
from dataclasses import dataclass
from math import degrees, isfinite, radians, tau
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mechanism.errors import CurveError

Float = NDArray[np.float64]

MINIMUM_POINTS: Final = 5
MAXIMUM_POINTS: Final = 100_000
MAXIMUM_FILE_BYTES: Final = 4_000_000
COLUMNS: Final = ("theta2_deg", "x_mm", "y_mm")

_GREATEST_GAP_RAD: Final = radians(120.0)
_WRONG_UNITS: Final = {
    "theta2_rad": "theta2_deg",
    "theta2": "theta2_deg",
    "x_m": "x_mm",
    "y_m": "y_mm",
    "x_cm": "x_mm",
    "y_cm": "y_mm",
    "x_in": "x_mm",
    "y_in": "y_mm",
    "x": "x_mm",
    "y": "y_mm",
}


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


def _check_header(header: list[str], source: str) -> None:
    expected = ",".join(COLUMNS)
    for name in header:
        right = _WRONG_UNITS.get(name)
        if right is not None:
            raise CurveError(f"column {name} has the wrong unit or none, expected {right}", source)
    if tuple(header) != COLUMNS:
        found = ",".join(header)[:80]
        raise CurveError(f"the columns are '{found}', expected '{expected}'", source)


def _read_row(row: list[str], number: int, source: str) -> tuple[float, float, float]:
    if len(row) != len(COLUMNS):
        raise CurveError(f"{len(row)} values, expected {len(COLUMNS)}", source, number)
    values: list[float] = []
    for name, text in zip(COLUMNS, row, strict=True):
        try:
            value = float(text)
        except ValueError:
            raise CurveError(f"{name} is '{text[:40]}', not a number", source, number) from None
        if not isfinite(value):
            raise CurveError(f"{name} is {value}, not a finite number", source, number)
        values.append(value)
    return values[0], values[1], values[2]


def parse_curve_csv(text: str, source: str) -> DesiredCurve:
    """A desired curve from the text of a CSV file with the columns theta2_deg, x_mm, y_mm. Raises CurveError."""
    reader = csv.reader(io.StringIO(text.removeprefix("\ufeff")), strict=True)
    rows: list[tuple[float, float, float]] = []
    try:
        header = next(reader, None)
        if header is None:
            raise CurveError("the file is empty", source)
        _check_header([name.strip() for name in header], source)
        for row in reader:
            if not row:
                continue
            if len(rows) >= MAXIMUM_POINTS:
                raise CurveError(f"more than {MAXIMUM_POINTS} rows", source)
            rows.append(_read_row(row, len(rows) + 1, source))
    except csv.Error as error:
        raise CurveError(f"not a CSV file ({error})", source) from None
    table = np.array(rows, dtype=np.float64).reshape(-1, 3)
    return DesiredCurve(np.radians(table[:, 0]), table[:, 1] * 1e-3, table[:, 2] * 1e-3, source)


def load_curve_csv(path: Path | str) -> DesiredCurve:
    """Read a desired curve: CSV, columns theta2_deg, x_mm, y_mm, at most 4 MB and 100 000 rows. Raises CurveError."""
    path = Path(path)
    try:
        with path.open("rb") as file:
            data = file.read(MAXIMUM_FILE_BYTES + 1)
    except OSError as error:
        raise CurveError(f"cannot be read ({error.strerror or type(error).__name__})", str(path)) from None
    if len(data) > MAXIMUM_FILE_BYTES:
        raise CurveError(f"larger than {MAXIMUM_FILE_BYTES} bytes", str(path))
    try:
        text = data.decode("utf-8")
    except UnicodeDecodeError:
        raise CurveError("not a text file (UTF-8)", str(path)) from None
    return parse_curve_csv(text, str(path))
