"""Every spread and every count of the cycle is in every place where a run is told of: text, page, JSON, monitor."""

import io
import json
import re
import subprocess
import sys

import numpy as np
import pytest
from recording_samples import CONSTANTS, LAYOUT, steady_run
from rich.console import Console

from gateway.record.histograms import CycleCounts, Timing
from gateway.record.recording import RecordingMetadata, RecordingWriter
from gateway.record.ring import RingReader, RingWriter
from gateway.record.sample import SampleFlag, missed_tpdo_flag
from gateway.reporting.analysis import report_of
from gateway.reporting.monitor import Monitor, render_view
from gateway.reporting.plots import plots_of, to_svg
from gateway.reporting.report import write_report
from gateway.reporting.report_text import render_report
from gateway.reporting.run_data import prepare

COUNTS = CycleCounts(
    missed_tpdo=3, late_tpdo=4, missed_rpdo_deadline=5, overruns=6, sync_lost=17, bus_errors=8, send_buffer_full=9
)
FLAGS = (
    (missed_tpdo_flag(1), COUNTS.missed_tpdo),
    (SampleFlag.LATE_TPDO, COUNTS.late_tpdo),
    (SampleFlag.MISSED_RPDO_DEADLINE, COUNTS.missed_rpdo_deadline),
    (SampleFlag.OVERRUN, COUNTS.overruns),
    (SampleFlag.SYNC_LOST, COUNTS.sync_lost),
    (SampleFlag.BUS_ERROR, COUNTS.bus_errors),
    (SampleFlag.SEND_BUFFER_FULL, COUNTS.send_buffer_full),
)
FIELDS = {
    Timing.SYNC_PERIOD: "sync_period_ns",
    Timing.WAKE_LATENESS: "wake_lateness_ns",
    Timing.TPDO_ARRIVAL: "tpdo_arrival_ns",
    Timing.RPDO_LEAD: "rpdo_lead_ns",
    Timing.LOOP_TIME: "loop_cpu_ns",
}
# Median and the one odd value of each, microseconds, none of them twice.
USUAL = {
    Timing.SYNC_PERIOD: 1003,
    Timing.WAKE_LATENESS: 21,
    Timing.TPDO_ARRIVAL: 311,
    Timing.RPDO_LEAD: 422,
    Timing.LOOP_TIME: 67,
}
ODD = {
    Timing.SYNC_PERIOD: 1180,
    Timing.WAKE_LATENESS: 188,
    Timing.TPDO_ARRIVAL: 588,
    Timing.RPDO_LEAD: 155,
    Timing.LOOP_TIME: 199,
}


@pytest.fixture(scope="module")
def samples():
    made = steady_run(1000)
    for timing, field in FIELDS.items():
        made[field] = USUAL[timing] * 1000
        made[field][900] = ODD[timing] * 1000
    # Where the TPDO is missed there is no arrival either, so the flags stay clear of the odd one.
    first = 100
    for flag, count in FLAGS:
        made["flags"][first : first + count] = flag
        first += count
    return made


def printed(renderable):
    console = Console(file=io.StringIO(), width=110)
    console.print(renderable)
    return console.file.getvalue()


def numbers(text):
    return {float(figure) for figure in re.findall(r"\d+(?:\.\d+)?", re.sub(r"(?<=\d) (?=\d{3}\b)", "", text))}


def require_text(text):
    """Each spread's usual and odd value, to the three digits that a histogram keeps."""
    told = numbers(text)
    for timing in Timing:
        for value in (USUAL[timing], ODD[timing]):
            assert any(figure == pytest.approx(value, rel=1e-3) for figure in told), (timing, value)


def json_figures(document):
    assert {name: document[name] for name in CycleCounts.__slots__} == {
        name: getattr(COUNTS, name) for name in CycleCounts.__slots__
    }
    for timing in Timing:
        spread = document["spread_us"][timing.value]
        ends = (spread["min"], spread["max"])
        assert spread["p50"] == pytest.approx(USUAL[timing], rel=2e-3)
        assert ODD[timing] in [pytest.approx(end, rel=2e-3) for end in ends]


def test_in_the_text_the_page_and_the_json_of_a_report(samples, tmp_path, monkeypatch):
    monkeypatch.setattr("gateway.reporting.report.to_png", lambda _plot, _data: b"")
    monkeypatch.setattr("gateway.reporting.report.to_svg", lambda _plot, _data: "")
    path = tmp_path / "run.mcap"
    with RecordingWriter(path, RecordingMetadata(CONSTANTS, "", "")) as writer:
        writer.write_samples(samples)
        writer.close({"stopped_by": "completed"})
    page, document, *_ = write_report(path, tmp_path / "out")
    html = re.sub(r"<svg.*?</svg>", "", page.read_text(), flags=re.DOTALL)
    html = re.sub(r"<[^>]*>", " ", html)
    text = printed(render_report(report_of(prepare(samples, CONSTANTS))))
    for told in (text, html):
        require_text(told)
        for what, count in (
            ("TPDOs missed", 3),
            ("cycles with a late TPDO", 4),
            ("RPDO deadlines missed", 5),
            ("overruns", 6),
            ("SYNCs lost", 17),
            ("cycles with bus errors", 8),
            ("cycles with a full send buffer", 9),
        ):
            assert re.search(rf"{what}\s+{count}\s", told), what
    json_figures(json.loads(document.read_text())["cycle"])


def test_in_the_text_and_the_json_of_the_monitor(samples, tmp_path):
    with RingWriter.create("everywhere", CONSTANTS, directory=tmp_path) as ring:
        for row in samples:
            ring.append(*(value for name in LAYOUT.dtype.names for value in np.ravel(row[name]).tolist()))
        with RingReader(ring.path) as reader:
            watcher = Monitor(reader)
            watcher.update()
            view = watcher.view()
    text = printed(render_view(view))
    require_text(text)
    for told in ("3 TPDO (4 came late)", "5 deadline", "6 overrun", "17 SYNC", "8 bus error", "9 buffer full"):
        assert told in " ".join(text.split()), told
    json_figures(json.loads(json.dumps(view.to_json())))


def test_the_page_draws_a_histogram_of_each(samples):
    data = prepare(samples, CONSTANTS)
    (timing,) = (plot for plot in plots_of(data) if plot.stem == "timing")
    svg = to_svg(timing, data)
    for label in ("SYNC period", "wake-up lateness", "last TPDO after SYNC", "last RPDO before", "processor time"):
        assert label in svg


def test_a_monitor_starts_without_what_analyses_a_run():
    """It is started in a hurry, beside a cycle that needs its processor."""
    code = (
        "import sys, gateway.reporting.monitor; print({'scipy', 'numba', 'matplotlib'} & sys.modules.keys() or 'none')"
    )
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert told.stdout.strip() == "none"
