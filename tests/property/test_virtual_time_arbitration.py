"""What holds on the virtual bus for whatever traffic."""

import random
from collections.abc import Sequence

from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.frame import WORST_CASE_BITS, Frame
from drivers.node import Event
from drivers.virtual_time import VirtualBus

BIT_NS = 2_000
BIT_RATE = 500_000


class Talker:
    """Sends its frames at their instants, and logs what it hears."""

    def __init__(self, plan: list[tuple[int, Frame]]) -> None:
        self.plan = sorted(plan, key=lambda item: item[0])
        self.offered = [frame for _, frame in self.plan]
        self.heard: list[tuple[int, Frame]] = []
        self.out: list[Frame] = []

    def receive(self, frame: Frame, now_ns: int) -> None:
        self.heard.append((now_ns, frame))

    def next_wake_ns(self) -> int | None:
        return self.plan[0][0] if self.plan else None

    def wake(self, now_ns: int) -> None:
        assert now_ns == self.plan[0][0]
        self.out.append(self.plan.pop(0)[1])

    def take_frames(self) -> list[Frame]:
        frames, self.out = self.out, []
        return frames

    def take_events(self) -> list[Event]:
        return []


class Chance:
    """Loses, doubles and delays at random."""

    def delays_ns(self, sender: int, frame: Frame, now_ns: int, source: random.Random) -> Sequence[int]:
        return source.choice(((0,), (0,), (), (0, 0), (source.randrange(1_000_000),)))


# The first bytes number the frames of a plan, so that each can be told from all others.
Plans = st.lists(
    st.lists(st.tuples(st.integers(0, 3_000_000), st.integers(0, 0x7FF), st.integers(2, 8)), max_size=12),
    min_size=1,
    max_size=4,
)
LIMIT_NS = 1_000_000_000


def build(plans: list[list[tuple[int, int, int]]]) -> list[Talker]:
    return [
        Talker(
            [
                (at_ns, Frame(cob_id, bytes((node, number)).ljust(length, b"\x55")))
                for number, (at_ns, cob_id, length) in enumerate(plan)
            ]
        )
        for node, plan in enumerate(plans)
    ]


@settings(max_examples=60, deadline=None)
@given(Plans)
def test_every_frame_is_heard_once_by_all_others_and_the_bus_carries_one_at_a_time(
    plans: list[list[tuple[int, int, int]]],
) -> None:
    traced: list[tuple[int, Frame]] = []
    nodes = build(plans)
    bus = VirtualBus(nodes, BIT_RATE, trace=lambda now_ns, frame: traced.append((now_ns, frame)))
    bus.run_until(LIMIT_NS)

    offered = [frame for node in nodes for frame in node.offered]
    assert sorted(frame for _, frame in traced) == sorted(offered)
    for index, node in enumerate(nodes):
        assert node.heard == [(at_ns, frame) for at_ns, frame in traced if frame.data[0] != index]
        own = [frame for _, frame in traced if frame.data[0] == index]
        assert own == node.offered
    starts = [at_ns - WORST_CASE_BITS[len(frame.data)] * BIT_NS for at_ns, frame in traced]
    ends = [at_ns for at_ns, _ in traced]
    assert all(end <= start for end, start in zip(ends, starts[1:], strict=False))
    assert bus.busy_ns == sum(end - start for end, start in zip(ends, starts, strict=True))


@settings(max_examples=60, deadline=None)
@given(Plans)
def test_whoever_wins_had_the_lowest_cob_id_of_the_frames_at_the_head_of_their_queues(
    plans: list[list[tuple[int, int, int]]],
) -> None:
    """Replays the arbitration in the plainest way, from the plans alone, and demands the same instants."""
    traced: list[tuple[int, int, int]] = []
    nodes = build(plans)
    bus = VirtualBus(nodes, BIT_RATE, trace=lambda now_ns, frame: traced.append((now_ns, *frame.data[:2])))
    pending = [list(node.plan) for node in nodes]
    bus.run_until(LIMIT_NS)

    expected: list[tuple[int, int, int]] = []
    free_ns = 0
    while any(pending):
        start_ns = max(free_ns, min(plan[0][0] for plan in pending if plan))
        heads = [plan[0][1] for plan in pending if plan and plan[0][0] <= start_ns]
        winner = min(heads, key=lambda frame: (frame.cob_id, frame.data[0]))
        pending[winner.data[0]].pop(0)
        free_ns = start_ns + WORST_CASE_BITS[len(winner.data)] * BIT_NS
        expected.append((free_ns, *winner.data[:2]))
    assert traced == expected


@settings(max_examples=40, deadline=None)
@given(Plans, st.integers(0, 1 << 32), st.lists(st.integers(1, 400_000), max_size=30))
def test_a_run_is_a_function_of_nodes_and_seed_however_it_is_cut(
    plans: list[list[tuple[int, int, int]]], seed: int, cuts: list[int]
) -> None:
    def run(steps: list[int]) -> list[tuple[int, Frame]]:
        traced: list[tuple[int, Frame]] = []
        bus = VirtualBus(build(plans), BIT_RATE, seed, lambda now_ns, frame: traced.append((now_ns, frame)), Chance())
        for step in steps:
            bus.run_until(bus.now_ns + step)
        bus.run_until(LIMIT_NS)
        return traced

    whole = run([])
    assert run([]) == whole
    assert run(cuts) == whole
