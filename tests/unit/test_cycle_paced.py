"""The cycle with a SYNC that somebody else sends, and TPDOs that come late; times and counts worked out by hand."""

import itertools
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from config.schema import GuardSection
from drivers.nmt import SYNC_COB_ID
from gateway.cyclic.axis_channel import AxisChannel, AxisLimits
from gateway.cyclic.cycle import CyclicLoop
from gateway.cyclic.guard import Condition, Guard
from gateway.cyclic.steering import Steering
from gateway.cyclic.watch import CycleWatch
from gateway.record.sample import INT32_MAX, Phase, SampleFlag
from gateway.units import AxisUnits

MS = 1_000_000
ENABLED = 0x1627
DEADLINE = 800_000


class ListSink:
    """Samples as they are appended; two axes."""

    def __init__(self):
        self.rows = []

    def append(self, *values):
        names = ("cycle", "sync", "master", "speed", "v0", "v1", "deviation", "period", "lateness", "arrival", "lead")
        names += ("cpu", "phase", "flags", "d0", "d1", "a0", "a1")
        self.rows.append(dict(zip(names, values, strict=False)))


class Counting:
    """A demand whose target is the number of steps taken."""

    def __init__(self):
        self.steps = 0
        self.torque_offsets = [0, 0]
        self.velocities = [0.0, 0.0]
        self.master_position = self.master_velocity = 0.0
        self.phase = Phase.CAM
        self.targets = [0, 0]

    def step(self):
        self.steps += 1
        self.targets = [self.steps, -self.steps]

    def controlled_stop(self):
        pass


class Bench:
    def __init__(self, is_paced=True, limits=()):
        units = AxisUnits(4096, 0.0, 1.5)
        self.sink = ListSink()
        guard = Guard(GuardSection(), ("cv", "servo"))
        axes = [AxisChannel(n, i, units, 10**6) for i, n in ((1, "cv"), (2, "servo"))]
        self.loop = CyclicLoop(Steering(axes, guard, CycleWatch(guard, axes, limits)), MS, self.sink)
        self.loop.is_paced = is_paced
        self.demand = Counting()
        self.loop.steering.follow(self.demand)
        self.loop.start(0)

    def tpdo(self, number, at_ns, actual=0):
        return self.loop.receive_tpdo(number, struct.pack("<Hih", ENABLED, actual, 0), at_ns)

    def take(self):
        frames, self.loop.outbox = self.loop.outbox, []
        return [(frame.cob_id, struct.unpack_from("<i", frame.data, 2)[0] if frame.data else None) for frame in frames]

    def cycle(self, sync_ns, actual=0):
        """A whole cycle in which everything is in time; returns what was sent."""
        self.loop.receive_sync(sync_ns)
        self.tpdo(0, sync_ns + 200_000, actual)
        assert self.tpdo(1, sync_ns + 300_000, actual)
        frames = self.take()
        self.loop.sent(sync_ns + 350_000)
        return frames


def test_a_paced_loop_sends_no_sync_and_answers_the_one_it_sees():
    bench = Bench()
    assert bench.cycle(20_000) == [(0x201, 1), (0x202, -1)]
    assert bench.loop.next_wake_ns() == 20_000 + MS + MS // 2
    assert bench.cycle(20_000 + MS) == [(0x201, 2), (0x202, -2)]
    bench.cycle(20_000 + 2 * MS)
    first, second = bench.sink.rows
    assert (first["cycle"], first["sync"], first["arrival"], first["lead"]) == (0, 20_000, 300_000, 650_000)
    assert (second["period"], second["deviation"], second["flags"]) == (MS, 0, 0)


def test_a_demand_that_missed_its_sync_is_sent_again_and_no_step_is_left_out():
    """The loop was held up from SYNC(1) to after SYNC(2): both wait in the queue, and with them TPDOs of both."""
    bench = Bench()
    bench.cycle(0)
    bench.loop.receive_sync(MS)
    bench.tpdo(0, MS + 200_000)
    bench.tpdo(1, MS + 300_000)
    assert bench.take() == [(0x201, 2), (0x202, -2)]
    bench.loop.sent(2 * MS + 400_000)  # SYNC(2) has been on the bus since 2 ms
    assert not bench.loop.receive_sync(2 * MS)
    bench.tpdo(0, 2 * MS + 200_000)
    bench.tpdo(1, 2 * MS + 300_000)
    assert bench.take() == [(0x201, 2), (0x202, -2)], "the same demand once more"
    bench.loop.sent(2 * MS + 450_000)
    assert bench.cycle(3 * MS) == [(0x201, 3), (0x202, -3)]
    for k in range(4, 8):
        bench.cycle(k * MS)
    rows = bench.sink.rows
    assert [bool(row["flags"] & SampleFlag.MISSED_RPDO_DEADLINE) for row in rows[:3]] == [False, True, False]
    assert rows[1]["lead"] == -400_000
    # The demand in force at SYNC(k) was applied at SYNC(k-1): 1 stays in force for two cycles.
    assert [row["d0"] for row in rows] == [0, 0, 1, 1, 2, 3, 4]


