"""Why one demand was late: every row of the table, with the kernel's counters made up and the times worked by hand.

The cycle is 1 ms, the loop wakes 0.3 ms after SYNC, so its own share is 0.7 ms. SYNC(k) is at 0, SYNC(k+1) at 1 ms.
"""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.cyclic.lateness import TABLE, CycleShape, Late, Spell, explain
from gateway.record.lateness import OUTSIDE, Cause, LateKind

US = 1000
MS = 1_000_000
PHASE_NS = 300 * US
LATE = Late(LateKind.RPDO_DEADLINE, 7, 0, MS, None, True, 0, 250 * US)
QUIET = Spell(
    planned_ns=PHASE_NS,
    woke_ns=PHASE_NS,
    end_ns=PHASE_NS,
    stale_ns=0,
    processor_ns=0,
    ready_ns=0,
    ready_at_wake_ns=0,
    extra_switches=0,
    major_faults=0,
    bus_ns=0,
)


def told(spell, sent_us, late=LATE, handed_us=None, carried=()):
    handed_ns = sent_us * US if handed_us is None else handed_us * US
    return explain(late, sent_us * US, spell, CycleShape(MS, PHASE_NS, handed_ns), carried)


def spell(end_us, woke_us=300, processor_us=100, **values):
    spans = {name.removesuffix("_us") + "_ns": value * US for name, value in values.items() if name.endswith("_us")}
    counts = {name: value for name, value in values.items() if not name.endswith("_us")}
    processor_ns = None if processor_us is None else processor_us * US
    return replace(QUIET, woke_ns=woke_us * US, end_ns=end_us * US, processor_ns=processor_ns, **spans, **counts)


# In each row the demand is on the bus at 1.4 ms, 0.4 ms too late.
ROWS = {
    # Woke at 0.3, worked 0.1 ms, was kept from the processor for 1 ms.
    Cause.ANOTHER_PROCESS: (LATE, spell(1400, ready_us=1000, extra_switches=1), True),
    # Slept on to 1.3 ms, and was not ready before.
    Cause.WOKEN_LATE: (LATE, spell(1400, woke_us=1300, extra_switches=0), True),
    # 1.1 ms awake, of which the kernel says that 0.1 ms were its own and that it was never off the processor.
    Cause.STOLEN: (LATE, spell(1400), True),
    # SYNC(k+1) came 0.6 ms after SYNC(k): 0.4 ms were missing.
    Cause.SYNC_IRREGULAR: (replace(LATE, deadline_ns=600 * US), spell(1000, processor_us=700), True),
    # It waited for a TPDO until 0.9 ms; 0.5 ms of work then end at 1.4 ms.
    Cause.DRIVES_LATE: (replace(LATE, tpdo_ns=900 * US), spell(1400, 900, 500, planned_us=900), True),
    # Of 1.1 ms it waited 0.9 ms for a full buffer.
    Cause.BUS_FULL: (LATE, spell(1400, processor_us=200, bus_us=900), True),
    # Off the processor for 1 ms, with a page that had to come from the disk.
    Cause.PAGE_FAULT: (LATE, spell(1400, extra_switches=1, major_faults=1), False),
    # Off the processor for 1 ms by itself: nobody was ready in its place, no page, one switch more.
    Cause.OWN_CALL: (LATE, spell(1400, extra_switches=1), False),
    # 1.1 ms of work where 0.7 ms are its share.
    Cause.OWN_WORK: (LATE, spell(1400, processor_us=1100), False),
    # The kernel keeps no account of waiting for a processor.
    Cause.NOT_EXPLAINED: (LATE, replace(spell(1400), ready_ns=None), False),
}


def test_every_cause_has_a_row_here():
    assert list(ROWS) == [*(cause for cause in Cause if cause in ROWS)]
    assert set(ROWS) == set(Cause) == {cause for cause, _ in TABLE} | {Cause.NOT_EXPLAINED}


@pytest.mark.parametrize("cause", ROWS, ids=lambda cause: cause.value)
def test_each_cause_by_itself(cause):
    late, of_it, is_explained = ROWS[cause]
    sent_us = of_it.end_ns // US
    found = told(of_it, sent_us, late)
    assert found.shares_ns == ((cause, 400 * US),)
    assert found.missed_by_ns == 400 * US
    assert found.cause is cause
    assert found.is_explained is is_explained


