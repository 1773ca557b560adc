"""The account of late demands, kept by the loop's real host in a world whose kernel, clock and bus are made up."""

import os

import pytest

from config.loading import load_config
from drivers.frame import Frame
from drivers.nmt import SYNC_COB_ID
from gateway.cyclic.lateness import Late
from gateway.record.lateness import LATE_ACCOUNT_KIND, LATE_DEMAND_KIND, Cause, LateAccount, LateKind, late_record
from gateway.record.ring import EVENT_MAX_BYTES, RingReader, RingWriter
from gateway.record.run_constants import RunConstants
from gateway.record.sample import SampleFlag
from gateway.running.assembly import build_core
from gateway.running.cycle_host import CycleHost
from gateway.running.late_account import (
    LateAccountant,
    ThreadCounters,
    is_processor_clock_fine,
    major_faults,
    open_counters,
)
from gateway.running.preparation import prepare

US = 1000
MS = 1_000_000
CONFIG = load_config("paper")
CYCLES = 120
FIRST, EVERY = 60, 20
"""The loop has learned its phase by then; one cycle in so many is disturbed."""


@pytest.fixture(scope="module")
def prepared():
    return prepare(CONFIG, 1)


class Kernel:
    """One thread's time: the clock, what it had of the processor, and what it waited for it."""

    def __init__(self):
        self.now_ns = MS
        self.processor_ns = self.ready_ns = self.switches = self.faults = self.reads = 0

    def work(self, span_ns):
        self.now_ns += span_ns
        self.processor_ns += span_ns

    def take_away(self, span_ns):
        self.now_ns += span_ns
        self.ready_ns += span_ns
        self.switches += 1

    def block(self, span_ns):
        self.now_ns += span_ns
        self.switches += 1

    def stand_still(self, span_ns):
        self.now_ns += span_ns

    def counters(self):
        self.reads += 1
        return f"{self.processor_ns} {self.ready_ns} {self.switches}\n".encode()


class World:
    """A bus with two drives that answer SYNC after 0.2 and 0.3 ms, a kernel, and what disturbs the loop."""

    def __init__(self, prepared, *, is_kernel_sync=True, is_echoed=True, disturb=None, drive_ns=100 * US, **options):
        self.kernel = Kernel()
        self.disturb = disturb or {}
        self.drive_ns = drive_ns
        self.queue = []
        self.next_sync_ns = None
        self.flags = {}
        self.told = []
        self.is_full = False
        self.core = build_core(CONFIG, prepared.cam.profile, prepared.plan, self, lambda: self.kernel.processor_ns)
        self.core._session = iter(lambda: 1 << 62, None)
        self.core.loop.start(self.kernel.now_ns)
        self.echo = 0x202 if is_kernel_sync and is_echoed else None
        self.late = LateAccountant(
            MS,
            lambda *event: self.told.append(event),
            **{
                "is_echoed": self.echo is not None,
                "counters": self.kernel.counters,
                "processor_ns": lambda: self.kernel.processor_ns,
                "faults": lambda: self.kernel.faults,
                "clock": lambda: self.kernel.now_ns,
                **options,
            },
        )
        self.host = CycleHost(
            self.core,
            self,
            self.poll,
            sync=self if is_kernel_sync else None,
            late=self.late,
            echo_cob_id=self.echo,
            clock=lambda: self.kernel.now_ns,
            sleep=self.sleep,
        )
        self.host.run()
        self.late.flush()

    # the samples
    def append(self, *values):
        self.flags[values[0]] = values[13]

    # the kernel's SYNC
    def start(self):
        self.next_sync_ns = self.kernel.now_ns + 10 * US

    def stop(self):
        self.next_sync_ns = None

    def retime(self, _period_us):
        pass

    # the bus
    def send(self, frame):
        self.kernel.work(5 * US)
        self.happen("full")
        if self.is_full:
            return False
        if frame.cob_id == self.echo:
            self.queue.append((self.kernel.now_ns, frame))
        if frame.cob_id == SYNC_COB_ID:
            self.answer(self.kernel.now_ns)
        return True

    def answer(self, sync_ns):
        for number in (1, 2):
            self.queue.append((sync_ns + self.drive_ns * (number + 1), Frame(0x180 + number, bytes(8))))

    def receive(self):
        self.pass_time(self.kernel.now_ns)
        if self.queue and self.queue[0][0] <= self.kernel.now_ns:
            at_ns, frame = self.queue.pop(0)
            return frame, at_ns
        return None

    def pass_time(self, to_ns):
        while self.next_sync_ns is not None and self.next_sync_ns <= to_ns:
            self.queue.append((self.next_sync_ns, Frame(SYNC_COB_ID)))
            self.answer(self.next_sync_ns)
            self.next_sync_ns += MS
        self.queue.sort(key=lambda entry: entry[0])
        self.kernel.now_ns = max(self.kernel.now_ns, to_ns)

    def wait(self, timeout_s):
        self.kernel.switches += 1
        self.is_full = False
        end_ns = self.kernel.now_ns + round(timeout_s * 1e9)
        coming = [at_ns for at_ns, _ in self.queue] + ([self.next_sync_ns] if self.next_sync_ns else [])
        self.pass_time(min([end_ns, *coming]))
        return self.kernel.now_ns < end_ns

    def sleep(self, span_s):
        self.kernel.switches += 1
        self.pass_time(self.kernel.now_ns + round(span_s * 1e9) + 2 * US)
        self.happen("asleep")

    def poll(self):
        self.kernel.work(20 * US)
        self.happen("awake")
        if self.core.loop.cycle >= CYCLES:
            self.core.loop.stop()
            self.core.is_done = True

    def happen(self, when):
        """What is to disturb this cycle disturbs it once."""
        cycle = self.core.loop.cycle
        if (when, cycle) in self.disturb:
            self.disturb.pop((when, cycle))(self)

    @property
    def missed(self):
        return [cycle for cycle, flags in self.flags.items() if flags & SampleFlag.MISSED_RPDO_DEADLINE]

    def explanations(self):
        return late_record(({"kind": kind, "at_ns": at_ns, **data} for at_ns, kind, _, data in self.told), 1000)


