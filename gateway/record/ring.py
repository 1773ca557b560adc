"""The shared-memory ring between the cyclic loop and everybody who watches it: one writer, many readers, no locks.

A memory-mapped file rather than ``multiprocessing.shared_memory``, whose resource tracker unlinks the memory when a
reader exits. The file holds a header of one page and three rings, for samples, CAN frames and events. The writer puts a
record into its slot and then stores the ring's counter, one aligned 64-bit store; a reader copies, looks at the counter
again, and throws away whatever may have been overwritten meanwhile (a seqlock without the lock). The writer never waits
for a reader.

The order of the two stores is the order of the program on x86-64; elsewhere a reader may, in theory, see a counter one
record early.
"""

import contextlib
import json
import mmap
import os
import re
import struct
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from gateway.errors import GatewayError
from gateway.record.order_word import pack_order, unpack_order
from gateway.record.run_constants import RunConstants
from gateway.record.sample import SampleArray, SampleLayout

MAGIC: Final = b"DGRING\r\n"
VERSION: Final = 1
HEADER_SIZE: Final = 4096
EVENT_SLOT_SIZE: Final = 512
EVENT_MAX_BYTES: Final = EVENT_SLOT_SIZE - 4
DEFAULT_SAMPLE_CAPACITY: Final = 8192
DEFAULT_FRAME_CAPACITY: Final = 65536
DEFAULT_EVENT_CAPACITY: Final = 256
_MAX_CAPACITY: Final = 1 << 24

FRAME_DTYPE: Final = np.dtype(
    [
        ("at_ns", "<i8"),
        ("cob_id", "<u4"),
        ("is_remote", "u1"),
        ("length", "u1"),
        ("data", "u1", (8,)),
        ("_padding", "u1", (2,)),
    ]
)
"""One CAN frame; also the body of a ``drive_gateway/msg/CanFrame``, without its padding."""
FrameArray = NDArray[np.void]
"""Frames as a numpy structured array of ``FRAME_DTYPE``, shape (frames,)."""

FRAME_STRUCT: Final = struct.Struct("<qIBB8s2x")
_FRAME_SIZE: Final = FRAME_STRUCT.size
_EVENT_LENGTH: Final = struct.Struct("<I")
# magic, version, header size, sample size, sample / frame / event capacity, length of the JSON, reserved
_FIXED: Final = struct.Struct("<8s8I")
_JSON_OFFSET: Final = 256
_JSON_MAX: Final = HEADER_SIZE - _JSON_OFFSET
# Words of 64 bits from byte 64 on, each with one writer, the stop request and the operator's order apart
_WORDS_OFFSET: Final = 64
_WORD_COUNT: Final = 16
_PID, _PID_START, _SAMPLES, _FRAMES, _EVENTS, _STATE, _RESULT, _HEARTBEAT, _STOP, _ORDER = range(10)
_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")


class RingError(GatewayError):
    """A ring cannot be made or attached: ``path`` names it, ``reason`` says why."""

    def __init__(self, path: Path, reason: str) -> None:
        super().__init__(f"ring {path}: {reason}")
        self.path = path
        self.reason = reason


class RunState(IntEnum):
    """Where the writer's run stands."""

    STARTING = 0
    RUNNING = 1
    FINISHED = 2
    """Ended by itself or as asked; nothing more will be written."""
    FAILED = 3
    """Ended with an error; nothing more will be written."""


class StopRequest(IntEnum):
    """What a reader or the parent asks of the loop; a stronger request is never weakened."""

    NONE = 0
    CONTROLLED_STOP = 1
    """An operator's: what the guard's ``operator_stop`` says, by default to ramp the master down on the cam."""
    SIGINT = 2
    """What the guard's ``sigint`` says."""
    SIGTERM = 3
    """What the guard's ``sigterm`` says."""
    QUICK_STOP = 4


@dataclass(frozen=True, slots=True)
class RunEvent:
    """Something that happened, as the loop told it: ``data`` is JSON-able and has at least ``at_ns`` and ``kind``."""

    data: Mapping[str, Any]


