"""What the vcan tests share: the product's programs as processes, and a machine that a slow computer keeps up with."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml
from slow_host import slow_host_paper

ROOT = Path(__file__).resolve().parent.parent.parent
PATIENCE_S = 240.0


@pytest.fixture(scope="module")
def unhurried(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``paper`` at 250 Hz, its guards warning of what is late: one slow processor has to carry every process here."""
    config = slow_host_paper()
    config["bus"] |= {"cycle_us": 4000, "heartbeat_timeout_ms": 1000}
    # A drive that the only processor is kept from for a second has not left the bus.
    config["guard"]["bus_off"]["persistence_cycles"] = 249
    config["guard"]["sync_lost"] = {"limit_cycles": 5, "reaction": "warn"}
    config["guard"]["unanswered_torque"] = {"limit_permille": 30000, "reaction": "disable"}
    path = tmp_path_factory.mktemp("machine") / "unhurried.yaml"
    path.write_text(yaml.safe_dump(config))
    return path


@pytest.fixture(scope="session")
def drive_gateway() -> Callable[..., "subprocess.Popen[str]"]:
    """``drive_gateway(*arguments)`` starts the command line as a process, its output on pipes."""

    def start(*arguments: object, folder: Path) -> "subprocess.Popen[str]":
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
        with (folder / "stderr").open("w") as stderr:
            return subprocess.Popen(
                [sys.executable, "-m", "gateway.cli", *map(str, arguments)],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=stderr,
                env=environment,
                cwd=folder,
                text=True,
            )

    return start
