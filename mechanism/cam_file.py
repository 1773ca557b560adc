"""The cam file: one JSON document with a compiled cam, sealed by a SHA-256, so that a damaged or edited one is refused.

The table theta2_deg against theta5_deg is there for people and their scripts; the coefficients, written so that every
float comes back bit by bit, are what is run.
"""

import hashlib
import json
import os
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, NoReturn, cast

import numpy as np

from mechanism.cam import Cam, CompiledCam
from mechanism.cam_profile import CamProfile
from mechanism.errors import CamFileError, MechanismError
from mechanism.five_bar import Closure, FiveBar
from mechanism.spline import DEGREE

FORMAT: Final = "drive-gateway cam"
VERSION: Final = 1
MAXIMUM_FILE_BYTES: Final = 16_000_000
_SEAL: Final = "sha256"
_LENGTH_TOLERANCE_M: Final = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class CamFile:
    """What a cam file says: the cam, and what it was compiled for.

    figures: the compiler's report (`CamReport.figures`), keys with units, read-only.
    """

    source: str
    cam: Cam
    counts_per_revolution: int
    master_speed_rad_per_s: float
    figures: Mapping[str, float]

    def require_for(self, five_bar: FiveBar, counts_per_revolution: int) -> Cam:
        """The cam, if it was made for this linkage and resolution; else raises CamFileError with what differs."""
        if self.counts_per_revolution != counts_per_revolution:
            raise CamFileError(
                self.source,
                f"made for {self.counts_per_revolution} counts a revolution, the machine has {counts_per_revolution}",
            )
        mine, other = self.cam.five_bar.to_array(), five_bar.to_array()
        names = ("p", "q", "r", "s", "cv_pivot x", "cv_pivot y", "servo_pivot x", "servo_pivot y")
        for name, made_for, has in zip(names, mine.tolist(), other.tolist(), strict=True):
            if abs(made_for - has) > _LENGTH_TOLERANCE_M:
                raise CamFileError(
                    self.source, f"made for {name} = {made_for * 1e3:g} mm, the machine has {has * 1e3:g} mm"
                )
        return self.cam


