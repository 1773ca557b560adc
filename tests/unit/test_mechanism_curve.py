"""The desired curve's file: what is read, and one sentence for everything that is not a curve."""

from math import radians
from pathlib import Path

import numpy as np
import pytest

from mechanism.curve import MAXIMUM_FILE_BYTES, DesiredCurve, load_curve_csv, parse_curve_csv
from mechanism.errors import CurveError

HEADER = "theta2_deg,x_mm,y_mm\n"


def rows(*angles: float) -> str:
    return HEADER + "".join(f"{angle},{100 + i},{-50.5}\n" for i, angle in enumerate(angles))


HEXAGON = rows(0, 60, 120, 180, 240, 300)


def test_units_are_si_and_arrays_read_only() -> None:
    curve = parse_curve_csv(HEXAGON, "c.csv")
    assert curve.theta2[1] == pytest.approx(radians(60))
    assert curve.x[2] == pytest.approx(0.102)
    assert curve.points[5] == pytest.approx([0.105, -0.0505])
    with pytest.raises(ValueError, match="read-only"):
        curve.x[0] = 1.0


def test_the_arrays_given_are_copied() -> None:
    theta2 = np.radians([0.0, 60, 120, 180, 240, 300])
    curve = DesiredCurve(theta2, np.ones(6), np.ones(6))
    theta2[0] = 5.0
    assert curve.theta2[0] == 0.0


def test_blank_lines_spaces_and_a_byte_order_mark_are_harmless() -> None:
    text = "\ufeff theta2_deg, x_mm ,y_mm\r\n" + HEXAGON.removeprefix(HEADER).replace("\n", "\r\n\r\n")
    assert parse_curve_csv(text, "c.csv").theta2.size == 6


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "c.csv: the file is empty"),
        ("theta2_deg,x_m,y_m\n", "c.csv: column x_m has the wrong unit or none, expected x_mm"),
        ("theta2_rad,x_mm,y_mm\n", "c.csv: column theta2_rad has the wrong unit or none, expected theta2_deg"),
        ("a,b\n", "c.csv: the columns are 'a,b', expected 'theta2_deg,x_mm,y_mm'"),
        ("x_mm,theta2_deg,y_mm\n", "c.csv: the columns are 'x_mm,theta2_deg,y_mm', expected 'theta2_deg,x_mm,y_mm'"),
        (HEADER + "1,2\n", "c.csv: row 1: 2 values, expected 3"),
        (HEADER + "1,2,3\n2,two,3\n", "c.csv: row 2: x_mm is 'two', not a number"),
        (HEADER + "1,2,nan\n", "c.csv: row 1: y_mm is nan, not a finite number"),
        (HEADER + "1,inf,3\n", "c.csv: row 1: x_mm is inf, not a finite number"),
        (rows(0, 90, 180, 270), "c.csv: 4 points are too few for a cam, at least 5 are needed"),
        (rows(0, 60, 120, 120, 240, 300), "c.csv: row 4: theta2 = 120 deg is repeated"),
        (rows(0, 60, 180, 120, 240, 300), "c.csv: row 4: theta2 = 120 deg is not in rising order"),
        (rows(0, 60, 120, 180, 240, 300, 360), "c.csv: row 7: theta2 spans 360 deg"),
        (rows(*range(0, 180, 2)), "does not cover one revolution: nothing between theta2 = 178 and 0 deg"),
        (HEADER + '1,"2', "c.csv: not a CSV file"),
    ],
)
def test_bad_curves_get_one_sentence(text: str, message: str) -> None:
    with pytest.raises(CurveError) as caught:
        parse_curve_csv(text, "c.csv")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_arrays_of_different_length_are_refused() -> None:
    with pytest.raises(CurveError, match="same length"):
        DesiredCurve(np.arange(6.0), np.zeros(6), np.zeros(5))


def test_files(tmp_path: Path) -> None:
    good = tmp_path / "good.csv"
    good.write_text(HEXAGON)
    assert load_curve_csv(good).theta2.size == 6
    with pytest.raises(CurveError, match="cannot be read"):
        load_curve_csv(tmp_path / "none.csv")
    with pytest.raises(CurveError, match="cannot be read"):
        load_curve_csv(tmp_path)
    binary = tmp_path / "binary.csv"
    binary.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(CurveError, match="not a text file"):
        load_curve_csv(binary)
    large = tmp_path / "large.csv"
    large.write_bytes(b"0" * (MAXIMUM_FILE_BYTES + 1))
    with pytest.raises(CurveError, match="larger than"):
        load_curve_csv(large)
