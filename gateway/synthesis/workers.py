"""Who runs the slices of a search: this process, processes beside it, or a dask cluster.

All three keep one promise: every slice handed in comes back, or `WorkersLostError` is raised. A worker that dies costs
the time of its slice and nothing else.
"""

import importlib
import multiprocessing
import signal
from collections.abc import Callable, Generator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from typing import Any, Final, Protocol

from gateway.errors import GatewayError, UsageError
from gateway.synthesis.search_slice import SearchSlice, SliceResult, run_slice

MAXIMUM_WORKERS: Final = 256
MAXIMUM_RESTARTS: Final = 5
CONNECT_TIMEOUT_S: Final = 10
"""How long a dask scheduler may take to answer at first."""
CLOSE_TIMEOUT_S: Final = 3


class WorkersLostError(GatewayError):
    """There is nobody left to run slices."""


class Workers(Protocol):
    """Slices in, results out, in whatever order they are done."""

    @property
    def capacity(self) -> int:
        """How many slices to hand in at once."""
        ...

    def submit(self, wanted: SearchSlice) -> None:
        """Hand in a slice."""
        ...

    def collect(self, timeout_s: float) -> list[SliceResult]:
        """What has been done; waits for at most so long for the first.

        Raises WorkersLostError and what a slice raised.
        """
        ...

    def close(self) -> None:
        """Let everybody go; what was handed in and not collected is given up."""
        ...


class InProcess:
    """No other process: `collect` runs one slice."""

    def __init__(self) -> None:
        self._waiting: list[SearchSlice] = []

    @property
    def capacity(self) -> int:
        """One."""
        return 1

    def submit(self, wanted: SearchSlice) -> None:
        """See `Workers`."""
        self._waiting.append(wanted)

    def collect(self, timeout_s: float) -> list[SliceResult]:
        """See `Workers`."""
        return [run_slice(self._waiting.pop(0))] if self._waiting else []

    def close(self) -> None:
        """See `Workers`."""
        self._waiting.clear()


def _leave_signals_to_the_parent() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)


class LocalProcesses:
    """A pool of processes on this machine; a pool that one of its processes broke by dying is made anew."""

    def __init__(self, count: int) -> None:
        if not 1 <= count <= MAXIMUM_WORKERS:
            raise UsageError(f"--workers {count}, bound 1 to {MAXIMUM_WORKERS}")
        self._count = count
        self._restarts = 0
        self._pool = self._new_pool()
        self._running: dict[Future[SliceResult], SearchSlice] = {}

    def _new_pool(self) -> ProcessPoolExecutor:
        context = multiprocessing.get_context("spawn")
        return ProcessPoolExecutor(self._count, mp_context=context, initializer=_leave_signals_to_the_parent)

    @property
    def capacity(self) -> int:
        """As many as there are processes."""
        return self._count

    @property
    def process_ids(self) -> list[int]:
        """The processes' ids."""
        processes: Any = getattr(self._pool, "_processes", None) or {}
        return [int(number) for number in processes]

    def submit(self, wanted: SearchSlice) -> None:
        """See `Workers`."""
        try:
            self._running[self._pool.submit(run_slice, wanted)] = wanted
        except BrokenProcessPool:
            self._restart([wanted])

    def collect(self, timeout_s: float) -> list[SliceResult]:
        """See `Workers`."""
        done, _ = wait(self._running, timeout_s, FIRST_COMPLETED)
        results: list[SliceResult] = []
        lost: list[SearchSlice] = []
        for future in done:
            handed = self._running.pop(future)
            try:
                results.append(future.result())
            except BrokenProcessPool:
                lost.append(handed)
        if lost:
            self._restart(lost)
        return results

    def _restart(self, lost: list[SearchSlice]) -> None:
        self._restarts += 1
        if self._restarts > MAXIMUM_RESTARTS:
            raise WorkersLostError(f"worker processes have died {self._restarts} times")
        lost += self._running.values()
        self._running.clear()
        self._pool.shutdown(wait=False, cancel_futures=True)
        self._pool = self._new_pool()
        for wanted in lost:
            self.submit(wanted)

    def close(self) -> None:
        """See `Workers`."""
        self._running.clear()
        self._pool.shutdown(wait=True, cancel_futures=True)