def _seal(document: Mapping[str, object]) -> str:
    payload = {key: value for key, value in document.items() if key != _SEAL}
    canonical = json.dumps(payload, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(canonical.encode()).hexdigest()


def cam_document(compiled: CompiledCam) -> dict[str, object]:
    """The document of a cam as plain JSON values, sealed. Raises the cam's first violation, if it has one."""
    compiled.require()
    profile, five_bar, report = compiled.profile, compiled.five_bar, compiled.report
    theta2_deg, theta5_deg = profile.table_degrees()
    document: dict[str, object] = {
        "format": FORMAT,
        "version": VERSION,
        "five_bar": {
            "p_m": five_bar.p,
            "q_m": five_bar.q,
            "r_m": five_bar.r,
            "s_m": five_bar.s,
            "cv_pivot_m": list(five_bar.cv_pivot),
            "servo_pivot_m": list(five_bar.servo_pivot),
        },
        "closure": int(compiled.closure),
        "counts_per_revolution": report.counts_per_revolution,
        "master_speed_rad_per_s": report.master_speed_rad_per_s,
        "net_turns": profile.net_turns,
        "spline_degree": DEGREE,
        "knots": profile.knots,
        "figures": report.figures(),
        "theta2_deg": theta2_deg,
        "theta5_deg": theta5_deg,
        "coefficients_rad": profile.coefficients.ravel().tolist(),
    }
    document[_SEAL] = _seal(document)
    return document


def write_cam_file(path: Path | str, compiled: CompiledCam) -> None:
    """Write a cam file in one step: readers see the old file or the whole new one.

    Raises the cam's first violation, or CamFileError where the file cannot be written.
    """
    path = Path(path)
    document = cam_document(compiled)
    # One key a line: a person can read it, and a diff shows what changed.
    lines = ",\n".join(f"{json.dumps(key)}: {json.dumps(value, allow_nan=False)}" for key, value in document.items())
    temporary: Path | None = None
    try:
        with tempfile.NamedTemporaryFile(
            "w", encoding="utf-8", dir=path.parent, prefix=f".{path.name}.", suffix=".tmp", delete=False
        ) as file:
            temporary = Path(file.name)
            file.write("{\n" + lines + "\n}\n")
            file.flush()
            os.fsync(file.fileno())
        # A temporary file is its owner's alone; a cam file is as readable as any other file of its owner.
        temporary.chmod(0o644)
        temporary.replace(path)
    except OSError as error:
        if temporary is not None:
            temporary.unlink(missing_ok=True)
        raise CamFileError(str(path), f"cannot be written ({error.strerror or type(error).__name__})") from None


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not a number")


def _parse(text: str, source: str) -> dict[str, Any]:
    try:
        document = json.loads(text, parse_constant=_refuse_constant)
    except (ValueError, RecursionError):
        raise CamFileError(source, "truncated or not a cam file (not a whole JSON document)") from None
    if not isinstance(document, dict) or cast("dict[str, Any]", document).get("format") != FORMAT:
        raise CamFileError(source, f"not a cam file (its format is not '{FORMAT}')")
    return cast("dict[str, Any]", document)


def parse_cam_file(text: str, source: str) -> CamFile:
    """Read the text of a cam file; ``source`` names it in errors. Raises CamFileError."""
    document = _parse(text, source)
    version = document.get("version")
    if version != VERSION:
        raise CamFileError(source, f"version {str(version)[:20]}, only {VERSION} is known")
    try:
        intact = document.get(_SEAL) == _seal(document)
    except (ValueError, RecursionError):
        intact = False
    if not intact:
        raise CamFileError(source, "its checksum is wrong, it was damaged or edited after it was compiled")
    try:
        lengths = document["five_bar"]
        five_bar = FiveBar(
            float(lengths["p_m"]),
            float(lengths["q_m"]),
            float(lengths["r_m"]),
            float(lengths["s_m"]),
            (float(lengths["cv_pivot_m"][0]), float(lengths["cv_pivot_m"][1])),
            (float(lengths["servo_pivot_m"][0]), float(lengths["servo_pivot_m"][1])),
        )
        knots = int(document["knots"])
        if int(document["spline_degree"]) != DEGREE:
            raise CamFileError(source, f"a spline of degree {document['spline_degree']}, only {DEGREE} is known")
        coefficients = np.array(document["coefficients_rad"], dtype=np.float64).reshape(knots, DEGREE + 1)
        return CamFile(
            source=source,
            cam=Cam(CamProfile(coefficients, int(document["net_turns"])), five_bar, Closure(int(document["closure"]))),
            counts_per_revolution=int(document["counts_per_revolution"]),
            master_speed_rad_per_s=float(document["master_speed_rad_per_s"]),
            figures=MappingProxyType({str(key): float(value) for key, value in document["figures"].items()}),
        )
    except CamFileError:
        raise
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError) as error:
        raise CamFileError(source, f"malformed ({type(error).__name__}: {str(error)[:80]})") from None
    except MechanismError as error:
        raise CamFileError(source, f"malformed ({error})") from None


def read_cam_file(path: Path | str) -> CamFile:
    """Read a cam file, at most 16 MB; its profile evaluates bit by bit as the one written. Raises CamFileError."""
    path = Path(path)
    try:
        with path.open("rb") as file:
            data = file.read(MAXIMUM_FILE_BYTES + 1)
    except OSError as error:
        raise CamFileError(str(path), f"cannot be read ({error.strerror or type(error).__name__})") from None
    if len(data) > MAXIMUM_FILE_BYTES:
        raise CamFileError(str(path), f"larger than {MAXIMUM_FILE_BYTES} bytes")
    try:
        text = data.decode("utf-8")
    except UnicodeDecodeError:
        raise CamFileError(str(path), "not a text file (UTF-8)") from None
    return parse_cam_file(text, str(path))
