"""The memory of learning between runs: one JSON file for each cam, in it what was learned at each speed of the master.

The file is bound to its cam by a CRC-32: what was learned on one profile is wrong on every other.
"""

import json
import os
import tempfile
from dataclasses import dataclass, replace
from math import isfinite, log
from pathlib import Path
from typing import Any, Final, NoReturn, cast
from zlib import crc32

import numpy as np

from gateway.errors import UsageError
from gateway.learning.kernels import SPEED_TOLERANCE
from gateway.learning.law import LearnedTorque
from mechanism.cam_profile import CamProfile

FORMAT: Final = "drive-gateway learning"
VERSION: Final = 1
SUFFIX: Final = ".learning.json"
MAXIMUM_FILE_BYTES: Final = 16_000_000
MAXIMUM_BINS: Final = 4096
MAXIMUM_TORQUE_NM: Final = 1e6


def cam_crc32(profile: CamProfile) -> int:
    """CRC-32 of a cam's coefficients (little-endian float64) and net turns."""
    return crc32(profile.coefficients.astype("<f8").tobytes() + profile.net_turns.to_bytes(8, "little", signed=True))


@dataclass(frozen=True, slots=True)
class LearningMemory:
    """What has been learned of one cam. ``learned``: one for each speed, slowest first."""

    cam_crc32: int
    axis_names: tuple[str, ...]
    learned: tuple[LearnedTorque, ...] = ()

    def nearest(self, speed: float) -> LearnedTorque | None:
        """What was learned at the speed (rad/s) whose ratio to this one is nearest to 1; None if nothing was."""
        return min(self.learned, key=lambda known: abs(log(known.speed / speed)), default=None)

    def with_learned(self, learned: LearnedTorque) -> "LearningMemory":
        """The memory with this in place of what it had for the same speed."""
        others = [known for known in self.learned if abs(known.speed - learned.speed) > SPEED_TOLERANCE * learned.speed]
        return replace(self, learned=tuple(sorted([*others, learned], key=lambda known: known.speed)))


def memory_file(path: Path, name: str, crc: int) -> Path:
    """The file itself, or in a folder the one for the cam with this CRC of the configuration ``name``."""
    return path / f"{name}-{crc:08X}{SUFFIX}" if path.is_dir() else path


def read_memory(path: Path, crc: int, axis_names: tuple[str, ...]) -> LearningMemory:
    """The memory in a file for this cam and these axes; an empty one if there is no such file.

    Raises UsageError for a file that cannot be read, is damaged, or belongs to another profile or machine.
    """
    if not path.exists():
        return LearningMemory(crc, axis_names)
    try:
        data = path.read_bytes() if path.stat().st_size <= MAXIMUM_FILE_BYTES else None
    except OSError as error:
        raise UsageError(f"{path}: cannot be read ({error.strerror or type(error).__name__})") from None
    if data is None:
        raise UsageError(f"{path}: larger than {MAXIMUM_FILE_BYTES} bytes")
    document = _parse(data, path)
    try:
        made_for = int(document["cam_crc32"], 16)
        axes = tuple(str(name) for name in document["axes"])
        learned = tuple(_entry(entry, axes) for entry in document["learned"])
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise UsageError(f"{path}: a damaged learning memory ({type(error).__name__}: {str(error)[:80]})") from None
    if made_for != crc:
        raise UsageError(
            f"{path}: the learning memory of another profile (its cam has CRC-32 {made_for:08X}h, this one {crc:08X}h)"
        )
    if axes != axis_names:
        raise UsageError(f"{path}: the learning memory of axes {', '.join(axes)}, not {', '.join(axis_names)}")
    return LearningMemory(crc, axis_names, learned)


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not a number")


def _parse(data: bytes, path: Path) -> dict[str, Any]:
    try:
        document = json.loads(data.decode("utf-8"), parse_constant=_refuse_constant)
    except (ValueError, RecursionError):
        raise UsageError(f"{path}: not a learning memory (not a whole JSON document)") from None
    if not isinstance(document, dict) or cast("dict[str, Any]", document).get("format") != FORMAT:
        raise UsageError(f"{path}: not a learning memory (its format is not '{FORMAT}')")
    known = cast("dict[str, Any]", document)
    if known.get("version") != VERSION:
        raise UsageError(f"{path}: version {str(known.get('version'))[:20]}, only {VERSION} is known")
    return known


def _entry(entry: dict[str, Any], axes: tuple[str, ...]) -> LearnedTorque:
    speed = float(entry["speed_rad_per_s"])
    torque = np.array([entry["torque_Nm"][name] for name in axes], dtype=np.float64)
    if not (isfinite(speed) and speed > 0.0):
        raise ValueError(f"speed_rad_per_s is {speed:g}")
    if torque.ndim != 2 or not 1 <= torque.shape[1] <= MAXIMUM_BINS:
        raise ValueError(f"torques of shape {torque.shape}")
    if not bool(np.all(np.abs(torque) <= MAXIMUM_TORQUE_NM)):
        raise ValueError("a torque is out of bounds")
    torque.flags.writeable = False
    return LearnedTorque(speed, torque)


def write_memory(path: Path, memory: LearningMemory) -> None:
    """Write the file in one step: readers see the old one or the whole new one. Raises UsageError."""
    document = {
        "format": FORMAT,
        "version": VERSION,
        "cam_crc32": f"{memory.cam_crc32:08X}",
        "axes": list(memory.axis_names),
        "learned": [
            {
                "speed_rad_per_s": known.speed,
                "torque_Nm": dict(zip(memory.axis_names, known.torque.tolist(), strict=True)),
            }
            for known in memory.learned
        ],
    }
    temporary: Path | None = None
    try:
        with tempfile.NamedTemporaryFile(
            "w", encoding="utf-8", dir=path.parent, prefix=f".{path.name}.", suffix=".tmp", delete=False
        ) as file:
            temporary = Path(file.name)
            file.write(json.dumps(document, allow_nan=False) + "\n")
            file.flush()
            os.fsync(file.fileno())
        temporary.chmod(0o644)
        temporary.replace(path)
    except OSError as error:
        if temporary is not None:
            temporary.unlink(missing_ok=True)
        raise UsageError(f"{path}: cannot be written ({error.strerror or type(error).__name__})") from None
