"""What a designer gives as a wanted curve: points with or without angles and tolerances, or a drawing."""

import io
from math import cos, pi, radians, sin, tau

import numpy as np
import pytest

from mechanism.curve import parse_curve_csv
from mechanism.curve_drawing import load_drawing, sample_closed
from mechanism.curve_points import CurvePoints, curve_csv, parse_curve_points
from mechanism.errors import CurveError, ParameterError

TIMED = "theta2_deg,x_mm,y_mm,tolerance_mm\n0,10,0,0.5\n80,0,10,0\n140,-10,0,0.1\n200,0,-10,0.1\n280,5,-5,0.1\n"
LOOP = "x_mm,y_mm\n10,0\n0,10\n-10,0\n0,-10\n5,-5\n"


def test_angles_points_and_tolerances_come_in_si_units() -> None:
    points = parse_curve_points(TIMED, "c.csv")
    assert points.theta2 is not None
    assert points.tolerances is not None
    assert points.theta2.tolist() == pytest.approx([0.0, radians(80), radians(140), radians(200), radians(280)])
    assert points.x.tolist() == pytest.approx([0.010, 0.0, -0.010, 0.0, 0.005])
    assert points.tolerances.tolist() == pytest.approx([0.0005, 0.0, 0.0001, 0.0001, 0.0001])
    with pytest.raises(ValueError, match="read-only"):
        points.x[0] = 1.0


def test_without_angles_the_closing_point_may_be_repeated() -> None:
    assert parse_curve_points(LOOP, "c.csv").count == 5
    assert parse_curve_points(LOOP + "10,0\n", "c.csv").count == 5
    evenly = parse_curve_points(LOOP, "c.csv").timed_evenly()
    assert evenly.theta2 is not None
    assert np.diff(evenly.theta2) == pytest.approx(np.full(4, tau / 5))
    assert parse_curve_points(TIMED, "c.csv").untimed().theta2 is None


def arc(span_deg: float, count: int) -> str:
    angles = [radians(span_deg) * i / (count - 1) for i in range(count)]
    return "x_mm,y_mm\n" + "".join(f"{100 * cos(a)},{100 * sin(a)}\n" for a in angles)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (LOOP.replace("5,-5\n", ""), "c.csv: 4 points are too few for a curve, at least 5 are needed"),
        (LOOP.replace("-10,0", "nan,0"), "c.csv: row 3: x_mm is nan, not a finite number"),
        (LOOP.replace("-10,0", "-10,inf"), "c.csv: row 3: y_mm is inf, not a finite number"),
        (LOOP.replace("0,10\n", "0,10\n0,10\n"), "c.csv: row 3: the point is that of the row before"),
        (TIMED.replace("140,", "80,"), "c.csv: row 3: theta2 = 80 deg is repeated"),
        (TIMED.replace("140,", "70,"), "c.csv: row 3: theta2 = 70 deg is not in rising order"),
        (TIMED.replace("0,0.1\n200", "0,-1\n200"), "c.csv: row 3: tolerance_mm is -1, bound 0 or more"),
        (TIMED.replace("tolerance_mm", "tolerance"), "column tolerance has the wrong unit or none, expected tolerance"),
        (LOOP.replace("x_mm", "x"), "c.csv: column x has the wrong unit or none, expected x_mm"),
        (LOOP.replace("x_mm,y_mm", "y_mm,x_mm"), "c.csv: the columns are 'y_mm,x_mm', expected 'theta2_deg,x_mm,y_mm'"),
        (LOOP.replace("-10,0", "-10,0,3"), "c.csv: row 3: 3 values, expected 2"),
        ("x_mm,y_mm\n" + "3,4\n" * 6, "c.csv: row 2: the point is that of the row before"),
        ("x_mm,y_mm\n" + "".join(f"{i},{i * i}\n" for i in range(1001)), "1001 points are too many for a synthesis"),
        (arc(180, 19), "c.csv: the curve is open: its last point lies 200 mm from its first (bound 174.3 mm"),
    ],
)
def test_what_is_no_curve_is_told_in_a_sentence(text: str, sentence: str) -> None:
    with pytest.raises(CurveError) as refusal:
        parse_curve_points(text, "c.csv")
    assert sentence in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_a_half_circle_in_19_points_is_open_by_more_than_ten_steps_and_a_nearly_whole_one_is_closed() -> None:
    # 180 deg in 18 steps: a step's chord is 2 * 100 sin(5 deg) = 17.43 mm, ten of them are less than the diameter.
    assert 10 * 200 * sin(radians(5)) == pytest.approx(174.3, abs=0.05)
    with pytest.raises(CurveError, match="open"):
        parse_curve_points(arc(240, 37), "c.csv")
    assert parse_curve_points(arc(350, 36), "c.csv").count == 36