def now_and_then(when, what):
    return {(when, cycle): what for cycle in range(FIRST, CYCLES - 10, EVERY)}


def slept_on(world):
    world.kernel.stand_still(3 * MS)


def had_to_wait(world):
    world.kernel.now_ns += 3 * MS
    world.kernel.ready_ns += 3 * MS


def no_bus(world):
    world.is_full = True


def taken_away(world):
    world.kernel.take_away(3 * MS)


DISTURBANCES = {
    "the timer wakes it late": ("asleep", slept_on, Cause.WOKEN_LATE, True),
    "another process when it is to wake": ("asleep", had_to_wait, Cause.ANOTHER_PROCESS, True),
    "another process while it works": ("awake", taken_away, Cause.ANOTHER_PROCESS, True),
    "stolen while it works": ("awake", lambda world: world.kernel.stand_still(3 * MS), Cause.STOLEN, True),
    "a call that waits": ("awake", lambda world: world.kernel.block(3 * MS), Cause.OWN_CALL, False),
    "its own work": ("awake", lambda world: world.kernel.work(3 * MS), Cause.OWN_WORK, False),
}  # fmt: skip


@pytest.mark.parametrize("sync", ["kernel, echoed", "kernel", "loop"])
@pytest.mark.parametrize("name", DISTURBANCES)
def test_whatever_takes_the_loops_time_is_found_as_what_it_is(prepared, name, sync):
    when, what, cause, is_explained = DISTURBANCES[name]
    world = World(
        prepared, is_kernel_sync=sync != "loop", is_echoed=sync == "kernel, echoed", disturb=now_and_then(when, what)
    )
    assert not world.disturb, "each of them has happened"
    account = world.late.account
    assert len(world.missed) >= 2, "a loop that is away for 3 ms misses deadlines"
    assert account.missed == len(world.missed)
    assert account.counts == {cause: account.missed}
    assert account.not_explained == (0 if is_explained else account.missed)
    assert {demand.cycle for demand in world.explanations().worst if demand.what.value == "rpdo_deadline"} == {
        *world.missed
    }


@pytest.mark.parametrize("is_kernel_sync", [True, False])
def test_a_loop_in_time_reads_its_counters_once_a_sleep_and_tells_nothing_but_the_end(prepared, is_kernel_sync):
    world = World(prepared, is_kernel_sync=is_kernel_sync)
    assert world.missed == []
    assert [kind for _, kind, _, _ in world.told] == [LATE_ACCOUNT_KIND]
    assert world.told[0][2] == "RPDO deadlines missed so far: 0"
    assert world.kernel.reads < (1.7 if is_kernel_sync else 2.5) * CYCLES