def test_a_loop_that_slept_through_a_whole_cycle_closes_it_when_the_next_sync_comes():
    bench = Bench()
    bench.cycle(0)
    bench.loop.receive_sync(MS)
    bench.tpdo(0, MS + 200_000)
    assert bench.loop.receive_sync(2 * MS), "closed without the second axis"
    assert bench.demand.steps == 2
    bench.tpdo(0, 2 * MS + 200_000)
    flags = bench.sink.rows[1]["flags"]
    assert flags == SampleFlag.MISSED_TPDO_AXIS1 | SampleFlag.MISSED_RPDO_DEADLINE


def test_the_grid_follows_the_earliest_sync_and_a_gap_is_an_overrun():
    bench = Bench()
    bench.cycle(100_000)
    bench.cycle(MS + 30_000)
    bench.cycle(2 * MS + 30_000)
    bench.cycle(5 * MS + 46_000)
    bench.cycle(6 * MS + 30_000)
    rows = bench.sink.rows
    assert [row["deviation"] for row in rows] == [100_000 - MS, -70_000, 0, 2 * MS + 16_000]
    assert rows[3]["flags"] == SampleFlag.OVERRUN
    assert bench.loop.sync_due_ns == 7 * MS + 30_000, "half of 16 us late, and then 8 us early again"


