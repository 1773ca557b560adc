"""The virtual-time host against instants worked out by hand; at 1 Mbit/s a bit is 1000 ns."""

import random
from collections.abc import Sequence

import pytest
from host_nodes import PeriodicNode, ScriptedNode, StuckNode

from drivers.frame import Frame
from drivers.node import Event
from drivers.virtual_time import LivelockError, VirtualBus

MEGABIT = 1_000_000
SYNC = Frame(0x080)


def test_a_frame_is_heard_by_all_but_its_sender_at_the_end_of_its_wire_time() -> None:
    sender = ScriptedNode({1_000: [Frame(0x181, bytes(8))]})
    others = [ScriptedNode(), ScriptedNode()]
    bus = VirtualBus([sender, *others], MEGABIT)
    bus.run_until(135_999)
    assert [node.received for node in others] == [[], []]
    bus.run_until(136_000)  # 1000 ns + 135 bits
    assert [node.received for node in others] == [[("181#0000000000000000", 136_000)]] * 2
    assert sender.received == []
    assert (bus.now_ns, bus.busy_ns, bus.frame_count) == (136_000, 135_000, 1)


def test_wire_time_is_rounded_up_to_whole_nanoseconds() -> None:
    listener = ScriptedNode()
    bus = VirtualBus([ScriptedNode({0: [SYNC]}), listener], 300_000)
    bus.run_until(1_000_000)
    assert listener.received == [("080#", 183_334)]  # 55 bits / 300 kbit/s = 183333.3 ns


def test_the_lowest_cob_id_wins_and_nobody_interrupts_a_frame() -> None:
    """At 0 node 0 offers 201h, node 1 182h and 181h in this order; node 2 offers 080h while 182h is on the wire."""
    traced: list[tuple[int, str]] = []
    nodes = [
        ScriptedNode({0: [Frame(0x201, b"\x01")]}),
        ScriptedNode({0: [Frame(0x182, b"\x02"), Frame(0x181, b"\x03")]}),
        ScriptedNode({10_000: [SYNC]}),
    ]
    bus = VirtualBus(nodes, MEGABIT, trace=lambda now_ns, frame: traced.append((now_ns, str(frame))))
    bus.run_until(1_000_000)
    # One byte takes 47 + 8 + floor(41 / 4) = 65 us. 181h had to wait behind its own node's 182h.
    assert traced == [(65_000, "182#02"), (120_000, "080#"), (185_000, "181#03"), (250_000, "201#01")]


def test_a_data_frame_goes_before_a_remote_frame_of_its_cob_id_and_then_the_lower_node() -> None:
    traced: list[str] = []
    nodes = [
        ScriptedNode({0: [Frame(0x701, b"", True)]}),
        ScriptedNode({0: [Frame(0x701, b"\x7f")]}),
        ScriptedNode({0: [Frame(0x701, b"\x05")]}),
    ]
    VirtualBus(nodes, MEGABIT, trace=lambda _, frame: traced.append(str(frame))).run_until(1_000_000)
    assert traced == ["701#7F", "701#05", "701#R"]


def test_frames_handed_out_at_one_instant_compete_whichever_node_woke_first() -> None:
    listener = ScriptedNode()
    nodes = [ScriptedNode({5: [Frame(0x300)]}), ScriptedNode({5: [Frame(0x100)]}), listener]
    VirtualBus(nodes, MEGABIT).run_until(1_000_000)
    assert listener.received == [("100#", 55_005), ("300#", 110_005)]


def test_at_one_instant_the_frame_comes_before_the_wake() -> None:
    node = ScriptedNode({55_000: []})
    VirtualBus([ScriptedNode({0: [SYNC]}), node], MEGABIT).run_until(55_000)
    assert node.log == [("080#", 55_000), ("wake", 55_000)]


def test_answers_compete_with_what_is_already_waiting() -> None:
    """A SYNC, answered with 181h by node 1, goes before node 0's own 201h, which waited for the SYNC to end."""
    traced: list[str] = []
    nodes = [
        ScriptedNode({0: [SYNC, Frame(0x201)]}),
        ScriptedNode(answer=lambda frame, _: [Frame(0x181)] if frame == SYNC else []),
    ]
    VirtualBus(nodes, MEGABIT, trace=lambda _, frame: traced.append(str(frame))).run_until(1_000_000)
    assert traced == ["080#", "181#", "201#"]


def test_frames_from_construction_and_from_outside_go_out() -> None:
    node, listener = ScriptedNode(initial=[Frame(0x701, b"\x00")]), ScriptedNode()
    bus = VirtualBus([node, listener], MEGABIT, start_ns=1_000_000)
    bus.run_until(2_000_000)
    node.out.append(SYNC)
    bus.run_until(3_000_000)
    assert listener.received == [("701#00", 1_065_000), ("080#", 2_055_000)]


def test_what_is_waiting_at_the_start_competes_with_the_wakes_due_then() -> None:
    listener = ScriptedNode()
    nodes = [ScriptedNode(initial=[Frame(0x701)]), ScriptedNode({0: [SYNC]}), listener]
    VirtualBus(nodes, MEGABIT).run_until(1_000_000)
    assert [what for what, _ in listener.received] == ["080#", "701#"]


