"""The real-time host on a port and a clock that are not real, and what it asks of the system."""

import ctypes
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from host_nodes import PeriodicNode, ScriptedNode

from drivers.errors import BusError
from drivers.frame import Frame
from drivers.real_time import (
    MAX_WAIT_S,
    RETRY_S,
    RealTimeFeature,
    RealTimeSetting,
    run_node,
    short_idle,
    tighten_timers,
)

SYNC = Frame(0x080)


class FakePort:
    """A bus whose clock moves only in ``wait``, by just as much as it is asked to wait."""

    def __init__(self, arrivals: list[tuple[int, Frame]], full_until_ns: int = 0) -> None:
        self.now_ns = 0
        self.arrivals = arrivals
        self.sent: list[tuple[int, str]] = []
        self.waits: list[float] = []
        self.full_until_ns = full_until_ns

    def clock(self) -> int:
        return self.now_ns

    def send(self, frame: Frame) -> bool:
        if self.now_ns < self.full_until_ns:
            return False
        self.sent.append((self.now_ns, str(frame)))
        return True

    def receive(self) -> tuple[Frame, int] | None:
        if self.arrivals and self.arrivals[0][0] <= self.now_ns:
            arrival_ns, frame = self.arrivals.pop(0)
            return frame, arrival_ns
        return None

    def wait(self, timeout_s: float) -> bool:
        self.waits.append(timeout_s)
        end_ns = self.now_ns + round(timeout_s * 1e9)
        if self.arrivals and self.arrivals[0][0] <= end_ns:
            self.now_ns = max(self.arrivals[0][0], self.now_ns)
            return True
        self.now_ns = end_ns
        return False

    def fileno(self) -> int:
        return -1

    def close(self) -> None:
        pass


def until(port: FakePort, end_ns: int) -> Callable[[], bool]:
    return lambda: port.now_ns >= end_ns


def test_wakes_and_frames_meet_the_core_at_their_instants() -> None:
    port = FakePort([(1_500_000, SYNC), (2_000_000, SYNC)])
    node = PeriodicNode(1_000_000, start_ns=1_000_000, frame=Frame(0x181))
    statistics = run_node(node, port, until(port, 3_500_000), clock=port.clock)
    assert node.log == [
        ("wake", 1_000_000),
        ("080#", 1_500_000),
        ("080#", 2_000_000),
        ("wake", 2_000_000),
        ("wake", 3_000_000),
    ]
    assert port.sent == [(1_000_000, "181#"), (2_000_000, "181#"), (3_000_000, "181#")]
    assert (statistics.wakes, statistics.frames_received, statistics.frames_sent) == (3, 2, 3)
    assert statistics.max_wake_lateness_ns == 0


def test_a_core_that_waits_for_frames_alone_does_not_keep_stop_from_being_asked() -> None:
    port = FakePort([])
    run_node(ScriptedNode(), port, until(port, 200_000_000), clock=port.clock)
    assert port.waits == [MAX_WAIT_S] * 4


def test_a_full_bus_is_tried_again_soon() -> None:
    port = FakePort([], full_until_ns=500_000)
    run_node(ScriptedNode(initial=[SYNC]), port, until(port, 1_000_000), clock=port.clock)
    assert port.sent == [(600_000, "080#")]
    assert port.waits[:3] == [RETRY_S] * 3


def test_a_lost_bus_ends_the_run_with_its_error() -> None:
    class LostPort(FakePort):
        def receive(self) -> tuple[Frame, int] | None:
            raise BusError("socketcan", "can0", "the interface has gone down")

    with pytest.raises(BusError, match="can0: the interface has gone down"):
        run_node(ScriptedNode(), LostPort([]), lambda: False)


def test_timer_slack_is_what_the_kernel_says() -> None:
    setting = tighten_timers()
    assert setting.feature is RealTimeFeature.TIMER_SLACK
    get_timer_slack = 30
    slack_ns = ctypes.CDLL(None).prctl(get_timer_slack, 0, 0, 0, 0)
    assert setting.is_on == (slack_ns == 1)


