"""Gains back into a configuration's text, where only the numbers change: comments, order and layout stay."""

from pathlib import Path
from typing import Final

import yaml

from config.loading import parse_config
from gateway.errors import UsageError
from gateway.tuning.controller import GainPair, Gains

_Edit = tuple[int, int, str]
"""First character, character after the last one, and what comes in their place."""

_WHERE: Final = ("emulation", "gains")


def with_gains(text: str, path: Path, axis_names: tuple[str, ...], gains: GainPair) -> str:
    """The configuration ``text`` with these gains of its axes (master, slave); ``path`` is where it came from.

    Raises config.loading.ConfigError for a text that is no configuration, UsageError if it cannot be changed so.
    """
    parse_config(text, path)
    root = yaml.compose(text, Loader=yaml.SafeLoader)
    edits: list[_Edit] = []
    for name, wanted in zip(axis_names, gains, strict=True):
        edits += _edits(text, _mapping(root, ("axes", name, *_WHERE), path), wanted)
    for first, last, replacement in sorted(edits, reverse=True):
        text = text[:first] + replacement + text[last:]
    changed = parse_config(text, path)
    found = tuple(Gains.from_section(axis.emulation.gains) for axis in changed.ordered_axes)
    if found != gains:
        raise UsageError(f"{path}: its gains cannot be replaced in place, write them by hand: {gains[0]}; {gains[1]}")
    return text


def _mapping(node: yaml.Node | None, keys: tuple[str, ...], path: Path) -> yaml.MappingNode:
    for key in keys:
        node = _value(node, key)
    if not isinstance(node, yaml.MappingNode):
        raise UsageError(f"{path}: {'.'.join(keys)} is no mapping")
    return node


def _value(node: yaml.Node | None, key: str) -> yaml.Node | None:
    if not isinstance(node, yaml.MappingNode):
        return None
    return next((value for name, value in node.value if name.value == key), None)


def _edits(text: str, mapping: yaml.MappingNode, gains: Gains) -> list[_Edit]:
    edits: list[_Edit] = []
    missing: list[str] = []
    for name, number in gains.to_json().items():
        value = _value(mapping, name)
        if value is not None:
            edits.append((value.start_mark.index, value.end_mark.index, str(number)))
        elif number:
            missing.append(f"{name}: {number}")
    if missing:
        edits.append(_insertion(text, mapping, missing))
    return edits


def _insertion(text: str, mapping: yaml.MappingNode, entries: list[str]) -> _Edit:
    """The entries after the last one that is there, in the mapping's own style."""
    name, last = mapping.value[-1]
    at = last.end_mark.index
    if mapping.flow_style:
        return at, at, "".join(f", {entry}" for entry in entries)
    end = text.find("\n", at)
    end = len(text) if end < 0 else end
    indent = " " * name.start_mark.column
    return end, end, "".join(f"\n{indent}{entry}" for entry in entries)
