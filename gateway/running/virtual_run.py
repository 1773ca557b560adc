"""Runs the gateway and an emulated machine together in virtual time: same cores, same frames, no waiting."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from drivers.node import Event, Node
from drivers.virtual_time import VirtualBus
from gateway.errors import GatewayError
from gateway.learning.law import Learning
from gateway.record.recording import RecordingMetadata, RecordingSink, RecordingWriter
from gateway.record.run_constants import RunConstants
from gateway.running.assembly import build_core
from gateway.running.core import GatewayCore
from gateway.running.event_text import describe
from gateway.running.preparation import PreparedRun

NS_PER_S: Final = 1_000_000_000
MAX_EXTRA_S: Final = 60.0
"""Virtual time that commissioning and shut-down may take beyond the planned motion."""
PROGRESS_SPAN_NS: Final = NS_PER_S // 4
LAST_FRAMES_NS: Final = 10_000_000
"""Time for the session's last frames to leave the bus."""
GATEWAY_NODE: Final = 0


def run_virtual(
    prepared: PreparedRun,
    machine: Node,
    path: Path,
    cam_text: str,
    seed: int,
    *,
    is_overwriting: bool = False,
    with_frames: bool = True,
    learning: Learning | None = None,
    on_progress: Callable[[float, GatewayCore], None] | None = None,
    on_event: Callable[[dict[str, Any]], None] | None = None,
) -> GatewayCore:
    """Carry out a prepared run against ``machine``, record it to ``path``, and return the gateway's core afterwards.

    The recording is a function of configuration, cam, seed and what ``learning`` begins with, byte for byte.
    ``on_progress`` is called with the virtual time in seconds now and then, and may ask the core for a stop;
    ``on_event`` with every event of the gateway's, as the recording has it.

    Raises RecordingError if the file cannot be written, GatewayError if the session does not end.
    """
    config = prepared.config
    metadata = RecordingMetadata(RunConstants.from_config(config, prepared.cam.closure), config.text, cam_text)
    with RecordingWriter(path, metadata, overwrite=is_overwriting) as writer:
        sink = RecordingSink(writer)
        core = build_core(config, prepared.cam.profile, prepared.plan, sink, learning=learning)

        def note(node: int, event: Event) -> None:
            kind, text, data = describe(event)
            source = "gateway" if node == GATEWAY_NODE else "emulator"
            sink.append_event(event.at_ns, kind, text, source=source, **data)
            if on_event is not None and node == GATEWAY_NODE:
                on_event({"at_ns": event.at_ns, "kind": kind, "text": text, **data})

        bus = VirtualBus(
            [core, machine], config.wire_bit_rate, seed, sink.trace if with_frames else None, on_event=note
        )
        limit_ns = round((prepared.plan.duration_s + MAX_EXTRA_S) * NS_PER_S)
        while not core.is_done and bus.now_ns < limit_ns:
            bus.run_while(lambda: not core.is_done, min(bus.now_ns + PROGRESS_SPAN_NS, limit_ns))
            if on_progress is not None:
                on_progress(bus.now_ns / NS_PER_S, core)
        bus.run_until(bus.now_ns + LAST_FRAMES_NS)
        sink.flush()
        writer.close({"stopped_by": core.stopped_by.value, "seed": str(seed)})
    if not core.is_done:
        raise GatewayError(f"the session did not end within {limit_ns / NS_PER_S:g} s of virtual time")
    return core