def test_lateness_is_explained_only_as_far_as_it_was_seen():
    # 0.4 ms late: 0.3 ms without a processor, 0.8 ms of its own work, 0.1 ms more than its share.
    found = told(spell(1400, processor_us=800, ready_us=300, extra_switches=1), 1400)
    assert found.shares_ns == ((Cause.ANOTHER_PROCESS, 300 * US), (Cause.OWN_WORK, 100 * US))
    assert not found.is_explained
    assert found.cause is Cause.OWN_WORK
    # The same with work within its share.
    found = told(spell(1400, processor_us=700, ready_us=400, extra_switches=1), 1400)
    assert found.is_explained


def test_waiting_for_a_processor_counts_for_no_more_than_the_loop_was_away():
    # 0.3 ms of the 0.9 passed before the loop was to wake: a boast of the counters' that the clock refutes.
    found = told(spell(1400, processor_us=800, ready_us=900, extra_switches=1), 1400)
    assert dict(found.shares_ns)[Cause.ANOTHER_PROCESS] == 300 * US
    assert not found.is_explained


def test_a_wake_that_was_late_for_want_of_a_processor_is_not_counted_twice():
    # 1 ms late in waking, 0.6 ms of it ready.
    found = told(spell(1400, woke_us=1300, ready_us=600, ready_at_wake_us=600), 1400)
    assert found.shares_ns == ((Cause.ANOTHER_PROCESS, 400 * US),)
    sooner = replace(LATE, deadline_ns=700 * US)
    shares = dict(told(spell(1400, woke_us=1300, ready_us=600, ready_at_wake_us=600), 1400, sooner).shares_ns)
    assert shares[Cause.ANOTHER_PROCESS] == 600 * US
    assert sum(shares.values()) == 700 * US


def test_a_wait_for_a_processor_before_the_wake_is_no_excuse_for_a_call_that_waits_after_it():
    # Woke at 0.9 ms, 0.6 ms late for want of a processor; then a call of its own waited for 0.5 ms.
    of_it = spell(1500, woke_us=900, ready_us=600, ready_at_wake_us=600, extra_switches=1)
    found = told(of_it, 1500, replace(LATE, deadline_ns=600 * US, is_paced=False))
    assert found.shares_ns == (
        (Cause.ANOTHER_PROCESS, 600 * US),
        (Cause.OWN_CALL, 300 * US),
    )
    assert found.cause is Cause.OWN_CALL


def test_a_loop_that_computes_before_it_sleeps_is_not_woken_late():
    """Its sleep ends late because it began late: the processor time tells, or where that is coarse the clock."""
    assert told(spell(1400, woke_us=1300, processor_us=1100), 1400).cause is Cause.OWN_WORK
    coarse = spell(1400, woke_us=1300, processor_us=None, stale_us=1000)
    found = told(replace(coarse, ready_ns=None), 1400)
    assert (found.cause, found.is_explained) == (Cause.NOT_EXPLAINED, False)
    found = told(replace(coarse, ready_ns=None, stale_ns=0), 1400)
    assert (found.cause, found.is_explained) == (Cause.WOKEN_LATE, True)


def test_where_the_processor_clock_is_coarse_being_awake_counts_as_work():
    # Woke at 0.9 ms, awake for 0.5 ms: late by 0.4 ms, of which the wake covers 0.6.
    coarse = replace(spell(1400, woke_us=900, processor_us=None), ready_ns=None)
    assert told(coarse, 1400).is_explained
    # Woke at 0.4 ms, awake for a whole ms.
    found = told(replace(coarse, woke_ns=400 * US), 1400)
    assert found.shares_ns == ((Cause.WOKEN_LATE, 100 * US), (Cause.NOT_EXPLAINED, 300 * US))


