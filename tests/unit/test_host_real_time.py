"""The real-time host on a port and a clock that are not real, and what it asks of the system."""

import ctypes
import subprocess
import sys
from collections.abc import Callable

import pytest
from host_nodes import PeriodicNode, ScriptedNode

from drivers.errors import BusError
from drivers.frame import Frame
from drivers.real_time import MAX_WAIT_S, RETRY_S, RealTimeFeature, run_node, tighten_timers

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


def test_what_the_system_lends_is_reported_and_never_raised() -> None:
    """In a process of its own: SCHED_FIFO and locked memory are not for the test runner."""
    program = (
        "from drivers.real_time import try_realtime\n"
        "for priority in (1, 1000):\n"
        "    print(*(f'{s.feature.name}={s.is_on}:{s.reason}' for s in try_realtime(priority)), sep='|')\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    permitted, impossible = (line.split("|") for line in done.stdout.splitlines())
    features = [feature.name for feature in RealTimeFeature if feature is not RealTimeFeature.KERNEL_SYNC]
    for settings in (permitted, impossible):
        assert sorted(entry.partition("=")[0] for entry in settings) == sorted(features)
        assert all(entry.partition(":")[2] for entry in settings)
    assert impossible[1].startswith("SCHEDULING=False:")
