"""Why one demand was late: decided from what was seen in that very cycle; a core without I/O.

Between the instant for which the loop had planned to wake, and the demand on the bus, every nanosecond is somebody's:

    late by = not running + bus + drives + SYNC + (own processor time - own share of the cycle)

where the own share is what is left of a cycle after the phase at which the loop wakes. So a demand is late by no more
than the first four, which are not the loop's, exactly when the loop's own processor time stayed within its share. What
of "not running" the kernel's own counters do not account for is not counted as anybody else's.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from gateway.record.lateness import Cause, Explanation, LateKind


@dataclass(frozen=True, slots=True)
class Late:
    """What the cycle itself knows of a demand (or SYNC) that was late."""

    kind: LateKind
    cycle: int
    sync_ns: int
    """SYNC(k)."""
    deadline_ns: int
    """SYNC(k+1)."""
    sent_ns: int | None
    """When the demand was on the bus; None while it is not known."""
    is_paced: bool
    """SYNC is sent by somebody else, at instants that are not the loop's doing."""
    deviation_ns: int
    """SYNC(k) against its ideal instant."""
    tpdo_ns: int | None
    """Last TPDO after SYNC(k); None where one is missing."""
    is_lost: bool = False
    """The demand never was on the bus: the controller was bus-off."""
    own_ns: int = 0
    """Processor time of the loop from account to account, so for this cycle; 0 where nobody measures it."""


@dataclass(frozen=True, slots=True)
class Spell:
    """One spell of the loop being awake, and the sleep before it; spans in ns."""

    planned_ns: int
    """When it was to wake."""
    woke_ns: int
    end_ns: int
    stale_ns: int
    """From the reading of the clock that the sleep was worked out from, until it began: the loop's own time."""
    processor_ns: int | None
    """The thread's own processor time since before the sleep; None where the kernel's clock for it is too coarse."""
    ready_ns: int | None
    """Ready and without a processor since before the sleep; None where nobody tells."""
    ready_at_wake_ns: int
    """Of this, what had passed when the loop woke; 0 where it woke in time."""
    extra_switches: int
    """How often the processor was given away or taken since the loop woke."""
    major_faults: int
    bus_ns: int
    """Waiting for a bus that was full."""


@dataclass(frozen=True, slots=True)
class Evidence:
    """What the table below is asked about; spans in ns."""

    off_ns: int = 0
    """Not running since the planned wake."""
    own_excess_ns: int = 0
    """Own processor time beyond the own share of one cycle."""
    own_overload_ns: int = 0
    """Own processor time beyond the own share of this very cycle, or of all of the spell's together."""
    late_wake_ns: int = 0
    """Of ``off_ns``, what had passed when the loop woke, and not been spent on waiting for a processor."""
    ready_ns: int = 0
    """Ready and without a processor."""
    extra_switches: int = 0
    """How often the processor was given away or taken since the loop woke."""
    major_faults: int = 0
    bus_ns: int = 0
    """From the demand's being offered to the bus until it was there."""
    drives_ns: int = 0
    """Waiting for TPDOs beyond the phase."""
    sync_ns: int = 0
    """By how much SYNC(k) was early, and the cycle too short."""

    @property
    def awake_off_ns(self) -> int:
        """Of ``off_ns``, what neither a wait for a processor nor a late wake accounts for."""
        return max(0, self.off_ns - min(self.ready_ns, self.off_ns) - self.late_wake_ns)


def _woken_late(seen: Evidence) -> int:
    return min(seen.late_wake_ns, seen.off_ns - min(seen.ready_ns, seen.off_ns))


def _stolen(seen: Evidence) -> int:
    return 0 if seen.extra_switches or seen.major_faults else seen.awake_off_ns


def _page_fault(seen: Evidence) -> int:
    return seen.awake_off_ns if seen.major_faults else 0


def _own_call(seen: Evidence) -> int:
    return seen.awake_off_ns if seen.extra_switches and not seen.major_faults else 0


TABLE: Final[tuple[tuple[Cause, Callable[[Evidence], int]], ...]] = (
    (Cause.OWN_WORK, lambda seen: seen.own_overload_ns),
    (Cause.ANOTHER_PROCESS, lambda seen: min(seen.ready_ns, seen.off_ns)),
    (Cause.SYNC_IRREGULAR, lambda seen: seen.sync_ns),
    (Cause.DRIVES_LATE, lambda seen: seen.drives_ns),
    (Cause.BUS_FULL, lambda seen: seen.bus_ns),
    (Cause.WOKEN_LATE, _woken_late),
    (Cause.STOLEN, _stolen),
    (Cause.PAGE_FAULT, _page_fault),
    (Cause.OWN_CALL, _own_call),
    (Cause.OWN_WORK, lambda seen: max(0, seen.own_excess_ns - seen.own_overload_ns)),
)
"""What each cause covers of the lateness, asked in this order; what none of them covers is not explained.

A loop that does too much is asked for its own work first: what once took its time would explain all the rest.
"""