def test_a_demand_sent_in_time_is_late_only_by_bus_and_sync():
    found = told(None, 1100, handed_us=450)
    assert (found.cause, found.is_explained, found.missed_by_ns) == (Cause.BUS_FULL, True, 100 * US)
    early = replace(LATE, deadline_ns=800 * US, deviation_ns=-100 * US)
    assert told(None, 1050, early, handed_us=1050).shares_ns == ((Cause.SYNC_IRREGULAR, 250 * US),)
    assert told(None, 1200, early, handed_us=1200).cause is Cause.NOT_EXPLAINED
    assert told(None, 1100, handed_us=1100).cause is Cause.NOT_EXPLAINED


def test_work_beyond_the_share_of_this_very_cycle_is_not_covered_by_what_was_taken_before():
    """3 ms were taken; catching up, the loop worked for 0.9 ms in this cycle, and for 0.2 ms in all others."""
    taken = spell(4100, processor_us=1100, ready_us=3000, extra_switches=1)
    late = replace(LATE, sync_ns=2500 * US, deadline_ns=3500 * US, tpdo_ns=2750 * US)
    assert told(taken, 4100, replace(late, own_ns=200 * US)).is_explained
    found = told(taken, 4100, replace(late, own_ns=900 * US))
    assert found.shares_ns == ((Cause.OWN_WORK, 200 * US), (Cause.ANOTHER_PROCESS, 400 * US))
    assert not found.is_explained


def test_a_loop_that_is_never_done_in_time_has_itself_to_blame():
    """9 ms of work in 12 ms, 8.4 ms of which are its share; or 8 ms: then the 3 ms that were taken are the cause."""
    sooner = replace(LATE, deadline_ns=11800 * US)
    found = told(spell(12300, processor_us=9000, ready_us=3000, extra_switches=1), 12300, sooner)
    assert found.shares_ns == ((Cause.OWN_WORK, 500 * US),)
    found = told(spell(12300, processor_us=8000, ready_us=3000, extra_switches=1), 12300, sooner)
    assert found.shares_ns == ((Cause.ANOTHER_PROCESS, 500 * US),)


def test_a_sync_of_the_loops_own_is_no_excuse():
    own = replace(LATE, is_paced=False, deadline_ns=600 * US, deviation_ns=400 * US)
    busy = spell(1000, processor_us=700)
    assert told(None, 1100, replace(LATE, is_paced=False, deviation_ns=-200 * US), 1100).cause is Cause.NOT_EXPLAINED
    assert told(busy, 1000, own).cause is Cause.NOT_EXPLAINED
    found = told(busy, 1000, own, carried=((Cause.ANOTHER_PROCESS, 400 * US),))
    assert (found.cause, found.is_explained) == (Cause.ANOTHER_PROCESS, True)


def test_drives_are_not_blamed_for_a_loop_that_wakes_too_late_by_plan():
    # All TPDOs there at 0.25 ms, planned to wake at 0.9 ms.
    found = told(spell(1400, 900, 500, planned_us=900), 1400)
    assert found.cause is Cause.NOT_EXPLAINED
    missing = replace(LATE, tpdo_ns=None)
    assert told(spell(1400, 900, 500, planned_us=900), 1400, missing).cause is Cause.DRIVES_LATE


span_us = st.integers(min_value=0, max_value=5000)


@given(asleep=span_us, own=span_us, away=span_us, stolen=span_us, full=span_us, tpdo=span_us, short=st.integers(0, 400))
def test_explained_exactly_when_the_loops_own_work_stayed_within_its_share(
    asleep, own, away, stolen, full, tpdo, short
):
    """Time is laid out piece by piece; what is not the loop's may be as much as it likes."""
    planned_us = max(300, tpdo)
    woke_us = planned_us + asleep
    end_us = woke_us + own + away + stolen + full
    late = replace(LATE, deadline_ns=(1000 - short) * US, tpdo_ns=tpdo * US)
    of_it = spell(
        end_us, woke_us, own, planned_us=planned_us, ready_us=away, extra_switches=0 if stolen else 1, bus_us=full
    )
    if end_us * US <= late.deadline_ns:
        return
    found = told(of_it, end_us, late)
    assert sum(share for _, share in found.shares_ns) == found.missed_by_ns
    assert found.is_explained is (own <= 700)
    outside = sum(share for cause, share in found.shares_ns if cause in OUTSIDE)
    assert outside == min(found.missed_by_ns, (asleep + away + stolen + full + planned_us - 300 + short) * US)
