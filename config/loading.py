"""Reads a configuration file, and says in one sentence what is wrong with it: file, key, value, bound."""

from collections.abc import Hashable
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Final, TypeVar, get_args

import yaml
from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails
from yaml.composer import ComposerError
from yaml.constructor import ConstructorError

from config.schema import GatewayConfig

SHIPPED: Final = Path(__file__).parent
MAX_FILE_BYTES: Final = 1 << 20

ModelT = TypeVar("ModelT", bound=BaseModel)


class ConfigError(Exception):
    """A configuration that cannot be used; ``problems`` has one sentence for each thing that is wrong."""

    def __init__(self, problems: list[str]) -> None:
        super().__init__("\n".join(problems))
        self.problems = problems


class _Loader(yaml.SafeLoader):
    """The safe loader, which also refuses keys given twice and aliases (a way to make a small file huge)."""

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            event = self.peek_event()
            raise ComposerError(None, None, "aliases are not accepted", event.start_mark)
        return super().compose_node(parent, index)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        seen: set[str] = set()
        for key_node, _ in node.value:
            if isinstance(key_node, yaml.ScalarNode):
                if key_node.value in seen:
                    raise ConstructorError(None, None, f"key '{key_node.value}' is given twice", key_node.start_mark)
                seen.add(key_node.value)
        return super().construct_mapping(node, deep)


def find_config(name: str) -> Path:
    """The file ``name``, or the shipped configuration of that name. Raises ConfigError."""
    path = Path(name)
    if path.exists():
        return path
    shipped = SHIPPED / f"{name}.yaml"
    if "/" not in name and shipped.is_file():
        return shipped
    known = ", ".join(sorted(file.stem for file in SHIPPED.glob("*.yaml")))
    raise ConfigError([f"{name}: no such file, nor a shipped configuration (there are: {known})"])


def load_config(name: str) -> GatewayConfig:
    """The configuration in the file ``name``, or the shipped one so called. Raises ConfigError."""
    path = find_config(name)
    return parse_config(read_text(path), path)


def read_text(path: Path) -> str:
    """The text of a file that people write, so of a bounded length. Raises ConfigError."""
    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            raise ConfigError([f"{path}: larger than {MAX_FILE_BYTES} bytes"])
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not UTF-8 text"
        raise ConfigError([f"{path}: cannot be read ({reason})"]) from None


def parse_config(text: str, path: Path) -> GatewayConfig:
    """The configuration that ``text`` says; ``path`` is where it came from. Raises ConfigError."""
    config = parse_model(text, path, GatewayConfig)
    config._path = path
    config._text = text
    return config


def parse_model(text: str, path: Path, model: type[ModelT]) -> ModelT:
    """The ``model`` that the YAML ``text`` says; ``path`` is where it came from. Raises ConfigError."""
    try:
        document = yaml.load(text, Loader=_Loader)  # noqa: S506 -- derived from SafeLoader
    except yaml.MarkedYAMLError as error:
        where = f" in line {error.problem_mark.line + 1}" if error.problem_mark else ""
        raise ConfigError([f"{path}: not valid YAML{where}: {error.problem}"]) from None
    except (yaml.YAMLError, RecursionError) as error:
        raise ConfigError([f"{path}: not valid YAML: {str(error).splitlines()[0]}"]) from None
    if not isinstance(document, dict):
        raise ConfigError([f"{path}: holds no mapping at its top level"])
    try:
        return model.model_validate(document)
    except ValidationError as error:
        raise ConfigError([f"{path}: {sentence(details, model)}" for details in error.errors()]) from None


def sentence(details: ErrorDetails, model: type[BaseModel]) -> str:
    """What is wrong with one key of a ``model``: key, value, bound, and for an unknown key the nearest known one."""
    key = ".".join(str(part) for part in details["loc"])
    value = details["input"]
    kind = details["type"]
    if kind == "extra_forbidden":
        return f"{key}: unknown key{_suggestion(details['loc'], model)}"
    if kind == "missing":
        return f"{key}: required key is missing"
    if kind == "value_error":
        message = str(details.get("ctx", {}).get("error", details["msg"]))
        return f"{key}.{message}" if key else message
    shown = repr(value) if isinstance(value, (str, int, float, bool, type(None), list)) else type(value).__name__
    message = details["msg"].removeprefix("Input ").removeprefix("Value error, ")
    return f"{key}: {shown[:80]} {message}"


def _suggestion(location: tuple[int | str, ...], model: type[BaseModel]) -> str:
    """The known key that is nearest to an unknown one; a unit suffix that differs is pointed out."""
    known = _keys_at(location[:-1], model)
    unknown = str(location[-1])
    same_stem = [key for key in known if key.split("_")[0] == unknown.split("_")[0] and key != unknown]
    close = get_close_matches(unknown, known, n=1, cutoff=0.6) or same_stem[:1]
    return f", did you mean {close[0]}?" if close else ""


def _keys_at(location: tuple[int | str, ...], root: type[BaseModel]) -> list[str]:
    model: type[BaseModel] | None = root
    for part in location:
        if model is None:
            return []
        if isinstance(part, int):  # a place in a list of models
            continue
        field = model.model_fields.get(part)
        if field is None:  # a key of a dictionary of models, such as an axis' name
            continue
        candidates = [field.annotation, *get_args(field.annotation)]
        candidates += [inner for candidate in candidates for inner in get_args(candidate)]
        model = next((c for c in candidates if isinstance(c, type) and issubclass(c, BaseModel)), None)
    return list(model.model_fields) if model else []
