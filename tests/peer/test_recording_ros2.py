"""Someone else's ROS 2 decoder reads ``/cycle`` and ``/frames`` from the schema text and the bytes alone."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from gateway.record.recording import RecordingMetadata, RecordingWriter
from gateway.record.ring import FRAME_DTYPE
from gateway.record.run_constants import AxisConstants, RunConstants
from gateway.record.sample import Phase, SampleFlag, SampleLayout

TWO_AXES = RunConstants("peer", 0.001, (AxisConstants("cv", 4096, 1.5), AxisConstants("servo", 4096, 0.5)))


@pytest.mark.parametrize("count", [1, 2, 3, 5])
def test_a_sample_decodes_field_by_field(tmp_path: Path, count: int) -> None:
    axes = tuple(AxisConstants(f"axis{i}", 4096, 1.0) for i in range(count))
    layout = SampleLayout([axis.name for axis in axes])
    samples = np.zeros(2, dtype=layout.dtype)
    samples["cycle"] = [11, 12]
    samples["sync_ns"] = [1_000_000, 2_000_000]
    samples["master_position"] = [2 * math.pi + math.radians(90), -1.5]
    samples["sync_deviation_ns"] = [-7, 7]
    samples["phase"] = Phase.CAM
    samples["flags"] = SampleFlag.OVERRUN
    samples["demand_velocity"] = np.arange(count) + 0.25
    samples["position_demand"] = 1000 + np.arange(count)
    samples["position_actual"] = 900 - np.arange(count)
    samples["statusword"] = 0xFFFF
    samples["torque_actual"] = -1 - np.arange(count)
    samples["torque_offset"] = 1 + np.arange(count)
    with RecordingWriter(tmp_path / "a.mcap", RecordingMetadata(replace(TWO_AXES, axes=axes))) as writer:
        writer.write_samples(samples)
    with (tmp_path / "a.mcap").open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        message, second = (decoded for *_, decoded in reader.iter_decoded_messages(["/cycle"]))
    assert (message.cycle, second.cycle) == (11, 12)
    assert message.sync_ns == 1_000_000
    assert message.master_position == 2 * math.pi + math.radians(90)
    assert (message.sync_deviation_ns, second.sync_deviation_ns) == (-7, 7)
    assert (message.phase, message.flags) == (3, 1 << 17)
    assert list(message.demand_velocity) == [i + 0.25 for i in range(count)]
    assert list(message.position_demand) == [1000 + i for i in range(count)]
    assert list(message.position_actual) == [900 - i for i in range(count)]
    assert list(message.statusword) == [0xFFFF] * count
    assert list(message.torque_actual) == [-1 - i for i in range(count)]
    assert list(message.torque_offset) == [1 + i for i in range(count)]
    # the two that are worked out for the viewer
    assert message.master_angle_deg == pytest.approx(90.0)
    assert list(message.following_error) == [100 + 2 * i for i in range(count)]


def test_a_frame_decodes_field_by_field(tmp_path: Path) -> None:
    frames = np.zeros(1, dtype=FRAME_DTYPE)
    frames[0] = (123_456_789, 0x181, 0, 3, [1, 2, 3, 0, 0, 0, 0, 0], [0, 0])
    with RecordingWriter(tmp_path / "a.mcap", RecordingMetadata(TWO_AXES)) as writer:
        writer.write_frames(frames)
    with (tmp_path / "a.mcap").open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        ((*_, message),) = reader.iter_decoded_messages(["/frames"])
    assert (message.at_ns, message.cob_id, message.is_remote, message.length) == (123_456_789, 0x181, 0, 3)
    assert bytes(message.data) == bytes([1, 2, 3, 0, 0, 0, 0, 0])
