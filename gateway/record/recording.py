"""The recording: an MCAP file that holds a run and everything needed to judge it later.

Channels: ``/cycle``, a sample a cycle (CDR, ``drive_gateway/msg/Cycle``); ``/frames``, the bus (CDR,
``drive_gateway/msg/CanFrame``); ``/events`` (JSON). Attachments: the configuration and the cam as they were. Metadata:
the machine's constants and, at the end, how the run ended. Foxglove and every other MCAP reader open it as it is.

The file says nothing of the wall clock unless it is told to, so that the same run gives the same bytes.
"""

import json
import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import Any, BinaryIO, Final, Self, cast

import numpy as np
from mcap.records import Attachment, Channel, Footer, Message, Metadata
from numpy.typing import NDArray

from drivers.frame import Frame
from gateway.errors import UsageError
from gateway.record.mcap_file import Bodies, McapError, McapWriter, RawChunk, Scanned, scan, split_records
from gateway.record.ring import FRAME_DTYPE, FRAME_STRUCT, FrameArray, RunEvent
from gateway.record.run_constants import RunConstants
from gateway.record.sample import CDR_HEADER, SAMPLE_SCHEMA_NAME, SampleArray, SampleLayout

LIBRARY: Final = "drive-gateway"
CYCLE_TOPIC: Final = "/cycle"
FRAMES_TOPIC: Final = "/frames"
EVENTS_TOPIC: Final = "/events"
CONFIG_ATTACHMENT: Final = "config.yaml"
CAM_ATTACHMENT: Final = "cam.json"
_RUN_METADATA: Final = "drive-gateway.run"
_OUTCOME_METADATA: Final = "drive-gateway.outcome"
_MAX_FILE_BYTES: Final = 1 << 32
_MAX_ATTACHMENT_BYTES: Final = 1 << 26
# 64 KiB of either; cut by count, so that the file does not depend on how the data came in
_SAMPLES_A_CHUNK: Final = 384
_FRAMES_A_CHUNK: Final = 1152
_SINK_SAMPLES: Final = 1024
"""So many samples are packed at once."""

FRAME_SCHEMA: Final = """\
# One CAN frame on the bus.
int64 at_ns  # when, monotonic or virtual
uint32 cob_id
uint8 is_remote
uint8 length
uint8[8] data  # the first `length` bytes count
"""
FRAME_SCHEMA_NAME: Final = "drive_gateway/msg/CanFrame"
_FRAME_BODY_BYTES: Final = 22
EVENT_SCHEMA: Final = json.dumps(
    {
        "type": "object",
        "properties": {"at_ns": {"type": "integer"}, "kind": {"type": "string"}, "text": {"type": "string"}},
        "required": ["at_ns", "kind"],
    }
)


class RecordingError(UsageError):
    """A recording cannot be written or read: ``path`` names it, ``reason`` says why."""

    def __init__(self, path: Path, reason: str) -> None:
        super().__init__(f"recording {path}: {reason}")
        self.path = path
        self.reason = reason


def product_version() -> str:
    """Version of this product as it is installed, ``unknown`` where it runs from a checkout."""
    try:
        return version("drive-gateway")
    except PackageNotFoundError:
        return "unknown"


@dataclass(frozen=True, slots=True)
class RecordingMetadata:
    """What is known when a recording begins.

    ``start_ns`` is the reading of the loop's clock that becomes log time 0, or ``start_wall_ns`` (ns since 1970) where
    that is given.
    """

    constants: RunConstants
    config_text: str = ""
    cam_text: str = ""
    start_ns: int = 0
    start_wall_ns: int | None = None
    product_version: str = field(default_factory=product_version)


