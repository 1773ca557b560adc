"""The ring between the loop and its readers: what is read is what was written, or is said to be lost."""

import json
import os
import stat
import struct
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from recording_samples import CONSTANTS, LAYOUT

from gateway.record.ring import (
    EVENT_MAX_BYTES,
    FRAME_DTYPE,
    RingError,
    RingReader,
    RingWriter,
    RunState,
    StopRequest,
    find_rings,
)
from gateway.record.run_constants import RunConstants
from gateway.record.sample import SampleLayout, saturate_int32

VALUES = (7, 1_000_000, 0.5, 6.25, 6.25, -3.5, 1, 2, 3, 4, 5, 6, 3, 1, 10, 20, 11, 19, 0x1237, 0x0008, -5, 6, 7, -8)


@pytest.fixture
def writer(tmp_path: Path) -> Iterator[RingWriter]:
    ring = RingWriter.create(
        "test", CONSTANTS, directory=tmp_path, sample_capacity=8, frame_capacity=8, event_capacity=4
    )
    yield ring
    ring.close()


def append(writer: RingWriter, cycle: int) -> None:
    writer.append(cycle, *VALUES[1:])


def test_layout_is_the_cdr_of_its_message() -> None:
    # By hand for two axes: 4 x 8, 2 x 8, 8 x 4, 2 x 2 x 4, 3 x 2 x 2 = 32 + 16 + 32 + 16 + 12 = 108, filled up to 112.
    assert LAYOUT.size == LAYOUT.dtype.itemsize == 112
    packed = LAYOUT.pack(*VALUES)
    assert packed[:8] == bytes([7, 0, 0, 0, 0, 0, 0, 0])
    assert packed[32:48] == struct.pack("<2d", 6.25, -3.5)
    assert packed[96:100] == bytes([0x37, 0x12, 0x08, 0x00])
    assert packed[100:108] == struct.pack("<4h", -5, 6, 7, -8)
    record = np.frombuffer(packed, LAYOUT.dtype)[0]
    assert (record["cycle"], record["master_velocity"], record["phase"], record["flags"]) == (7, 6.25, 3, 1)
    assert record["position_demand"].tolist() == [10, 20]
    assert record["position_actual"].tolist() == [11, 19]
    assert record["torque_offset"].tolist() == [7, -8]


@pytest.mark.parametrize("count", range(1, 9))
def test_struct_and_numpy_agree_for_any_number_of_axes(count: int) -> None:
    layout = SampleLayout([f"axis{i}" for i in range(count)])
    assert layout.size == layout.dtype.itemsize
    values: list[float] = list(range(1, 5))
    expected = {"cycle": 1, "sync_ns": 2, "master_position": 3, "master_velocity": 4}
    for name in (layout.dtype.names or ())[4:]:
        field = layout.dtype[name]
        width = field.shape[0] if field.shape else 1
        expected[name] = len(values) + 1
        values.extend(range(len(values) + 1, len(values) + 1 + width))
    record = np.frombuffer(layout.pack(*values), layout.dtype)[0]
    for name, first in expected.items():
        assert np.ravel(record[name])[0] == first, name


@pytest.mark.parametrize("names", [[], ["a", "a"], [str(i) for i in range(9)]])
def test_a_layout_needs_one_to_eight_different_axes(names: list[str]) -> None:
    with pytest.raises(ValueError, match=r"axes|differ"):
        SampleLayout(names)


def test_doubtful_values_are_held_within_int32() -> None:
    assert [saturate_int32(v) for v in (5, 2**40, -(2**40), 2**31 - 1)] == [5, 2**31 - 1, -(2**31 - 1), 2**31 - 1]


def test_a_reader_gets_each_record_once(writer: RingWriter) -> None:
    with RingReader(writer.path) as reader:
        assert len(reader.read_new()[0]) == 0
        append(writer, 1)
        append(writer, 2)
        samples, lost = reader.read_new()
        assert (samples["cycle"].tolist(), lost) == ([1, 2], 0)
        append(writer, 3)
        assert reader.read_new()[0]["cycle"].tolist() == [3]
        assert reader.read_new()[0].tolist() == []
        assert reader.written == 3


def test_records_come_in_order_across_the_end_of_the_ring(writer: RingWriter) -> None:
    with RingReader(writer.path) as reader:
        for first in (0, 5, 10, 15):
            for cycle in range(first, first + 5):
                append(writer, cycle)
            samples, lost = reader.read_new()
            assert (samples["cycle"].tolist(), lost) == (list(range(first, first + 5)), 0)


