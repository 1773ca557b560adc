"""Why deadlines were missed, as report, page and monitor say it."""

import json
from pathlib import Path

import numpy as np
from recording_samples import CONSTANTS, steady_run
from rich.console import Console

from gateway.record.lateness import LATE_ACCOUNT_KIND, LATE_DEMAND_KIND, Cause, Explanation, LateAccount, LateKind
from gateway.record.recording import RecordingMetadata, RecordingWriter, read_recording
from gateway.record.ring import RingReader, RingWriter, RunEvent
from gateway.record.sample import SampleFlag
from gateway.reporting.analysis import analyse
from gateway.reporting.monitor import Monitor, render_view
from gateway.reporting.report import write_report
from gateway.reporting.report_text import render_report

US = 1000


def miss(cycle, by_us, *shares_us):
    shares = tuple((cause, span * US) for cause, span in shares_us)
    return Explanation(LateKind.RPDO_DEADLINE, cycle, cycle * 1_000_000, by_us * US, shares)


TAKEN = [miss(100 + n, 1500, (Cause.ANOTHER_PROCESS, 1400), (Cause.WOKEN_LATE, 100)) for n in range(9)]
OWN = miss(500, 300, (Cause.WOKEN_LATE, 100), (Cause.OWN_WORK, 200))
VERDICT = "10: 9 another process had the processor (12.6 ms), 1 not explained (of these 1 own work (0.2 ms))"


def events_of(explanations):
    account = LateAccount()
    for explanation in explanations:
        account.add(explanation)
        data = {"at_ns": explanation.deadline_ns, "kind": LATE_DEMAND_KIND, "text": explanation.sentence()}
        yield RunEvent(data | explanation.to_event())
    yield RunEvent({"at_ns": 10**9, "kind": LATE_ACCOUNT_KIND, "text": account.verdict(), **account.to_event()})


def record(path: Path, explanations, unaccounted=()) -> Path:
    samples = steady_run()
    cycles = [explanation.cycle for explanation in explanations] + [*unaccounted]
    samples["flags"][np.array(cycles, dtype=int)] |= int(SampleFlag.MISSED_RPDO_DEADLINE)
    with RecordingWriter(path, RecordingMetadata(CONSTANTS)) as writer:
        writer.write_samples(samples)
        for event in events_of(explanations):
            writer.write_event(event)
    return path


def printed(renderable) -> str:
    console = Console(width=200, record=True, file=None, quiet=False)
    with console.capture() as capture:
        console.print(renderable)
    return capture.get()


def test_the_report_says_how_many_of_what_cause_and_how_many_are_not_explained(tmp_path):
    report = analyse(read_recording(record(tmp_path / "run.mcap", [*TAKEN, OWN])))
    assert f"missed RPDO deadlines, and why: {VERDICT}" in printed(render_report(report))
    late = report.to_json()["late"]
    assert late["verdict"] == VERDICT
    assert (late["missed_rpdo_deadline"], late["explained"], late["not_explained"]) == (10, 9, 1)
    assert late["by_cause"]["another_process"] == {"count": 9, "lateness_us": 12_600}
    assert late["by_cause"]["woken_late"] == {"count": 0, "lateness_us": 1000}
    first = late["worst"][0]
    assert (first["cycle"], first["is_explained"], first["cause"]) == (500, False, "own_work"), (
        "the ones to look at first"
    )
    assert first["shares_us"] == {"woken_late": 100, "own_work": 200}


def test_a_miss_that_the_account_lacks_is_not_explained(tmp_path):
    report = analyse(read_recording(record(tmp_path / "run.mcap", TAKEN, unaccounted=[700, 701])))
    late = report.to_json()["late"]
    assert (late["missed_rpdo_deadline"], late["not_explained"]) == (11, 2)
    assert late["verdict"].endswith(", 2 not explained")


def test_a_run_without_misses_says_so_and_one_without_an_account_says_nothing(tmp_path):
    report = analyse(read_recording(record(tmp_path / "run.mcap", [])))
    assert "missed RPDO deadlines, and why: 0\n" in printed(render_report(report))
    with RecordingWriter(tmp_path / "virtual.mcap", RecordingMetadata(CONSTANTS)) as writer:
        writer.write_samples(steady_run())
    report = analyse(read_recording(tmp_path / "virtual.mcap"))
    assert report.to_json()["late"] is None
    assert "and why" not in printed(render_report(report))


def test_the_page_has_the_worst_in_a_table_and_none_of_them_among_the_events(tmp_path):
    page, figures, *_ = write_report(record(tmp_path / "run.mcap", [*TAKEN, OWN]), tmp_path / "report")
    text = page.read_text()
    table = text[text.index('<details id="late">') : text.index("<h2>Events</h2>")]
    assert table.count("<tr>") == 1 + 10
    assert table.index("own work 200 µs") < table.index("another process had the processor 1 400 µs")
    assert "another process" not in text[text.index("<h2>Events</h2>") :]
    assert json.loads(figures.read_text())["late"]["verdict"] == VERDICT


def test_the_monitor_shows_the_account_of_the_whole_run(tmp_path):
    with RingWriter.create("hand-made", CONSTANTS, directory=tmp_path) as ring, RingReader(ring.path) as reader:
        watcher = Monitor(reader)
        for row in steady_run(3):
            ring.append(*[value for name in ring.layout.dtype.names for value in np.ravel(row[name]).tolist()])
        ring.append_event(1, "step", "moving")
        watcher.update()
        assert watcher.view().to_json()["late"] is None
        for event in events_of([*TAKEN, OWN]):
            ring.append_event(**event.data)
        watcher.update()
        view = watcher.view()
    late = view.to_json()["late"]
    assert (late["missed"], late["explained"], late["verdict"]) == (10, 9, VERDICT)
    json.dumps(view.to_json())
    assert view.events == ("0.000 s  step: moving",), "they are counted, not listed"
    assert "9 another process had the processor" in printed(render_view(view))
