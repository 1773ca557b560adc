"""Recordings: what was written comes back, also from a file whose writer was killed; anything else is one sentence."""

import contextlib
import io
import json
import signal
import struct
import subprocess
import sys
import warnings
import zlib
from pathlib import Path

import can
import numpy as np
import pytest
import zstandard
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from mcap.writer import Writer
from recording_samples import CONSTANTS, LAYOUT, steady_run

from gateway.record.mcap_file import McapError, RawChunk, scan, split_records
from gateway.record.recording import (
    RecordingError,
    RecordingMetadata,
    RecordingSink,
    RecordingWriter,
    read_recording,
    write_candump_log,
)
from gateway.record.ring import FRAME_DTYPE, FrameArray, RingWriter, RunEvent, RunState
from gateway.record.sample import SampleArray

METADATA = RecordingMetadata(CONSTANTS, "name: hand-made\n", product_version="1.2.3")


def frames(count: int = 3000) -> FrameArray:
    made = np.zeros(count, dtype=FRAME_DTYPE)
    made["at_ns"] = np.arange(count) * 500_000
    made["cob_id"] = 0x181 + np.arange(count) % 2
    made["length"] = 8
    made["data"] = np.arange(count)[:, None] % 251
    return made


def write(path: Path, samples: SampleArray, *, batch: int = 10_000) -> Path:
    with RecordingWriter(path, METADATA) as writer:
        for start in range(0, len(samples), batch):
            writer.write_samples(samples[start : start + batch])
        writer.write_frames(frames())
        writer.write_event(RunEvent({"at_ns": 5, "kind": "state", "text": "begin"}))
        writer.write_event(RunEvent({"at_ns": 2_000_000_000, "kind": "end", "text": "", "stopped_by": "completed"}))
    return path


def test_everything_comes_back(tmp_path: Path) -> None:
    samples = steady_run()
    recording = read_recording(write(tmp_path / "a.mcap", samples))
    assert np.array_equal(recording.samples, samples)
    assert np.array_equal(recording.frames(), frames())
    assert [event.data["kind"] for event in recording.events] == ["state", "end"]
    assert recording.metadata == METADATA
    assert recording.constants == CONSTANTS
    assert recording.config_text == "name: hand-made\n"
    assert recording.stopped_by == "completed"
    assert recording.is_complete


def test_the_same_run_is_the_same_bytes_however_it_came_in(tmp_path: Path) -> None:
    first = write(tmp_path / "a.mcap", steady_run()).read_bytes()
    for batch in (1, 7, 384, 385):
        assert write(tmp_path / f"{batch}.mcap", steady_run(), batch=batch).read_bytes() == first


def test_the_sink_writes_what_the_writer_writes(tmp_path: Path) -> None:
    samples = steady_run(1500)
    with RecordingWriter(tmp_path / "a.mcap", METADATA) as writer:
        sink = RecordingSink(writer)
        for record in samples:
            values: list[float] = []
            for name in LAYOUT.dtype.names or ():
                values.extend(np.ravel(record[name]).tolist())
            sink.append(*values)
        sink.append_frame(3, 0x80, b"")
        sink.append_event(4, "end", "", stopped_by="operator")
        sink.flush()
    recording = read_recording(tmp_path / "a.mcap")
    assert np.array_equal(recording.samples, samples)
    assert recording.frames()[["at_ns", "cob_id", "length"]].tolist() == [(3, 0x80, 0)]
    assert recording.stopped_by == "operator"


