"""Parts of a run in real time: stop requests, the look at the bus before, processes that end with their parent."""

import os
import select
import signal
import subprocess
import sys
from pathlib import Path

import can
import pytest

from config.loading import load_config
from drivers.frame import Frame
from drivers.master import BootUpReceived
from gateway.errors import CommissioningError, GatewayError
from gateway.record.ring import StopRequest
from gateway.running.bus_address import resolve_bus
from gateway.running.cycle_host import run_core
from gateway.running.cyclic_process import Poll, pass_on_stop, refuse_other_master
from gateway.running.session import StopSwitch

ROOT = Path(__file__).resolve().parent.parent.parent


def test_the_second_signal_is_a_quick_stop_and_a_closed_terminal_never_is():
    switch = StopSwitch()
    with switch.installed():
        signal.raise_signal(signal.SIGHUP)
        signal.raise_signal(signal.SIGHUP)
        assert switch.request is StopRequest.CONTROLLED_STOP
        signal.raise_signal(signal.SIGINT)
        assert switch.request is StopRequest.QUICK_STOP
    assert signal.getsignal(signal.SIGHUP) is signal.SIG_DFL


def test_under_nohup_a_closed_terminal_stops_nothing():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        switch = StopSwitch()
        with switch.installed():
            signal.raise_signal(signal.SIGHUP)
        assert switch.request is StopRequest.NONE
    finally:
        signal.signal(signal.SIGHUP, before)


class CountingCore:
    def __init__(self):
        self.calls = []

    def request_stop(self, wish):
        self.calls.append(wish.value)

    def request_quick_stop(self):
        self.calls.append("quick stop")


def test_a_stop_request_is_handed_on_once():
    core, answered = CountingCore(), 0
    for request in (0, 0, StopRequest.SIGINT, StopRequest.SIGINT, 1, StopRequest.QUICK_STOP, StopRequest.QUICK_STOP):
        answered = pass_on_stop(core, request, answered)
    assert core.calls == ["sigint", "quick stop"]


def test_each_signal_asks_for_what_the_guard_says_of_it():
    for number, request in ((signal.SIGINT, StopRequest.SIGINT), (signal.SIGTERM, StopRequest.SIGTERM)):
        switch = StopSwitch()
        with switch.installed():
            signal.raise_signal(number)
            assert switch.request is request
            signal.raise_signal(number)
            assert switch.request is StopRequest.QUICK_STOP


class TellingCore:
    """A core that has an event in every second poll, and a failure when it is given one."""

    failure = None

    def __init__(self):
        self.polls = 0

    def take_events(self):
        self.polls += 1
        return [BootUpReceived(self.polls, 2)] if self.polls % 2 else []


class ListRing:
    def __init__(self):
        self.events = []

    def append_event(self, _at_ns, kind, text, **_data):
        self.events.append((kind, text))

    def beat(self, _now_ns):
        pass

    def stop_request(self):
        return 0

    def order_word(self):
        return 0


def test_a_failure_is_told_with_the_next_event_and_each_sentence_once():
    core, ring = TellingCore(), ListRing()
    poll = Poll(core, ring)
    poll()
    core.failure = CommissioningError(["axis cv: one thing", "axis servo: another"])
    for _ in range(4):
        poll()
    poll.tell_failure(GatewayError("axis cv: one thing\nand the bus is lost"))
    assert [text for kind, text in ring.events if kind == "failure"] == [
        "axis cv: one thing",
        "axis servo: another",
        "and the bus is lost",
    ]
    assert [kind for kind, _ in ring.events] == ["boot_up", "boot_up", "failure", "failure", "boot_up", "failure"]


class LateCore:
    """A core that is due for ever, as one on an overloaded host; ends after so many wakes."""

    is_running = is_closed = is_paced = False
    arrival_offset_ns = sync_due_ns = cycle = 0
    period_ns = 1_000_000
    axes = ()

    def __init__(self, wakes):
        self.left = wakes
        self.loop = self.steering = self

    @property
    def is_done(self):
        return self.left == 0

    def next_wake_ns(self):
        return 0

    def wake(self, _now_ns):
        self.left -= 1

    def take_frames(self):
        return [Frame(0x080)]

    def sent(self, _now_ns):
        pass


class SilentPort:
    def __init__(self, frames=()):
        self.frames = list(frames)

    def receive(self):
        return (self.frames.pop(0), 0) if self.frames else None

    def wait(self, _timeout_s):
        return False

    def send(self, _frame):
        return True


def test_a_loop_that_is_always_late_still_hears_of_stops():
    polls = []
    run_core(LateCore(5), SilentPort(), lambda: 1, lambda: polls.append(1))
    assert len(polls) >= 5


@pytest.mark.parametrize(
    ("frames", "sign"),
    [
        ([Frame(0x181, bytes(8)), Frame(0x080)], "SYNC"),
        ([Frame(0x701, b"\x7f"), Frame(0x77F, b"\x05")], "the heartbeat of node 127"),
    ],
)
def test_a_bus_with_another_master_is_refused(frames, sign):
    with pytest.raises(GatewayError, match=sign):
        refuse_other_master(SilentPort(frames), 127, 10.0)


def test_a_bus_with_drives_alone_is_not_refused():
    refuse_other_master(SilentPort([Frame(0x701, b"\x7f"), Frame(0x081, bytes(8)), Frame(0x702, b"\x00")]), 127, 0.001)


def test_python_can_is_told_the_bit_rate(monkeypatch):
    seen = {}

    open_bus = can.Bus

    def open_virtually(interface, channel, **options):
        seen.update(options, interface=interface, channel=channel)
        return open_bus(interface="virtual", channel="nowhere")

    monkeypatch.setattr(can, "Bus", open_virtually)
    resolve_bus(load_config("paper").bus, "pcan", "PCAN_USBBUS1").open().close()
    assert seen == {"interface": "pcan", "channel": "PCAN_USBBUS1", "bitrate": 1_000_000}


def test_a_child_ends_with_a_parent_that_is_killed(tmp_path):
    (tmp_path / "blocker.py").write_text("import signal\nprint('up', flush=True)\nsignal.pause()\n")
    start = "import os, subprocess, sys; subprocess.Popen([sys.executable, '-m', 'gateway.running.child_process', "
    start += "str(os.getpid()), 'blocker']).wait()"
    environment = {**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{tmp_path}"}
    parent = subprocess.Popen([sys.executable, "-c", start], stdout=subprocess.PIPE, env=environment)
    with parent:
        assert parent.stdout.readline() == b"up\n"
        parent.kill()
        # The pipe's other end is the child's now: it closes when the child ends, and not before.
        ready, _, _ = select.select([parent.stdout], [], [], 20.0)
        assert ready
        assert parent.stdout.read() == b""
