"""HDR histograms of the cycle's timing, and its counts: against numpy, and against values worked out by hand."""

import numpy as np
import pytest
from hdrh.histogram import HdrHistogram
from recording_samples import LAYOUT, steady_run

from gateway.record.histograms import CycleCounts, CycleHistograms, Timing, count_cycles
from gateway.record.sample import SampleFlag


def test_percentiles_are_those_of_the_samples_to_three_digits():
    samples = steady_run(5000)
    generator = np.random.default_rng(3)
    samples["wake_lateness_ns"] = generator.exponential(40_000, 5000).astype(np.int64)
    samples["loop_cpu_ns"] = generator.integers(20_000, 90_000, 5000)
    histograms = CycleHistograms()
    for part in np.array_split(samples, 7):
        histograms.add(part)
    for timing, field in ((Timing.WAKE_LATENESS, "wake_lateness_ns"), (Timing.LOOP_TIME, "loop_cpu_ns")):
        spread = histograms.spread(timing)
        ordered = np.sort(samples[field])
        exact = [ordered[max(int(p / 100 * 5000 + 0.5) - 1, 0)] / 1e3 for p in (1, 50, 90, 99, 99.9, 100)]
        found = (spread.p1, spread.p50, spread.p90, spread.p99, spread.p999, spread.max)
        assert spread.count == 5000
        assert found == pytest.approx(exact, rel=2e-3, abs=0.01)


def test_what_is_no_figure_is_left_out():
    samples = steady_run(10)
    samples["flags"][3] = SampleFlag.MISSED_TPDO_AXIS1
    samples["tpdo_arrival_ns"][3] = 0
    samples["rpdo_lead_ns"][4] = -70_000
    histograms = CycleHistograms()
    histograms.add(samples)
    counts = {timing: histograms.spread(timing).count for timing in Timing}
    assert counts == {
        Timing.SYNC_PERIOD: 9,  # the first SYNC has none before it
        Timing.WAKE_LATENESS: 10,
        Timing.TPDO_ARRIVAL: 9,
        Timing.RPDO_LEAD: 10,
        Timing.LOOP_TIME: 10,
    }
    assert histograms.spread(Timing.RPDO_LEAD).min == 0.0, "a demand that came too late has no lead"
    assert histograms.spread(Timing.TPDO_ARRIVAL).min == pytest.approx(300.0, rel=1e-3)
    assert CycleHistograms().spread(Timing.RPDO_LEAD).p50 is None


def test_the_encoded_histogram_is_read_by_the_library_and_adds_up():
    samples = steady_run(100)
    histograms = CycleHistograms()
    histograms.add(samples)
    decoded = HdrHistogram.decode(histograms.encoded(Timing.RPDO_LEAD))
    assert decoded.get_total_count() == 100
    assert decoded.get_value_at_percentile(50) == pytest.approx(400_000, rel=1e-3)
    other = CycleHistograms()
    other.add(samples)
    other.add(samples)
    assert HdrHistogram.decode(other.encoded(Timing.RPDO_LEAD)).get_total_count() == 200


def test_every_flag_is_counted_under_its_name():
    samples = np.zeros(8, LAYOUT.dtype)
    samples["flags"] = [
        SampleFlag.MISSED_TPDO_AXIS0 | SampleFlag.MISSED_TPDO_AXIS1,
        SampleFlag.MISSED_TPDO_AXIS1 | SampleFlag.LATE_TPDO,
        SampleFlag.MISSED_RPDO_DEADLINE | SampleFlag.OVERRUN,
        SampleFlag.SYNC_LOST,
        SampleFlag.SYNC_LOST,
        SampleFlag.BUS_ERROR,
        SampleFlag.SEND_BUFFER_FULL,
        0,
    ]
    counts = count_cycles(samples, 2)
    assert counts == CycleCounts(3, 1, 1, 1, 2, 1, 1)
    assert counts.total == 9, "the late one is missed already"
    assert (counts + counts).total == 18
