"""Whatever a master writes, in whatever mode: the state machine of the standard, no jump, nothing beyond the limits.

The model of the power state machine here is the test's own, and the demand is judged from its values at servo ticks.
"""

from collections import deque
from collections.abc import Callable

import pytest
from drive_bench import MS, Bench
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_drive.settings import DriveSettings
from sim_drive.switches import Switches

LIMIT = 1000
FASTEST = 20_000
"""Counts/s: 607Fh, and 2000 counts within the interpolation time of 100 ms."""
RATE = 400_000
"""Counts/s^2: every acceleration, deceleration and stop there is."""
SWITCHED_ON, ENABLED, QUICK_STOP, DISABLED, READY = 0x23, 0x27, 0x07, 0x40, 0x21
STEPPING = {4, 7, 8, 10}
"""Modes whose demand runs in lines from one set-point to the next, or follows the shaft: its velocity may step."""

Act = Callable[["Master"], object]


def state_of(word: int) -> int:
    return word & 0x4F if word & 0x4F in (0x00, 0x40, 0x0F, 0x08) else word & 0x6F


def command_of(word: int) -> str:
    """The command coding of CiA 402-2, bits 7, 3, 2, 1, 0."""
    for mask, value, name in (
        (0x82, 0x00, "disable voltage"),
        (0x86, 0x02, "quick stop"),
        (0x87, 0x06, "shutdown"),
        (0x8F, 0x07, "switch on"),
        (0x8F, 0x0F, "enable operation"),
    ):
        if word & mask == value:
            return name
    return ""


LEADS_TO: dict[tuple[int, str], int] = {
    (DISABLED, "shutdown"): READY,
    (READY, "switch on"): SWITCHED_ON,
    (READY, "enable operation"): ENABLED,
    (READY, "quick stop"): DISABLED,
    (READY, "disable voltage"): DISABLED,
    (SWITCHED_ON, "enable operation"): ENABLED,
    (SWITCHED_ON, "shutdown"): READY,
    (SWITCHED_ON, "quick stop"): DISABLED,
    (SWITCHED_ON, "disable voltage"): DISABLED,
    (ENABLED, "disable voltage"): DISABLED,
    (QUICK_STOP, "disable voltage"): DISABLED,
}
"""Transitions without a ramp; those out of operation enabled with one, and quick stop, are in ``Master.control``."""


class Master:
    """Writes to a drive whose shaft is where its demand is, and knows in what state it has to be."""

    def __init__(self, switches: Switches | None = None) -> None:
        self.bench = bench = Bench(DriveSettings(switches=switches or Switches()))
        for index in (0x6083, 0x6084, 0x6085, 0x60C5, 0x60C6, 0x609A):
            bench.must(index, 0, RATE, 4)
        bench.must(0x607F, 0, FASTEST, 4)
        bench.must(0x60C2, 1, 100, 1)
        bench.must(0x607D, 1, -LIMIT, 4)
        bench.must(0x607D, 2, LIMIT, 4)
        for speed in (1, 2):
            bench.must(0x6099, speed, 5000, 4)
        bench.follows = True
        self.options = {0x605A: 2, 0x605B: 0, 0x605C: 1}
        self.states = {DISABLED}
        """Those that the drive may be in: two while a ramp leads from one to the other."""
        self.stays = False
        """Quick stop active is not left by itself, as 605Ah was when it was entered."""
        self.modes = {0}
        self.demands: deque[float] = deque([0.0] * 3, maxlen=3)
        self.was_off = True
        """Since the last servo tick, which makes the demand begin anew."""
        self.line_ticks = 0
        """Servo ticks since the demand ran in lines; none of its steps is older."""

    @property
    def word(self) -> int:
        return self.bench.drive.dictionary.entry(0x6041).value

    # -- acts ----------------------------------------------------------------------------------------------------

    def control(self, word: int) -> None:
        command = command_of(word)
        after: set[int] = set()
        for state in self.states:
            if state == ENABLED and command == "quick stop":
                option = self.options[0x605A]
                self.stays = option >= 5
                # Quick stop active is left by itself for options 1 to 4, when the axis stands.
                after |= {DISABLED} if option == 0 else {QUICK_STOP} if option >= 5 else {QUICK_STOP, DISABLED}
            elif state == ENABLED and command in ("switch on", "shutdown"):
                target, index = (SWITCHED_ON, 0x605C) if command == "switch on" else (READY, 0x605B)
                after |= {target, ENABLED} if self.options[index] else {target}
            elif state == QUICK_STOP and command == "enable operation":
                after |= {ENABLED} if self.stays else {QUICK_STOP, DISABLED}
            else:
                after.add(LEADS_TO.get((state, command), state))
        # A drive that is stopping of itself may go on with that, or have the command in the state that it came to.
        self.bench.control(word)
        shown = state_of(self.word)
        assert shown in after, f"{word:04X}h led from {self.states} to {shown:02X}h"
        self.states = after
        self.was_off = self.was_off or not self.bench.drive.is_powered

    def option(self, index: int, value: int) -> None:
        # The option counts at the command: what is stopping already is not asked again.
        self.settle()
        self.options[index] = value
        self.bench.must(index, 0, value, 2)

    def settle(self) -> None:
        """Let every ramp come to its end, so that there is one state."""
        while len(self.states) > 1:
            for _ in range(120):
                self.tick()
            self.states = {state_of(self.word)}
        self.states = {state_of(self.word)}

    def mode(self, value: int) -> None:
        if self.bench.write(0x6060, 0, value, 1) == 0:
            self.modes = {value, *self.modes}

    def write(self, index: int, subindex: int, value: int, size: int) -> None:
        self.bench.write(index, subindex, value, size)

    # -- time ----------------------------------------------------------------------------------------------------

    def tick(self) -> None:
        bench = self.bench
        was_off = self.was_off or not bench.drive.is_powered
        self.was_off = False
        bench.tick()
        shown = state_of(self.word)
        assert shown in self.states, f"{shown:02X}h, not {self.states}"
        mode = bench.drive.dictionary.entry(0x6061).value
        assert mode in self.modes
        assert mode == bench.drive.dictionary.entry(0x6060).value
        self.modes = {mode}
        self.line_ticks = 0 if mode in STEPPING else self.line_ticks + 1
        demand = bench.drive.position_demand_counts
        self.demands.append(demand)
        if was_off or not bench.drive.is_powered:
            self.demands.extend([demand] * 2)
            self.line_ticks = 0
        before, middle, _ = self.demands
        first, second = middle - before, demand - middle
        assert abs(second) <= FASTEST * 1e-3 + 1.0, (middle, demand)
        assert abs(demand + bench.drive.axis.offset_counts) <= LIMIT + 1.0
        # A line that is left may be followed to its end, which is a step: that takes one interpolation time and a bit.
        # csv goes to a new velocity within 100 ms, whatever the step: 40 000 counts/s at the most.
        if self.line_ticks > 250:
            assert abs(second - first) <= 1.05 * max(RATE, 2 * FASTEST / 0.1) * 1e-6 + 1e-6, (before, middle, demand)
        self.check_statusword(mode)

    def check_statusword(self, mode: int) -> None:
        word = self.word
        assert word & 0x0210 == 0x0210
        assert not word & 0x8188
        if state_of(word) != ENABLED and mode not in (0, 6):
            assert not word & 0x1000, f"mode {mode}: bit 12 in {word:04X}h"
        if mode in (8, 9, 10):
            assert not word & 0x0400


