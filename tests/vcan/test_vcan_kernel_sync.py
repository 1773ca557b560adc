"""SYNC from the kernel's broadcast manager on a real vcan0: its period, its end, and a run that it paces."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import can
import pytest

from drivers.broadcast_manager import PeriodicFrame
from drivers.errors import BusError
from drivers.frame import Frame
from drivers.ports import interface_is_up, open_port
from gateway.record.recording import read_recording

pytestmark = [
    pytest.mark.vcan,
    pytest.mark.timeout(400),
    pytest.mark.skipif(not interface_is_up("vcan0"), reason="there is no CAN interface vcan0 that is up"),
]

SYNC = Frame(0x080)
PATIENCE_S = 240.0
ROOT = Path(__file__).resolve().parent.parent.parent


def arrivals(port: Any, count: int) -> list[int]:
    instants: list[int] = []
    end_ns = time.monotonic_ns() + round(PATIENCE_S * 1e9)
    while len(instants) < count and time.monotonic_ns() < end_ns:
        received = port.receive()
        if received is None:
            port.wait(1.0)
        else:
            assert received[0] == SYNC
            instants.append(received[1])
    return instants


def test_the_kernel_sends_every_period_and_stops_when_told() -> None:
    port = open_port("socketcan", "vcan0", filters=[(0x080, 0x7FF)])
    timer = PeriodicFrame("vcan0", SYNC, 10_000)
    try:
        timer.start()
        instants = arrivals(port, 51)
        assert len(instants) == 51
        # The kernel sets its timer anew after each frame: a period is never shorter, and a little longer.
        mean_ns = (instants[-1] - instants[0]) / 50
        assert 9.8e6 < mean_ns < 15e6
        before_ns = time.monotonic_ns()
        timer.retime(100_000)
        instants = arrivals(port, 5)
        # One more may come at the period before; none is sent for the change itself.
        assert instants[2] - instants[1] > 90e6
        assert instants[1] - before_ns > 90e6
        timer.stop()
        while port.receive() is not None or port.wait(0.0):
            pass
        assert not port.wait(0.05)
        timer.start()
        assert port.wait(PATIENCE_S), "and can be started again"
        timer.close()
        while port.receive() is not None or port.wait(0.0):
            pass
        assert not port.wait(0.05), "it ends with its socket"
    finally:
        timer.close()
        port.close()


def test_the_kernels_sync_ends_with_a_process_that_is_killed() -> None:
    program = (
        "from drivers.broadcast_manager import PeriodicFrame\nfrom drivers.frame import Frame\nimport signal\n"
        "timer = PeriodicFrame('vcan0', Frame(0x080), 2000)\ntimer.start()\nsignal.pause()\n"
    )
    port = open_port("socketcan", "vcan0", filters=[(0x080, 0x7FF)])
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    process = subprocess.Popen([sys.executable, "-c", program], env=environment)
    try:
        assert port.wait(PATIENCE_S)
        process.send_signal(signal.SIGKILL)
        process.wait(PATIENCE_S)
        while port.receive() is not None or port.wait(0.0):
            pass
        assert not port.wait(0.05)
    finally:
        process.kill()
        process.wait()
        port.close()


def test_an_interface_that_is_not_there_is_one_sentence() -> None:
    with pytest.raises(BusError, match="socketcan:vcan99: the broadcast manager cannot use it"):
        PeriodicFrame("vcan99", SYNC, 1000)


def test_a_run_is_paced_by_the_kernels_sync_and_says_so(
    start_own_sim_drive: Callable[..., dict[str, Any]],
    unhurried: Path,
    drive_gateway: Callable[..., "subprocess.Popen[str]"],
    tmp_path: Path,
) -> None:
    """The gateway itself sends no SYNC: what it sends, a socket of another process cannot tell, but its events do."""
    start_own_sim_drive("--interface", "socketcan", "--channel", "vcan0", "--realtime", config=str(unhurried))
    options = ("-i", "socketcan", "-c", "vcan0", "--cycles", "1", "--record", "run.mcap", "--json")
    process = drive_gateway("run", unhurried, *options, folder=tmp_path)
    output, _ = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, (tmp_path / "stderr").read_text()
    answer = json.loads(output)
    assert answer["stopped_by"] == "completed"
    recording = read_recording(tmp_path / "run.mcap")
    settings = [str(event.data["text"]) for event in recording.events if event.data["kind"] == "realtime"]
    assert "SYNC from the kernel on: broadcast manager on vcan0" in settings
    print(json.dumps(answer["cycle"], indent=1))
    with can.Bus(interface="socketcan", channel="vcan0", can_filters=[{"can_id": 0x080, "can_mask": 0x7FF}]) as bus:
        assert bus.recv(0.05) is None, "SYNC has ended with the run"