class RecordingWriter:
    """Writes a recording to ``path``; close it (or use ``with``) to make it whole.

    A file that was never closed is still read by ``read_recording``, up to the last ``flush``. Raises
    ``RecordingError`` where the file exists (unless ``overwrite``) or cannot be made.
    """

    def __init__(self, path: Path, metadata: RecordingMetadata, *, overwrite: bool = False) -> None:
        self.path: Final = path
        self.layout: Final = SampleLayout(metadata.constants.axis_names)
        try:
            self._stream: BinaryIO = path.open("wb" if overwrite else "xb")
        except FileExistsError as error:
            raise RecordingError(path, "exists already and is not overwritten unless asked") from error
        except OSError as error:
            raise RecordingError(path, f"cannot be made: {error.strerror}") from error
        self._log_offset = (metadata.start_wall_ns or 0) - metadata.start_ns
        self._writer = McapWriter(self._stream, LIBRARY)
        schema = self._writer.add_schema(SAMPLE_SCHEMA_NAME, "ros2msg", self.layout.schema_text)
        self._cycle_channel = self._writer.add_channel(CYCLE_TOPIC, "cdr", schema)
        schema = self._writer.add_schema(FRAME_SCHEMA_NAME, "ros2msg", FRAME_SCHEMA)
        self._frames_channel = self._writer.add_channel(FRAMES_TOPIC, "cdr", schema)
        schema = self._writer.add_schema("drive_gateway.Event", "jsonschema", EVENT_SCHEMA)
        self._events_channel = self._writer.add_channel(EVENTS_TOPIC, "json", schema)
        wall = "" if metadata.start_wall_ns is None else str(metadata.start_wall_ns)
        self._writer.add_metadata(
            _RUN_METADATA,
            {
                "product_version": metadata.product_version,
                "config_name": metadata.constants.config_name,
                "constants": metadata.constants.to_json(),
                "start_ns": str(metadata.start_ns),
                "start_wall_ns": wall,
            },
        )
        if metadata.config_text:
            self._writer.add_attachment(CONFIG_ATTACHMENT, "application/yaml", metadata.config_text.encode())
        if metadata.cam_text:
            self._writer.add_attachment(CAM_ATTACHMENT, "application/json", metadata.cam_text.encode())
        self._samples = _Backlog(self.layout.dtype, _SAMPLES_A_CHUNK, self._write_sample_chunk)
        self._frames = _Backlog(FRAME_DTYPE, _FRAMES_A_CHUNK, self._write_frame_chunk)
        self._events: list[tuple[int, bytes]] = []
        self._is_closed = False

    def write_samples(self, samples: SampleArray) -> None:
        """Take samples (``layout.dtype``), in the order of their time."""
        self._samples.add(samples)

    def write_frames(self, frames: FrameArray) -> None:
        """Take CAN frames (``ring.FRAME_DTYPE``), in the order of their time."""
        self._frames.add(frames)

    def write_event(self, event: RunEvent) -> None:
        """Take an event; its ``at_ns`` is its time."""
        body = json.dumps(dict(event.data), allow_nan=False).encode()
        self._events.append((max(0, int(event.data["at_ns"]) + self._log_offset), body))

    def flush(self) -> None:
        """Put everything taken so far into the file, where it survives the death of this process."""
        self._samples.flush()
        self._frames.flush()
        if self._events:
            self._writer.write_messages(self._events_channel, self._events)
            self._events.clear()
        self._stream.flush()

    def close(self, outcome: Mapping[str, str] | None = None) -> None:
        """Finish the file; ``outcome`` says how the run ended (``stopped_by``, lost records)."""
        if self._is_closed:
            return
        self._is_closed = True
        try:
            self.flush()
            self._writer.add_metadata(_OUTCOME_METADATA, dict(outcome or {}))
            self._writer.finish()
        finally:
            self._stream.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _write_sample_chunk(self, samples: SampleArray) -> None:
        recorded = self.layout.derive(samples)
        self._write_cdr(self._cycle_channel, samples["sync_ns"], recorded, self.layout.recorded_size)

    def _write_frame_chunk(self, frames: FrameArray) -> None:
        self._write_cdr(self._frames_channel, frames["at_ns"], frames, _FRAME_BODY_BYTES)

    def _write_cdr(self, channel: int, at_ns: NDArray[np.int64], records: NDArray[np.void], size: int) -> None:
        bodies = np.empty((len(records), len(CDR_HEADER) + size), dtype=np.uint8)
        bodies[:, : len(CDR_HEADER)] = np.frombuffer(CDR_HEADER, np.uint8)
        bodies[:, len(CDR_HEADER) :] = records.view(np.uint8).reshape(len(records), -1)[:, :size]
        log_times = np.maximum(at_ns + np.int64(self._log_offset), 0).astype(np.uint64)
        self._writer.write_array(channel, log_times, bodies)