def test_a_wake_asked_for_in_the_past_is_due_now() -> None:
    node = ScriptedNode({100: []})
    bus = VirtualBus([node], MEGABIT, start_ns=5_000)
    bus.run_until(5_000)
    assert node.log == [("wake", 5_000)]


def test_a_node_that_holds_the_time_is_named() -> None:
    bus = VirtualBus([ScriptedNode(), StuckNode()], MEGABIT)
    with pytest.raises(LivelockError, match=r"node 1 \(StuckNode\) still asks to be woken at 0 ns") as caught:
        bus.run_until(10)
    assert (caught.value.node_index, caught.value.now_ns) == (1, 0)


def test_run_while_tells_whether_the_condition_or_the_limit_ended_it() -> None:
    node = PeriodicNode(1_000_000)
    bus = VirtualBus([node], MEGABIT)
    assert bus.run_while(lambda: len(node.log) < 5, limit_ns=10_000_000)
    assert bus.now_ns == 4_000_000
    assert not bus.run_while(lambda: len(node.log) < 100, limit_ns=9_500_000)
    assert bus.now_ns == 9_500_000
    assert len(node.log) == 10


def test_a_bus_where_nothing_happens_comes_to_its_time() -> None:
    bus = VirtualBus([], MEGABIT)
    bus.run_until(7)
    assert bus.now_ns == 7


def test_time_does_not_run_backwards() -> None:
    bus = VirtualBus([], MEGABIT, start_ns=8)
    with pytest.raises(ValueError, match="from 8 ns to 7 ns"):
        bus.run_until(7)
    with pytest.raises(ValueError, match="bit_rate"):
        VirtualBus([], 0)


def test_a_node_that_says_that_nothing_has_come_of_it_is_not_asked() -> None:
    class Quiet(ScriptedNode):
        """Silent until 300 us; what it then has to say has been put there by a frame before."""

        def __init__(self) -> None:
            super().__init__({300_000: [SYNC]})
            self.questions: list[str] = []

        def receive(self, frame: Frame, now_ns: int) -> bool:
            super().receive(frame, now_ns)
            return False

        def wake(self, now_ns: int) -> bool:
            super().wake(now_ns)
            return bool(self.out)

        def next_wake_ns(self) -> int | None:
            self.questions.append("wake")
            return self.sends[0][0] if self.sends else None

        def take_frames(self) -> list[Frame]:
            self.questions.append("frames")
            return super().take_frames()

    quiet = Quiet()
    quiet.sends.insert(0, (200_000, []))
    frames: list[str] = []
    bus = VirtualBus(
        [ScriptedNode({0: [SYNC, Frame(0x181)]}), quiet], MEGABIT, trace=lambda _, f: frames.append(str(f))
    )
    bus.run_until(150_000)
    quiet.questions.clear()
    bus.run_until(190_000)
    assert quiet.questions == ["frames", "wake"]  # of the run's beginning
    assert [what for what, _ in quiet.log] == ["080#", "181#"]
    quiet.questions.clear()
    bus.run_until(250_000)
    assert quiet.questions == ["frames", "wake", "wake", "wake"]  # its own wake asks for the next one, too
    bus.run_until(400_000)
    assert frames == ["080#", "181#", "080#"]


def test_events_are_handed_on_with_the_node_they_come_from() -> None:
    seen: list[tuple[int, Event]] = []
    nodes = [ScriptedNode({0: [SYNC]}), ScriptedNode(), ScriptedNode()]
    VirtualBus(nodes, MEGABIT, on_event=lambda index, event: seen.append((index, event))).run_until(55_000)
    assert seen == [(1, Event(55_000)), (2, Event(55_000))]


def test_without_a_listener_events_stay_in_the_node() -> None:
    node = ScriptedNode()
    VirtualBus([ScriptedNode({0: [SYNC]}), node], MEGABIT).run_until(55_000)
    assert node.take_events() == [Event(55_000)]


class ByCobId:
    """Faults by COB-ID: 1 is lost, 2 is doubled, 3 is late by 500 us, all others pass."""

    def delays_ns(self, sender: int, frame: Frame, now_ns: int, source: random.Random) -> Sequence[int]:
        return {1: (), 2: (0, 0), 3: (500_000,)}.get(frame.cob_id, (0,))


def test_frames_are_lost_doubled_and_late_and_take_their_wire_time_all_the_same() -> None:
    traced: list[tuple[int, str]] = []
    listener = ScriptedNode()
    bus = VirtualBus(
        [ScriptedNode({0: [Frame(1), Frame(2), Frame(3), Frame(4)]}), listener],
        MEGABIT,
        trace=lambda now_ns, frame: traced.append((now_ns, str(frame))),
        faults=ByCobId(),
    )
    bus.run_until(1_000_000)
    assert listener.received == [("002#", 110_000), ("002#", 110_000), ("004#", 220_000), ("003#", 665_000)]
    assert [(what, at_ns) for at_ns, what in traced] == listener.received
    assert (bus.frame_count, bus.busy_ns) == (4, 220_000)
