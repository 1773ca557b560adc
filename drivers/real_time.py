"""The real-time host: one thread that drives a core by the clock and a port, and what the system lends it for that."""

import ctypes
import gc
import logging
import os
import resource
import time
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Final

from drivers.bus_off import Restarter
from drivers.node import Event, Node
from drivers.node_runner import NodeRunner, RunStatistics
from drivers.ports import Port

MAX_WAIT_S: Final = 0.05
"""Longest sleep, and so the longest that ``stop`` goes unnoticed."""
RETRY_S: Final = 0.0002
"""When to offer a full bus its frames again: a frame of 8 bytes takes 135 us at 1 Mbit/s."""
MAX_FRAMES_PER_PASS: Final = 256

_PR_SET_TIMERSLACK: Final = 29
_MCL_CURRENT: Final = 1
_MCL_FUTURE: Final = 2
_CAP_IPC_LOCK: Final = 14


_log = logging.getLogger(__name__)


def run_node(
    node: Node,
    port: Port,
    stop: Callable[[], bool],
    on_event: Callable[[Event], None] | None = None,
    clock: Callable[[], int] = time.monotonic_ns,
    on_wake: Callable[[int, int], None] | None = None,
    restarter: Restarter | None = None,
) -> RunStatistics:
    """Drive ``node`` on ``port`` until ``stop()``, which is asked on every pass and at least every ``MAX_WAIT_S``.

    Deadlines are absolute and wakes are handed over with the time they were due (see NodeRunner); ``clock`` is the
    clock that ``port`` gives arrivals in. ``on_event`` gets the node's events, ``on_wake(due_ns, now_ns)`` tells how
    late a wake was. With a ``restarter`` a controller that goes bus-off comes back, as that says; meanwhile frames are
    lost.

    Raises:
        BusError: the bus has gone away; without a ``restarter`` also when the controller has gone bus-off.
        LivelockError: the node does not let the time go on.
    """
    transmit = port.send
    if restarter is not None:
        port.outlives_bus_off = True
        transmit = restarter.losing(port.send)
    runner = NodeRunner(node, transmit, clock(), on_event, on_wake)
    while not stop():
        if restarter is not None:
            for text in restarter.look(clock()):
                _log.warning("the CAN controller is bus-off: %s", text)
        # Read before the queue is emptied: every frame older than this instant is then handed over before its wakes.
        now_ns = clock()
        for _ in range(MAX_FRAMES_PER_PASS):
            received = port.receive()
            if received is None:
                runner.advance(now_ns)
                port.wait(wait_s(runner, clock()))
                break
            runner.deliver(*received, now_ns)
        if runner.has_backlog:
            runner.flush()
    return runner.statistics


def wait_s(runner: NodeRunner, now_ns: int) -> float:
    """How long a host may sleep at ``now_ns`` before ``runner`` needs it."""
    longest_s = RETRY_S if runner.has_backlog else MAX_WAIT_S
    next_wake_ns = runner.next_wake_ns
    if next_wake_ns is None:
        return longest_s
    return min(max(next_wake_ns - now_ns, 0) * 1e-9, longest_s)


class RealTimeFeature(Enum):
    """What the system can lend to a process that must be on time."""

    TIMER_SLACK = "timer slack"
    SCHEDULING = "SCHED_FIFO"
    LOCKED_MEMORY = "locked memory"
    FROZEN_GARBAGE = "frozen garbage collector"
    PROCESSOR = "processor of its own"
    IDLE_LATENCY = "short idle states"
    KERNEL_SYNC = "SYNC from the kernel"
    HARDWARE_STAMPS = "hardware timestamps"


@dataclass(frozen=True, slots=True)
class RealTimeSetting:
    """Whether a feature is on for this process, and why or why not, in a few words for the user."""

    feature: RealTimeFeature
    is_on: bool
    reason: str


def tighten_timers() -> RealTimeSetting:
    """Let the calling thread's sleeps end 1 ns late at most instead of the usual 50 us (prctl PR_SET_TIMERSLACK)."""
    try:
        failed = ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_TIMERSLACK, ctypes.c_ulong(1), 0, 0, 0)
    except (OSError, AttributeError):
        return RealTimeSetting(RealTimeFeature.TIMER_SLACK, False, "this system has no prctl")
    if failed:
        return RealTimeSetting(RealTimeFeature.TIMER_SLACK, False, os.strerror(ctypes.get_errno()))
    return RealTimeSetting(RealTimeFeature.TIMER_SLACK, True, "1 ns")