def test_the_package_mcap_reads_it_with_all_checksums(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", steady_run(1000))
    with path.open("rb") as stream:
        topics: dict[str, list[int]] = {}
        for _, channel, message in make_reader(stream, validate_crcs=True).iter_messages():
            topics.setdefault(channel.topic, []).append(message.log_time)
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    with path.open("rb") as stream:
        names = [attachment.name for attachment in make_reader(stream).iter_attachments()]
    assert {topic: len(times) for topic, times in topics.items()} == {"/cycle": 1000, "/frames": 3000, "/events": 2}
    assert topics["/cycle"] == [k * 1_000_000 for k in range(1000)]
    assert names == ["config.yaml"]
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == 4002
    assert summary.statistics.message_end_time == 2_000_000_000
    # through the chunk indices, by time: half-open, so 0.100 to 0.199 s
    with path.open("rb") as stream, warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # newer releases call the bounds otherwise
        part = make_reader(stream).iter_messages(["/cycle"], start_time=100_000_000, end_time=200_000_000)
        assert sum(1 for _ in part) == 100
    with path.open("rb") as stream:
        assert sum(1 for _ in StreamReader(stream, validate_crcs=True).records) > 4000


def test_the_summary_checksum_is_that_of_the_specification(tmp_path: Path) -> None:
    data = write(tmp_path / "a.mcap", steady_run(10)).read_bytes()
    # footer: opcode, u64 length, summary start, summary offset start, crc, then the magic
    _, _, summary_start, _, crc = struct.unpack("<BQQQI", data[-8 - 29 : -8])
    assert zlib.crc32(data[summary_start : -8 - 4]) == crc


def test_log_times_follow_the_wall_clock_where_it_is_given(tmp_path: Path) -> None:
    samples = steady_run(3)
    samples["sync_ns"] += 50_000_000_000
    metadata = RecordingMetadata(CONSTANTS, start_ns=50_000_000_000, start_wall_ns=1_700_000_000_000_000_000)
    with RecordingWriter(tmp_path / "a.mcap", metadata) as writer:
        writer.write_samples(samples)
    with (tmp_path / "a.mcap").open("rb") as stream:
        times = [message.log_time for _, _, message in make_reader(stream).iter_messages()]
    assert times == [1_700_000_000_000_000_000 + k * 1_000_000 for k in range(3)]
    assert read_recording(tmp_path / "a.mcap").metadata.start_wall_ns == 1_700_000_000_000_000_000


@pytest.mark.parametrize("share", [0.3, 0.5, 0.7, 0.9, 0.99])
def test_a_file_cut_off_anywhere_is_read_up_to_there(tmp_path: Path, share: float) -> None:
    whole = write(tmp_path / "a.mcap", steady_run(), batch=100).read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole[: int(len(whole) * share)])
    recording = read_recording(cut)
    assert not recording.is_complete
    count = len(recording.samples)
    assert np.array_equal(recording.samples, steady_run()[:count])
    assert recording.config_text == "name: hand-made\n"


def test_what_was_flushed_survives_without_a_close(tmp_path: Path) -> None:
    writer = RecordingWriter(tmp_path / "a.mcap", METADATA)
    writer.write_samples(steady_run(500))
    writer.write_frames(frames(10))
    writer.flush()
    recording = read_recording(tmp_path / "a.mcap")
    assert (len(recording.samples), len(recording.frames()), recording.is_complete) == (500, 10, False)
    assert recording.stopped_by == "unknown"
    writer.close()


def test_an_existing_file_is_kept_unless_asked(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_text("precious")
    with pytest.raises(RecordingError, match="exists already"):
        RecordingWriter(path, METADATA)
    assert path.read_text() == "precious"
    RecordingWriter(path, METADATA, overwrite=True).close()
    assert read_recording(path).is_complete


def test_a_folder_that_does_not_exist_is_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="cannot be made: No such file"):
        RecordingWriter(tmp_path / "no" / "a.mcap", METADATA)