class _Backlog:
    """Records on their way into chunks of exactly ``limit``."""

    def __init__(self, dtype: np.dtype[Any], limit: int, write: Callable[[NDArray[np.void]], None]) -> None:
        self._buffer = np.empty(limit, dtype=dtype)
        self._count = 0
        self._write = write

    def add(self, records: NDArray[np.void]) -> None:
        position = 0
        while position < len(records):
            taken = min(len(self._buffer) - self._count, len(records) - position)
            self._buffer[self._count : self._count + taken] = records[position : position + taken]
            self._count += taken
            position += taken
            if self._count == len(self._buffer):
                self.flush()

    def flush(self) -> None:
        if self._count:
            self._write(self._buffer[: self._count])
            self._count = 0


def _tracer(put: Callable[[bytes], None], pack: Callable[..., bytes]) -> Callable[[int, Frame], None]:
    # A function of its own, for it is called for every frame: it looks nothing up.
    def trace(at_ns: int, frame: Frame) -> None:
        cob_id, data, is_remote = frame
        put(pack(at_ns, cob_id, is_remote, len(data), data))

    return trace


class RecordingSink:
    """Lets the cyclic loop write a recording directly (``ring.Sink``): for virtual time, where nobody waits."""

    def __init__(self, writer: RecordingWriter) -> None:
        self._writer = writer
        self._pack = writer.layout.pack
        self._pack_frame = FRAME_STRUCT.pack
        self._limit = _SINK_SAMPLES * writer.layout.size
        # Packed at once: thousands of tuples kept until the next flush would keep the garbage collector busy.
        self._samples = bytearray()
        self._frames = bytearray()
        self._put_sample = self._samples.extend
        self._put_frame = self._frames.extend
        self.trace: Final = _tracer(self._put_frame, FRAME_STRUCT.pack)
        """Takes one CAN frame from the virtual bus."""

    def append(self, *values: float) -> None:
        """Take one sample; see ``ring.Sink``."""
        self._put_sample(self._pack(*values))
        if len(self._samples) >= self._limit:
            self.flush()

    def append_frame(self, at_ns: int, cob_id: int, data: bytes, is_remote: bool = False) -> None:
        """Take one CAN frame; see ``ring.Sink``."""
        self._put_frame(self._pack_frame(at_ns, cob_id, is_remote, len(data), data))

    def append_event(self, at_ns: int, kind: str, text: str, **data: str | int | float | bool | None) -> None:
        """Take one event; see ``ring.Sink``."""
        self._writer.write_event(RunEvent({"at_ns": at_ns, "kind": kind, "text": text, **data}))

    def flush(self) -> None:
        """Hand everything to the writer; call it before the writer is closed."""
        if self._samples:
            self._writer.write_samples(np.frombuffer(bytes(self._samples), self._writer.layout.dtype))
            self._samples.clear()
        if self._frames:
            self._writer.write_frames(np.frombuffer(bytes(self._frames), FRAME_DTYPE))
            self._frames.clear()


