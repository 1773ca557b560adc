"""Recorder, monitor and parent killed in the middle of a real run over loopback: the cycle goes on as it should."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml

from gateway.record.ring import RingReader, RunState, find_rings, runtime_directory
from gateway.record.sample import Phase

pytestmark = [pytest.mark.slow, pytest.mark.timeout(240)]

ROOT = Path(__file__).resolve().parents[2]
PATIENCE_S = 120.0


@pytest.fixture
def machine(tmp_path):
    """``paper`` at 4 ms, its guards warning of what a busy computer is late with, under a name of its own."""
    config = yaml.safe_load((ROOT / "config" / "paper.yaml").read_text())
    config["name"] = f"deaths-{os.getpid()}"
    config["motion"]["curve"] = str(ROOT / "config" / config["motion"]["curve"])
    config["emulator"]["eds"] = str(ROOT / "config" / config["emulator"]["eds"])
    for axis in config["axes"].values():
        del axis["sync_watchdog"]
    config["bus"] |= {"cycle_us": 4000, "heartbeat_timeout_ms": 2000}
    config["guard"] |= {name: {"reaction": "warn"} for name in ("missed_tpdo", "missed_deadline", "axis_silent")}
    config["guard"]["sync_lost"] = {"limit_cycles": 100, "reaction": "warn"}
    # A cycle that is lost on the way is 16 counts of travel here.
    config["guard"]["frozen_actual"] = {"limit_deg": 10.0, "reaction": "disable"}
    path = tmp_path / "deaths.yaml"
    path.write_text(yaml.safe_dump(config))
    return config["name"], path


def start(command, *arguments, folder):
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with (folder / f"{command}.stderr").open("w") as stderr:
        return subprocess.Popen(
            [sys.executable, "-m", "gateway.cli", command, *map(str, arguments)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=stderr,
            env=environment,
            cwd=folder,
        )


def until(condition, what):
    """What ``condition`` answers, as soon as it is something."""
    end = time.monotonic() + PATIENCE_S
    while time.monotonic() < end:
        answer = condition()
        if answer:
            return answer
        time.sleep(0.02)
    raise AssertionError(what)


def child_of(process, module):
    for folder in Path("/proc").iterdir():
        try:
            parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
            command = (folder / "cmdline").read_bytes().decode().split("\0")
        except (OSError, IndexError, ValueError):
            continue
        if parent == process.pid and module in command:
            return int(folder.name)
    raise AssertionError(f"no child of {process.pid} runs {module}")


def run_on_the_cam(machine, port, folder, cycles):
    name, config = machine
    options = ("-i", "socketcand", "--port", port, "--cycles", cycles, "--record", "run.mcap")
    process = start("run", config, *options, folder=folder)
    reader = RingReader(until(lambda: find_rings(name) or (process.poll() is not None and 1), "no ring")[0])
    seen = []

    def is_on_the_cam():
        seen.append(reader.read_new()[0]["phase"])
        assert process.poll() is None, (folder / "run.stderr").read_text()
        return Phase.CAM in seen[-1]

    until(is_on_the_cam, "never on the cam")
    return process, reader, seen


def test_a_killed_recorder_and_a_killed_monitor_do_not_touch_the_cycle(machine, start_own_sim_drive, tmp_path):
    place = start_own_sim_drive("--interface", "socketcand", "--port", "0", "--realtime", config=str(machine[1]))
    process, reader, seen = run_on_the_cam(machine, place["port"], tmp_path, 3)
    monitor = start("monitor", machine[1], "--json", folder=tmp_path)
    time.sleep(0.5)
    monitor.kill()
    os.kill(child_of(process, "gateway.running.recorder"), signal.SIGKILL)
    monitor.wait()
    while process.poll() is None:
        seen.append(reader.read_new()[0]["phase"])
        time.sleep(0.05)
    seen.append(reader.read_new()[0]["phase"])
    complaints = (tmp_path / "run.stderr").read_text()
    phases = {Phase(int(phase)) for part in seen for phase in part}
    assert {Phase.CAM, Phase.RAMP_DOWN, Phase.DISABLED} <= phases, complaints
    assert not phases & {Phase.CONTROLLED_STOP, Phase.QUICK_STOP}, complaints
    assert reader.state is RunState.FINISHED
    reader.close()
    assert process.returncode == 1
    assert "the recorder was ended by SIGKILL: the run goes on, unrecorded" in complaints
    assert "Traceback" not in complaints


def test_a_killed_parent_leaves_no_ring_behind(machine, start_own_sim_drive, tmp_path):
    place = start_own_sim_drive("--interface", "socketcand", "--port", "0", "--realtime", config=str(machine[1]))
    process, reader, seen = run_on_the_cam(machine, place["port"], tmp_path, 50)
    process.kill()
    process.wait()
    until(reader.is_over, "the cyclic process went on without its parent")
    seen.append(reader.read_new()[0]["phase"])
    phases = {Phase(int(phase)) for part in seen for phase in part}
    assert Phase.CONTROLLED_STOP in phases
    assert Phase.QUICK_STOP not in phases
    until(lambda: not list(runtime_directory().glob(f"drive-gateway-{machine[0]}-*")), "the ring is still there")
    reader.close()
