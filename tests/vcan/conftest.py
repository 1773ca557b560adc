"""What the vcan tests share: the product's programs as processes, and a machine that a slow computer keeps up with."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).resolve().parent.parent.parent
PATIENCE_S = 240.0
LATENESS = ("missed_tpdo", "missed_deadline", "axis_silent")
"""Conditions of the guard that a slow computer brings about."""


@pytest.fixture(scope="module")
def unhurried(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``paper`` at 250 Hz, its guards warning of what is late: one slow processor has to carry every process here."""
    config = yaml.safe_load((ROOT / "config" / "paper.yaml").read_text())
    config["motion"]["curve"] = str(ROOT / "config" / config["motion"]["curve"])
    config["emulator"]["eds"] = str(ROOT / "config" / config["emulator"]["eds"])
    for axis in config["axes"].values():
        del axis["sync_watchdog"]
    config["bus"] |= {"cycle_us": 4000, "heartbeat_timeout_ms": 1000}
    config["guard"] |= {name: {"reaction": "warn"} for name in LATENESS}
    # A drive that the only processor is kept from for a second has not left the bus.
    config["guard"]["bus_off"]["persistence_cycles"] = 249
    config["guard"]["sync_lost"] = {"limit_cycles": 5, "reaction": "warn"}
    # A cycle that is lost on the way is 16 counts of travel here.
    config["guard"]["frozen_actual"] = {"limit_deg": 10.0, "reaction": "disable"}
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