HELPERS = Path(__file__).resolve().parents[1] / "helpers"


def lent(priority: int = 1, *, unprivileged: bool = False) -> dict[str, Any]:
    """What a process of its own has asked for and got."""
    launcher = [sys.executable, str(HELPERS / "unprivileged.py")] if unprivileged else []
    command = [*launcher, sys.executable, str(HELPERS / "real_time_effects.py"), str(priority)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    features = {feature.name for feature in RealTimeFeature}
    assert found["settings"].keys() == features - {"KERNEL_SYNC", "HARDWARE_STAMPS"}
    assert all(reason for _, reason in found["settings"].values())
    return found


def assert_true(found: dict[str, Any]) -> None:
    """What is said to be on has its effect, and what is said to be off has none."""
    is_on = {name: setting[0] for name, setting in found["settings"].items()}
    assert (found["policy"] == os.SCHED_FIFO) is is_on["SCHEDULING"]
    assert found["resets_on_fork"] is is_on["SCHEDULING"]
    assert found["priority"] == (1 if is_on["SCHEDULING"] else 0)
    assert found["locked_later"] is is_on["LOCKED_MEMORY"]
    assert found["locked_share"] > 0.5 if is_on["LOCKED_MEMORY"] else found["locked_share"] == 0.0
    assert is_on["FROZEN_GARBAGE"]
    assert found["settings"]["FROZEN_GARBAGE"][1] == f"{found['frozen']} objects"
    assert found["frozen"] > 1000
    assert (found["affinity"] == [found["processor"]]) or not is_on["PROCESSOR"]
    assert (found["idle_latency_us"] == 0) is is_on["IDLE_LATENCY"]
    # A real-time thread has no slack at all, and later kernels say so.
    assert (found["slack_ns"] in {0, 1}) is is_on["TIMER_SLACK"]


def test_what_is_said_to_be_on_is_on() -> None:
    assert_true(lent())


def test_a_priority_that_does_not_exist_is_refused_and_the_rest_goes_on() -> None:
    found = lent(1000)
    assert found["settings"]["SCHEDULING"][0] is False
    assert found["settings"]["SCHEDULING"][1].startswith(("priority 1000 refused", "not permitted"))
    assert_true(found)


def test_without_any_privilege_what_is_refused_is_off_and_the_reason_told() -> None:
    found = lent(unprivileged=True)
    assert found["capabilities"] == 0
    assert_true(found)
    settings = found["settings"]
    assert settings["SCHEDULING"] == [False, "not permitted; it needs CAP_SYS_NICE or an rtprio limit"]
    assert settings["LOCKED_MEMORY"] == [False, "not permitted; the memlock limit is 0 KiB"]
    assert (found["policy"], found["locked_share"]) == (os.SCHED_OTHER, 0.0)
    assert settings["TIMER_SLACK"] == [True, "1 ns"]


def test_the_wake_up_latency_is_asked_for_as_long_as_the_process_lives(tmp_path: Path) -> None:
    device = tmp_path / "cpu_dma_latency"
    device.touch()
    setting = short_idle(device)
    descriptors = [int(link.name) for link in Path("/proc/self/fd").iterdir()]
    held = [descriptor for descriptor in descriptors if is_open_on(descriptor, device)]
    for descriptor in held:
        os.close(descriptor)
    assert setting == RealTimeSetting(RealTimeFeature.IDLE_LATENCY, True, "0 us")
    assert (len(held), device.read_bytes()) == (1, bytes(4))


def test_a_device_that_is_not_there_or_not_ours_is_told(tmp_path: Path) -> None:
    device = tmp_path / "cpu_dma_latency"
    assert short_idle(device) == RealTimeSetting(RealTimeFeature.IDLE_LATENCY, False, f"this kernel has no {device}")
    assert short_idle(tmp_path) == RealTimeSetting(RealTimeFeature.IDLE_LATENCY, False, f"{tmp_path}: is a directory")


def is_open_on(descriptor: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except OSError:
        return False