def test_a_dwell_is_a_wish_where_there_are_angles() -> None:
    assert parse_curve_points(TIMED.replace("140,-10,0,", "140,0,10,"), "c.csv").count == 5


def test_a_curve_written_is_the_curve_read() -> None:
    curve = parse_curve_csv("theta2_deg,x_mm,y_mm\n0,1.5,2\n90,0.333333333,7\n180,-4,5\n250,1,1\n300,2,-1\n", "c.csv")
    again = parse_curve_csv(curve_csv(curve), "again.csv")
    for name in ("theta2", "x", "y"):
        assert getattr(again, name) == pytest.approx(getattr(curve, name), abs=1e-14)
    assert curve_csv(again) == curve_csv(curve)


def test_steps_along_a_square_are_equal() -> None:
    square = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0]])
    assert sample_closed(square, 8).tolist() == [[0, 0], [2, 0], [4, 0], [4, 2], [4, 4], [2, 4], [0, 4], [0, 2]]


def dxf(draw, tmp_path, units: int = 4):
    ezdxf = pytest.importorskip("ezdxf")
    document = ezdxf.new()
    document.units = units
    draw(document.modelspace())
    stream = io.StringIO()
    document.write(stream)
    path = tmp_path / "curve.dxf"
    path.write_text(stream.getvalue())
    return path


@pytest.mark.parametrize(("units", "millimetres"), [(0, 1.0), (4, 1.0), (5, 10.0), (6, 1000.0), (1, 25.4)])
def test_a_circle_in_a_dxf_file(tmp_path, units: int, millimetres: float) -> None:
    path = dxf(lambda space: space.add_circle((10, 20), 50), tmp_path, units)
    points = load_drawing(path, 36)
    unit = millimetres * 1e-3
    assert np.hypot(points.x - 10 * unit, points.y - 20 * unit) == pytest.approx(np.full(36, 50 * unit), rel=1e-4)
    steps = np.hypot(np.diff(points.x), np.diff(points.y))
    assert steps == pytest.approx(np.full(35, 2 * 50 * unit * sin(pi / 36)), rel=1e-3)


def test_lines_and_an_arc_in_any_order_make_one_path(tmp_path) -> None:
    def slot(space) -> None:
        space.add_line((0, 0), (100, 0))
        space.add_line((0, 50), (0, 0))
        space.add_arc((100, 25), 25, -90, 90)
        space.add_line((100, 50), (0, 50))

    points = load_drawing(dxf(slot, tmp_path), 500)
    on_arc = points.x > 0.1001
    radii = np.hypot(points.x[on_arc] - 0.100, points.y[on_arc] - 0.025)
    assert radii == pytest.approx(np.full(radii.size, 0.025), rel=2e-4)
    # Length 100 + 50 + 100 + 25 pi; the shoelace area of the sampled outline is that of box and half disc.
    steps = np.hypot(np.diff(points.x), np.diff(points.y))
    assert float(steps.max()) == pytest.approx((250 + 25 * pi) / 500 * 1e-3, rel=1e-3)
    area = 0.5 * abs(float(np.sum(points.x * np.roll(points.y, -1) - np.roll(points.x, -1) * points.y)))
    assert area == pytest.approx((5000 + pi * 625 / 2) * 1e-6, rel=1e-3)


