"""Following errors machine cycle by machine cycle, worked out by hand."""

import io
import json
import math

import numpy as np
import pytest
from recording_samples import CONSTANTS, WITHOUT_MECHANISM, steady_run
from rich.console import Console

from gateway.record.sample import Phase, missed_tpdo_flag
from gateway.reporting.analysis import report_of
from gateway.reporting.cycle_errors import MOST_LISTED, CycleErrors, cycle_errors
from gateway.reporting.report_text import render_report
from gateway.reporting.run_data import prepare


def errors_of(samples):
    return cycle_errors(prepare(samples, WITHOUT_MECHANISM))


def test_each_whole_revolution_has_its_greatest_and_rms_error():
    samples = steady_run(2500)
    samples["position_actual"][10, 1] -= 8
    samples["position_actual"][999, 1] += 6
    samples["position_actual"][1000, 0] -= 3
    samples["position_actual"][2400] += 99  # of a revolution that is not whole
    errors = errors_of(samples)
    assert errors.peak.tolist() == [[0.0, 8.0], [3.0, 0.0]]
    assert errors.rms == pytest.approx(np.array([[0.0, math.sqrt(0.1)], [math.sqrt(0.009), 0.0]]))


def test_a_revolution_begins_where_the_constant_speed_does():
    samples = steady_run(2300)
    samples["phase"][:300] = Phase.RAMP_UP
    samples["position_actual"][[299, 300, 1299, 1300], 1] -= (1, 2, 3, 4)
    assert errors_of(samples).peak[:, 1].tolist() == [3.0, 4.0]


def test_a_missed_tpdo_is_left_out_and_a_silent_axis_has_none():
    samples = steady_run(2000)
    samples["position_actual"][500, 1] = 9999
    samples["flags"][500] = missed_tpdo_flag(1)
    samples["flags"][1000:] = missed_tpdo_flag(0)
    errors = errors_of(samples)
    assert errors.peak[0].tolist() == [0.0, 0.0]
    assert np.isnan(errors.peak[1, 0])
    assert errors.to_json(("cv", "servo"))["axes"]["cv"]["rms_counts"] == [0.0, None]


@pytest.mark.parametrize("records", [0, 1, 999])
def test_without_a_whole_revolution_there_is_nothing(records):
    errors = errors_of(steady_run(1000)[:records])
    assert errors.count == 0
    assert errors.shown() == []
    document = json.dumps(errors.to_json(CONSTANTS.axis_names))
    assert json.loads(document)["machine_cycle"] == []


def test_of_very_many_cycles_some_are_listed():
    many = np.arange(5001.0)[:, np.newaxis] * [1.0, 2.0]
    errors = CycleErrors(many, many)
    listed = errors.to_json(("a", "b"))
    assert len(listed["machine_cycle"]) == MOST_LISTED
    assert (listed["machine_cycle"][0], listed["machine_cycle"][-1]) == (1, 5001)
    assert listed["axes"]["b"]["peak_counts"][-1] == 10_000.0
    assert errors.shown() == [1, 2, 3, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 5001]


def test_the_report_shows_them():
    samples = steady_run(3000)
    samples["position_actual"][:, 1] -= np.repeat([7, 4, 1], 1000)
    report = report_of(prepare(samples, WITHOUT_MECHANISM))
    assert report.to_json()["by_machine_cycle"]["axes"]["servo"]["peak_counts"] == [7.0, 4.0, 1.0]
    console = Console(width=120, file=io.StringIO())
    console.print(render_report(report))
    text = console.file.getvalue()
    assert "Error by machine cycle" in text
    assert "7 / 7.0" in text
