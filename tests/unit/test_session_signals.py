"""SIGINT, SIGTERM and a second SIGINT to a real run over loopback: phases, stopped_by, exit status."""

import os
import signal

import pytest
from loopback_run import LoopbackRun, unhurried_machine

from gateway.record.recording import read_recording
from gateway.record.ring import RunState
from gateway.record.sample import Phase

pytestmark = [pytest.mark.slow, pytest.mark.timeout(240)]

IN_ORDER = [Phase.CONTROLLED_STOP, Phase.STANDSTILL, Phase.DISABLED]
AT_ONCE = [Phase.CONTROLLED_STOP, Phase.QUICK_STOP, Phase.DISABLED]


@pytest.fixture
def run(start_own_sim_drive, tmp_path):
    """A run of many revolutions, on its cam."""
    machine = unhurried_machine(tmp_path)
    place = start_own_sim_drive("--interface", "socketcand", "--port", "0", "--realtime", config=str(machine[1]))
    return LoopbackRun(machine, place["port"], tmp_path, 100)


def interrupt(run):
    """Ctrl-C: the terminal sends it to every process of the run."""
    os.killpg(run.process.pid, signal.SIGINT)


def assert_stopped(run, phases):
    assert run.to_end() == 1, run.complaints
    assert run.phases[-3:] == phases
    assert run.reader.state is RunState.FINISHED
    run.reader.close()
    assert "the run did not complete, it was stopped by: operator" in run.complaints
    assert "the linkage stands with" in run.complaints
    assert "Traceback" not in run.complaints
    recording = read_recording(run.folder / "run.mcap")
    assert recording.is_complete
    assert recording.stopped_by == "operator"
    # The last one that the process has written is there too.
    assert recording.samples["cycle"][-1] == run.samples[-1]["cycle"]


def test_an_interrupt_is_a_controlled_stop(run):
    interrupt(run)
    assert_stopped(run, IN_ORDER)


def test_a_termination_is_a_controlled_stop(run):
    run.process.send_signal(signal.SIGTERM)
    assert_stopped(run, IN_ORDER)


def test_a_second_interrupt_is_a_quick_stop(run):
    interrupt(run)
    run.wait_for(Phase.CONTROLLED_STOP)
    interrupt(run)
    assert_stopped(run, AT_ONCE)