def test_a_path_in_an_svg_file_has_its_transform_and_its_physical_width(tmp_path) -> None:
    pytest.importorskip("svgpathtools")
    path = tmp_path / "curve.svg"
    path.write_text(
        '<svg xmlns="http://www.w3.org/2000/svg" width="200mm" height="200mm" viewBox="0 0 100 100">'
        '<g transform="translate(10,0)"><path d="M 10 10 h 80 v 40 h -80 z"/></g></svg>'
    )
    points = load_drawing(path, 24)
    assert (points.x[0], points.y[0]) == pytest.approx((0.040, -0.020))
    assert (float(np.ptp(points.x)), float(np.ptp(points.y))) == pytest.approx((0.160, 0.080))
    assert load_drawing(path, 24, 1.0).x[0] == pytest.approx(0.020)
    path.write_text('<svg xmlns="http://www.w3.org/2000/svg"><circle cx="0" cy="0" r="96"/></svg>')
    assert np.hypot(*np.stack((load_drawing(path, 24).x, load_drawing(path, 24).y))).max() == pytest.approx(0.0254)


@pytest.mark.parametrize(
    ("name", "text", "sentence"),
    [
        ("c.svg", "<svg", "not an SVG file"),
        ("c.svg", '<svg xmlns="http://www.w3.org/2000/svg"/>', "holds no paths, expected one closed path"),
        (
            "c.svg",
            '<svg xmlns="http://www.w3.org/2000/svg"><path d="M0 0 L 5 5"/></svg>',
            "holds 1 open path, expected one closed path",
        ),
        ("c.svg", '<!DOCTYPE svg [<!ENTITY a "aa">]><svg/>', "declares entities, which are not taken"),
        ("c.dxf", "  0\nSECTION\nrubbish", "not a DXF file"),
        ("c.dxf", "", "not a DXF file"),
    ],
)
def test_what_is_no_drawing(tmp_path, name: str, text: str, sentence: str) -> None:
    pytest.importorskip("ezdxf")
    pytest.importorskip("svgpathtools")
    (tmp_path / name).write_text(text)
    with pytest.raises(CurveError) as refusal:
        load_drawing(tmp_path / name, 24)
    assert sentence in str(refusal.value)


def test_two_circles_are_one_too_many(tmp_path) -> None:
    def draw(space) -> None:
        space.add_circle((0, 0), 1)
        space.add_circle((5, 0), 1)

    with pytest.raises(CurveError, match="holds 2 closed paths, expected one"):
        load_drawing(dxf(draw, tmp_path), 24)


def test_a_drawing_needs_a_number_of_points_and_a_unit(tmp_path) -> None:
    path = dxf(lambda space: space.add_circle((0, 0), 1), tmp_path)
    with pytest.raises(ParameterError, match="the number of points is 4, but must be 5 to 1000"):
        load_drawing(path, 4)
    with pytest.raises(ParameterError, match=r"the drawing's unit is 0\.0 mm, but must be positive"):
        load_drawing(path, 24, 0.0)


def test_a_library_that_is_not_there_is_named(tmp_path, monkeypatch) -> None:
    path = dxf(lambda space: space.add_circle((0, 0), 1), tmp_path)

    def nothing(name: str):
        raise ImportError(name)

    monkeypatch.setattr("importlib.import_module", nothing)
    with pytest.raises(
        CurveError, match=r"needs ezdxf, which is not installed \(pip install 'drive-gateway\[curves\]'\)"
    ):
        load_drawing(path, 24)


def test_tolerances_of_another_length() -> None:
    x = np.array([0.0, 1.0, 1.0, 0.5, 0.0])
    with pytest.raises(CurveError, match="3 values of tolerance for 5 points"):
        CurvePoints(x, x[::-1] ** 2, tolerances=np.ones(3))