@dataclass(frozen=True, slots=True)
class CycleShape:
    """The cycle that a demand was late in."""

    period_ns: int
    phase_ns: int
    """When after SYNC the loop wakes."""
    handed_ns: int
    """When its demand had been handed to the bus, at the latest."""


def explain(
    late: Late, sent_ns: int, spell: Spell | None, cycle: CycleShape, carried: tuple[tuple[Cause, int], ...] = ()
) -> Explanation:
    """Why ``late`` was late, its demand on the bus at ``sent_ns``.

    ``spell``: the one in which the demand was sent; None where that was short, and nothing worth a look.
    ``carried``: why the loop's own SYNC of this cycle was late.
    """
    missed_by_ns = max(1, sent_ns - late.deadline_ns)
    left_ns = missed_by_ns
    shares: dict[Cause, int] = {}
    seen = evidence(late, sent_ns, spell, cycle)
    found = dict(carried)
    for cause, test in TABLE:
        covered_ns = min(left_ns, test(seen) + found.pop(cause, 0))
        if covered_ns > 0:
            shares[cause] = shares.get(cause, 0) + covered_ns
            left_ns -= covered_ns
    if left_ns:
        shares[Cause.NOT_EXPLAINED] = left_ns
    return Explanation(late.kind, late.cycle, late.deadline_ns, missed_by_ns, tuple(shares.items()))


def evidence(late: Late, sent_ns: int, spell: Spell | None, cycle: CycleShape) -> Evidence:
    """What is seen of a late demand; see ``explain``."""
    period_ns, phase_ns = cycle.period_ns, cycle.phase_ns
    short_ns = max(0, period_ns - (late.deadline_ns - late.sync_ns)) if late.is_paced else 0
    before_ns = max(0, -late.deviation_ns) if late.is_paced else 0
    on_bus_ns = max(0, sent_ns - cycle.handed_ns)
    if spell is None:
        # It was handed over in time, for the SYNC that was expected.
        return Evidence(bus_ns=on_bus_ns, sync_ns=short_ns + before_ns)
    handed_ns = min(sent_ns, spell.end_ns)
    late_wake_ns = max(0, spell.woke_ns - spell.planned_ns)
    elapsed_ns = max(0, handed_ns - spell.planned_ns)
    awake_ns = max(0, handed_ns - max(spell.planned_ns, spell.woke_ns)) - spell.bus_ns
    # Where the clock is too coarse the loop is taken to have computed for as long as it was awake.
    own_ns = awake_ns + spell.stale_ns if spell.processor_ns is None else spell.processor_ns
    off_ns = max(0, elapsed_ns - own_ns - spell.bus_ns)
    if spell.ready_ns is None:
        # All that is certain without the kernel's counters: asleep it did not work.
        off_ns = min(off_ns, late_wake_ns)
    share_ns = period_ns - phase_ns
    cycles = -(-elapsed_ns // period_ns)
    # Later in its cycle than the phase, because SYNC was early, or because TPDOs were waited for.
    waited_ns = max(0, spell.planned_ns - late.sync_ns - phase_ns)
    early_ns = min(waited_ns, before_ns)
    drives_ns = waited_ns - early_ns
    if late.tpdo_ns is not None:
        drives_ns = min(drives_ns, max(0, late.tpdo_ns - late.sync_ns - phase_ns))
    return Evidence(
        off_ns=off_ns,
        own_excess_ns=0 if spell.processor_ns is None else max(0, own_ns - share_ns),
        own_overload_ns=0
        if spell.processor_ns is None
        else max(0, own_ns - share_ns * max(1, cycles), late.own_ns - share_ns),
        late_wake_ns=min(off_ns, max(0, late_wake_ns - spell.ready_at_wake_ns)),
        ready_ns=spell.ready_ns or 0,
        extra_switches=spell.extra_switches,
        major_faults=spell.major_faults,
        bus_ns=spell.bus_ns + on_bus_ns,
        drives_ns=drives_ns,
        sync_ns=short_ns + early_ns,
    )
