"""The order in which the real-time hosts hand wakes and frames to a core."""

import logging

import pytest
from host_nodes import PeriodicNode, ScriptedNode, StuckNode

from drivers.frame import Frame
from drivers.node import Event
from drivers.node_runner import LATENESS_WARNING_NS, MAX_BACKLOG_FRAMES, MAX_CATCH_UP_NS, MAX_WAKES_PER_CALL, NodeRunner
from drivers.virtual_time import MAX_WAKES_PER_INSTANT, LivelockError

SYNC = Frame(0x080)
MILLISECOND = 1_000_000


class Wire:
    """Takes ``room`` frames and then no more."""

    def __init__(self, room: int = 1_000_000) -> None:
        self.room = room
        self.sent: list[str] = []

    def transmit(self, frame: Frame) -> bool:
        if self.room == 0:
            return False
        self.room -= 1
        self.sent.append(str(frame))
        return True


def test_late_wakes_are_given_their_own_instants_and_none_is_left_out() -> None:
    node = PeriodicNode(MILLISECOND, start_ns=5 * MILLISECOND, frame=SYNC)
    wire = Wire()
    lateness: list[tuple[int, int]] = []
    runner = NodeRunner(node, wire.transmit, 0, on_wake=lambda due_ns, now_ns: lateness.append((due_ns, now_ns)))
    runner.advance(5 * MILLISECOND - 1)
    assert node.log == []
    runner.advance(7 * MILLISECOND + 300)
    assert node.log == [("wake", 5_000_000), ("wake", 6_000_000), ("wake", 7_000_000)]
    assert lateness == [(5_000_000, 7_000_300), (6_000_000, 7_000_300), (7_000_000, 7_000_300)]
    assert wire.sent == ["080#"] * 3
    assert runner.next_wake_ns == 8 * MILLISECOND
    assert runner.statistics.max_wake_lateness_ns == 2_000_300
    assert (runner.statistics.wakes, runner.statistics.frames_sent) == (3, 3)


def test_wakes_due_before_a_frame_come_before_it_and_later_ones_do_not() -> None:
    node = PeriodicNode(MILLISECOND, start_ns=MILLISECOND)
    runner = NodeRunner(node, Wire().transmit, 0)
    runner.deliver(SYNC, 2_500_000, 4 * MILLISECOND)
    runner.deliver(SYNC, 3_000_000, 4 * MILLISECOND)
    runner.advance(4 * MILLISECOND)
    assert node.log == [
        ("wake", 1_000_000),
        ("wake", 2_000_000),
        ("080#", 2_500_000),
        ("080#", 3_000_000),  # at the same nanosecond the frame goes first, as in virtual time
        ("wake", 3_000_000),
        ("wake", 4_000_000),
    ]
    assert runner.statistics.max_wake_lateness_ns == 3 * MILLISECOND


def test_time_never_runs_backwards() -> None:
    node = ScriptedNode({10: [], 300: []})
    runner = NodeRunner(node, Wire().transmit, 200)
    runner.advance(250)
    runner.advance(400)
    runner.deliver(SYNC, 290)
    assert node.log == [("wake", 200), ("wake", 300), ("080#", 300)]


def test_a_time_too_long_to_make_good_is_skipped() -> None:
    node = PeriodicNode(MILLISECOND, start_ns=0)
    runner = NodeRunner(node, Wire().transmit, 0)
    runner.advance(0)
    runner.advance(MAX_CATCH_UP_NS + 2 * MILLISECOND)
    assert node.log == [("wake", 0), ("wake", MAX_CATCH_UP_NS + 2 * MILLISECOND)]
    assert runner.statistics.max_wake_lateness_ns == MAX_CATCH_UP_NS + MILLISECOND


def test_a_host_that_has_fallen_behind_comes_up_for_air() -> None:
    node = PeriodicNode(1_000, start_ns=0)
    runner = NodeRunner(node, Wire().transmit, 0)
    runner.advance(3 * MILLISECOND)
    assert len(node.log) == MAX_WAKES_PER_CALL
    assert runner.next_wake_ns == MAX_WAKES_PER_CALL * 1_000


def test_falling_behind_is_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    node = PeriodicNode(10 * MILLISECOND, start_ns=0)
    runner = NodeRunner(node, Wire().transmit, 0)
    with caplog.at_level(logging.WARNING):
        runner.advance(LATENESS_WARNING_NS - 1)
        assert caplog.messages == []
        runner.advance(3 * LATENESS_WARNING_NS)
        runner.advance(6 * LATENESS_WARNING_NS)
    assert caplog.messages == ["200 ms behind real time; is this machine too slow, or too busy?"]


def test_a_core_that_holds_the_time_is_named() -> None:
    runner = NodeRunner(StuckNode(), Wire().transmit, 5)
    for _ in range(MAX_WAKES_PER_INSTANT // MAX_WAKES_PER_CALL):
        runner.advance(10)
    with pytest.raises(LivelockError, match="StuckNode"):
        runner.advance(10)


def test_frames_that_the_bus_has_no_room_for_are_offered_again_in_their_order() -> None:
    node = ScriptedNode({1: [Frame(1), Frame(2), Frame(3)], 2: [Frame(4)]})
    wire = Wire(room=1)
    runner = NodeRunner(node, wire.transmit, 0)
    runner.advance(1)
    assert (wire.sent, runner.has_backlog) == (["001#"], True)
    wire.room = 1
    runner.advance(2)
    assert wire.sent == ["001#", "002#"]
    wire.room = 9
    runner.flush()
    assert (wire.sent, runner.has_backlog) == (["001#", "002#", "003#", "004#"], False)
    assert runner.statistics.frames_sent == 4


def test_the_oldest_of_too_many_waiting_frames_are_dropped_and_counted() -> None:
    node = ScriptedNode({1: [Frame(number) for number in range(MAX_BACKLOG_FRAMES + 3)]})
    wire = Wire(room=0)
    runner = NodeRunner(node, wire.transmit, 0)
    runner.advance(1)
    wire.room = 1_000
    runner.flush()
    assert wire.sent[0] == "003#"
    assert len(wire.sent) == MAX_BACKLOG_FRAMES
    assert runner.statistics.frames_dropped == 3


def test_frames_from_construction_go_out_and_events_are_handed_on() -> None:
    wire = Wire()
    events: list[Event] = []
    runner = NodeRunner(ScriptedNode(initial=[Frame(0x701, b"\x00")]), wire.transmit, 7, events.append)
    assert wire.sent == ["701#00"]
    assert runner.next_wake_ns is None
    runner.deliver(SYNC, 9)
    assert events == [Event(9)]
