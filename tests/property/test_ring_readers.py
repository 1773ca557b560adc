"""Whatever the order of writing and reading, a reader gets every record once, in order, or is told how many it lost."""

import tempfile
from pathlib import Path

from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.record.ring import RingReader, RingWriter
from gateway.record.run_constants import AxisConstants, RunConstants

CONSTANTS = RunConstants("property", 0.001, (AxisConstants("only", 4096, 1.0),))
REST = (0, 0.0, 0.0, 0.0, *[0] * 8, *[0] * 5)
CAPACITY = 8


@settings(max_examples=60, deadline=None)
@given(st.lists(st.integers(0, 20), max_size=30))
def test_read_and_lost_make_up_what_was_written(batches: list[int]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        writer = RingWriter.create(
            "p",
            CONSTANTS,
            directory=Path(folder),
            sample_capacity=CAPACITY,
            frame_capacity=CAPACITY,
            event_capacity=CAPACITY,
        )
        with writer, RingReader(writer.path) as reader:
            written = 0
            expected_next = 0
            for batch in batches:
                for _ in range(batch):
                    writer.append(written, *REST)
                    writer.append_frame(written, written % 2048, b"")
                    writer.append_event(written, "k", "")
                    written += 1
                samples, lost = reader.read_new()
                frames, lost_frames = reader.read_new_frames()
                events, lost_events = reader.read_new_events()
                numbers = samples["cycle"].tolist()
                assert numbers == list(range(expected_next + lost, written))
                assert frames["at_ns"].tolist() == numbers
                assert [event.data["at_ns"] for event in events] == numbers
                assert lost == lost_frames == lost_events
                # nothing is given up that is certain to be whole
                assert len(numbers) >= min(batch, CAPACITY - 1)
                expected_next = written