def test_another_process_explains_no_more_than_it_took(prepared):
    """2 ms are taken away after the demand of cycle k, 1.65 ms before the one of k+1 is due to be on its way.

    With 0.5 ms of work all would have been in time without it. With 1.8 ms the demand of k+1 would have been late all
    the same, and that of k+2, which is 1.15 ms late, would not.
    """

    def world_of(own_us):
        def both(world):
            world.kernel.take_away(2 * MS)
            world.kernel.work(own_us * US)

        return World(prepared, disturb=now_and_then("awake", both))

    world = world_of(500)
    assert world.missed
    assert world.late.account.not_explained == 0
    world = world_of(1800)
    explained = {
        demand.cycle: demand.is_explained for demand in world.explanations().worst if demand.what.value[0] == "r"
    }
    assert [explained[cycle + 1] for cycle in (60, 80, 100)] == [False] * 3
    assert [explained[cycle + 2] for cycle in (60, 80, 100)] == [True] * 3


def test_what_was_taken_at_first_does_not_explain_what_is_late_for_good(prepared):
    """3 ms are taken away once; from then on the loop works for 1.2 ms in every cycle of 1 ms."""

    def overloaded(world):
        world.kernel.work(1200 * US)

    def taken_once(world):
        taken_away(world)
        overloaded(world)

    disturb = {("awake", cycle): overloaded for cycle in range(61, CYCLES)} | {("awake", 60): taken_once}
    world = World(prepared, disturb=disturb)
    own = [demand for demand in world.explanations().worst if demand.cycle > 70 and demand.what.value[0] == "r"]
    assert len(own) > 10
    assert not any(demand.is_explained for demand in own)


def test_a_call_that_waits_is_not_covered_by_a_processor_that_was_waited_for_before(prepared):
    """1.5 ms ready before the wake, then 3 ms in a call: the demand of k+1 is some 2.9 ms late."""

    def waited(world):
        world.kernel.now_ns += 1500 * US
        world.kernel.ready_ns += 1500 * US

    # The sleep before cycle 70 belongs to 69.
    disturb = {("asleep", 69): waited, ("awake", 70): lambda world: world.kernel.block(3 * MS)}
    world = World(prepared, disturb=disturb)
    told = {demand.cycle: dict(demand.shares_us) for demand in world.explanations().worst}
    blamed = [shares for shares in told.values() if Cause.OWN_CALL in shares]
    assert blamed
    assert all(Cause.WOKEN_LATE not in shares or shares[Cause.WOKEN_LATE] < 20 for shares in blamed)


def test_stamps_that_the_loops_own_lateness_has_changed_prove_nothing(prepared):
    """It works for 1.2 ms in every cycle of 1 ms, and no processor clock tells: SYNCs then seem to come at once."""
    disturb = {("awake", cycle): lambda world: world.kernel.work(1200 * US) for cycle in range(60, CYCLES)}
    world = World(prepared, disturb=disturb, is_fine=False)
    assert len(world.missed) > 10
    shares = {cause for demand in world.explanations().worst for cause, span in demand.shares_us if span > 20}
    assert Cause.SYNC_IRREGULAR not in shares


class StubLoop:
    cycle = 5
    is_closed = False
    processor_read_ns = 0


def accountant(kernel, told):
    late = LateAccountant(
        MS,
        lambda *event: told.append(event),
        counters=kernel.counters,
        processor_ns=lambda: kernel.processor_ns,
        faults=lambda: 0,
        clock=lambda: kernel.now_ns,
    )
    late.follow(StubLoop(), lambda: 300 * US)
    return late


def test_why_the_loops_own_sync_was_late_is_why_its_demand_was():
    """SYNC, due at 2 ms, is sent at 2.75 after 0.7 ms of waiting for a processor; its demand, due at 3, at 3.3 ms."""
    kernel, told = Kernel(), []
    late = accountant(kernel, told)
    late.rests(kernel.now_ns, 2 * MS)
    kernel.block(MS)
    kernel.take_away(700 * US)
    late.woke(4, kernel.now_ns)
    kernel.work(50 * US)
    late.rests(kernel.now_ns, 3050 * US)
    kernel.block(300 * US)
    late.woke(5, kernel.now_ns)
    kernel.work(250 * US)
    late.missed(Late(LateKind.RPDO_DEADLINE, 5, 2750 * US, 3 * MS, 3300 * US, False, 750 * US, 2950 * US))
    late.rests(kernel.now_ns, 4 * MS)
    assert late.account.counts == {Cause.ANOTHER_PROCESS: 1}
    assert late.account.not_explained == 0


def test_of_thousands_at_once_the_worst_are_told():
    kernel, told = Kernel(), []
    late = accountant(kernel, told)
    for number in range(3000):
        late.missed(Late(LateKind.OVERRUN, number, 0, MS, MS + number * US, True, 0, None))
    late.flush()
    demands = [data for _, kind, _, data in told if kind == LATE_DEMAND_KIND]
    assert sorted(data["missed_by_us"] for data in demands) == list(range(3000 - 64, 3000))
    assert told[-1][3]["overruns"] == 3000


