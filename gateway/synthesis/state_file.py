"""An interrupted search as a file: one JSON document with the whole task and the state of every start, sealed.

Nothing in it is executed when it is read: numbers, names, and the states that `mechanism.synthesis` parses itself.
"""

import base64
import binascii
import hashlib
import json
import os
import tempfile
from dataclasses import asdict, dataclass
from math import isfinite
from pathlib import Path
from typing import Any, Final, NoReturn, cast

import numpy as np

from gateway.errors import UsageError
from gateway.synthesis.run_search import SearchSettings, SearchStatus, StartState
from gateway.synthesis.search_slice import Found
from mechanism.errors import MechanismError
from mechanism.synthesis.machine_model import MachineModel
from mechanism.synthesis.search import Method, Phase
from mechanism.synthesis.task import (
    Bounds,
    Box,
    Circle,
    KeepOutZone,
    SynthesisTask,
    Term,
    Timing,
    WeightedTerm,
)

FORMAT: Final = "drive-gateway synthesis"
VERSION: Final = 1
MAXIMUM_FILE_BYTES: Final = 64_000_000
_SEAL: Final = "sha256"

Document = dict[str, Any]


@dataclass(frozen=True, slots=True, eq=False)
class SavedSearch:
    """A search as it stood. ``template``: the text of the configuration that its machine is made from."""

    status: SearchStatus
    template: str
    is_speed_fixed: bool = False


def write_state_file(path: Path, saved: SavedSearch) -> None:
    """Write where a search stands, in one step. Raises OSError."""
    document = saved_document(saved)
    temporary: Path | None = None
    try:
        with tempfile.NamedTemporaryFile(
            "w", encoding="utf-8", dir=path.parent, prefix=f".{path.name}.", suffix=".tmp", delete=False
        ) as file:
            temporary = Path(file.name)
            json.dump(document, file, allow_nan=False)
            file.flush()
            os.fsync(file.fileno())
        temporary.chmod(0o644)
        temporary.replace(path)
    except OSError:
        if temporary is not None:
            temporary.unlink(missing_ok=True)
        raise


def read_state_file(path: Path) -> SavedSearch:
    """Where a search stood. Raises UsageError for a file that is not whole."""
    try:
        with path.open("rb") as file:
            data = file.read(MAXIMUM_FILE_BYTES + 1)
    except OSError as error:
        raise UsageError(f"{path}: cannot be read ({error.strerror or type(error).__name__})") from None
    if len(data) > MAXIMUM_FILE_BYTES:
        raise UsageError(f"{path}: larger than {MAXIMUM_FILE_BYTES} bytes")
    try:
        document = json.loads(data.decode("utf-8"), parse_constant=_refuse_constant)
    except (ValueError, RecursionError):
        raise UsageError(f"{path}: truncated or no file of an interrupted search") from None
    if not isinstance(document, dict) or cast("Document", document).get("format") != FORMAT:
        raise UsageError(f"{path}: no file of an interrupted search (its format is not '{FORMAT}')")
    return parse_saved(cast("Document", document), str(path))


def saved_document(saved: SavedSearch) -> Document:
    """Where a search stands as plain JSON values, sealed."""
    settings = saved.status.settings
    document: Document = {
        "format": FORMAT,
        "version": VERSION,
        "method": settings.method.value,
        "seed": settings.seed,
        "budget": settings.budget,
        "population": settings.population,
        "task": task_document(settings.task),
        "template": saved.template,
        "is_speed_fixed": saved.is_speed_fixed,
        "starts": [_start_document(start) for start in saved.status.starts],
    }
    document[_SEAL] = _seal(document)
    return document


def parse_saved(document: Document, source: str) -> SavedSearch:
    """The inverse of `saved_document`. Raises UsageError."""
    if document.get("version") != VERSION:
        raise UsageError(f"{source}: version {str(document.get('version'))[:20]}, only {VERSION} is known")
    try:
        if document.get(_SEAL) != _seal(document):
            raise UsageError(f"{source}: its checksum is wrong, it was damaged or edited")
        starts = tuple(_parse_start(entry) for entry in document["starts"])
        settings = SearchSettings(
            task=parse_task(document["task"]),
            method=Method(document["method"]),
            seed=int(document["seed"]),
            budget=int(document["budget"]),
            starts=len(starts),
            population=None if document["population"] is None else int(document["population"]),
        )
        return SavedSearch(SearchStatus(settings, starts), str(document["template"]), bool(document["is_speed_fixed"]))
    except UsageError:
        raise
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, RecursionError, binascii.Error) as error:
        raise UsageError(f"{source}: malformed ({type(error).__name__}: {str(error)[:80]})") from None
    except MechanismError as error:
        raise UsageError(f"{source}: malformed ({error})") from None


