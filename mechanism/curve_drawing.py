"""A wanted curve from a drawing: the one closed path of a DXF or SVG file, sampled at equal steps of its length.

ezdxf and svgpathtools do the reading; they are optional (``pip install 'drive-gateway[curves]'``).
"""

import importlib
import io
import re
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mechanism.curve import MINIMUM_POINTS
from mechanism.curve_csv import read_text
from mechanism.curve_points import MAXIMUM_POINTS, CurvePoints
from mechanism.errors import CurveError, ParameterError, finite

Float = NDArray[np.float64]

DRAWING_SUFFIXES: Final = frozenset({".dxf", ".svg"})
MAXIMUM_ENTITIES: Final = 10_000
_FLATNESS: Final = 1e-5
"""How far the polyline that is measured may be from the path, in parts of its size."""
_ARC_SEGMENTS: Final = 8
"""Bezier pieces of a quarter circle: one alone is off by 3e-4 of the radius."""
_SEGMENT_SAMPLES: Final = 200
_CSS_MM: Final = {"mm": 1.0, "cm": 10.0, "in": 25.4, "pt": 25.4 / 72.0, "pc": 25.4 / 6.0, "px": 25.4 / 96.0}
_NOT_DRAWN: Final = frozenset({"TEXT", "MTEXT", "DIMENSION", "POINT", "HATCH", "VIEWPORT", "INSERT", "LEADER"})


def load_drawing(path: Path | str, count: int, mm_per_unit: float | None = None) -> CurvePoints:
    """The closed path in a DXF or SVG file (at most 4 MB) as ``count`` points, from its start, without crank angles.

    ``mm_per_unit``: length of the drawing's unit; None: as the file says (DXF without units: mm; SVG without a physical
    width: 1/96 inch). SVG's y axis is turned to point up. Raises CurveError, ParameterError.
    """
    path = Path(path)
    if not MINIMUM_POINTS <= count <= MAXIMUM_POINTS:
        raise ParameterError("the number of points", count, f"{MINIMUM_POINTS} to {MAXIMUM_POINTS}")
    if mm_per_unit is not None and not (finite(mm_per_unit) and mm_per_unit > 0.0):
        raise ParameterError("the drawing's unit", f"{mm_per_unit} mm", "positive and finite")
    read = _read_svg if path.suffix.lower() == ".svg" else _read_dxf
    line, unit_mm = read(read_text(path), str(path))
    points = sample_closed(line, count) * (unit_mm if mm_per_unit is None else mm_per_unit) * 1e-3
    return CurvePoints(points[:, 0], points[:, 1], source=str(path))


def sample_closed(line: Float, count: int) -> Float:
    """``count`` points at equal steps along the closed polyline ``line`` (n, 2), the first at its start."""
    closed = np.concatenate((line, line[:1]))
    along = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(closed, axis=0).T))))
    at = np.arange(count) * (along[-1] / count)
    points = np.empty((count, 2), dtype=np.float64)
    for column in range(2):
        points[:, column] = np.interp(at, along, closed[:, column])
    return points