def test_a_bus_that_takes_nothing_is_to_blame(prepared):
    def full_for_long(world):
        world.is_full = True
        if world.core.loop.cycle in range(70, 73):
            world.disturb["full", world.core.loop.cycle] = full_for_long

    world = World(prepared, disturb={("full", cycle): full_for_long for cycle in range(70, 73)})
    assert world.missed
    assert set(world.late.account.counts) == {Cause.BUS_FULL}
    assert world.late.account.not_explained == 0


def test_without_the_kernels_counters_only_sleep_proves_anything(prepared):
    for name, cause in (("the timer wakes it late", Cause.WOKEN_LATE), ("stolen while it works", Cause.NOT_EXPLAINED)):
        when, what, _, _ = DISTURBANCES[name]
        for coarse in ({"counters": None}, {"is_fine": False}):
            world = World(prepared, disturb=now_and_then(when, what), **coarse)
            assert world.missed
            assert set(world.late.account.counts) == {cause}


def test_computing_before_a_sleep_is_not_taken_for_a_late_timer_where_the_processor_clock_is_coarse(prepared):
    when, what, _, _ = DISTURBANCES["its own work"]
    world = World(prepared, disturb=now_and_then(when, what), is_fine=False)
    assert world.missed
    assert world.late.account.explained == 0


def test_a_loop_that_is_always_late_does_not_flood_its_recording(prepared):
    world = World(prepared, disturb={("awake", cycle): lambda w: w.kernel.work(2 * MS) for cycle in range(40, CYCLES)})
    kinds = [kind for _, kind, _, _ in world.told]
    assert world.late.account.missed == len(world.missed) > 40
    assert kinds.count(LATE_ACCOUNT_KIND) == 2, "at once, and at the end"
    # One in 50 ms of a quarter of a second, and what is left at the end.
    assert kinds.count(LATE_DEMAND_KIND) <= 64 + 8
    assert kinds[-1] == LATE_ACCOUNT_KIND


def test_the_greatest_account_fits_an_event(tmp_path):
    account = LateAccount(missed=10**7, explained=10**7 - 1, overruns=10**6, overruns_explained=10**6)
    for cause in Cause:
        account.counts[cause] = 10**6
        account.spans_us[cause] = 10**9 - 1
    constants = RunConstants.from_config(CONFIG, 1)
    with RingWriter.create("late", constants, directory=tmp_path) as ring, RingReader(ring.path) as reader:
        ring.append_event(10**16, LATE_ACCOUNT_KIND, account.verdict(), **account.to_event())
        (event,), _ = reader.read_new_events()
    assert late_record([event.data]).account == account
    assert EVENT_MAX_BYTES == 508


def test_demands_that_the_account_lacks_are_not_explained():
    account = LateAccount(missed=3, explained=3, counts={Cause.STOLEN: 3}, spans_us={Cause.STOLEN: 4500})
    assert account.verdict() == "3: 3 stolen by the host (4.5 ms), 0 not explained"
    assert account.verdict(5) == "5: 3 stolen by the host (4.5 ms), 2 not explained"
    assert late_record([{"kind": LATE_ACCOUNT_KIND, **account.to_event()}]).to_json(5)["not_explained"] == 2
    assert late_record([{"kind": "step"}]) is None


def test_this_kernel_keeps_the_counters_of_this_thread():
    counters = open_counters()
    if counters is None:
        pytest.skip("this kernel keeps no account of waiting for a processor")
    before = counters().split()
    os.sched_yield()
    after = counters().split()
    counters.close()
    assert len(before) == 3
    assert all(int(then) <= int(now) for then, now in zip(before, after, strict=True))
    assert major_faults() >= 0


def test_a_kernel_without_counters_is_no_error(monkeypatch, tmp_path):
    with pytest.raises(FileNotFoundError):
        ThreadCounters(tmp_path / "nothing")
    monkeypatch.setattr("gateway.running.late_account.ThreadCounters", lambda: (_ for _ in ()).throw(OSError()))
    assert open_counters() is None


@pytest.mark.parametrize(("step_ns", "expected"), [(700, True), (50_000, True), (60_000, False), (10_000_000, False)])
def test_a_processor_clock_of_large_steps_is_known(step_ns, expected):
    now = [0]

    def clock():
        now[0] += 200
        return now[0]

    assert is_processor_clock_fine(lambda: clock() // step_ns * step_ns, clock) is expected