@dataclass(frozen=True, slots=True)
class Recording:
    """A recording that was read.

    Attributes: ``samples`` as a structured array of ``layout.dtype``; ``events``; ``outcome`` as the writer's ``close``
    was told, empty where there was none; ``is_complete``, False where the file was never closed.
    """

    path: Path
    metadata: RecordingMetadata
    layout: SampleLayout
    samples: SampleArray
    events: tuple[RunEvent, ...]
    outcome: Mapping[str, str]
    is_complete: bool
    _frame_chunks: tuple[RawChunk | NDArray[np.uint8], ...] = field(repr=False)

    @property
    def constants(self) -> RunConstants:
        return self.metadata.constants

    @property
    def config_text(self) -> str:
        return self.metadata.config_text

    @property
    def cam_text(self) -> str:
        return self.metadata.cam_text

    @property
    def stopped_by(self) -> str:
        """Why the run ended, in its own word; ``unknown`` where the recording does not say."""
        for event in reversed(self.events):
            if "stopped_by" in event.data:
                return str(event.data["stopped_by"])
        return self.outcome.get("stopped_by", "unknown")

    def frames(self) -> FrameArray:
        """The frames on the bus (``ring.FRAME_DTYPE``), unpacked at each call."""
        parts: list[FrameArray] = []
        for chunk in self._frame_chunks:
            if isinstance(chunk, RawChunk):
                try:
                    found, _ = split_records(chunk.messages(), chunk.offset)
                    bodies = _rows(next(iter(found.values())), chunk.offset)
                except McapError as error:
                    raise RecordingError(self.path, f"is damaged: {error}") from error
            else:
                bodies = chunk
            parts.append(_records(bodies, FRAME_DTYPE, self.path))
        return np.concatenate(parts) if parts else np.empty(0, dtype=FRAME_DTYPE)


class _Contents:
    """What a scan of the file has found so far."""

    def __init__(self) -> None:
        self.topics: dict[int, str] = {}
        self.metadata: dict[str, dict[str, str]] = {}
        self.attachments: dict[str, str] = {}
        self.samples: list[NDArray[np.uint8]] = []
        self.frames: list[RawChunk | NDArray[np.uint8]] = []
        self.events: list[bytes] = []
        self.is_complete = False

    def take(self, record: Scanned) -> None:
        if isinstance(record, Channel):
            self.topics[record.id] = record.topic
        elif isinstance(record, Metadata):
            self.metadata[record.name] = record.metadata
        elif isinstance(record, Attachment):
            if len(record.data) > _MAX_ATTACHMENT_BYTES:
                raise McapError(0, f"attachment {record.name} is larger than {_MAX_ATTACHMENT_BYTES} bytes")
            self.attachments[record.name] = record.data.decode()
        elif isinstance(record, RawChunk):
            self._take_chunk(record)
        elif isinstance(record, Message):
            self._take_bodies(record.channel_id, [record.data], 0)
        elif isinstance(record, Footer):
            self.is_complete = True

    def _take_chunk(self, chunk: RawChunk) -> None:
        found, channels = split_records(chunk.messages(), chunk.offset)
        for declared in channels:
            self.topics[declared.id] = declared.topic
        if [self.topics.get(channel) for channel in found] == [FRAMES_TOPIC]:
            self.frames.append(chunk)  # kept packed: most reports never look at the frames
            return
        for channel, bodies in found.items():
            self._take_bodies(channel, bodies, chunk.offset)

    def _take_bodies(self, channel: int, bodies: Bodies, offset: int) -> None:
        topic = self.topics.get(channel)
        if topic == CYCLE_TOPIC:
            self.samples.append(_rows(bodies, offset))
        elif topic == FRAMES_TOPIC:
            self.frames.append(_rows(bodies, offset))
        elif topic == EVENTS_TOPIC:
            self.events.extend(bytes(body) for body in bodies)


def read_recording(path: Path) -> Recording:
    """Read a recording, finished or not.

    Raises ``RecordingError``, one sentence, for a file that is missing, foreign, damaged, too large or without a run.
    """
    contents = _Contents()
    try:
        _scan_file(path, contents)
    except (McapError, UnicodeDecodeError) as error:
        raise RecordingError(path, f"is no recording or damaged: {error}") from error
    run = contents.metadata.get(_RUN_METADATA)
    if run is None:
        raise RecordingError(path, "was not made by drive-gateway, or is truncated before the run begins")
    try:
        wall = run["start_wall_ns"]
        metadata = RecordingMetadata(
            constants=RunConstants.from_json(run["constants"]),
            config_text=contents.attachments.get(CONFIG_ATTACHMENT, ""),
            cam_text=contents.attachments.get(CAM_ATTACHMENT, ""),
            start_ns=int(run["start_ns"]),
            start_wall_ns=int(wall) if wall else None,
            product_version=run["product_version"],
        )
        layout = SampleLayout(metadata.constants.axis_names)
        events = tuple(RunEvent(_event(body)) for body in contents.events)
    except (KeyError, ValueError) as error:
        raise RecordingError(path, f"is damaged: {error}") from error
    parts = [_records(rows, layout.recorded_dtype, path) for rows in contents.samples]
    samples = np.concatenate(parts) if parts else np.empty(0, dtype=layout.recorded_dtype)
    return Recording(
        path=path,
        metadata=metadata,
        layout=layout,
        samples=layout.strip(samples),
        events=events,
        outcome=contents.metadata.get(_OUTCOME_METADATA, {}),
        is_complete=contents.is_complete,
        _frame_chunks=tuple(contents.frames),
    )