def task_document(task: SynthesisTask) -> Document:
    """A task as plain JSON values, metres and radians."""
    return {
        "theta2": None if task.theta2 is None else task.theta2.tolist(),
        "x": task.x.tolist(),
        "y": task.y.tolist(),
        "tolerances": None if task.tolerances is None else task.tolerances.tolist(),
        "lower": task.bounds.lower.tolist(),
        "upper": task.bounds.upper.tolist(),
        "terms": [[entry.term.name, entry.weight] for entry in task.terms],
        "timing": task.timing.value,
        "keep_out": [{type(zone).__name__: asdict(zone)} for zone in task.keep_out],
        "machine": asdict(task.machine),
        "speed_rad_per_s": task.speed_rad_per_s,
        "harmonics": task.harmonics,
        "minimum_sine": task.minimum_sine,
        "source": task.source,
    }


def parse_task(document: Document) -> SynthesisTask:
    """The inverse of `task_document`. Raises KeyError, TypeError, ValueError, MechanismError."""
    zones: dict[str, type[KeepOutZone]] = {"Circle": Circle, "Box": Box}
    machine: Document = {
        name: tuple(cast("list[float]", value)) if isinstance(value, list) else value
        for name, value in cast("Document", document["machine"]).items()
    }
    return SynthesisTask(
        theta2=None if document["theta2"] is None else np.array(document["theta2"], dtype=np.float64),
        x=np.array(document["x"], dtype=np.float64),
        y=np.array(document["y"], dtype=np.float64),
        tolerances=None if document["tolerances"] is None else np.array(document["tolerances"], dtype=np.float64),
        bounds=Bounds(np.array(document["lower"], dtype=np.float64), np.array(document["upper"], dtype=np.float64)),
        terms=tuple(WeightedTerm(Term[name], float(weight)) for name, weight in document["terms"]),
        timing=Timing(document["timing"]),
        keep_out=tuple(zones[kind](**values) for zone in document["keep_out"] for kind, values in zone.items()),
        machine=MachineModel(**machine),
        speed_rad_per_s=float(document["speed_rad_per_s"]),
        harmonics=int(document["harmonics"]),
        minimum_sine=float(document["minimum_sine"]),
        source=None if document["source"] is None else str(document["source"]),
    )


def _start_document(start: StartState) -> Document:
    return {
        "seed": start.seed,
        "evaluations": start.evaluations,
        "generation": start.generation,
        "phase": start.phase.value,
        "state": None if start.state is None else base64.b64encode(start.state).decode(),
        "best": None if start.best is None else _found_document(start.best),
        "front": [_found_document(found) for found in start.front],
        "is_finished": start.is_finished,
        "improvements": [[evaluations, _plain(value)] for evaluations, value in start.improvements],
    }


def _found_document(found: Found) -> list[Any]:
    return [list(found.variables), [_plain(value) for value in found.terms], _plain(found.objective)]


def _plain(value: float) -> float | str:
    """JSON knows no infinity; ``float`` reads it back from its name."""
    return value if isfinite(value) else str(value)


def _parse_start(document: Document) -> StartState:
    state = document["state"]
    best = document["best"]
    return StartState(
        seed=int(document["seed"]),
        evaluations=int(document["evaluations"]),
        generation=int(document["generation"]),
        phase=Phase(document["phase"]),
        state=None if state is None else base64.b64decode(state, validate=True),
        best=None if best is None else _parse_found(best),
        front=tuple(_parse_found(found) for found in document["front"]),
        is_finished=bool(document["is_finished"]),
        improvements=tuple((int(evaluations), float(value)) for evaluations, value in document["improvements"]),
    )


def _parse_found(entry: list[Any]) -> Found:
    variables, terms, objective = entry
    return Found(tuple(float(v) for v in variables), tuple(float(v) for v in terms), float(objective))


def _seal(document: Document) -> str:
    payload = {key: value for key, value in document.items() if key != _SEAL}
    canonical = json.dumps(payload, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(canonical.encode()).hexdigest()


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not a number")