class DaskCluster:
    """The workers of a dask scheduler; the scheduler hands a dead worker's slices to another one."""

    def __init__(self, address: str, timeout_s: float = CONNECT_TIMEOUT_S) -> None:
        if not address.startswith(("tcp://", "tls://")):
            raise UsageError(f"--dask {address[:80]}: an address looks like tcp://127.0.0.1:8786")
        try:
            self._distributed: Any = importlib.import_module("distributed")
        except ImportError:
            raise UsageError("--dask needs distributed (pip install 'drive-gateway[dask]')") from None
        try:
            self._client: Any = self._distributed.Client(
                address, timeout=timeout_s, set_as_default=False, direct_to_workers=False
            )
        except (OSError, ValueError, TimeoutError) as error:
            raise GatewayError(f"--dask {address}: no scheduler answers ({str(error)[:120]})") from None
        self._address = address
        self._running: dict[Any, SearchSlice] = {}
        self._deaths = 0

    @property
    def worker_count(self) -> int:
        """How many workers the cluster has."""
        return len(self._client.nthreads())

    def wait_for_workers(self, count: int, timeout_s: float) -> None:
        """Wait until the cluster has so many workers. Raises WorkersLostError."""
        try:
            self._client.wait_for_workers(count, timeout_s)
        except TimeoutError:
            raise WorkersLostError(f"--dask {self._address}: fewer than {count} workers") from None

    @property
    def capacity(self) -> int:
        """Two slices a thread of the cluster, so that none has to wait for the next."""
        with self._answered():
            threads: dict[str, int] = self._client.nthreads()
        return max(2 * sum(threads.values()), 1)

    @contextmanager
    def _answered(self) -> Generator[None]:
        try:
            yield
        except TimeoutError:
            raise
        except (OSError, self._distributed.CancelledError) as error:
            reason = str(error) or type(error).__name__
            raise WorkersLostError(f"--dask {self._address}: the scheduler is gone ({reason[:120]})") from None

    def submit(self, wanted: SearchSlice) -> None:
        """See `Workers`."""
        with self._answered():
            self._running[self._client.submit(run_slice, wanted, pure=False)] = wanted

    def collect(self, timeout_s: float) -> list[SliceResult]:
        """See `Workers`."""
        if not self._running:
            return []
        try:
            with self._answered(), self._client.as_current():
                done: Any = self._distributed.wait(list(self._running), timeout_s, "FIRST_COMPLETED").done
        except self._distributed.TimeoutError:
            return self._nothing_yet()
        return [result for future in done if (result := self._result(future)) is not None]

    def _nothing_yet(self) -> list[SliceResult]:
        if self._client.status != "running":
            raise WorkersLostError(f"--dask {self._address}: the scheduler is gone")
        return []

    def _result(self, future: Any) -> SliceResult | None:
        handed = self._running.pop(future)
        try:
            return future.result()
        except (self._distributed.KilledWorker, self._distributed.CancelledError, OSError) as error:
            self._deaths += 1
            if self._deaths > MAXIMUM_RESTARTS or self._client.status != "running":
                reason = str(error).partition("\n")[0] or type(error).__name__
                raise WorkersLostError(f"--dask {self._address}: {reason[:160]}") from None
            self.submit(handed)
            return None

    def close(self) -> None:
        """See `Workers`."""
        with suppress(OSError, self._distributed.CancelledError):
            for future in self._running:
                future.cancel()
            self._client.close(timeout=CLOSE_TIMEOUT_S)
        self._running.clear()


def make_workers(count: int, dask_address: str | None) -> Callable[[], Workers]:
    """What makes the workers asked for. Raises UsageError for both at once or a bad number."""
    if dask_address is not None:
        if count != 1:
            raise UsageError("--workers and --dask exclude each other: the cluster has its own workers")
        return lambda: DaskCluster(dask_address)
    if not 1 <= count <= MAXIMUM_WORKERS:
        raise UsageError(f"--workers {count}, bound 1 to {MAXIMUM_WORKERS}")
    return InProcess if count == 1 else lambda: LocalProcesses(count)
