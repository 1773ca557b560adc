"""Keeps the account of late demands: what the kernel tells of the loop's time, gathered where something was late.

In time, one small read a cycle: how long the thread has waited for a processor so far. All the rest is read only after
a spell of being awake that took longer than usual, and told where the loop has time for it: a second apart, and a
bounded number of single demands, so that a run that is always late is not made later by telling so.
"""

import os
import resource
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Final

from gateway.cyclic.cycle import CyclicLoop
from gateway.cyclic.lateness import CycleShape, Late, Spell, explain
from gateway.record.lateness import (
    LATE_ACCOUNT_KIND,
    LATE_DEMAND_KIND,
    OUTSIDE,
    Cause,
    Explanation,
    LateAccount,
    LateKind,
)
from gateway.running.wake_trace import WakeTrace

LONG_SHARE: Final = 0.25
"""A spell of so large a part of the cycle is looked at."""
NO_REST_SHARE: Final = 0.03
"""A wait that ends within this part of the cycle was none."""
COARSE_NS: Final = 50_000
"""A processor clock that goes in steps larger than this cannot tell who had a part of a cycle."""
TELL_EVERY_NS: Final = 1_000_000_000
TELL_DEMAND_EVERY_NS: Final = 50_000_000
MAX_TOLD: Final = 1000
"""Late demands told one by one in a run."""
MAX_PENDING: Final = 64
_MAX_QUEUED: Final = 64
_STAT_BYTES: Final = 96

Tell = Callable[[int, str, str, dict[str, str | int | bool]], None]
"""Instant, kind, sentence and data of an event."""
Shares = tuple[tuple[Cause, int], ...]


class ThreadCounters:
    """``/proc/thread-self/schedstat`` of the thread that makes it, held open: a read costs less than a microsecond."""

    def __init__(self, path: Path = Path("/proc/thread-self/schedstat")) -> None:
        """Raises OSError where the kernel keeps no such account."""
        self._descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)

    def __call__(self) -> bytes:
        """Processor time, time ready without a processor (both ns), and how often it was given one; as text."""
        return os.pread(self._descriptor, _STAT_BYTES, 0)

    def close(self) -> None:
        """Let the file go."""
        os.close(self._descriptor)


def open_counters() -> ThreadCounters | None:
    """The calling thread's; None where the kernel keeps none."""
    try:
        return ThreadCounters()
    except OSError:
        return None


def is_processor_clock_fine(
    processor_ns: Callable[[], int] = time.thread_time_ns, clock: Callable[[], int] = time.monotonic_ns
) -> bool:
    """Whether the thread's processor clock goes in steps small against a cycle; computes until it has gone on one."""
    last_ns = processor_ns()
    begin_ns = clock()
    while (now_ns := processor_ns()) == last_ns:
        if clock() - begin_ns > 4 * COARSE_NS:
            return False
    return now_ns - last_ns <= COARSE_NS


def major_faults() -> int:
    """Of the calling thread, so far."""
    return resource.getrusage(resource.RUSAGE_THREAD).ru_majflt


class _Pending:
    """A late demand of which not everything is known yet."""

    __slots__ = ("carried", "handed_ns", "late", "sent_ns", "spell")

    def __init__(
        self, late: Late, sent_ns: int | None, spell: Spell | None, carried: Shares, handed_ns: int | None
    ) -> None:
        self.late = late
        self.sent_ns = sent_ns
        self.spell = spell
        self.carried = carried
        self.handed_ns = handed_ns
        """When it had been handed to the bus; None: in the spell that goes on."""


