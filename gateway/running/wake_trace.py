"""Every late wake, whether a deadline was missed or not: what the kernel knows of the time that the loop did not have.

One cheap read a cycle (the thread's own figures), two dear ones, of files in /proc, only after a late wake. What is
found is collected, and told in a sentence at most once a second. Why deadlines were missed is kept by
``gateway.running.late_account``, always; this is the closer look that ``bus.trace_lateness`` asks for.
"""

import os
import resource
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

LATE_SHARE: Final = 0.1
"""A wake counts as late from this share of the cycle on."""
LEAST_LATE_NS: Final = 100_000
TELL_EVERY_NS: Final = 1_000_000_000
_STAT_BYTES: Final = 512
_STEAL_COLUMN: Final = 8


@dataclass(frozen=True, slots=True)
class ThreadFigures:
    """What the kernel has counted for the loop's thread so far."""

    involuntary_switches: int
    """How often the processor was taken from it."""
    minor_faults: int
    major_faults: int


def read_thread() -> ThreadFigures:
    """The calling thread's figures."""
    usage = resource.getrusage(resource.RUSAGE_THREAD)
    return ThreadFigures(usage.ru_nivcsw, usage.ru_minflt, usage.ru_majflt)


def read_steal_ns(path: Path = Path("/proc/stat")) -> int | None:
    """Time for which the host has run something else on this machine's processors; None where nobody tells."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        try:
            line = os.read(descriptor, _STAT_BYTES).split(b"\n", 1)[0].split()
        finally:
            os.close(descriptor)
        return int(line[_STEAL_COLUMN]) * (1_000_000_000 // os.sysconf("SC_CLK_TCK"))
    except (OSError, ValueError, IndexError):
        return None


def read_waited_ns(path: Path = Path("/proc/thread-self/schedstat")) -> int | None:
    """Time for which the calling thread was ready and had to wait for a processor; None where nobody tells."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        try:
            return int(os.read(descriptor, _STAT_BYTES).split()[1])
        finally:
            os.close(descriptor)
    except (OSError, ValueError, IndexError):
        return None


class WakeTrace:
    """Notes late wakes and their causes."""

    def __init__(
        self,
        period_ns: int,
        tell: Callable[[str, dict[str, int]], None],
        *,
        thread: Callable[[], ThreadFigures] = read_thread,
        steal_ns: Callable[[], int | None] = read_steal_ns,
        waited_ns: Callable[[], int | None] = read_waited_ns,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """``tell`` gets a sentence about all late wakes since the last one, and their figures."""
        self._limit_ns = max(round(period_ns * LATE_SHARE), LEAST_LATE_NS)
        self._tell = tell
        self._thread = thread
        self._steal_ns = steal_ns
        self._waited_ns = waited_ns
        self._clock = clock
        self._before = thread()
        self._steal_before_ns = steal_ns()
        self._waited_before_ns = waited_ns()
        self._told_ns = clock() - TELL_EVERY_NS
        self._late = self._unexplained = self._switches = self._faults = self._stolen_ns = 0
        self._queued_ns = 0
        """Waiting for a processor, between late wakes too."""
        self._worst_ns = self._worst_cycle = 0

    def woke(self, cycle: int, lateness_ns: int) -> None:
        """The loop woke so late for the cycle after number ``cycle``."""
        now = self._thread()
        if lateness_ns >= self._limit_ns:
            self._note(cycle, lateness_ns, now)
        self._before = now

    def tell(self) -> None:
        """Tell what has not been told yet, if it is time to."""
        if self._late and self._clock() - self._told_ns >= TELL_EVERY_NS:
            self.flush()

    def flush(self) -> None:
        """Tell what has not been told yet."""
        if not self._late:
            return
        causes: list[str] = []
        if self._switches:
            causes.append(f"the processor taken away {self._switches} times")
        if self._queued_ns:
            causes.append(f"{self._queued_ns / 1000:.0f} us of waiting for a processor")
        if self._stolen_ns:
            causes.append(f"{self._stolen_ns / 1e6:.0f} ms stolen by the host")
        if self._faults:
            causes.append(f"{self._faults} page faults")
        if self._unexplained:
            causes.append(f"no cause seen for {self._unexplained}: interrupts, or a timer that was late")
        text = f"{self._late} late wakes, the worst {self._worst_ns / 1000:.0f} us at cycle {self._worst_cycle}: "
        figures = {
            "late": self._late,
            "unexplained": self._unexplained,
            "involuntary_switches": self._switches,
            "page_faults": self._faults,
            "waited_us": self._queued_ns // 1000,
            "stolen_us": self._stolen_ns // 1000,
            "worst_us": self._worst_ns // 1000,
        }
        self._tell(text + ", ".join(causes), figures)
        self._told_ns = self._clock()
        self._late = self._unexplained = self._switches = self._faults = self._stolen_ns = 0
        self._worst_ns = self._queued_ns = 0

    def _note(self, cycle: int, lateness_ns: int, now: ThreadFigures) -> None:
        before = self._before
        switches = now.involuntary_switches - before.involuntary_switches
        faults = now.minor_faults + now.major_faults - before.minor_faults - before.major_faults
        steal_ns = self._steal_ns()
        stolen_ns = 0
        if steal_ns is not None and self._steal_before_ns is not None:
            stolen_ns = steal_ns - self._steal_before_ns
        self._steal_before_ns = steal_ns
        waited_ns = self._waited_ns()
        if waited_ns is not None and self._waited_before_ns is not None:
            queued_ns = waited_ns - self._waited_before_ns
        else:
            queued_ns = 0
        self._waited_before_ns = waited_ns
        self._queued_ns += queued_ns
        self._late += 1
        self._switches += switches
        self._faults += faults
        self._stolen_ns += stolen_ns
        self._unexplained += not (switches or faults or stolen_ns or queued_ns >= self._limit_ns)
        if lateness_ns > self._worst_ns:
            self._worst_ns, self._worst_cycle = lateness_ns, cycle
