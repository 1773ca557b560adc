"""The account of late demands on this machine's own kernel and clock: what is done to the loop must come out as that.

Nothing here is asserted of how late anything is, and a busy machine may add causes of its own.
"""

import os
import select
import subprocess
import sys
import time

import pytest

from config.loading import load_config
from drivers.frame import Frame
from drivers.nmt import SYNC_COB_ID
from gateway.record.lateness import Cause, LateAccount, LateKind
from gateway.record.sample import SampleFlag
from gateway.running.assembly import build_core
from gateway.running.cycle_host import CycleHost
from gateway.running.late_account import LateAccountant, is_processor_clock_fine, open_counters
from gateway.running.preparation import prepare

MS = 1_000_000
CYCLE_NS = MS
CONFIG = load_config("paper")
CYCLES = 400
BURST_S = 0.004
DISTURBER = f"""
import sys, time
end = time.monotonic() + 8.0
print("ready", flush=True)
while time.monotonic() < end:
    time.sleep(0.03)
    begin = time.monotonic()
    while time.monotonic() - begin < {BURST_S}:
        pass
"""


class Drives:
    """A bus within the process, whose two drives answer SYNC at once."""

    def __init__(self):
        self.queue = []
        self.reader, self.writer = os.pipe()

    def send(self, frame):
        if frame.cob_id == SYNC_COB_ID:
            now_ns = time.monotonic_ns()
            self.queue += [(Frame(0x180 + number, bytes(8)), now_ns) for number in (1, 2)]
        return True

    def receive(self):
        return self.queue.pop(0) if self.queue else None

    def wait(self, timeout_s):
        return bool(select.select((self.reader,), (), (), 0.0 if self.queue else timeout_s)[0])

    def fileno(self):
        return self.reader

    def close(self):
        os.close(self.reader)
        os.close(self.writer)


class FullAccount(LateAccount):
    """Keeps every explanation, however many there are."""

    def __init__(self):
        super().__init__()
        self.all = []

    def add(self, explanation):
        super().add(explanation)
        self.all.append(explanation)


class Samples:
    def __init__(self):
        self.missed = []

    def append(self, *values):
        if values[13] & SampleFlag.MISSED_RPDO_DEADLINE:
            self.missed.append(values[0])


def run_loop(in_poll):
    """Why demands and SYNCs were late of a loop of 1 ms on this machine; ``in_poll`` gets the cycle."""
    counters = open_counters()
    if counters is None or not is_processor_clock_fine():
        pytest.skip("this kernel does not tell who had the processor")
    prepared = prepare(CONFIG, 1)
    samples, drives = Samples(), Drives()
    core = build_core(CONFIG, prepared.cam.profile, prepared.plan, samples, time.thread_time_ns)
    core._session = iter(lambda: 1 << 62, None)
    core.loop.start(time.monotonic_ns())
    late = LateAccountant(CYCLE_NS, lambda *_: None, counters=counters)
    late.account = account = FullAccount()
    polled = set()

    def poll():
        cycle = core.loop.cycle
        # Right after SYNC: the demand of this cycle is still to be made.
        if not core.loop.is_closed and cycle not in polled:
            polled.add(cycle)
            in_poll(cycle)
        if cycle >= CYCLES:
            core.loop.stop()
            core.is_done = True

    try:
        CycleHost(core, drives, poll, late=late).run()
        late.flush()
    finally:
        drives.close()
        counters.close()
    assert account.missed == len(samples.missed)
    return account.all


@pytest.fixture
def one_processor():
    before = os.sched_getaffinity(0)
    chosen = max(before)
    os.sched_setaffinity(0, {chosen})
    yield chosen
    os.sched_setaffinity(0, before)


@pytest.fixture
def disturber(one_processor):
    """A process that takes this processor for 4 ms at a time, before everything else."""
    process = subprocess.Popen([sys.executable, "-c", DISTURBER], stdout=subprocess.PIPE)
    try:
        os.sched_setaffinity(process.pid, {one_processor})
        try:
            os.sched_setscheduler(process.pid, os.SCHED_FIFO, os.sched_param(90))
        except PermissionError:
            pytest.skip("real-time scheduling is not permitted")
        process.stdout.readline()
        yield process
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


@pytest.mark.usefixtures("disturber")
def test_another_process_that_takes_the_processor_is_named():
    told = run_loop(lambda _cycle: None)
    # 0.4 s and more have at least ten bursts, each of which the loop cannot but be late after.
    named = [late for late in told if late.cause is Cause.ANOTHER_PROCESS]
    assert len(named) >= 5
    assert all(late.is_explained for late in named)


def test_a_poll_of_the_loops_own_that_computes_is_own_work_and_not_explained():
    burnt = []

    def burn(cycle):
        if cycle >= 100 and cycle % 30 == 0:
            burnt.append(cycle)
            end_ns = time.thread_time_ns() + 3 * MS
            while time.thread_time_ns() < end_ns:
                pass

    told = run_loop(burn)
    assert len(burnt) >= 5
    own = [late for late in told if late.kind is LateKind.RPDO_DEADLINE and late.cycle in burnt]
    assert len(own) == len(burnt), "3 ms of work do not fit into a cycle of 1 ms"
    assert not any(late.is_explained for late in own)
    assert all(Cause.OWN_WORK in dict(late.shares_ns) for late in own)
