"""Recorder, monitor and parent killed in the middle of a real run over loopback: the cycle goes on as it should."""

import json
import os
import signal
import subprocess

import numpy as np
import pytest
from loopback_run import LoopbackRun, child_of, start, unhurried_machine, until

from gateway.record.histograms import count_cycles
from gateway.record.ring import RunState, runtime_directory
from gateway.record.sample import Phase

pytestmark = [pytest.mark.slow, pytest.mark.timeout(240)]

WATCHED_CYCLES = 250
"""A second of them before a death, and one after it."""
NOISE_CYCLES = 25
"""So many more may be amiss on a busy computer; on one that keeps up none is, before or after."""
CYCLE_NS = 4_000_000


@pytest.fixture
def begin(start_own_sim_drive, tmp_path):
    """``begin(cycles)``: the machine of the run, and the run on its cam."""

    def begin(cycles):
        machine = unhurried_machine(tmp_path)
        place = start_own_sim_drive("--interface", "socketcand", "--port", "0", "--realtime", config=str(machine[1]))
        return machine, LoopbackRun(machine, place["port"], tmp_path, cycles)

    return begin


def amiss(samples):
    """What the cycle's own account says of these samples: flags, and cycles for which there was no SYNC."""
    span_ns = int(samples["sync_ns"][-1] - samples["sync_ns"][0])
    return count_cycles(samples, 2).total + round(span_ns / CYCLE_NS) - (len(samples) - 1)


def assert_account_goes_on(run, killed_at):
    """Around sample number ``killed_at`` no sample is lost, and no more is amiss than before.

    All that is asked of the cycle's time is that the death does not show in it.
    """
    before = np.array(run.samples[killed_at - WATCHED_CYCLES : killed_at])
    after = np.array(run.samples[killed_at : killed_at + WATCHED_CYCLES])
    assert len(before) == len(after) == WATCHED_CYCLES
    assert (np.diff(np.concatenate([before["cycle"], after["cycle"]])) == 1).all(), "a cycle has no sample"
    assert set(after["phase"]) == {Phase.CAM}
    assert amiss(after) <= amiss(before) + NOISE_CYCLES


def test_a_killed_monitor_does_not_touch_the_cycle(begin, tmp_path):
    machine, run = begin(100)
    with start("monitor", machine[1], "--json", folder=tmp_path, stdout=subprocess.PIPE) as monitor:
        # It shows this run, live; else its death would prove nothing.
        shown = json.loads(monitor.stdout.readline())
        assert (shown["config"], shown["phase"]) == (machine[0], "cam")
        run.go_on(WATCHED_CYCLES)
        killed_at = len(run.samples)
        assert monitor.poll() is None
        monitor.kill()
        monitor.wait()
    run.go_on(WATCHED_CYCLES)
    assert_account_goes_on(run, killed_at)
    run.process.send_signal(signal.SIGTERM)
    assert run.to_end() == 1
    assert run.phases[-2:] == [Phase.STANDSTILL, Phase.DISABLED]
    assert run.reader.state is RunState.FINISHED
    run.reader.close()


def test_a_killed_recorder_does_not_touch_the_cycle(begin):
    _, run = begin(5)
    run.go_on(WATCHED_CYCLES)
    killed_at = len(run.samples)
    os.kill(child_of(run.process, "gateway.running.recorder"), signal.SIGKILL)
    assert run.to_end() == 1
    assert_account_goes_on(run, killed_at)
    assert run.phases[-4:] == [Phase.CAM, Phase.RAMP_DOWN, Phase.STANDSTILL, Phase.DISABLED], run.complaints
    assert run.reader.state is RunState.FINISHED
    run.reader.close()
    assert "the recorder was ended by SIGKILL: the run goes on, unrecorded" in run.complaints
    assert "Traceback" not in run.complaints


def test_a_killed_parent_leaves_no_ring_behind(begin):
    machine, run = begin(50)
    run.process.kill()
    run.process.wait()
    until(run.reader.is_over, "the cyclic process went on without its parent")
    run.read()
    assert Phase.CONTROLLED_STOP in run.phases
    assert Phase.QUICK_STOP not in run.phases
    until(lambda: not list(runtime_directory().glob(f"drive-gateway-{machine[0]}-*")), "the ring is still there")
    run.reader.close()
