"""The recorder: a process of its own that drains the ring into a recording; the cyclic loop never waits for a disk.

It ends when the writer says that its run is over, or is gone. SIGINT is left to the parent, who stops the loop; SIGTERM
closes the file properly. Killed, it leaves a file that is read up to its last flush, a fifth of a second before.
"""

import argparse
import json
import os
import signal
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

import numpy as np

from drivers.errors import BusError
from drivers.ports import Port
from gateway.errors import GatewayError
from gateway.record.recording import RecordingError, RecordingMetadata, RecordingWriter
from gateway.record.ring import FRAME_DTYPE, FRAME_STRUCT, FrameArray, RingReader, RunEvent, RunState
from gateway.running.bus_address import BusAddress

_DRAIN_S: Final = 0.05
_DRAINS_A_FLUSH: Final = 4
MAX_FRAMES_A_DRAIN: Final = 20_000


@dataclass(frozen=True, slots=True)
class RecorderResult:
    """What was written, and what the ring overran before it could be."""

    samples: int
    frames: int
    events: int
    lost_samples: int
    lost_frames: int
    lost_events: int


class BusListener:
    """Takes down every frame on the bus, with a connection of its own, so that it costs the cycle nothing."""

    def __init__(self, port: Port) -> None:
        self._port: Port | None = port
        self.failure = ""
        """Why the bus is not heard any more, empty while it is."""

    def read(self) -> FrameArray:
        """Frames that have arrived since the last call; at most a second of a full bus."""
        packed = bytearray()
        try:
            for _ in range(MAX_FRAMES_A_DRAIN):
                received = self._port.receive() if self._port is not None else None
                if received is None:
                    break
                frame, at_ns = received
                packed += FRAME_STRUCT.pack(at_ns, frame.cob_id, frame.is_remote, len(frame.data), frame.data)
        except BusError as error:
            self.failure = str(error)
            self.close()
        return np.frombuffer(bytes(packed), FRAME_DTYPE)

    def close(self) -> None:
        """Leave the bus."""
        if self._port is not None:
            self._port.close()
            self._port = None


class Recorder:
    """Moves whatever is new in ``ring``, and on the bus where there is a listener, into ``writer``."""

    def __init__(self, ring: RingReader, writer: RecordingWriter, listener: BusListener | None = None) -> None:
        self._ring = ring
        self._writer = writer
        self._listener = listener
        self._counts = [0, 0, 0]
        self._lost = [0, 0, 0]
        self._stopped_by = ""

    def drain(self) -> None:
        """Write everything that is in the ring now."""
        samples, lost_samples = self._ring.read_new()
        frames, lost_frames = self._ring.read_new_frames()
        events, lost_events = self._ring.read_new_events()
        self._writer.write_samples(samples)
        self._writer.write_frames(frames)
        if self._listener is not None:
            heard = self._listener.read()
            self._writer.write_frames(heard)
            self._counts[1] += len(heard)
        for event in events:
            self._writer.write_event(event)
            self._stopped_by = str(event.data.get("stopped_by", self._stopped_by))
        for i, (count, lost) in enumerate(
            ((len(samples), lost_samples), (len(frames), lost_frames), (len(events), lost_events))
        ):
            self._counts[i] += count
            self._lost[i] += lost

    @property
    def result(self) -> RecorderResult:
        return RecorderResult(*self._counts, *self._lost)

    def outcome(self, interruption: str = "") -> dict[str, str]:
        """How the run ended, as the recording keeps it; ``interruption`` where the recorder was stopped before it."""
        ring = self._ring
        if interruption:
            why = interruption
        elif ring.state in (RunState.FINISHED, RunState.FAILED):
            why = self._stopped_by or ring.state.name.lower()
        else:
            why = "gateway_lost"
        result = self.result
        return {
            "stopped_by": why,
            "run_state": ring.state.name,
            "result": str(ring.result),
            **{
                f"lost_{name}": str(lost)
                for name, lost in zip(("samples", "frames", "events"), self._lost, strict=True)
            },
            "samples": str(result.samples),
        }