class _Mapping:
    """The mapped file, its words and its three areas; what writer and reader share."""

    def __init__(self, path: Path, *, writable: bool) -> None:
        self.path = path
        flags = (os.O_RDWR if writable else os.O_RDONLY) | os.O_CLOEXEC | os.O_NOFOLLOW
        try:
            descriptor = os.open(path, flags)
        except OSError as error:
            raise RingError(path, f"cannot be opened: {error.strerror}") from error
        try:
            size = os.fstat(descriptor).st_size
            if size < HEADER_SIZE:
                raise RingError(path, f"not a ring, or truncated: {size} bytes, at least {HEADER_SIZE} expected")
            self.memory = mmap.mmap(descriptor, size, access=mmap.ACCESS_WRITE if writable else mmap.ACCESS_READ)
        except (OSError, ValueError) as error:
            raise RingError(path, f"cannot be mapped: {error}") from error
        finally:
            os.close(descriptor)
        try:
            self._read_header(size)
        except BaseException:
            self.memory.close()
            raise
        self.view = memoryview(self.memory)
        self.words = self.view[_WORDS_OFFSET : _WORDS_OFFSET + 8 * _WORD_COUNT].cast("Q")

    def _read_header(self, size: int) -> None:
        magic, version, header, record, samples, frames, events, json_length, _ = _FIXED.unpack_from(self.memory, 0)
        if magic != MAGIC:
            raise RingError(self.path, "not a ring of the gateway")
        if version != VERSION or header != HEADER_SIZE:
            raise RingError(self.path, f"has version {version}, this program reads version {VERSION}")
        if not _are_capacities(samples, frames, events):
            raise RingError(self.path, f"has impossible capacities {samples}, {frames} and {events}")
        if json_length > _JSON_MAX:
            raise RingError(self.path, f"has an impossible header of {json_length} bytes")
        try:
            text = bytes(self.memory[_JSON_OFFSET : _JSON_OFFSET + json_length]).decode()
            self.constants = RunConstants.from_json(text)
            self.layout = SampleLayout(self.constants.axis_names)
        except ValueError as error:
            raise RingError(self.path, f"has an unreadable header: {error}") from error
        if record != self.layout.size:
            raise RingError(self.path, f"has records of {record} bytes, {self.layout.size} expected for its axes")
        self.sample_capacity, self.frame_capacity, self.event_capacity = samples, frames, events
        self.sample_offset = HEADER_SIZE
        self.frame_offset = self.sample_offset + samples * record
        self.event_offset = self.frame_offset + frames * FRAME_DTYPE.itemsize
        expected = self.event_offset + events * EVENT_SLOT_SIZE
        if size != expected:
            raise RingError(self.path, f"is truncated or damaged: {size} bytes, {expected} expected")

    def close(self) -> None:
        self.words.release()
        self.view.release()
        # A numpy view that somebody still holds keeps the memory alive until it goes; that is no error.
        with contextlib.suppress(BufferError):
            self.memory.close()


