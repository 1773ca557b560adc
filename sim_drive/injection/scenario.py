"""Scenarios: which faults the emulated machine makes, and when, from a YAML file or words of a command line."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final

import yaml
from pydantic import Field, ValidationError

from config.loading import ConfigError, parse_model, read_text, sentence
from config.schema import Model
from sim_drive.injection.faults import FAULTS, PARAMETERS, Direction, Fault, FaultKind

MAX_FAULTS: Final = 10_000
ALL_NODES: Final = "all"
"""In place of a node: every drive of the machine."""

_Whole = Annotated[int, Field()]
_Number = Annotated[float, Field()]


@dataclass(frozen=True, slots=True)
class Scenario:
    """What is to go wrong in a run."""

    faults: tuple[Fault, ...] = ()
    seed: int = 0
    """Of all chance in the faults."""
    name: str = ""


class FaultSection(Model):
    """One fault as people write it; `sim_drive.injection.faults.Fault` has the bounds and what each kind takes."""

    kind: FaultKind
    node: _Whole | str
    """Node id, the name of an axis of the configuration, or all."""
    at_s: _Number = 0.0
    for_s: _Number | None = None
    error_code: _Whole | None = None
    axis: _Whole | None = None
    counts: _Whole | None = None
    delay_s: _Number | None = None
    index: _Whole | None = None
    subindex: _Whole | None = None
    abort_code: _Whole | None = None
    cob_id: _Whole | None = None
    cob_id_mask: _Whole | None = None
    direction: Direction | None = None
    probability: _Number | None = None
    count: _Whole | None = None
    vendor_id: _Whole | None = None
    product_code: _Whole | None = None
    revision_number: _Whole | None = None
    serial_number: _Whole | None = None

    def resolve(
        self, nodes: Mapping[str, int], node_ids: Sequence[int], axes: Mapping[str, int] | None = None
    ) -> list[Fault]:
        """The faults that this says, one a node; raises ValueError with a sentence."""
        parameters: dict[str, Any] = {key: getattr(self, key) for key in PARAMETERS}
        if axes and isinstance(self.node, str) and "axis" in FAULTS[self.kind].optional and self.axis is None:
            parameters["axis"] = axes.get(self.node)
        return [
            Fault(self.kind, node_id, self.at_s, self.for_s, **parameters)
            for node_id in self._node_ids(nodes, node_ids)
        ]

    def _node_ids(self, nodes: Mapping[str, int], node_ids: Sequence[int]) -> Sequence[int]:
        if self.node == ALL_NODES:
            return node_ids
        node_id = nodes.get(self.node) if isinstance(self.node, str) else self.node
        if node_id is None or node_id not in node_ids:
            known = ", ".join([*nodes, *map(str, sorted(node_ids)), ALL_NODES])
            raise ValueError(f"node: there is no {self.node} (there are: {known})")
        return [node_id]


class ScenarioSection(Model):
    """A whole scenario file."""

    name: Annotated[str, Field(max_length=64)] = ""
    description: Annotated[str, Field(max_length=2000)] = ""
    seed: Annotated[int, Field(ge=0)] = 0
    faults: Annotated[list[FaultSection], Field(max_length=MAX_FAULTS)]


def load_scenario(
    path: Path, nodes: Mapping[str, int], node_ids: Sequence[int], axes: Mapping[str, int] | None = None
) -> Scenario:
    """The scenario in a file; ``nodes`` are the axes' names with their node ids. Raises config.loading.ConfigError.

    ``axes``: where axes share a node, their names with their numbers in it.
    """
    return parse_scenario(read_text(path), path, nodes, node_ids, axes)


def parse_scenario(
    text: str,
    path: Path,
    nodes: Mapping[str, int],
    node_ids: Sequence[int],
    axes: Mapping[str, int] | None = None,
) -> Scenario:
    """The scenario that ``text`` says; ``path`` is where it came from. Raises config.loading.ConfigError."""
    section = parse_model(text, path, ScenarioSection)
    faults: list[Fault] = []
    problems: list[str] = []
    for place, fault in enumerate(section.faults):
        try:
            faults += fault.resolve(nodes, node_ids, axes)
        except ValueError as error:
            problems.append(f"{path}: faults.{place}.{error}")
    if problems:
        raise ConfigError(problems)
    return Scenario(tuple(faults), section.seed, section.name)


def parse_fault(
    text: str, nodes: Mapping[str, int], node_ids: Sequence[int], axes: Mapping[str, int] | None = None
) -> list[Fault]:
    """The faults that one line says: ``NODE KIND [KEY=VALUE]...``, with the keys of a scenario file.

    For example ``servo over_current at_s=3 for_s=1``. Raises config.loading.ConfigError.
    """
    words = text.split()
    if len(words) < 2:
        raise ConfigError([f"fault '{text}': is not NODE KIND [KEY=VALUE]..."])
    document: dict[str, object] = {"node": _value(words[0]), "kind": words[1]}
    for word in words[2:]:
        key, equals, value = word.partition("=")
        if not equals or not value:
            raise ConfigError([f"fault '{text}': {word} is not KEY=VALUE"])
        if key in document:
            raise ConfigError([f"fault '{text}': {key} is given twice"])
        document[key] = _value(value)
    try:
        return FaultSection.model_validate(document).resolve(nodes, node_ids, axes)
    except ValidationError as error:
        raise ConfigError(
            [f"fault '{text}': {sentence(details, FaultSection)}" for details in error.errors()]
        ) from None
    except ValueError as error:
        raise ConfigError([f"fault '{text}': {error}"]) from None


def _value(text: str) -> object:
    """A word as YAML has it: 0x10 and 3.5 are numbers."""
    try:
        value: object = yaml.safe_load(text)
    except yaml.YAMLError:
        return text
    return value if isinstance(value, (str, int, float)) else text
