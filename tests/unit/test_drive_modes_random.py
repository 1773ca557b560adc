"""Whatever a master writes, in whatever mode: no exception, no jump of the demand, nothing beyond the limits."""

from collections.abc import Callable

from drive_bench import MS, Bench
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_drive.cia402 import PowerState
from sim_drive.settings import DriveSettings
from sim_drive.switches import Switches

LIMIT = 1000
FASTEST = 20_000
"""Counts/s: 607Fh, and 2000 counts within the interpolation time of 100 ms."""

Act = Callable[[Bench], object]
"""What is done to the bench; acts that let time pass do so in ticks that are looked at."""


def _write(index: int, subindex: int, size: int, values: st.SearchStrategy[int]) -> st.SearchStrategy[Act]:
    def act(value: int) -> Act:
        return lambda bench: bench.write(index, subindex, value, size)

    return values.map(act)


def _control(word: int) -> Act:
    return lambda bench: bench.control(word)


def _run(ticks: int) -> Act:
    def act(bench: Bench) -> None:
        for _ in range(ticks):
            check_tick(bench)

    return act


WORDS = st.sampled_from(
    [0x0F, 0x1F, 0x0F, 0x1F, 0x0F, 0x3F, 0x5F, 0x7F, 0x21F, 0x10F, 0x11F, 0x06, 0x07, 0x02, 0x00, 0x80, 0x0E]
)


def _let_pass(ticks: int) -> Act:
    return lambda bench: bench.run(ticks * MS)


UNTIMED = st.one_of(
    _write(0x6060, 0, 1, st.sampled_from([0, 1, 3, 4, 6, 7, 8, 9, 10, 2, 5])),
    _write(0x607A, 0, 4, st.integers(-2 * LIMIT, 2 * LIMIT)),
    _write(0x60FF, 0, 4, st.integers(-30_000, 30_000)),
    _write(0x6071, 0, 2, st.integers(-500, 500)),
    _write(0x60C1, 1, 4, st.integers(-2 * LIMIT, 2 * LIMIT)),
    _write(0x60B0, 0, 4, st.integers(-50, 50)),
    _write(0x6081, 0, 4, st.integers(1, 50_000)),
    _write(0x605A, 0, 2, st.integers(0, 8)),
    _write(0x605C, 0, 2, st.integers(0, 1)),
    _write(0x605D, 0, 2, st.integers(1, 4)),
    WORDS.map(_control),
    st.just(_control(0x0F)),
    st.just(_control(0x1F)),
)
ACTS = st.one_of(UNTIMED, st.integers(1, 60).map(_run), st.integers(20, 120).map(_run))


METHODS = _write(0x6098, 0, 1, st.integers(0, 37))


def check_tick(bench: Bench) -> None:
    drive = bench.drive
    was_powered = drive.is_powered
    before = drive.position_demand_counts
    bench.tick()
    now = drive.position_demand_counts
    if was_powered and drive.is_powered:
        assert abs(now - before) <= FASTEST * 1e-3 + 1.0, (before, now)
    assert abs(now + drive.axis.offset_counts) <= LIMIT + 1.0
    assert drive.power_state is not PowerState.FAULT


def enabled(bench: Bench) -> Bench:
    for index in (0x6083, 0x6084, 0x6085, 0x60C6):
        bench.must(index, 0, 400_000, 4)
    bench.must(0x607F, 0, FASTEST, 4)
    bench.must(0x60C2, 1, 100, 1)
    bench.must(0x607D, 1, -LIMIT, 4)
    bench.must(0x607D, 2, LIMIT, 4)
    bench.enable(mode=1)
    bench.follows = True
    return bench


@given(st.lists(ACTS, min_size=60, max_size=200))
@settings(max_examples=60, deadline=None, derandomize=True)
def test_no_jump_and_nothing_beyond_the_software_limits(acts: list[Act]):
    bench = enabled(Bench())
    for act in acts:
        act(bench)
        check_tick(bench)


@given(
    st.integers(-LIMIT, LIMIT),
    st.lists(
        st.one_of(UNTIMED, st.integers(1, 60).map(_let_pass), _write(0x6098, 0, 1, st.integers(0, 37))), max_size=60
    ),
)
@settings(max_examples=20, deadline=None, derandomize=True)
def test_homing_in_between_never_raises(start: int, acts: list[Act]):
    bench = Bench(DriveSettings(switches=Switches(-900, 900, (100.0, 200.0), 40)))
    bench.shaft = start
    bench.tick()
    enabled(bench)
    for act in acts:
        act(bench)
        bench.run(3 * MS)
    bench.must(0x6060, 0, 0, 1)
    bench.control(0x00)
    bench.run(MS)
    assert bench.drive.power_state in {PowerState.SWITCH_ON_DISABLED, PowerState.FAULT}
    assert bench.read(0x6061) == 0