def _someone_elses() -> bytes:
    stream = io.BytesIO()
    writer = Writer(stream)
    writer.start()
    schema = writer.register_schema("x", "jsonschema", b"{}")
    channel = writer.register_channel("/cycle", "json", schema)
    writer.add_message(channel, 0, b"{}", 0)
    writer.finish()
    return stream.getvalue()


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "is empty"),
        (b"hello world, I am no recording", "not an MCAP file"),
        (_someone_elses(), "was not made by drive-gateway"),
        (b"\x89MCAP0\r\n", "was not made by drive-gateway, or is truncated before the run begins"),
    ],
)
def test_other_files_are_one_sentence(tmp_path: Path, data: bytes, reason: str) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(data)
    with pytest.raises(RecordingError, match=reason) as caught:
        read_recording(path)
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="cannot be read: No such file"):
        read_recording(tmp_path / "none.mcap")


def test_no_flipped_byte_brings_down_the_reader(tmp_path: Path) -> None:
    whole = write(tmp_path / "a.mcap", steady_run(400)).read_bytes()
    random = np.random.default_rng(20)
    path = tmp_path / "b.mcap"
    for position in random.integers(0, len(whole), 300):
        data = bytearray(whole)
        data[position] ^= int(random.integers(1, 256))
        path.write_bytes(data)
        with contextlib.suppress(RecordingError):
            read_recording(path).frames()


def test_a_chunk_that_unpacks_to_more_than_it_says_is_refused() -> None:
    bomb = zstandard.ZstdCompressor(write_content_size=False).compress(bytes(50_000_000))
    with pytest.raises(McapError, match=r"cannot be decompressed|checksum"):
        RawChunk(0, "zstd", bomb, 1000, 0).messages()
    honest = zstandard.compress(bytes(50_000_000))
    with pytest.raises(McapError, match="contradicts itself"):
        RawChunk(0, "zstd", honest, 1000, 0).messages()
    with pytest.raises(McapError, match="at most"):
        RawChunk(0, "zstd", honest, 1 << 40, 0).messages()


def test_a_recording_that_another_program_rewrote_is_still_read(tmp_path: Path) -> None:
    """The package's writer interleaves the channels within a chunk, as ``mcap compress`` and ``mcap filter`` do."""
    path = write(tmp_path / "a.mcap", steady_run(500))
    other = tmp_path / "b.mcap"
    with path.open("rb") as source, other.open("wb") as target:
        writer = Writer(target)
        writer.start()
        reader = make_reader(source)
        ids: dict[int, int] = {}
        for schema, channel, message in reader.iter_messages():
            if channel.id not in ids:
                assert schema is not None
                schema_id = writer.register_schema(schema.name, schema.encoding, schema.data)
                ids[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, schema_id)
            writer.add_message(ids[channel.id], message.log_time, message.data, message.publish_time)
        for metadata in reader.iter_metadata():
            writer.add_metadata(metadata.name, metadata.metadata)
        writer.finish()
    recording = read_recording(other)
    assert np.array_equal(recording.samples, steady_run(500))
    assert np.array_equal(recording.frames(), frames())


def test_messages_that_do_not_fit_their_chunk_are_an_error() -> None:
    with pytest.raises(McapError, match="ends within a record"):
        split_records(b"\x05" + struct.pack("<Q", 10**9) + bytes(30), 0)
    assert split_records(b"", 0) == ({}, [])
    with pytest.raises(McapError, match="not an MCAP file"):
        list(scan(b"xxxxxxxxxxxx"))


def test_the_candump_log_is_read_by_python_can(tmp_path: Path) -> None:
    made = np.zeros(3, dtype=FRAME_DTYPE)
    made["at_ns"] = [1_700_000_000_000_001_000, 1_700_000_000_000_500_000, 1_700_000_001_000_000_000]
    made["cob_id"] = [0x80, 0x181, 0x701]
    made["length"] = [0, 3, 1]
    made["is_remote"] = [0, 0, 1]
    made["data"][1, :3] = [0x37, 0x12, 0x01]
    path = tmp_path / "bus.log"
    write_candump_log(made, path, "vcan0")
    assert path.read_text().splitlines() == [
        "(1700000000.000001) vcan0 080#",
        "(1700000000.000500) vcan0 181#371201",
        "(1700000001.000000) vcan0 701#R",
    ]
    with can.CanutilsLogReader(path) as log:
        messages = list(log)
    assert [m.arbitration_id for m in messages] == [0x80, 0x181, 0x701]
    assert [bytes(m.data) for m in messages] == [b"", b"\x37\x12\x01", b""]
    assert [m.is_remote_frame for m in messages] == [False, False, True]
    with pytest.raises(RecordingError, match="exists already"):
        write_candump_log(made, path)


