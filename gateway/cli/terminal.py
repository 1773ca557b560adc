"""What the commands share: consoles, the answer to an error, options that several commands take."""

import json
import sys
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Final, NoReturn

import typer
from rich.console import Console

EXIT_NO: Final = 1
EXIT_USE: Final = 2
WIDTH_WITHOUT_TERMINAL: Final = 110
"""Columns of a table that is written to a file or a pipe."""

ConfigArgument = Annotated[
    str, typer.Argument(metavar="CONFIG", help="Configuration file, or the name of a shipped one: paper.")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print the result as JSON on standard output.")]
InterfaceOption = Annotated[
    str | None,
    typer.Option("--interface", "-i", help="socketcan, socketcand or any python-can interface  [default: from CONFIG]"),
]
ChannelOption = Annotated[
    str | None, typer.Option("--channel", "-c", help="Channel of the interface, e.g. can0  [default: from CONFIG]")
]
PortOption = Annotated[
    int | None,
    typer.Option("--port", min=1, max=65535, help="TCP port of the socketcand server  [default: from CONFIG]"),
]
OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="Replace a file that exists.")]


def results() -> Console:
    """Console of standard output."""
    return _console(stderr=False)


def messages() -> Console:
    """Console of standard error."""
    return _console(stderr=True)


def _console(*, stderr: bool) -> Console:
    stream = sys.stderr if stderr else sys.stdout
    width = None if stream.isatty() else WIDTH_WITHOUT_TERMINAL
    return Console(stderr=stderr, width=width, highlight=False)


def print_json(document: dict[str, Any]) -> None:
    """One JSON document on standard output."""
    print(json.dumps(document, indent=2, allow_nan=False))


def complain(sentences: list[str], status: int) -> NoReturn:
    """Say what is wrong, a line each, and end with ``status``."""
    for sentence in sentences:
        print(f"drive-gateway: {sentence}", file=sys.stderr)
    sys.exit(status)


@contextmanager
def errors_answered() -> Generator[None]:
    """Every foreseen error becomes its sentence on standard error and its exit status, never a traceback."""
    # Imported here: what raises these errors takes a second to import, and --help needs none of it.
    from config.loading import ConfigError
    from drivers.errors import DriveError
    from gateway.errors import GatewayError, UsageError
    from gateway.record.ring import RingError
    from mechanism.errors import CamFileError, CurveError, MechanismError, ParameterError

    try:
        yield
    except ConfigError as error:
        complain(error.problems, EXIT_USE)
    except (UsageError, CamFileError, CurveError, ParameterError) as error:
        complain(str(error).splitlines(), EXIT_USE)
    except (GatewayError, DriveError, MechanismError, RingError) as error:
        complain(str(error).splitlines(), EXIT_NO)
    except KeyboardInterrupt:
        complain(["interrupted"], EXIT_NO)
    except OSError as error:
        complain([f"{error.filename or 'input/output'}: {error.strerror or error}"], EXIT_USE)


def require_absent(path: Path, is_overwriting: bool) -> None:
    """Refuse to write over a file unless asked, and a folder that is not there. Raises UsageError."""
    from gateway.errors import UsageError

    if path.exists() and not is_overwriting:
        raise UsageError(f"{path}: exists already (give --overwrite to replace it)")
    if not path.parent.is_dir():
        raise UsageError(f"{path}: there is no folder {path.parent}")
