"""A whole run over loopback by somebody to whom the system lends nothing: it completes, and says what it had to do
without."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from slow_host import slow_host_paper

from gateway.record.recording import read_recording

pytestmark = [pytest.mark.slow, pytest.mark.timeout(240)]

ROOT = Path(__file__).resolve().parents[2]
PATIENCE_S = 200.0


@pytest.fixture
def config(tmp_path: Path) -> Path:
    """``paper`` at 4 ms, its guards warning of what a busy computer is late with."""
    config = slow_host_paper()
    config["name"] = f"unprivileged-{os.getpid()}"
    config["bus"] |= {"cycle_us": 4000, "heartbeat_timeout_ms": 2000}
    config["guard"]["sync_lost"] = {"limit_cycles": 100, "reaction": "warn"}
    path = tmp_path / "unprivileged.yaml"
    path.write_text(yaml.safe_dump(config))
    return path


def test_a_run_without_any_privilege_completes_and_tells_what_is_off(
    config: Path, start_own_sim_drive: Callable[..., dict[str, Any]], tmp_path: Path
) -> None:
    place = start_own_sim_drive("--interface", "socketcand", "--port", "0", "--realtime", config=str(config))
    command = [sys.executable, str(ROOT / "tests" / "helpers" / "unprivileged.py"), sys.executable, "-m", "gateway.cli"]
    options = ["-i", "socketcand", "--port", str(place["port"]), "--cycles", "1", "--record", "run.mcap", "--json"]
    done = subprocess.run(
        [*command, "run", str(config), *options],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["stopped_by"] == "completed"
    told = [event.data for event in read_recording(tmp_path / "run.mcap").events]
    settings = {str(data["text"]).partition(":")[0]: data for data in told if data["kind"] == "realtime"}
    assert settings["SCHED_FIFO off"]["text"].endswith("not permitted; it needs CAP_SYS_NICE or an rtprio limit")
    assert settings["locked memory off"]["text"].endswith("not permitted; the memlock limit is 0 KiB")
    assert {"timer slack on", "frozen garbage collector on"} <= settings.keys()
    shown = " ".join(done.stderr.split())
    assert "SCHED_FIFO off: not permitted" in shown
    assert "locked memory off: not permitted" in shown
    held = [data["text"] for data in told if data["kind"] == "guards_set"]
    assert [text.partition(" the drive holds ")[0] for text in held] == ["axis cv:", "axis servo:"]