def _scan_file(path: Path, contents: _Contents) -> None:
    try:
        with path.open("rb") as stream:
            size = os.fstat(stream.fileno()).st_size
            if size > _MAX_FILE_BYTES:
                raise RecordingError(path, f"has {size} bytes, at most {_MAX_FILE_BYTES} are read")
            if size == 0:
                raise RecordingError(path, "is empty")
            with mmap(stream.fileno(), size, access=ACCESS_READ) as data, memoryview(data) as view:
                for record in scan(view):
                    contents.take(record)
    except OSError as error:
        raise RecordingError(path, f"cannot be read: {error.strerror}") from error


def _event(body: bytes) -> dict[str, Any]:
    data: Any = json.loads(body)
    if not isinstance(data, dict):
        raise ValueError("an event that is not an object")
    event = cast("dict[str, Any]", data)
    if not isinstance(event.get("at_ns"), int):
        raise ValueError("an event without at_ns")
    return event


def _rows(bodies: Bodies, offset: int) -> NDArray[np.uint8]:
    if not isinstance(bodies, list):
        return bodies
    sizes = {len(body) for body in bodies}
    if len(sizes) != 1:
        raise McapError(offset, "messages of one channel differ in size")
    return np.frombuffer(b"".join(bodies), np.uint8).reshape(len(bodies), -1)


def _records(rows: NDArray[np.uint8], dtype: np.dtype[Any], path: Path) -> NDArray[np.void]:
    """Messages of shape (messages, bytes), each with its CDR header, as a structured array."""
    size = rows.shape[1] - len(CDR_HEADER)
    if not dtype.itemsize - 8 < size <= dtype.itemsize:
        raise RecordingError(path, f"has messages of {size} bytes where {dtype.itemsize} are expected")
    padded = np.zeros((len(rows), dtype.itemsize), dtype=np.uint8)
    padded[:, :size] = rows[:, len(CDR_HEADER) :]
    return padded.reshape(-1).view(dtype)


def write_candump_log(frames: FrameArray, path: Path, channel: str = "vcan0", start_ns: int = 0) -> None:
    """Write frames as a candump log (``(seconds) channel id#data``), which can-utils, python-can and Wireshark read.

    ``start_ns`` is taken off every time stamp; a negative one adds the wall clock. Raises ``RecordingError``.
    """
    try:
        with path.open("x") as stream:
            stream.writelines(_candump_lines(frames, channel, start_ns))
    except FileExistsError as error:
        raise RecordingError(path, "exists already and is not overwritten") from error
    except OSError as error:
        raise RecordingError(path, f"cannot be written: {error.strerror}") from error


def _candump_lines(frames: FrameArray, channel: str, start_ns: int) -> Iterable[str]:
    for at_ns, cob_id, is_remote, length, data in zip(
        *(frames[name].tolist() for name in ("at_ns", "cob_id", "is_remote", "length")), frames["data"], strict=True
    ):
        seconds, nanoseconds = divmod(at_ns - start_ns, 1_000_000_000)
        text = "R" if is_remote else data[:length].tobytes().hex().upper()
        yield f"({seconds}.{nanoseconds // 1000:06d}) {channel} {cob_id:03X}#{text}\n"
