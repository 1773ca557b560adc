"""On a real vcan0, beside a process that never rests: which deadlines were missed, and why.

Times are printed, never asserted; ``-s`` shows them. ``DRIVE_GATEWAY_BENCH_CYCLE_US`` (4000) and
``DRIVE_GATEWAY_BENCH_S`` (4) set the cycle and the seconds: ten minutes at 1 kHz are 1000 and 600. What is asserted is
that the account has every missed deadline, and calls none explained beyond what it saw.
"""

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from slow_host import LATENESS, slow_host_paper

from drivers.ports import interface_is_up

CYCLE_US = int(os.environ.get("DRIVE_GATEWAY_BENCH_CYCLE_US", "4000"))
SPAN_S = float(os.environ.get("DRIVE_GATEWAY_BENCH_S", "4"))
ALONE_MAX_S = 20.0
"""Without the busy process a short run is enough to compare with."""
PATIENCE_S = 3.0 * SPAN_S + 600.0
ROOT = Path(__file__).resolve().parent.parent.parent
BUSY_MAX_S = 2.0 * SPAN_S + 300.0
"""The busy process ends by itself after this at the latest."""

pytestmark = [
    pytest.mark.vcan,
    pytest.mark.bench,
    pytest.mark.timeout(PATIENCE_S + 120.0),
    pytest.mark.skipif(not interface_is_up("vcan0"), reason="there is no CAN interface vcan0 that is up"),
]


@pytest.fixture
def machine(tmp_path: Path) -> Path:
    """``paper`` at the bench's cycle, its guards warning only."""
    config = slow_host_paper(())
    config["bus"] |= {"cycle_us": CYCLE_US, "heartbeat_timeout_ms": 2000, "is_virtual": True}
    warned = (
        *LATENESS,
        "following_error",
        "bus_off",
        "end_effector_error",
        "velocity",
        "torque",
        "cam_window",
        "frozen_actual",
    )
    config["guard"] |= {name: {**config["guard"].get(name, {}), "reaction": "warn"} for name in warned}
    config["guard"]["sync_lost"] = {"limit_cycles": 5, "reaction": "warn"}
    config["guard"]["unanswered_torque"] = {"limit_permille": 30000, "reaction": "disable"}
    path = tmp_path / "deadlines.yaml"
    path.write_text(yaml.safe_dump(config))
    return path


@pytest.fixture
def start_busy() -> Iterator[Callable[[], None]]:
    """Starts a process that computes without end, at normal priority, beside everything else."""
    started: list[subprocess.Popen[bytes]] = []

    def start() -> None:
        code = f"import time\nend = time.monotonic() + {BUSY_MAX_S}\nwhile time.monotonic() < end: pass"
        started.append(subprocess.Popen([sys.executable, "-c", code]))

    yield start
    for process in started:
        process.kill()
        process.wait()


def test_why_deadlines_are_missed(
    start_sim_drive: Callable[..., dict[str, Any]],
    drive_gateway: Callable[..., "subprocess.Popen[str]"],
    start_busy: Callable[[], None],
    machine: Path,
    tmp_path: Path,
) -> None:
    start_sim_drive("--interface", "socketcan", "--channel", "vcan0", "--realtime", config=str(machine))
    options = ("-i", "socketcan", "-c", "vcan0", "--record", "run.mcap", "--overwrite", "--no-frames", "--json")
    for is_busy in (False, True):
        if is_busy:
            start_busy()
        cycles = max(1, round(SPAN_S if is_busy else min(SPAN_S, ALONE_MAX_S)))
        process = drive_gateway("run", machine, *options, "--cycles", cycles, "--from-here", folder=tmp_path)
        output, _ = process.communicate(timeout=PATIENCE_S)
        assert output, (tmp_path / "stderr").read_text()
        report = json.loads(output)
        cycle, late = report["cycle"], report["late"]
        beside = "beside a busy process" if is_busy else "alone"
        print(f"\n{cycle['count']} cycles of {CYCLE_US} us {beside}: stopped by {report['stopped_by']}")
        print("missed RPDO deadlines, and why:", late["verdict"])
        print("overruns:", late["overruns"], "explained:", late["overruns_explained"])
        for name in ("wake_lateness_us", "rpdo_lead_us", "sync_period_deviation_us", "loop_cpu_us_per_cycle"):
            print(name, cycle[name])
        for worst in late["worst"][:8]:
            print("  ", {name: worst[name] for name in ("what", "cycle", "missed_by_us", "is_explained", "shares_us")})
        check_account(late, cycle["missed_rpdo_deadline"])


def check_account(late: dict[str, Any], missed: int) -> None:
    """Every miss is in the account, and none that is called explained has a share that is the gateway's."""
    assert late["missed_rpdo_deadline"] == missed == sum(cause["count"] for cause in late["by_cause"].values())
    for worst in late["worst"]:
        own = sum(worst["shares_us"].get(name, 0) for name in ("own_work", "own_call", "page_fault", "not_explained"))
        assert not (worst["is_explained"] and own)
