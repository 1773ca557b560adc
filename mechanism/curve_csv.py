"""CSV tables of curves: files and texts of bounded size in, columns of finite numbers out, or one sentence."""

import csv
import io
from collections.abc import Sequence
from math import isfinite
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mechanism.errors import CurveError

Float = NDArray[np.float64]

MAXIMUM_ROWS: Final = 100_000
MAXIMUM_FILE_BYTES: Final = 4_000_000
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
    "tolerance": "tolerance_mm",
    "tolerance_m": "tolerance_mm",
    "tolerance_um": "tolerance_mm",
}


def read_bounded(path: Path) -> bytes:
    """The bytes of a file of at most 4 MB. Raises CurveError."""
    try:
        with path.open("rb") as file:
            data = file.read(MAXIMUM_FILE_BYTES + 1)
    except OSError as error:
        raise CurveError(f"cannot be read ({error.strerror or type(error).__name__})", str(path)) from None
    if len(data) > MAXIMUM_FILE_BYTES:
        raise CurveError(f"larger than {MAXIMUM_FILE_BYTES} bytes", str(path))
    return data


def read_text(path: Path) -> str:
    """The text of a file of at most 4 MB. Raises CurveError."""
    try:
        return read_bounded(path).decode("utf-8")
    except UnicodeDecodeError:
        raise CurveError("not a text file (UTF-8)", str(path)) from None


def parse_table(text: str, source: str, known: Sequence[tuple[str, ...]]) -> tuple[tuple[str, ...], Float]:
    """The header, which must be one of ``known``, and the rows, (n, columns). Raises CurveError."""
    reader = csv.reader(io.StringIO(text.removeprefix("\ufeff")), strict=True)
    rows: list[list[float]] = []
    try:
        header = next(reader, None)
        if header is None:
            raise CurveError("the file is empty", source)
        columns = _check_header([name.strip() for name in header], source, known)
        for row in reader:
            if not row:
                continue
            if len(rows) >= MAXIMUM_ROWS:
                raise CurveError(f"more than {MAXIMUM_ROWS} rows", source)
            rows.append(_read_row(row, len(rows) + 1, source, columns))
    except csv.Error as error:
        raise CurveError(f"not a CSV file ({error})", source) from None
    return columns, np.array(rows, dtype=np.float64).reshape(-1, len(columns))


def _check_header(header: list[str], source: str, known: Sequence[tuple[str, ...]]) -> tuple[str, ...]:
    for name in header:
        right = _WRONG_UNITS.get(name)
        if right is not None:
            raise CurveError(f"column {name} has the wrong unit or none, expected {right}", source)
    if tuple(header) not in known:
        found = ",".join(header)[:80]
        expected = "' or '".join(",".join(columns) for columns in known)
        raise CurveError(f"the columns are '{found}', expected '{expected}'", source)
    return tuple(header)


def _read_row(row: list[str], number: int, source: str, columns: tuple[str, ...]) -> list[float]:
    if len(row) != len(columns):
        raise CurveError(f"{len(row)} values, expected {len(columns)}", source, number)
    values: list[float] = []
    for name, text in zip(columns, row, strict=True):
        try:
            value = float(text)
        except ValueError:
            raise CurveError(f"{name} is '{text[:40]}', not a number", source, number) from None
        if not isfinite(value):
            raise CurveError(f"{name} is {value}, not a finite number", source, number)
        values.append(value)
    return values