class LateAccountant:
    """Watches one loop; see ``gateway.running.cycle_host.LateWatch``."""

    def __init__(
        self,
        period_ns: int,
        tell: Tell,
        *,
        is_echoed: bool = False,
        is_fine: bool = True,
        trace: WakeTrace | None = None,
        counters: Callable[[], bytes] | None = None,
        processor_ns: Callable[[], int] = time.thread_time_ns,
        faults: Callable[[], int] = major_faults,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """``is_echoed``: the bus says when a demand was on it. ``is_fine``: see ``is_processor_clock_fine``.

        ``counters``: see ``ThreadCounters``; None where there are none, and with a clock that is not fine.
        """
        self.account = LateAccount()
        self._period_ns = period_ns
        self._long_ns = round(period_ns * LONG_SHARE)
        self._tell = tell
        self._is_echoed = is_echoed
        self._is_fine = is_fine
        self._trace = trace
        self._counters = counters if is_fine else None
        self._processor_ns = processor_ns
        self._faults = faults
        self._clock = clock
        self._loop: CyclicLoop | None = None
        self._phase_ns: Callable[[], int] = int
        # The sleep before this spell, and the spell so far
        self._rest_ns = self._planned_ns = self._woke_ns = clock()
        self._stale_ns = self._ready_at_wake_ns = self._bus_ns = self._refusals = 0
        self._counters_before = b"" if self._counters is None else self._counters()
        self._processor_before_ns = processor_ns() if is_fine else 0
        self._before_wait: tuple[int, int, int, int, int, int, int, bytes, int] | None = None
        self._faults_before = faults()
        self._looked: Spell | None = None
        """The long spell that ended last, in cycle ``_looked_cycle``."""
        self._looked_cycle = self._closed_cycle = -1
        self._stale_cycle = -2
        """The SYNC after this one was given an instant that is not the kernel's."""
        self._handed_ns = 0
        """When the loop rested after the demand of cycle ``_closed_cycle``."""
        self._pending: list[_Pending] = []
        self._queue: list[Explanation] = []
        self._told = 0
        self._is_news = False
        self._told_ns = self._demand_told_ns = clock() - TELL_EVERY_NS

    # -- what the host says ------------------------------------------------------------------------------------------

    def follow(self, loop: CyclicLoop, phase_ns: Callable[[], int]) -> None:
        """See ``gateway.running.cycle_host.LateWatch``."""
        self._loop = loop
        self._phase_ns = phase_ns

    def rests(self, now_ns: int, until_ns: int) -> None:
        """See ``gateway.running.cycle_host.LateWatch``."""
        loop = self._loop
        if loop is None:
            return
        if self._pending or now_ns - self._planned_ns > self._long_ns:
            self._look(now_ns, loop.cycle)
        if loop.is_closed and loop.cycle != self._closed_cycle:
            self._closed_cycle = loop.cycle
            self._handed_ns = now_ns
        self._rest_ns = now_ns
        self._planned_ns = until_ns
        self._bus_ns = self._refusals = 0
        if self._counters is not None:
            self._counters_before = self._counters()
        if self._is_fine:
            self._processor_before_ns = loop.processor_read_ns
        else:
            self._stale_ns = self._clock() - now_ns

    def waits(self, now_ns: int, until_ns: int) -> None:
        """See ``gateway.running.cycle_host.LateWatch``."""
        self._before_wait = (
            self._rest_ns, self._planned_ns, self._woke_ns, self._stale_ns, self._ready_at_wake_ns, self._bus_ns,
            self._refusals, self._counters_before, self._processor_before_ns,
        )  # fmt: skip
        self.rests(now_ns, until_ns)

    def woke(self, cycle: int, woke_ns: int) -> None:
        """See ``gateway.running.cycle_host.LateWatch``."""
        self._woke_ns = woke_ns
        late_ns = woke_ns - self._planned_ns
        self._ready_at_wake_ns = self._ready_so_far_ns() if late_ns > self._long_ns else 0
        if self._trace is not None:
            self._trace.woke(cycle, max(0, late_ns))

    def roused(self, woke_ns: int) -> None:
        """See ``gateway.running.cycle_host.LateWatch``."""
        if self._before_wait is not None and self._has_not_waited(woke_ns - self._rest_ns):
            (
                self._rest_ns, self._planned_ns, self._woke_ns, self._stale_ns, self._ready_at_wake_ns, self._bus_ns,
                self._refusals, self._counters_before, self._processor_before_ns,
            ) = self._before_wait  # fmt: skip
            return
        self._woke_ns = woke_ns
        self._ready_at_wake_ns = self._ready_so_far_ns()
        if woke_ns < self._planned_ns:
            # Called by a frame: the time for which it was ready then is all that it can have come too late.
            self._planned_ns = woke_ns - self._ready_at_wake_ns

    def sync_is_stale(self) -> None:
        """See ``gateway.running.cycle_host.LateWatch``."""
        self._stale_cycle = -1 if self._loop is None else self._loop.cycle

    def was_refused(self, span_ns: int) -> None:
        """See ``gateway.running.cycle_host.LateWatch``."""
        self._bus_ns += span_ns
        self._refusals += 1

    # -- what the loop says ------------------------------------------------------------------------------------------

    def missed(self, late: Late) -> None:
        """See ``gateway.cyclic.cycle.LateListener``."""
        if late.kind is LateKind.OVERRUN and late.is_paced:
            by_ns = max(1, (late.sent_ns or 0) - late.deadline_ns)
            self._count(Explanation(late.kind, late.cycle, late.deadline_ns, by_ns, ((Cause.SYNC_IRREGULAR, by_ns),)))
            return
        if late.is_lost:
            shares = ((Cause.BUS_FULL, self._period_ns),)
            self._count(Explanation(late.kind, late.cycle, late.deadline_ns, self._period_ns, shares))
            return
        if len(self._pending) >= MAX_PENDING:
            self._look(self._clock(), -1)
        is_earlier = late.is_paced and late.sent_ns is not None and self._closed_cycle == late.cycle
        looked = self._looked if self._looked_cycle == late.cycle else None
        # A loop that sends SYNC itself may have been late with that one already.
        carried = () if late.is_paced or looked is None else self._why_sync_was_late(late, looked)
        sent_ns = None if self._is_echoed and late.is_paced else late.sent_ns
        if self._stale_cycle >= late.cycle - 1:
            late = replace(late, is_paced=False)
        if is_earlier:
            self._pending.append(_Pending(late, sent_ns, looked, carried, self._handed_ns))
        else:
            self._pending.append(_Pending(late, sent_ns, None, carried, None))

    def demand_is_out(self, at_ns: int) -> None:
        """See ``gateway.cyclic.cycle.LateListener``."""
        for pending in self._pending:
            if pending.sent_ns is None:
                pending.sent_ns = at_ns
                return

    # -- what is made of it ------------------------------------------------------------------------------------------

    def tell(self) -> None:
        """Tell at most one event, if it is time for one; called where the loop has nothing more urgent to do."""
        if not self._is_news and self._trace is None and not self._pending:
            return
        now_ns = self._clock()
        if self._pending and now_ns - self._told_ns >= TELL_EVERY_NS:
            # A loop that is always late never rests, and is told of all the same.
            self._look(now_ns, -1)
        if self._is_news and now_ns - self._told_ns >= TELL_EVERY_NS:
            self._tell_account(now_ns)
        elif self._queue and now_ns - self._demand_told_ns >= TELL_DEMAND_EVERY_NS:
            self._demand_told_ns = now_ns
            self._tell_demand()
        elif self._trace is not None:
            self._trace.tell()

    def flush(self) -> None:
        """Tell what has not been told yet, and the account as it stands at the end of the run."""
        now_ns = self._clock()
        if self._pending:
            self._look(now_ns, -1)
        while self._queue:
            self._tell_demand()
        self._tell_account(now_ns)
        if self._trace is not None:
            self._trace.flush()

    def _has_not_waited(self, span_ns: int) -> bool:
        """Whether what the loop had asked for was there at once, whoever took the processor meanwhile."""
        if self._counters is not None:
            before, now = self._counters_before.split(), self._counters().split()
            if now[2] == before[2]:
                return True
            span_ns -= int(now[1]) - int(before[1])
        return span_ns < NO_REST_SHARE * self._period_ns

    def _ready_so_far_ns(self) -> int:
        """Ready without a processor since the last rest began."""
        if self._counters is None:
            return 0
        return max(0, int(self._counters().split()[1]) - int(self._counters_before.split()[1]))

    def _look(self, now_ns: int, cycle: int) -> None:
        """A spell that took long, or was of something late, is over."""
        ready_ns, switches = None, 0
        processor_ns = self._processor_ns() - self._processor_before_ns if self._is_fine else None
        if self._counters is not None:
            before, now = self._counters_before.split(), self._counters().split()
            ready_ns = max(0, int(now[1]) - int(before[1]))
            # One for the wake itself, one for each wait for the bus.
            switches = max(0, int(now[2]) - int(before[2]) - 1 - self._refusals)
        faults = self._faults()
        spell = Spell(
            planned_ns=self._planned_ns,
            woke_ns=self._woke_ns,
            end_ns=now_ns,
            stale_ns=self._stale_ns,
            processor_ns=processor_ns,
            ready_ns=ready_ns,
            ready_at_wake_ns=self._ready_at_wake_ns,
            extra_switches=switches,
            major_faults=faults - self._faults_before,
            bus_ns=self._bus_ns,
        )
        self._faults_before = faults
        if self._pending:
            self._settle(now_ns, spell)
        self._looked, self._looked_cycle = spell, cycle

    def _settle(self, now_ns: int, spell: Spell | None) -> None:
        for pending in self._pending:
            # A demand that nobody has seen on the bus is not there before now.
            sent_ns = now_ns if pending.sent_ns is None else pending.sent_ns
            handed_ns, its_spell = pending.handed_ns, pending.spell
            if handed_ns is None:
                handed_ns, its_spell = now_ns, spell
            phase_ns = 0 if pending.late.kind is LateKind.OVERRUN else self._phase_ns()
            cycle = CycleShape(self._period_ns, phase_ns, handed_ns)
            self._count(explain(pending.late, sent_ns, its_spell, cycle, pending.carried))
        self._pending.clear()

    def _why_sync_was_late(self, late: Late, spell: Spell) -> Shares:
        """Causes, none of them the loop's, of which the loop's own SYNC was late."""
        # A SYNC that is whole cycles late leaves as much of its own cycle as if it were late by the rest alone.
        short_ns = self._period_ns - (late.deadline_ns - late.sync_ns)
        if short_ns <= 0:
            return ()
        due_ns = late.sync_ns - short_ns
        own_sync = Late(LateKind.OVERRUN, late.cycle, due_ns, due_ns, late.sync_ns, False, 0, None)
        told = explain(own_sync, late.sync_ns, spell, CycleShape(self._period_ns, 0, late.sync_ns))
        return tuple((cause, span_ns) for cause, span_ns in told.shares_ns if cause in OUTSIDE)

    def _count(self, explanation: Explanation) -> None:
        self.account.add(explanation)
        self._is_news = True
        queue = self._queue
        if len(queue) >= _MAX_QUEUED:
            least = min(range(len(queue)), key=lambda number: queue[number].missed_by_ns)
            if queue[least].missed_by_ns >= explanation.missed_by_ns:
                return
            del queue[least]
        queue.append(explanation)

    def _tell_demand(self) -> None:
        explanation = self._queue.pop(0)
        if self._told < MAX_TOLD:
            self._told += 1
            self._tell(explanation.deadline_ns, LATE_DEMAND_KIND, explanation.sentence(), explanation.to_event())

    def _tell_account(self, now_ns: int) -> None:
        self._told_ns = now_ns
        self._is_news = bool(self._queue)
        text = f"RPDO deadlines missed so far: {self.account.verdict()}"
        self._tell(now_ns, LATE_ACCOUNT_KIND, text, {**self.account.to_event()})