def test_a_missing_sync_is_flagged_and_after_three_the_loop_sends_it_itself():
    bench = Bench()
    bench.cycle(0)
    wakes = []
    for _ in range(3):
        wakes.append(bench.loop.next_wake_ns())
        bench.loop.wake(wakes[-1])
    assert wakes == [MS + MS // 2, 2 * MS + MS // 2, 3 * MS + MS // 2]
    assert not bench.loop.is_paced
    assert bench.take() == [(SYNC_COB_ID, None)]
    assert bench.loop.next_wake_ns() == wakes[-1] + DEADLINE
    bench.tpdo(0, wakes[-1] + 1000)
    bench.tpdo(1, wakes[-1] + 2000)
    assert bench.loop.steering.phase is Phase.QUICK_STOP, "the guard takes it for a lost SYNC"
    assert bench.take() == [(0x201, 1), (0x202, -1)]
    bench.loop.wake(wakes[-1] + MS)
    assert [row["flags"] for row in bench.sink.rows] == [SampleFlag.SYNC_LOST, SampleFlag.SYNC_LOST]
    assert not bench.loop.receive_sync(10 * MS), "whoever sends SYNC now is not this loop's pace"


def test_a_host_that_was_away_does_not_take_its_late_timer_for_a_lost_one():
    """The loop wakes 20 ms late; the kernel's SYNC was held up as long, and comes right after."""
    bench = Bench()
    bench.cycle(0)
    bench.loop.wake(21 * MS)
    assert bench.loop.next_wake_ns() == 22 * MS
    bench.loop.wake(21 * MS + 10_000)
    assert (bench.loop.missing_syncs, bench.loop.is_paced) == (1, True)
    assert bench.cycle(21 * MS + 20_000) == [(0x201, 2), (0x202, -2)]
    assert bench.loop.sync_due_ns == 22 * MS + 20_000


def test_one_missing_sync_costs_no_step():
    bench = Bench()
    bench.cycle(0)
    bench.loop.wake(MS + MS // 2)
    assert bench.loop.missing_syncs == 1
    assert bench.cycle(2 * MS) == [(0x201, 2), (0x202, -2)]
    assert bench.loop.missing_syncs == 0
    bench.cycle(3 * MS)
    assert [row["flags"] for row in bench.sink.rows] == [SampleFlag.SYNC_LOST, SampleFlag.SYNC_LOST]


@pytest.mark.parametrize("gap_ns", [0, 5_300_000])
def test_a_way_gone_while_a_sync_was_missing_is_no_leap(gap_ns):
    """39 counts in a cycle of 5.3 ms are none, whoever noticed the gap first; in one of 1 ms they are."""
    limits = AxisLimits(12.0, INT32_MAX, INT32_MAX, INT32_MAX, INT32_MAX)
    bench = Bench(limits=(limits, limits))
    bench.loop.steering.phase = Phase.CAM
    bench.loop.steering.begin_guarding()
    for k in range(10):
        bench.cycle(k * MS, 4 * k)
    again_ns = 9 * MS + (gap_ns or MS)
    if gap_ns:
        # The host comes back shortly before the timer's SYNC is seen, and takes that for missing.
        bench.loop.wake(again_ns - 200_000)
        assert bench.loop.missing_syncs == 1
    for k in range(10):
        bench.cycle(again_ns + k * MS, 36 + 39 + 4 * k)
    trips = {(trip.condition, trip.value) for trip in bench.loop.steering.guard.tripped}
    assert trips == (set() if gap_ns else {(Condition.VELOCITY, 38), (Condition.VELOCITY, 40)})


@pytest.mark.parametrize("is_paced", [True, False])
def test_a_tpdo_after_the_next_sync_is_not_taken_for_the_next_ones(is_paced):
    """TPDO(1) of axis 0 comes 0.1 ms after SYNC(2), TPDO(2) in time: sample 2 has the value of SYNC(2)."""
    bench = Bench(is_paced)
    loop = bench.loop

    def sync(at_ns):
        loop.receive_sync(at_ns) if is_paced else loop.wake(at_ns)

    for k in (1, 2):
        sync(k * MS)
        if k == 2:
            assert not bench.tpdo(0, k * MS + 100_000, 1001), "of cycle 1, come late"
        bench.tpdo(1, k * MS + 300_000, 1000 + k)
        assert not loop.is_closed
        if k == 1:
            loop.wake(k * MS + DEADLINE)
        else:
            assert bench.tpdo(0, k * MS + 310_000, 1002)
        loop.sent(loop.sync_due_ns - 1)
    sync(3 * MS)
    first, second = bench.sink.rows
    assert first["flags"] == SampleFlag.MISSED_TPDO_AXIS0
    assert second["flags"] == SampleFlag.LATE_TPDO
    assert (second["a0"], second["a1"], second["arrival"]) == (1002, 1002, 310_000)


def test_after_a_lost_tpdo_the_next_one_counts_at_the_deadline():
    bench = Bench(is_paced=False)
    loop = bench.loop
    loop.wake(MS)
    bench.tpdo(1, MS + 300_000)
    loop.wake(MS + DEADLINE)
    loop.wake(2 * MS)
    bench.tpdo(0, 2 * MS + 200_000, 77)
    bench.tpdo(1, 2 * MS + 300_000)
    assert not loop.is_closed
    loop.wake(2 * MS + DEADLINE)
    loop.wake(3 * MS)
    assert [row["flags"] for row in bench.sink.rows] == [SampleFlag.MISSED_TPDO_AXIS0, 0]
    assert bench.sink.rows[1]["a0"] == 77
    bench.tpdo(0, 3 * MS + 200_000)
    assert bench.tpdo(1, 3 * MS + 300_000), "and is trusted again"


def test_a_tpdo_after_its_deadline_is_booked_to_its_own_cycle():
    bench = Bench(is_paced=False)
    loop = bench.loop
    loop.wake(MS)
    bench.tpdo(1, MS + 300_000)
    loop.wake(MS + DEADLINE)
    assert not bench.tpdo(0, MS + 900_000, 5)
    loop.wake(2 * MS)
    assert bench.sink.rows[0]["flags"] == SampleFlag.MISSED_TPDO_AXIS0 | SampleFlag.LATE_TPDO
    assert bench.sink.rows[0]["a0"] == 5
    bench.tpdo(0, 2 * MS + 200_000)
    assert bench.tpdo(1, 2 * MS + 300_000)


@given(
    st.lists(
        st.tuples(st.integers(-40_000, 3_500_000), st.integers(0, 1_700_000), st.sampled_from([0, 1, 2, 3])),
        min_size=3,
        max_size=40,
    )
)
def test_whatever_comes_late_what_the_drives_apply_advances_by_one_step_at_most(events):
    """Random lateness of SYNC and of the loop, lost TPDOs; a drive applies the last RPDO that came before SYNC."""
    bench = Bench()
    loop = bench.loop
    rpdos, applied = [(-1, 0)], [0]
    sync_ns = now_ns = 0
    for late_ns, delay_ns, answers in events:
        sync_ns += MS + late_ns
        if loop.steering.phase is Phase.QUICK_STOP:
            # An axis has been silent for so long that the demand is left.
            break
        applied.append(next(demand for at_ns, demand in reversed(rpdos) if at_ns <= sync_ns))
        assert applied[-1] - applied[-2] in (0, 1)
        loop.receive_sync(sync_ns)
        now_ns = max(now_ns, sync_ns)
        rpdos += [(now_ns, value) for cob_id, value in bench.take() if cob_id == 0x201]
        for number in (0, 1):
            if answers >> number & 1:
                bench.tpdo(number, now_ns)
        if not loop.is_closed:
            now_ns = max(now_ns, loop.next_wake_ns())
            loop.wake(now_ns)
        now_ns += delay_ns
        rpdos += [(now_ns, value) for cob_id, value in bench.take() if cob_id == 0x201]
        loop.sent(now_ns)
    for before, after in itertools.pairwise(row["d0"] for row in bench.sink.rows):
        assert after - before in (0, 1)