def _ring_with_a_run(folder: Path) -> RingWriter:
    ring = RingWriter.create("run", CONSTANTS, directory=folder)
    for k in range(100):
        ring.append(k, k * 1_000_000, 0.0, 0.0, 0.0, 0.0, *[0] * 6, 3, 0, *[0] * 10)
    ring.append_frame(7, 0x80, b"")
    return ring


def _recorder(ring: Path, out: Path) -> "subprocess.Popen[str]":
    return subprocess.Popen(
        [sys.executable, "-m", "gateway.running.recorder", str(ring), str(out)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def test_the_recorder_takes_a_finished_run_whole(tmp_path: Path) -> None:
    with _ring_with_a_run(tmp_path) as ring:
        ring.append_event(9, "end", "", stopped_by="completed")
        ring.set_state(RunState.FINISHED)
        with _recorder(ring.path, tmp_path / "a.mcap") as recorder:
            output, errors = recorder.communicate()
    assert (recorder.returncode, errors) == (0, "")
    assert json.loads(output) == {
        "samples": 100,
        "frames": 1,
        "events": 1,
        "lost_samples": 0,
        "lost_frames": 0,
        "lost_events": 0,
    }
    recording = read_recording(tmp_path / "a.mcap")
    assert (len(recording.samples), recording.stopped_by, recording.is_complete) == (100, "completed", True)
    assert recording.outcome["run_state"] == "FINISHED"


def test_the_recorder_ends_with_sigterm_and_the_file_is_whole(tmp_path: Path) -> None:
    with _ring_with_a_run(tmp_path) as ring, _recorder(ring.path, tmp_path / "a.mcap") as recorder:
        _wait_for(tmp_path / "a.mcap", recorder)
        recorder.send_signal(signal.SIGINT)  # the parent's business
        recorder.send_signal(signal.SIGTERM)
        output, errors = recorder.communicate()
    assert (recorder.returncode, errors) == (0, "")
    assert json.loads(output)["samples"] == 100
    recording = read_recording(tmp_path / "a.mcap")
    assert (recording.stopped_by, recording.is_complete) == ("recorder_stopped", True)


def test_the_recorder_ends_when_the_gateway_is_gone(tmp_path: Path) -> None:
    with _ring_with_a_run(tmp_path) as ring:
        data = bytearray(ring.path.read_bytes())
    # pid and its start time, the two first words: a process that cannot be
    data[64:80] = struct.pack("<2Q", 2**22 + 5, 1)
    dead = tmp_path / "dead.ring"
    dead.write_bytes(data)
    with _recorder(dead, tmp_path / "a.mcap") as recorder:
        recorder.communicate()
    recording = read_recording(tmp_path / "a.mcap")
    assert (recorder.returncode, len(recording.samples), recording.stopped_by) == (0, 100, "gateway_lost")


def test_the_recorder_answers_wrong_use_with_a_sentence(tmp_path: Path) -> None:
    with _recorder(tmp_path / "none.ring", tmp_path / "a.mcap") as recorder:
        output, errors = recorder.communicate()
    assert (recorder.returncode, output) == (2, "")
    assert errors.count("\n") == 1
    assert "cannot be opened" in errors


def _wait_for(path: Path, process: "subprocess.Popen[str]") -> None:
    """Until the recorder has drained the ring once and flushed; bounded by the test's own timeout."""
    while process.poll() is None:
        try:
            if len(read_recording(path).samples):
                return
        except RecordingError:
            continue
