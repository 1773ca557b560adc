"""``drive-gateway demo`` on a vcan0 that is up: it finds the interface and starts the emulator there by itself."""

import json
import subprocess
from collections.abc import Callable
from pathlib import Path

import can
import pytest

from drivers.ports import interface_is_up
from gateway.record.recording import read_recording

pytestmark = [
    pytest.mark.vcan,
    pytest.mark.timeout(400),
    pytest.mark.skipif(not interface_is_up("vcan0"), reason="there is no CAN interface vcan0 that is up"),
]

PATIENCE_S = 240.0
TOO_SLOW = {
    "missed_tpdo",
    "missed_deadline",
    "axis_silent",
    "frozen_actual",
    "unanswered_torque",
    "sync_lost",
    "bus_off",
    "emergency",
    "heartbeat_lost",
}
"""Reasons to stop that a computer gives which cannot keep 1 kHz with all the processes on its one processor."""


def test_the_demo_runs_on_vcan0(drive_gateway: Callable[..., "subprocess.Popen[str]"], tmp_path: Path) -> None:
    heard: list[can.Message] = []
    with can.Bus(interface="socketcan", channel="vcan0") as bus:
        listener = can.Notifier(bus, [heard.append])
        process = drive_gateway("demo", "--cycles", "1", "-o", "report", "--json", folder=tmp_path)
        output, _ = process.communicate(timeout=PATIENCE_S)
        listener.stop()
    complaints = (tmp_path / "stderr").read_text()
    assert "the emulated machine is on socketcan vcan0" in complaints
    if not output:
        # Or it does not even get as far as the run.
        assert process.returncode == 1, complaints
        assert "has fallen silent" in complaints, complaints
        return
    answer = json.loads(output)
    assert {0x080, 0x181, 0x182, 0x201, 0x202, 0x701, 0x702, 0x77F} <= {message.arbitration_id for message in heard}
    assert read_recording(tmp_path / "report" / "demo.mcap").is_complete
    assert {"report.html", "report.json", "cam.json"} <= {path.name for path in (tmp_path / "report").iterdir()}
    assert answer == json.loads((tmp_path / "report" / "report.json").read_text())
    if process.returncode == 0:
        assert answer["stopped_by"] == "completed"
        assert answer["machine_cycles"] >= 1
        return
    # Whoever cannot keep the cycle is told so, in words and in figures, and the machine is stopped.
    assert process.returncode == 1, complaints
    assert answer["stopped_by"] in TOO_SLOW, complaints
    assert f"the run did not complete, it was stopped by: {answer['stopped_by']}" in complaints
    assert sum(answer["cycle"][what] for what in ("missed_tpdo", "missed_rpdo_deadline", "overruns", "sync_lost")) > 0
    assert "Traceback" not in complaints


def test_the_demo_says_what_it_misses_where_there_is_no_such_interface(
    drive_gateway: Callable[..., "subprocess.Popen[str]"], tmp_path: Path
) -> None:
    process = drive_gateway("demo", "--channel", "vcan99", "--cycles", "1", "-o", "report", folder=tmp_path)
    output, _ = process.communicate(timeout=PATIENCE_S)
    assert process.returncode in {1, 2}
    assert output == ""
    last = (tmp_path / "stderr").read_text().splitlines()[-1]
    assert "vcan99" in last
    assert "no such interface" in last