def control(word: int) -> Act:
    return lambda master: master.control(word)


def write(index: int, subindex: int, size: int, values: st.SearchStrategy[int]) -> st.SearchStrategy[Act]:
    def act(value: int) -> Act:
        return lambda master: master.write(index, subindex, value, size)

    return values.map(act)


def run(ticks: int) -> Act:
    return lambda master: [master.tick() for _ in range(ticks)]


def option(index: int, highest: int) -> st.SearchStrategy[Act]:
    def act(value: int) -> Act:
        return lambda master: master.option(index, value)

    return st.integers(0, highest).map(act)


def mode(value: int) -> Act:
    return lambda master: master.mode(value)


WORDS = st.one_of(
    st.sampled_from([0x0F, 0x1F, 0x0F, 0x1F, 0x3F, 0x5F, 0x7F, 0x21F, 0x10F, 0x11F, 0x06, 0x07, 0x02, 0x00, 0x80]),
    st.integers(0, 0xFFFF),
)
ENABLING = st.just(lambda master: [master.control(word) for word in (0x06, 0x07, 0x0F)])
ACTS = st.one_of(
    st.sampled_from([0, 1, 3, 4, 6, 7, 8, 9, 10, 2, 5, -3]).map(mode),
    write(0x607A, 0, 4, st.integers(-2 * LIMIT, 2 * LIMIT)),
    write(0x60FF, 0, 4, st.integers(-30_000, 30_000)),
    write(0x6071, 0, 2, st.integers(-500, 500)),
    write(0x60C1, 1, 4, st.integers(-2 * LIMIT, 2 * LIMIT)),
    write(0x60B0, 0, 4, st.integers(-50, 50)),
    write(0x6081, 0, 4, st.integers(1, 50_000)),
    write(0x6082, 0, 4, st.sampled_from([0, 0, 0, 500, 5000])),
    option(0x605A, 8),
    option(0x605B, 1),
    option(0x605C, 1),
    write(0x605D, 0, 2, st.integers(1, 4)),
    WORDS.map(control),
    WORDS.map(control),
    ENABLING,
    ENABLING,
    st.integers(1, 60).map(run),
    st.integers(60, 300).map(run),
)


@given(st.lists(ACTS, min_size=20, max_size=60))
@settings(max_examples=50, deadline=None, derandomize=True)
def test_the_state_machine_is_the_standards_and_the_demand_never_jumps(acts: list[Act]):
    master = Master()
    for act in acts:
        act(master)
        master.tick()


@pytest.mark.slow
@given(st.lists(ACTS, min_size=40, max_size=150))
@settings(max_examples=150, deadline=None, derandomize=True)
def test_the_same_for_long(acts: list[Act]):
    master = Master()
    for act in acts:
        act(master)
        master.tick()


@given(
    st.integers(-LIMIT, LIMIT),
    st.lists(st.one_of(ACTS, write(0x6098, 0, 1, st.integers(0, 37))), max_size=40),
)
@settings(max_examples=15, deadline=None, derandomize=True)
def test_homing_in_between_never_raises(start: int, acts: list[Act]):
    """Homing moves the frame that the limits are in, and limit switches stop: the rest must hold all the same."""
    master = Master(Switches(-900, 900, (100.0, 200.0), 40))
    bench = master.bench
    bench.shaft = start
    master.tick = lambda: bench.run(MS)  # type: ignore[method-assign]
    for act in acts:
        act(master)
        bench.run(3 * MS)
    bench.must(0x6060, 0, 0, 1)
    bench.control(0x00)
    bench.run(MS)
    assert state_of(bench.statusword) in {DISABLED, 0x08}
    assert bench.read(0x6061) == 0
