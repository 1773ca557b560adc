"""Fixtures that the peer tests and the vcan tests share: the emulated machine as a process, and tshark."""

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parent.parent
PATIENCE_S = 120.0


def pytest_configure() -> None:
    """Signals as a terminal gives them: a suite started by nohup or in the background inherits them as ignored."""
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.default_int_handler)


@contextmanager
def sim_drive_process(folder: Path, config: str, options: tuple[str, ...]) -> Iterator[dict[str, Any]]:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    complaints = folder / "sim-drive.stderr"
    with complaints.open("w") as stderr:
        process = subprocess.Popen(
            [sys.executable, "-m", "sim_drive", config, "--json", *options],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=stderr,
            env=environment,
            text=True,
        )
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        assert line, f"sim-drive did not come up: {complaints.read_text()}"
        yield json.loads(line)
    finally:
        process.send_signal(signal.SIGTERM)
        try:
            rest, _ = process.communicate(timeout=PATIENCE_S)
        except subprocess.TimeoutExpired:
            process.kill()
            rest, _ = process.communicate()
    assert process.returncode == 0, complaints.read_text()
    assert json.loads(rest.splitlines()[-1])["event"] == "stopped"


def sim_drives(folders: pytest.TempPathFactory) -> Iterator[Callable[..., dict[str, Any]]]:
    with ExitStack() as stack:

        def start(*options: str, config: str = "paper") -> dict[str, Any]:
            return stack.enter_context(sim_drive_process(folders.mktemp("sim-drive"), config, options))

        yield start


@pytest.fixture(scope="module")
def start_sim_drive(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[..., dict[str, Any]]]:
    """``start_sim_drive(*options)`` starts ``sim-drive paper`` and answers where its bus is; ended with the module."""
    yield from sim_drives(tmp_path_factory)


@pytest.fixture
def start_own_sim_drive(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[..., dict[str, Any]]]:
    """The same, ended with the test."""
    yield from sim_drives(tmp_path_factory)


@pytest.fixture(scope="session")
def dissect() -> Callable[..., list[list[str]]]:
    """``dissect(log, *fields)`` has tshark decode a candump log as CANopen: a row a frame, a column a field."""
    program = shutil.which("tshark")
    if program is None:
        pytest.skip("tshark is not installed")

    def run(log: Path, *fields: str) -> list[list[str]]:
        command = [program, "-r", str(log), "-d", "can.subdissector,canopen", "-T", "fields", "-E", "separator=|"]
        command += [option for field in fields for option in ("-e", field)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=True)
        return [line.split("|") for line in done.stdout.splitlines()]

    return run