def try_realtime(priority: int = 80, processor: int | None = None) -> list[RealTimeSetting]:
    """Ask for all that keeps this process on time; what is refused is reported, never raised.

    Timer slack of 1 ns; SCHED_FIFO at ``priority`` (1 to 99), inherited by no child; all memory locked, present and
    future; ``processor`` alone, or the first isolated one; no idle state that takes long to wake from; and the objects
    that exist now taken out of the garbage collector's view.
    """
    return [
        tighten_timers(),
        _try_fifo(priority),
        _try_lock_memory(),
        _try_processor(processor),
        short_idle(),
        freeze_garbage(),
    ]


def isolated_processors(root: Path = Path("/sys/devices/system/cpu")) -> list[int]:
    """Processors that the scheduler leaves alone (isolcpus), as the kernel's ``root`` tells it."""
    try:
        text = (root / "isolated").read_text().strip()
        ranges = [part.partition("-") for part in text.split(",") if part]
        return [n for first, _, last in ranges for n in range(int(first), int(last or first) + 1)]
    except (OSError, ValueError):
        return []


def _try_processor(processor: int | None) -> RealTimeSetting:
    feature = RealTimeFeature.PROCESSOR
    isolated = isolated_processors()
    if processor is None and not isolated:
        return RealTimeSetting(feature, False, "no processor is isolated, and none is named")
    chosen = isolated[0] if processor is None else processor
    try:
        os.sched_setaffinity(0, {chosen})
    except (OSError, ValueError) as error:
        return RealTimeSetting(feature, False, f"processor {chosen} refused ({error})")
    shared = "" if chosen in isolated else ", which others use too"
    return RealTimeSetting(feature, True, f"processor {chosen}{shared}")


def short_idle(device: Path = Path("/dev/cpu_dma_latency")) -> RealTimeSetting:
    """Ask for a wake-up latency of 0 us; the request lasts as long as the file is open, so as this process."""
    feature = RealTimeFeature.IDLE_LATENCY
    try:
        descriptor = os.open(device, os.O_WRONLY | os.O_CLOEXEC)
    except FileNotFoundError:
        return RealTimeSetting(feature, False, f"this kernel has no {device}")
    except OSError as error:
        return RealTimeSetting(feature, False, f"{device}: {(error.strerror or str(error)).lower()}")
    try:
        os.write(descriptor, (0).to_bytes(4, "little"))
    except OSError as error:
        os.close(descriptor)
        return RealTimeSetting(feature, False, f"{device}: {(error.strerror or str(error)).lower()}")
    return RealTimeSetting(feature, True, "0 us")


def _try_fifo(priority: int) -> RealTimeSetting:
    feature = RealTimeFeature.SCHEDULING
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
    except PermissionError:
        return RealTimeSetting(feature, False, "not permitted; it needs CAP_SYS_NICE or an rtprio limit")
    except (OSError, ValueError, OverflowError) as error:
        return RealTimeSetting(feature, False, f"priority {priority} refused ({error})")
    except AttributeError:
        return RealTimeSetting(feature, False, "this system has no SCHED_FIFO")
    return RealTimeSetting(feature, True, f"priority {priority}")


def _try_lock_memory() -> RealTimeSetting:
    feature = RealTimeFeature.LOCKED_MEMORY
    limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    # Below a limit the lock itself may succeed, and every later allocation that passes the limit would then fail.
    if limit != resource.RLIM_INFINITY and not _may_lock_memory():
        return RealTimeSetting(feature, False, f"not permitted; the memlock limit is {limit // 1024} KiB")
    try:
        failed = ctypes.CDLL(None, use_errno=True).mlockall(_MCL_CURRENT | _MCL_FUTURE)
    except (OSError, AttributeError):
        return RealTimeSetting(feature, False, "this system has no mlockall")
    if failed:
        return RealTimeSetting(feature, False, os.strerror(ctypes.get_errno()))
    return RealTimeSetting(feature, True, "all pages")


def _may_lock_memory() -> bool:
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
        capabilities = next(int(line.split()[1], 16) for line in lines if line.startswith("CapEff:"))
    except (OSError, ValueError, IndexError, StopIteration):
        return False
    return bool(capabilities >> _CAP_IPC_LOCK & 1)


def freeze_garbage() -> RealTimeSetting:
    """Take all objects that exist now out of the garbage collector's view, so that its runs stay short."""
    gc.collect()
    gc.freeze()
    return RealTimeSetting(RealTimeFeature.FROZEN_GARBAGE, True, f"{gc.get_freeze_count()} objects")