def test_a_slow_reader_is_told_what_it_lost(writer: RingWriter) -> None:
    with RingReader(writer.path) as reader:
        for cycle in range(20):
            append(writer, cycle)
        samples, lost = reader.read_new()
        # 8 slots; the oldest of them is the one that the writer may be writing into already
        assert samples["cycle"].tolist() == list(range(13, 20))
        assert lost == 13
        append(writer, 20)
        assert (reader.read_new()[0]["cycle"].tolist(), reader.read_new()[1]) == ([20], 0)


def test_records_overwritten_while_they_are_copied_are_thrown_away(
    writer: RingWriter, monkeypatch: pytest.MonkeyPatch
) -> None:
    with RingReader(writer.path) as reader:
        for cycle in range(6):
            append(writer, cycle)
        original = np.empty

        def overtake(*arguments: object, **keywords: object) -> object:
            # Between the two looks at the counter the writer goes on: records 6 to 10 overwrite 0 to 2.
            monkeypatch.setattr(np, "empty", original)
            for cycle in range(6, 11):
                append(writer, cycle)
            return original(*arguments, **keywords)  # type: ignore[call-overload]

        monkeypatch.setattr(np, "empty", overtake)
        samples, lost = reader.read_new()
        # counter is 11: record 11 may be under way in the slot of record 3
        assert samples["cycle"].tolist() == [4, 5]
        assert lost == 4
        assert reader.read_new()[0]["cycle"].tolist() == [6, 7, 8, 9, 10]


def test_a_late_reader_may_begin_with_what_comes(writer: RingWriter) -> None:
    append(writer, 1)
    with RingReader(writer.path, from_start=False) as late:
        append(writer, 2)
        assert late.read_new()[0]["cycle"].tolist() == [2]


def test_frames_travel_with_their_length_and_kind(writer: RingWriter) -> None:
    writer.append_frame(5, 0x181, b"\x37\x12\x01")
    writer.append_frame(6, 0x701, b"", True)
    with RingReader(writer.path) as reader:
        frames, lost = reader.read_new_frames()
    assert lost == 0
    assert FRAME_DTYPE.itemsize == 24
    assert frames["at_ns"].tolist() == [5, 6]
    assert frames["cob_id"].tolist() == [0x181, 0x701]
    assert frames["length"].tolist() == [3, 0]
    assert frames["is_remote"].tolist() == [0, 1]
    assert frames["data"][0].tolist() == [0x37, 0x12, 1, 0, 0, 0, 0, 0]


def test_events_are_cut_to_their_slot_and_stay_json(writer: RingWriter) -> None:
    writer.append_event(1, "emergency", "short", node_id=2, code=0x8611)
    writer.append_event(2, "warning", "é" * 5000, axis="servo")
    writer.append_event(3, "warning", "x", blob="y" * 5000)
    with RingReader(writer.path) as reader:
        events, lost = reader.read_new_events()
    assert lost == 0
    assert events[0].data == {"at_ns": 1, "kind": "emergency", "text": "short", "node_id": 2, "code": 0x8611}
    assert events[1].data["axis"] == "servo"
    assert set(events[1].data["text"]) <= {"é"}
    assert len(json.dumps(dict(events[1].data))) <= EVENT_MAX_BYTES
    assert events[2].data == {"at_ns": 3, "kind": "warning", "text": ""}


def test_events_that_were_overrun_are_counted(writer: RingWriter) -> None:
    with RingReader(writer.path) as reader:
        for number in range(10):
            writer.append_event(number, "state", "x")
        events, lost = reader.read_new_events()
        assert ([event.data["at_ns"] for event in events], lost) == ([7, 8, 9], 7)


def test_stop_requests_are_never_weakened(writer: RingWriter) -> None:
    with RingReader(writer.path) as reader:
        assert writer.stop_request() == StopRequest.NONE
        reader.request_stop(StopRequest.QUICK_STOP)
        reader.request_stop(StopRequest.CONTROLLED_STOP)
        assert writer.stop_request() == StopRequest.QUICK_STOP


def test_state_result_and_heartbeat_reach_the_reader(writer: RingWriter) -> None:
    with RingReader(writer.path) as reader:
        assert reader.state is RunState.STARTING
        writer.beat(123)
        writer.set_state(RunState.FAILED, 17)
        assert (reader.state, reader.result, reader.heartbeat_ns) == (RunState.FAILED, 17, 123)
        assert reader.is_over()
        assert reader.writer_pid == os.getpid()