class RingWriter:
    """The loop's end. Make one with ``create`` (or ``take_over`` one that the parent has made)."""

    def __init__(self, mapping: _Mapping) -> None:
        self._mapping = mapping
        self.path: Final = mapping.path
        self.constants: Final = mapping.constants
        self.layout: Final = mapping.layout
        words = mapping.words
        # 0 while the two words change hands: a reader then goes by the pid alone.
        words[_PID_START] = 0
        words[_PID] = os.getpid()
        words[_PID_START] = _start_time(os.getpid())
        self._words = words
        self._view = mapping.view
        self._pack_into: Callable[..., None] = mapping.layout.pack_into
        self._size = mapping.layout.size
        self._sample_mask = mapping.sample_capacity - 1
        self._sample_offset = mapping.sample_offset
        self._samples: int = words[_SAMPLES]
        self._pack_frame: Callable[..., None] = FRAME_STRUCT.pack_into
        self._frame_mask = mapping.frame_capacity - 1
        self._frame_offset = mapping.frame_offset
        self._frames: int = words[_FRAMES]

    @classmethod
    def create(
        cls,
        name: str,
        constants: RunConstants,
        *,
        directory: Path | None = None,
        sample_capacity: int = DEFAULT_SAMPLE_CAPACITY,
        frame_capacity: int = DEFAULT_FRAME_CAPACITY,
        event_capacity: int = DEFAULT_EVENT_CAPACITY,
    ) -> Self:
        """Make the ring of a run called ``name`` (usually the config's); rings that dead writers left are removed.

        The file is private to the user (mode 0600) and appears under its name only when it is whole. Capacities are
        powers of two. Raises ``RingError``.
        """
        folder = directory or runtime_directory()
        path = folder / f"drive-gateway-{name}-{os.getpid()}.ring"
        if not _NAME.fullmatch(name):
            raise RingError(path, "a name is made of letters, digits, points, dashes and underscores, 64 at most")
        if not _are_capacities(sample_capacity, frame_capacity, event_capacity):
            raise RingError(path, "capacities must be powers of two")
        _remove_dead_rings(folder, name)
        layout = SampleLayout(constants.axis_names)
        text = constants.to_json().encode()
        if len(text) > _JSON_MAX:
            raise RingError(path, f"constants take {len(text)} bytes, at most {_JSON_MAX} fit")
        header = bytearray(HEADER_SIZE)
        capacities = (sample_capacity, frame_capacity, event_capacity)
        _FIXED.pack_into(header, 0, MAGIC, VERSION, HEADER_SIZE, layout.size, *capacities, len(text), 0)
        struct.pack_into("<2Q", header, _WORDS_OFFSET, os.getpid(), _start_time(os.getpid()))
        header[_JSON_OFFSET : _JSON_OFFSET + len(text)] = text
        body = sample_capacity * layout.size + frame_capacity * FRAME_DTYPE.itemsize + event_capacity * EVENT_SLOT_SIZE
        partial = path.with_suffix(f".{time.monotonic_ns()}.partial")
        try:
            descriptor = os.open(partial, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
            try:
                # Reserved at once: a full /dev/shm is an error here, not a SIGBUS in the cycle.
                os.posix_fallocate(descriptor, 0, HEADER_SIZE + body)
                os.pwrite(descriptor, bytes(header), 0)
            finally:
                os.close(descriptor)
            os.link(partial, path)
        except FileExistsError as error:
            raise RingError(path, "exists already; another run in this process uses the name") from error
        except OSError as error:
            raise RingError(path, f"cannot be made: {error.strerror}") from error
        finally:
            partial.unlink(missing_ok=True)
        return cls(_Mapping(path, writable=True))

    @classmethod
    def take_over(cls, path: Path) -> Self:
        """Become the writer of a ring that another process (the parent) has made and does not write to any more."""
        return cls(_Mapping(path, writable=True))

    def append(self, *values: float) -> None:
        """Write one sample: the values of ``SampleLayout.pack_into``, in its order."""
        count = self._samples
        self._pack_into(self._view, self._sample_offset + (count & self._sample_mask) * self._size, *values)
        self._samples = count = count + 1
        self._words[_SAMPLES] = count

    def append_frame(self, at_ns: int, cob_id: int, data: bytes, is_remote: bool = False) -> None:
        """Write one CAN frame that was sent or received at ``at_ns``."""
        count = self._frames
        offset = self._frame_offset + (count & self._frame_mask) * _FRAME_SIZE
        self._pack_frame(self._view, offset, at_ns, cob_id, is_remote, len(data), data)
        self._frames = count = count + 1
        self._words[_FRAMES] = count

    def append_event(self, at_ns: int, kind: str, text: str, **data: str | int | float | bool | None) -> None:
        """Write one event: JSON of ``at_ns``, ``kind``, ``text`` and ``data``; the text is cut where it does not fit.

        Not for every cycle: it formats.
        """
        encoded = json.dumps({"at_ns": at_ns, "kind": kind, "text": text, **data}).encode()
        if len(encoded) > EVENT_MAX_BYTES:
            # json.dumps writes ASCII: a character takes 12 bytes at most, and cutting so many is always enough
            excess = len(encoded) - EVENT_MAX_BYTES
            kept = text[: max(0, len(text) - excess)]
            encoded = json.dumps({"at_ns": at_ns, "kind": kind[:64], "text": kept, **data}).encode()
            if len(encoded) > EVENT_MAX_BYTES:
                encoded = json.dumps({"at_ns": at_ns, "kind": kind[:64], "text": ""}).encode()
        count: int = self._words[_EVENTS]
        offset = self._mapping.event_offset + (count & (self._mapping.event_capacity - 1)) * EVENT_SLOT_SIZE
        _EVENT_LENGTH.pack_into(self._view, offset, len(encoded))
        self._view[offset + 4 : offset + 4 + len(encoded)] = encoded
        self._words[_EVENTS] = count + 1

    def beat(self, now_ns: int) -> None:
        """Say that the loop is alive; ``now_ns`` is its clock."""
        self._words[_HEARTBEAT] = now_ns

    def set_state(self, state: RunState, result: int = 0) -> None:
        """Say where the run stands; ``result`` is the loop's own result code, 0 to 2^64 - 1."""
        self._words[_RESULT] = result
        self._words[_STATE] = state

    def stop_request(self) -> int:
        """What the readers ask for, as the value of a ``StopRequest`` (an int, because the loop asks every cycle)."""
        return self._words[_STOP]

    def order_word(self) -> int:
        """The last order of an operator, see ``gateway.record.order_word``; 0 while there has been none."""
        return self._words[_ORDER]

    def request_stop(self, request: StopRequest) -> None:
        """Ask for a stop from the writer's own process (a signal handler)."""
        _request_stop(self._words, request)

    def close(self, *, unlink: bool = True) -> None:
        """Unmap, and remove the file's name; readers that are attached keep their memory."""
        if unlink:
            self.path.unlink(missing_ok=True)
        self._mapping.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class RingReader:
    """A reader's end. ``from_start`` begins with the oldest record that is left, else with the next one written.

    Raises ``RingError`` where ``path`` is no ring, or a truncated or foreign one.
    """

    def __init__(self, path: Path, *, from_start: bool = True) -> None:
        # Mapped for writing for the stop request's sake; nothing else is ever written here.
        self._mapping = mapping = _Mapping(path, writable=True)
        self.path: Final = path
        self.constants: Final = mapping.constants
        self.layout: Final = mapping.layout
        self._words = mapping.words
        memory = mapping.memory
        self._sample_slots: SampleArray = np.frombuffer(
            memory, mapping.layout.dtype, mapping.sample_capacity, mapping.sample_offset
        )
        self._frame_slots: FrameArray = np.frombuffer(memory, FRAME_DTYPE, mapping.frame_capacity, mapping.frame_offset)
        self._next_sample = 0 if from_start else self._words[_SAMPLES]
        self._next_frame = 0 if from_start else self._words[_FRAMES]
        self._next_event = 0 if from_start else self._words[_EVENTS]

    def read_new(self) -> tuple[SampleArray, int]:
        """Samples since the last call, oldest first, as a copy; and how many were lost to a reader too slow."""
        samples, self._next_sample, lost = self._read(self._sample_slots, _SAMPLES, self._next_sample)
        return samples, lost

    def read_new_frames(self) -> tuple[FrameArray, int]:
        """As ``read_new``, for CAN frames."""
        frames, self._next_frame, lost = self._read(self._frame_slots, _FRAMES, self._next_frame)
        return frames, lost

    def _read(self, slots: NDArray[np.void], word: int, next_index: int) -> tuple[NDArray[np.void], int, int]:
        capacity = len(slots)
        written: int = self._words[word]
        first = max(next_index, written - capacity)
        count = written - first
        begin = first % capacity
        copied = np.empty(count, dtype=slots.dtype)
        head = min(count, capacity - begin)
        copied[:head] = slots[begin : begin + head]
        copied[head:] = slots[: count - head]
        # The writer may be in the middle of record number `written`, whose slot held record `written - capacity`.
        safe = self._words[word] - capacity + 1
        if safe > first:
            copied = copied[min(count, safe - first) :].copy()
        return copied, written, written - len(copied) - next_index

    def read_new_events(self) -> tuple[list[RunEvent], int]:
        """Events since the last call, oldest first, and how many were lost."""
        mapping = self._mapping
        capacity = mapping.event_capacity
        written: int = self._words[_EVENTS]
        first = max(self._next_event, written - capacity)
        raw: list[bytes] = []
        for index in range(first, written):
            offset = mapping.event_offset + (index % capacity) * EVENT_SLOT_SIZE
            (length,) = _EVENT_LENGTH.unpack_from(mapping.memory, offset)
            raw.append(bytes(mapping.memory[offset + 4 : offset + 4 + min(length, EVENT_MAX_BYTES)]))
        safe: int = self._words[_EVENTS] - capacity + 1
        raw = raw[max(0, safe - first) :]
        lost = written - len(raw) - self._next_event
        self._next_event = written
        return [RunEvent(json.loads(text)) for text in raw], lost

    @property
    def written(self) -> int:
        """Samples written so far."""
        return self._words[_SAMPLES]

    @property
    def state(self) -> RunState:
        return RunState(self._words[_STATE])

    @property
    def result(self) -> int:
        """The loop's result code; see ``RingWriter.set_state``."""
        return self._words[_RESULT]

    @property
    def heartbeat_ns(self) -> int:
        return self._words[_HEARTBEAT]

    @property
    def writer_pid(self) -> int:
        return self._words[_PID]

    def writer_is_alive(self) -> bool:
        """Whether the process that wrote here last still runs."""
        return _is_alive(self._words[_PID], self._words[_PID_START])

    def is_over(self) -> bool:
        """Whether nothing more will be written: the run is finished or failed, or its process is gone."""
        return self.state in (RunState.FINISHED, RunState.FAILED) or not self.writer_is_alive()

    def send_order(self, order: int, value: float) -> None:
        """Give the loop an operator's order in place of the last one. Raises ValueError for a value too large."""
        number, _, _ = unpack_order(self._words[_ORDER])
        self._words[_ORDER] = pack_order(number + 1, order, value)

    def request_stop(self, request: StopRequest) -> None:
        """Ask the loop to stop."""
        _request_stop(self._words, request)

    def close(self) -> None:
        """Unmap. Arrays that were read are copies and stay good."""
        del self._sample_slots, self._frame_slots
        self._mapping.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _are_capacities(*values: int) -> bool:
    return all(0 < value <= _MAX_CAPACITY and value & (value - 1) == 0 for value in values)


def _request_stop(words: "memoryview[int]", request: StopRequest) -> None:
    if words[_STOP] < request:
        words[_STOP] = request


def runtime_directory() -> Path:
    """Where rings live: /dev/shm, which is memory, or the folder for temporary files where there is none."""
    shared = Path("/dev/shm")  # noqa: S108 - rings are made private and exclusively, see RingWriter.create
    return shared if shared.is_dir() and os.access(shared, os.W_OK | os.X_OK) else Path(tempfile.gettempdir())


def find_rings(name: str | None = None, directory: Path | None = None) -> list[Path]:
    """Rings of this user whose writer lives, newest first; of every run, or of the one called ``name``."""
    found: list[tuple[int, Path]] = []
    for path in _ring_files(directory or runtime_directory(), name):
        with contextlib.suppress(RingError, OSError), RingReader(path) as reader:
            if reader.writer_is_alive():
                found.append((path.stat().st_mtime_ns, path))
    return [path for _, path in sorted(found, reverse=True)]


def attach(name_or_ring: str | Path) -> RingReader:
    """A reader of the named run's ring, or of the ring in this file. Raises ``GatewayError`` where there is none."""
    if isinstance(name_or_ring, Path):
        return RingReader(name_or_ring)
    found = find_rings(name_or_ring)
    if not found:
        others = sorted({path.name.removeprefix("drive-gateway-").rpartition("-")[0] for path in find_rings()})
        going = f", going on: {', '.join(others)}" if others else ""
        raise GatewayError(f"no run of {name_or_ring} is going on{going}")
    return RingReader(found[0])


def _ring_files(folder: Path, name: str | None) -> list[Path]:
    if name is not None and not _NAME.fullmatch(name):
        return []
    pattern = re.compile(rf"drive-gateway-{_NAME.pattern if name is None else re.escape(name)}-[0-9]+\.ring")
    files: list[Path] = []
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        regular = [entry for entry in entries if pattern.fullmatch(entry.name) and entry.is_file(follow_symlinks=False)]
        files = [Path(entry.path) for entry in regular if entry.stat().st_uid == os.getuid()]
    return sorted(files)


def _remove_dead_rings(folder: Path, name: str) -> None:
    for path in _ring_files(folder, name):
        with contextlib.suppress(RingError, OSError):
            with RingReader(path) as reader:
                alive = reader.writer_is_alive()
            if not alive:
                path.unlink(missing_ok=True)


def _start_time(pid: int) -> int:
    """When the process started, in clock ticks since boot: a recycled pid is not taken for it; 0 where unknown."""
    try:
        # proc(5): starttime is field 22; the second field, in brackets, may itself hold blanks and brackets
        fields = Path(f"/proc/{pid}/stat").read_text(errors="replace").rpartition(")")[2].split()
        return 0 if fields[0] == "Z" else int(fields[19])
    except (OSError, IndexError, ValueError):
        return 0


def _is_alive(pid: int, start_time: int) -> bool:
    if pid <= 0:
        return False
    if start_time:
        return _start_time(pid) == start_time
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
