"""Frames that are lost, late, doubled or reordered, in both directions, and which drive is concerned."""

from collections import Counter

import pytest
from fault_line import MS, Line

from sim_drive.injection.faults import Direction, Fault, FaultKind

NODE, OTHER = 5, 7
HEARTBEAT = 0x700 + NODE


def beating(faults: list[Fault], seed: int = 0) -> Line:
    """Heartbeats every 10 ms of node 5; those at 1.0 s and after are the faults'."""
    line = Line(faults, seed=seed)
    line.until(0.0911)
    line.write(0x1017, 0, 10, 2)
    line.until(1.0)
    return line


def times_ms(line: Line, until_s: float) -> list[float]:
    """When heartbeats came, from now on, in ms after the servo has sent its first of a 10 ms grid."""
    line.until(until_s)
    return [round(at_ns / MS, 1) for at_ns, text in line.tester.heard if text.startswith("705")]


def grid(line: Line) -> list[float]:
    return times_ms(line, 1.095)


def test_lost_frames_are_as_many_as_counted_and_of_that_cob_id() -> None:
    undisturbed = grid(beating([]))
    assert len(undisturbed) == 10
    lost = Fault(FaultKind.LOST_FRAMES, NODE, at_s=1.0, cob_id=HEARTBEAT, count=3)
    assert grid(beating([lost])) == undisturbed[3:]
    other = Fault(FaultKind.LOST_FRAMES, NODE, at_s=1.0, cob_id=HEARTBEAT + 1, count=3)
    assert grid(beating([other])) == undisturbed
    masked = Fault(FaultKind.LOST_FRAMES, NODE, at_s=1.0, cob_id=0x700, cob_id_mask=0x780)
    assert grid(beating([masked])) == []
    to_the_drive = Fault(FaultKind.LOST_FRAMES, NODE, at_s=1.0, direction=Direction.RECEIVED)
    assert grid(beating([to_the_drive])) == undisturbed


def test_late_frames_come_that_much_later_and_doubled_ones_twice() -> None:
    undisturbed = grid(beating([]))
    late = Fault(FaultKind.LATE_FRAMES, NODE, at_s=1.0, cob_id=HEARTBEAT, count=1, delay_s=0.0123)
    moved = [undisturbed[0] + 12.3, *undisturbed[1:]]
    assert grid(beating([late])) == pytest.approx(sorted(moved), abs=0.11)
    doubled = Fault(FaultKind.DOUBLED_FRAMES, NODE, at_s=1.0, cob_id=HEARTBEAT, count=1)
    seen = grid(beating([doubled]))
    assert len(seen) == 11
    assert seen[1] - seen[0] == pytest.approx(0.063, abs=0.11), "one after the other, at 63 us a frame of one byte"


def test_a_reordered_frame_changes_places_with_the_next_one() -> None:
    """Two SDO responses, the first of them held until the second has passed."""
    line = Line([Fault(FaultKind.REORDERED_FRAMES, NODE, at_s=0.1, cob_id=0x585, direction=Direction.SENT, count=1)])
    line.until(0.2)
    assert line.put(0x605, "4018100100000000") == []
    assert line.put(0x605, "4018100200000000") == ["585#4318100224100000", "585#43181001D2040000"]
    assert line.put(0x605, "4018100100000000") == ["585#43181001D2040000"]


def test_a_reordered_frame_without_a_next_one_goes_on_after_a_second_or_with_the_end_of_the_fault() -> None:
    for for_s, arrival_s in ((None, 1.3), (0.5, 0.6)):
        fault = Fault(FaultKind.REORDERED_FRAMES, NODE, at_s=0.1, for_s=for_s, cob_id=0x585, count=1)
        line = Line([fault])
        line.until(0.2998)
        assert line.put(0x605, "4018100100000000") == []
        assert line.until(arrival_s - 0.001) == []
        assert line.until(arrival_s + 0.002) == ["585#43181001D2040000"]


def test_requests_are_lost_doubled_and_late_on_their_way_to_the_drive() -> None:
    request = "4018100100000000"
    answer = "585#43181001D2040000"
    cases = (
        (FaultKind.LOST_FRAMES, None, []),
        (FaultKind.DOUBLED_FRAMES, None, [answer, answer]),
        (FaultKind.LATE_FRAMES, 0.001, [answer]),
        (FaultKind.LATE_FRAMES, 0.005, []),
    )
    for kind, delay_s, heard in cases:
        line = Line([Fault(kind, NODE, at_s=0.1, direction=Direction.RECEIVED, cob_id=0x605, delay_s=delay_s)])
        line.until(0.2)
        assert line.put(0x605, request) == heard


def test_only_the_drive_that_is_named_is_concerned() -> None:
    """An NMT reset of all nodes is heard by one drive and lost on the way to the other."""
    line = Line([Fault(FaultKind.LOST_FRAMES, NODE, at_s=0.1, direction=Direction.RECEIVED)], (NODE, OTHER))
    line.until(0.2)
    assert line.put(0x000, "8100") == ["707#00"]


def test_what_a_drive_loses_other_drives_of_the_machine_do_not_hear_either() -> None:
    """Node 7 watches the heartbeat of node 5, inside the one process."""
    for faults, missed in (([], False), ([Fault(FaultKind.MUTE_HEARTBEAT, NODE, at_s=1.0)], True)):
        line = Line(faults, (NODE, OTHER))
        line.until(0.1)
        line.write(0x1017, 0, 20, 2, NODE)
        assert line.write(0x1016, 1, NODE << 16 | 100, 4, OTHER) == 0
        line.until(1.05)
        heard = line.until(1.5)
        assert any(text.startswith("087#3081") for text in heard) == missed


def test_chance_comes_from_the_seed_alone() -> None:
    fault = Fault(FaultKind.LOST_FRAMES, NODE, at_s=1.0, cob_id=HEARTBEAT, probability=0.5)
    runs = []
    for seed in (1, 1, 2):
        line = beating([fault], seed)
        runs.append(times_ms(line, 5.0))
    assert runs[0] == runs[1] != runs[2]
    assert 140 < len(runs[0]) < 260, "of 400"


def test_two_faults_of_frames_work_one_after_the_other() -> None:
    """Each heartbeat is doubled, then each of the two lost with probability: Binomial(2 n, 1/2)."""
    line = beating(
        [
            Fault(FaultKind.DOUBLED_FRAMES, NODE, at_s=1.0, cob_id=HEARTBEAT),
            Fault(FaultKind.LOST_FRAMES, NODE, at_s=1.0, cob_id=HEARTBEAT, probability=0.5),
        ]
    )
    line.until(5.0)
    per_period = Counter(at_ns // (10 * MS) for at_ns, _ in line.tester.heard)
    assert 330 < sum(per_period.values()) < 470
    assert set(per_period.values()) == {1, 2}