def _library(name: str, source: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError:
        package = name.partition(".")[0]
        raise CurveError(
            f"reading drawings needs {package}, which is not installed (pip install 'drive-gateway[curves]')", source
        ) from None


def _read_dxf(text: str, source: str) -> tuple[Float, float]:
    ezdxf = _library("ezdxf", source)
    paths, units = _library("ezdxf.path", source), _library("ezdxf.units", source)
    miner, smith = _library("ezdxf.edgeminer", source), _library("ezdxf.edgesmith", source)
    try:
        document = ezdxf.read(io.StringIO(text))
    except (ezdxf.DXFError, OSError, ValueError, KeyError, IndexError) as error:
        raise CurveError(f"not a DXF file ({str(error)[:80] or type(error).__name__})", source) from None
    entities = [entity for entity in document.modelspace() if entity.dxftype() not in _NOT_DRAWN]
    if len(entities) > MAXIMUM_ENTITIES:
        raise CurveError(f"holds {len(entities)} entities, bound {MAXIMUM_ENTITIES}", source)
    found: list[Any] = []
    others: list[Any] = []
    for entity in entities:
        try:
            path = paths.make_path(entity, segments=_ARC_SEGMENTS)
        except (TypeError, ValueError):
            continue
        (found if path.is_closed else others).append(path if path.is_closed else entity)
    if others:
        edges = list(smith.edges_from_entities_2d(others))
        loop = _loop_of(miner, edges)
        if loop:
            found.append(_joined(paths, loop))
    path = _the_one(found, len(others), source)
    box = paths.bbox([path])
    size = max(float(box.size.x), float(box.size.y))
    if not (finite(size) and size > 0.0):
        raise CurveError("the path has no size", source)
    line = np.array([(vertex.x, vertex.y) for vertex in path.flattening(_FLATNESS * size)], dtype=np.float64)
    factor = 1.0 if document.units == 0 else float(units.conversion_factor(document.units, units.MM))
    return line[:-1], factor


def _loop_of(miner: Any, edges: list[Any]) -> Any:
    try:
        return miner.find_loop_by_edge(miner.Deposit(edges), edges[0]) if edges else ()
    except miner.TimeoutError:
        return ()


def _joined(paths: Any, loop: Any) -> Any:
    whole = paths.Path()
    for edge in loop:
        piece = paths.make_path(edge.payload, segments=_ARC_SEGMENTS)
        whole.append_path(piece.reversed() if edge.is_reverse else piece)
    return whole


def _the_one(found: list[Any], open_ones: int, source: str) -> Any:
    if not found:
        what = f"{open_ones} open" if open_ones else "no"
        raise CurveError(f"holds {what} path{'' if open_ones == 1 else 's'}, expected one closed path", source)
    if len(found) > 1:
        raise CurveError(f"holds {len(found)} closed paths, expected one", source)
    return found[0]


def _read_svg(text: str, source: str) -> tuple[Float, float]:
    if "<!ENTITY" in text.upper():
        raise CurveError("declares entities, which are not taken", source)
    library = _library("svgpathtools", source)
    try:
        paths: list[Any] = [path for path in library.Document.from_svg_string(text).paths() if len(path)]
    except Exception as error:  # the library lets errors of its XML and path parsers through as they come
        raise CurveError(f"not an SVG file ({str(error)[:80] or type(error).__name__})", source) from None
    if sum(len(path) for path in paths) > MAXIMUM_ENTITIES:
        raise CurveError(f"holds more than {MAXIMUM_ENTITIES} path segments", source)
    path = _the_one([path for path in paths if path.isclosed()], len(paths), source)
    points: list[complex] = []
    for segment in path:
        steps = 1 if type(segment).__name__ == "Line" else _SEGMENT_SAMPLES
        points.extend(complex(segment.point(step / steps)) for step in range(steps))
    line = np.array([(point.real, -point.imag) for point in points], dtype=np.float64)
    if not bool(np.all(np.isfinite(line))):
        raise CurveError("the path is not finite", source)
    return line, _svg_unit_mm(text)


def _svg_unit_mm(text: str) -> float:
    """Millimetres of a user unit: the width over the view box's, if the file gives both, else a CSS pixel."""
    head = re.search(r"<svg\b[^>]*>", text)
    if head is None:
        return _CSS_MM["px"]
    width = re.search(r"\bwidth\s*=\s*[\"']\s*([0-9.eE+]+)\s*(mm|cm|in|pt|pc|px)?\s*[\"']", head[0])
    box = re.search(r"\bviewBox\s*=\s*[\"']\s*([-0-9.eE+]+[\s,]+){2}([0-9.eE+]+)", head[0])
    if width is None or box is None:
        return _CSS_MM["px"]
    try:
        units, millimetres = float(box[2]), float(width[1]) * _CSS_MM[width[2] or "px"]
    except ValueError:
        return _CSS_MM["px"]
    return millimetres / units if units > 0.0 and millimetres > 0.0 else _CSS_MM["px"]