def test_the_header_carries_the_machine(writer: RingWriter) -> None:
    with RingReader(writer.path) as reader:
        assert reader.constants == CONSTANTS
        assert reader.layout.axis_names == ("cv", "servo")
    assert RunConstants.from_json(CONSTANTS.to_json()) == CONSTANTS


def test_the_file_is_private_and_goes_with_its_writer(writer: RingWriter, tmp_path: Path) -> None:
    assert writer.path.name == f"drive-gateway-test-{os.getpid()}.ring"
    assert stat.S_IMODE(writer.path.stat().st_mode) == 0o600
    assert find_rings("test", tmp_path) == find_rings(None, tmp_path) == [writer.path]
    assert find_rings("tes", tmp_path) == []
    writer.close()
    assert list(tmp_path.iterdir()) == []


def test_a_reader_keeps_its_memory_when_the_file_is_gone(writer: RingWriter) -> None:
    append(writer, 1)
    with RingReader(writer.path) as reader:
        writer.close()
        assert reader.read_new()[0]["cycle"].tolist() == [1]


def test_two_rings_of_one_name_in_one_process_are_refused(writer: RingWriter, tmp_path: Path) -> None:
    with pytest.raises(RingError, match="exists already"):
        RingWriter.create("test", CONSTANTS, directory=tmp_path)
    assert writer.path.exists()


@pytest.mark.parametrize("name", ["", "../x", "a/b", "x" * 65, ".hidden"])
def test_a_name_that_is_no_file_name_is_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(RingError, match="a name is made of"):
        RingWriter.create(name, CONSTANTS, directory=tmp_path)
    assert find_rings(name, tmp_path) == []


def test_capacities_are_powers_of_two(tmp_path: Path) -> None:
    with pytest.raises(RingError, match="powers of two"):
        RingWriter.create("x", CONSTANTS, directory=tmp_path, sample_capacity=1000)


CHILD = """
import sys
from pathlib import Path
from gateway.record.ring import RingWriter
ring = RingWriter.take_over(Path(sys.argv[1]))
ring.append(*range(1, 5), 0.0, 0.0, *range(7, 25))
print("ready", flush=True)
sys.stdin.readline()
"""


def test_a_child_takes_over_and_its_death_is_seen(writer: RingWriter, tmp_path: Path) -> None:
    with (
        RingReader(writer.path) as reader,
        subprocess.Popen(
            [sys.executable, "-c", CHILD, str(writer.path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        ) as child,
    ):
        assert child.stdin is not None
        assert child.stdout is not None
        assert child.stdout.readline() == "ready\n"
        assert reader.writer_pid == child.pid
        assert not reader.is_over()
        assert reader.read_new()[0]["cycle"].tolist() == [1]
        child.kill()
        child.wait()
        assert reader.state is RunState.STARTING
        assert reader.is_over()
        assert find_rings("test", tmp_path) == []
        # the next run of this name clears it away
        dead = writer.path.rename(tmp_path / "drive-gateway-test-1.ring")
        RingWriter.create("test", CONSTANTS, directory=tmp_path).close()
        assert not dead.exists()


def _damage(data: bytearray, kind: str) -> bytes:
    if kind == "magic":
        data[0] ^= 1
    elif kind == "version":
        data[8] = 99
    elif kind == "record size":
        data[16] ^= 8
    elif kind == "capacity":
        data[20] = 7
    elif kind == "json":
        data[260] = 0xFF
    elif kind == "json length":
        data[32:36] = b"\xff\xff\xff\x7f"
    elif kind == "truncated":
        return bytes(data[:-1])
    elif kind == "short":
        return bytes(data[:100])
    elif kind == "empty":
        return b""
    return bytes(data)


@pytest.mark.parametrize(
    "kind", ["magic", "version", "record size", "capacity", "json", "json length", "truncated", "short", "empty"]
)
def test_a_foreign_or_damaged_file_is_one_error(writer: RingWriter, tmp_path: Path, kind: str) -> None:
    path = tmp_path / "other.ring"
    path.write_bytes(_damage(bytearray(writer.path.read_bytes()), kind))
    with pytest.raises(RingError) as caught:
        RingReader(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_file_and_a_link_are_refused(writer: RingWriter, tmp_path: Path) -> None:
    with pytest.raises(RingError, match="cannot be opened"):
        RingReader(tmp_path / "none.ring")
    link = tmp_path / "link.ring"
    link.symlink_to(writer.path)
    with pytest.raises(RingError, match="cannot be opened"):
        RingReader(link)