def run_recorder(
    ring_path: Path,
    out_path: Path,
    config_text: str = "",
    cam_text: str = "",
    *,
    start_ns: int = 0,
    start_wall_ns: int | None = None,
    overwrite: bool = False,
    bus: BusAddress | None = None,
) -> RecorderResult:
    """Record the run of a ring until it is over, and every frame on ``bus`` where that is given; blocks.

    To be called in a process of its own, on its main thread.

    Raises ``RingError``, and ``RecordingError`` also where the disk is full.
    """
    stopping: list[int] = []
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda number, _: stopping.append(number))
    with RingReader(ring_path) as ring:
        metadata = RecordingMetadata(ring.constants, config_text, cam_text, start_ns, start_wall_ns)
        writer = RecordingWriter(out_path, metadata, overwrite=overwrite)
        listener = _listen(bus, writer, start_ns)
        recorder = Recorder(ring, writer, listener)
        try:
            try:
                _drain_to_the_end(ring, recorder, writer, stopping)
            finally:
                if listener is not None:
                    listener.close()
                writer.close(recorder.outcome("recorder_stopped" if stopping else ""))
        except OSError as error:
            raise RecordingError(out_path, f"cannot be written: {error.strerror}") from error
        return recorder.result


def _drain_to_the_end(ring: RingReader, recorder: Recorder, writer: RecordingWriter, stopping: list[int]) -> None:
    drains = 0
    while True:
        # Asked before draining: what was written before the end is then in the ring.
        over = bool(stopping) or ring.is_over()
        recorder.drain()
        if over:
            return
        drains += 1
        if drains % _DRAINS_A_FLUSH == 0:
            writer.flush()
        time.sleep(_DRAIN_S)


def _listen(bus: BusAddress | None, writer: RecordingWriter, at_ns: int) -> BusListener | None:
    """A listener on the bus; one that cannot be had is an event of the recording, and no reason not to record."""
    if bus is None:
        return None
    try:
        return BusListener(bus.open())
    except BusError as error:
        writer.write_event(RunEvent({"at_ns": at_ns, "kind": "warning", "text": f"frames are not recorded: {error}"}))
        return None


def _bus(words: Sequence[str] | None) -> BusAddress | None:
    if not words:
        return None
    interface, channel, host, port = words
    return BusAddress(interface, channel, host, int(port))


def main(arguments: Sequence[str] | None = None) -> int:
    """``python -m gateway.running.recorder RING OUT [--config FILE] [--cam FILE]``; prints its result as JSON."""
    parser = argparse.ArgumentParser(
        prog="python -m gateway.running.recorder", description="Record the run of a ring to MCAP."
    )
    parser.add_argument("ring", type=Path, help="the ring's file")
    parser.add_argument("out", type=Path, help="the recording to write")
    parser.add_argument("--config", type=Path, help="configuration to attach")
    parser.add_argument("--cam", type=Path, help="cam file to attach")
    parser.add_argument("--start-ns", type=int, default=0, help="reading of the loop's clock that becomes time 0")
    parser.add_argument("--start-wall-ns", type=int, help="wall clock at --start-ns, ns since 1970")
    parser.add_argument("--bus", help="also record every frame of this bus: INTERFACE CHANNEL HOST PORT", nargs=4)
    parser.add_argument("--overwrite", action="store_true", help="replace an existing recording")
    options = parser.parse_args(arguments)
    try:
        result = run_recorder(
            options.ring,
            options.out,
            options.config.read_text() if options.config else "",
            options.cam.read_text() if options.cam else "",
            start_ns=options.start_ns,
            start_wall_ns=options.start_wall_ns,
            overwrite=options.overwrite,
            bus=_bus(options.bus),
        )
    except GatewayError as error:
        sys.stderr.write(f"{error}\n")
        return 2
    except OSError as error:
        sys.stderr.write(f"{error.filename}: {error.strerror}\n")
        return 2
    sys.stdout.write(json.dumps(asdict(result)) + os.linesep)
    return 0


if __name__ == "__main__":
    sys.exit(main())
