"""Searches on a dask cluster: a real scheduler and two real workers, all of them processes on loopback."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from config.loading import load_config
from gateway.errors import GatewayError
from gateway.synthesis.request import SynthesisRequest
from gateway.synthesis.run_search import SearchRun, SearchStatus
from gateway.synthesis.workers import DaskCluster, InProcess, WorkersLostError
from mechanism.synthesis.search import Method

pytest.importorskip("distributed")

PAPER = load_config("paper")
CURVE = Path(PAPER.relative("desired_path_36.csv"))
ROOT = Path(__file__).resolve().parents[2]
SETTINGS = SynthesisRequest(
    CURVE, PAPER, Method.DIFFERENTIAL_EVOLUTION, seed=11, budget=6000, starts=4, population=40
).settings()


def start(*arguments, folder):
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "3"}
    return subprocess.Popen(
        [sys.executable, "-m", *arguments],
        cwd=folder,
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


@pytest.fixture
def cluster(tmp_path):
    """The scheduler's address; its process and those of two workers."""
    file = tmp_path / "scheduler.json"
    scheduler = ("distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard")
    worker = ("distributed.cli.dask_worker", "--host", "127.0.0.1", "--no-dashboard", "--no-nanny", "--nthreads", "1")
    processes = [start(*scheduler, "--scheduler-file", str(file), folder=tmp_path)]
    try:
        # A worker waits for the scheduler's file itself.
        processes += [start(*worker, "--scheduler-file", str(file), folder=tmp_path) for _ in range(2)]
        for _ in range(600):
            if file.exists() and file.stat().st_size:
                break
            with pytest.raises(subprocess.TimeoutExpired):
                processes[0].wait(0.1)
        yield json.loads(file.read_text())["address"], processes
    finally:
        for process in reversed(processes):
            process.kill()
            process.wait()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_a_worker_that_is_killed_in_mid_search_loses_nothing_but_time(cluster):
    address, (_, *workers) = cluster
    alone = SearchRun(SearchStatus.beginning(SETTINGS), InProcess()).run()
    dask = DaskCluster(address)
    dask.wait_for_workers(2, 60.0)
    seen = []

    def progressed(status):
        seen.append((status.finished_starts, dask.worker_count))
        if len(seen) == 2:
            workers[0].send_signal(signal.SIGKILL)

    try:
        spread = SearchRun(SearchStatus.beginning(SETTINGS), dask, progressed).run()
        assert dask.worker_count == 1
    finally:
        dask.close()
    assert workers[0].poll() == -signal.SIGKILL
    assert seen[1] == (0, 2), "the worker was killed before any start was finished"
    for one, other in zip(alone.starts, spread.starts, strict=True):
        assert one.best.variables == other.best.variables
        assert one.best.terms == other.best.terms
        assert (one.seed, one.evaluations, one.improvements) == (other.seed, other.evaluations, other.improvements)
    assert alone.best.objective == spread.best.objective


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_a_scheduler_that_is_killed_ends_the_search_with_what_was_found(cluster):
    address, processes = cluster
    dask = DaskCluster(address)
    dask.wait_for_workers(2, 60.0)
    run = SearchRun(SearchStatus.beginning(SETTINGS), dask, lambda _: processes[0].kill())
    try:
        with pytest.raises(WorkersLostError, match=f"--dask {address}: "):
            run.run()
    finally:
        dask.close()
    assert run.status.best is not None
    assert not run.status.is_finished


@pytest.mark.slow
def test_an_address_where_nobody_answers():
    with pytest.raises(GatewayError, match=r"--dask tcp://127\.0\.0\.1:9: no scheduler answers"):
        DaskCluster("tcp://127.0.0.1:9", timeout_s=1)
