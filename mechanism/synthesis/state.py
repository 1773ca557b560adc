"""What a search needs to go on where it stood, as bytes: a line of JSON, then plain arrays; nothing in it is run."""

import hashlib
import json
from typing import Any, Final, cast

import numpy as np
from numpy.typing import NDArray

from mechanism.errors import SynthesisError
from mechanism.synthesis.task import SynthesisTask

Float = NDArray[np.float64]

_MAGIC: Final = b"drive-gateway synthesis 1\n"
MAXIMUM_BYTES: Final = 1_000_000_000


def fingerprint(task: SynthesisTask, *settings: object) -> str:
    """A digest of everything that decides how a search goes."""
    digest = hashlib.sha256()
    for array in (task.theta2, task.x, task.y, task.tolerances, task.bounds.lower, task.bounds.upper):
        digest.update(b"-" if array is None else array.tobytes())
        digest.update(b";")
    others = (
        task.terms,
        task.timing,
        task.keep_out,
        task.machine,
        task.speed_rad_per_s,
        task.harmonics,
        task.minimum_sine,
        *settings,
    )
    digest.update(repr(others).encode())
    return digest.hexdigest()


def pack(header: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> bytes:
    """Header (what JSON can hold) and arrays (float64 or int64) as bytes."""
    table = [[name, array.dtype.str, list(array.shape)] for name, array in arrays.items()]
    line = json.dumps({"header": header, "arrays": table}, sort_keys=True)
    return b"".join((_MAGIC, line.encode(), b"\n", *(np.ascontiguousarray(a).tobytes() for a in arrays.values())))


def unpack(state: bytes) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """What `pack` was given. Raises SynthesisError for anything else."""
    if not state.startswith(_MAGIC) or len(state) > MAXIMUM_BYTES:
        raise SynthesisError("the saved state is none of this program's synthesis")
    line, _, data = state[len(_MAGIC) :].partition(b"\n")
    arrays: dict[str, NDArray[Any]] = {}
    position = 0
    try:
        described = cast("dict[str, Any]", json.loads(line))
        for name, kind, shape in described["arrays"]:
            if kind not in ("<f8", "<i8"):
                raise ValueError(kind)
            count = 1
            for extent in shape:
                count *= int(extent)
            part = data[position : position + 8 * count]
            arrays[name] = np.frombuffer(part, dtype=kind).reshape(shape).copy()
            position += 8 * count
        if position != len(data):
            raise ValueError(position)
        return cast("dict[str, Any]", described["header"]), arrays
    except (ValueError, KeyError, TypeError, AttributeError):
        raise SynthesisError("the saved state is damaged") from None
