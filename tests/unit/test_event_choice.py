"""What ended a run is shown in its report however much else happened; what is left out is counted."""

import io
import re
from collections import Counter
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from recording_samples import CONSTANTS, steady_run
from rich.console import Console

from gateway.record.recording import RecordingMetadata, RecordingWriter, read_recording
from gateway.record.ring import RunEvent
from gateway.reporting.analysis import analyse
from gateway.reporting.event_choice import LEAST_OTHERS, MOST_DECISIVE, MOST_SHOWN, choose_events, is_decisive
from gateway.reporting.report import _what_stopped_it, write_report
from gateway.reporting.report_text import render_report

TRIP = {"kind": "guard", "condition": "torque", "axis": "servo", "reaction": "quick_stop", "text": "torque: too much"}
RECOVERY = {"kind": "recovery", "is_ready": False, "text": "axis servo: its reference is lost: bring it home"}
FAILURE = {"kind": "failure", "text": "the drives did not confirm"}
END = {"kind": "end", "text": "stopped by torque", "stopped_by": "torque"}
LATE = {"kind": "late", "text": "woken 2 ms late"}
WARNING = {"kind": "guard", "condition": "missed_tpdo", "axis": "cv", "reaction": "warn", "text": "missed"}
STEP = {"kind": "step", "text": "moving"}
DEMAND = {"kind": "late_demand", "text": "late"}


def timed(events):
    return [{"at_ns": number * 1_000_000, **event} for number, event in enumerate(events)]


def test_a_trip_behind_thousands_of_late_wakes_and_warnings_is_shown():
    events = timed([STEP, *[LATE] * 3000, *[WARNING] * 700, STEP, TRIP, RECOVERY, FAILURE, END])
    choice = choose_events(events)
    assert len(choice.shown) == MOST_SHOWN
    assert list(choice.shown)[-4:] == events[-4:]
    # Two steps and four that matter leave 194 places; of those the weightier warnings have all.
    shown = Counter(event["kind"] for event in choice.shown)
    assert shown == {"guard": 195, "step": 2, "recovery": 1, "failure": 1, "end": 1}
    assert dict(choice.left_out) == {"late": 3000, "guard": 700 - 194}
    assert choice.left_out_text() == "3000 late, 506 guard"
    warnings = [event["at_ns"] // 1_000_000 for event in choice.shown if event.get("reaction") == "warn"]
    assert warnings == [*range(3001, 3098), *range(3604, 3701)], "as many of the beginning as of the end"


def test_one_of_its_kind_is_not_hidden_by_many_of_another():
    other = {**WARNING, "condition": "missed_deadline", "text": "another"}
    choice = choose_events(timed([*[WARNING] * 5000, other, *[WARNING] * 5000]))
    assert "another" in [event["text"] for event in choice.shown]


def test_late_demands_have_an_account_of_their_own():
    assert choose_events(timed([DEMAND] * 5)).shown == ()
    assert choose_events(timed([DEMAND] * 5)).left_out == {}


def test_so_many_trips_that_even_they_are_cut_keep_the_first_and_the_last():
    events = timed([TRIP] * (MOST_DECISIVE + 500) + [STEP] * 90 + [END])
    choice = choose_events(events)
    assert choice.shown[0] is events[0]
    assert choice.shown[-1] is events[-1]
    assert len(choice.shown) == MOST_DECISIVE + LEAST_OTHERS
    assert choice.left_out == {"guard": 501, "step": 40}


@given(
    st.lists(st.sampled_from([TRIP, RECOVERY, FAILURE, END, LATE, WARNING, STEP]), max_size=400), st.integers(1, 250)
)
def test_nothing_decisive_is_left_out_and_everything_is_shown_or_counted(kinds, most):
    events = timed(kinds)
    choice = choose_events(events, most)
    assert [event["at_ns"] for event in choice.shown] == sorted(event["at_ns"] for event in choice.shown)
    shown = {event["at_ns"] for event in choice.shown}
    assert all(event["at_ns"] in shown for event in events if is_decisive(event))
    assert len(shown) + sum(choice.left_out.values()) == len(events)


@pytest.fixture
def stopped(tmp_path):
    path = tmp_path / "stopped.mcap"
    with RecordingWriter(path, RecordingMetadata(CONSTANTS, "", "")) as writer:
        writer.write_samples(steady_run(100))
        for event in timed([STEP, *[LATE] * 400, TRIP, RECOVERY, END]):
            writer.write_event(RunEvent(event))
        writer.close({"stopped_by": "torque"})
    return path


def test_page_text_and_json_say_what_stopped_the_run(stopped, tmp_path, monkeypatch):
    monkeypatch.setattr("gateway.reporting.report.to_png", lambda _plot, _data: b"")
    monkeypatch.setattr("gateway.reporting.report.to_svg", lambda _plot, _data: "")
    html = write_report(stopped, tmp_path / "out")[0].read_text()
    assert len(re.findall(r'<td class="left bad">torque: too much</td>', html)) == 2, "at the top, and among the events"
    assert "its reference is lost: bring it home" in html
    assert "Not shown here, and in the recording: 204 late." in html
    report = analyse(read_recording(stopped))
    console = Console(file=io.StringIO(), width=110)
    console.print(render_report(report))
    text = console.file.getvalue()
    assert "0.401 s  guard: torque: too much" in text
    assert "0.402 s  recovery: axis servo: its reference is lost: bring it home" in text
    told = report.to_json()["events"]
    assert told["counts"] == {"late": 400, "step": 1, "guard": 1, "recovery": 1, "end": 1}
    assert [(event["kind"], event["is_alarming"]) for event in told["decisive"]] == [
        ("guard", True),
        ("recovery", True),
        ("end", False),
    ]


def test_a_stop_that_somebody_asked_for_is_no_alarm(tmp_path):
    path = tmp_path / "asked.mcap"
    wish = {**TRIP, "condition": "sigint", "reaction": "controlled_stop", "text": "sigint: on request"}
    with RecordingWriter(path, RecordingMetadata(CONSTANTS, "", "")) as writer:
        writer.write_samples(steady_run(100))
        for event in timed([wish, {"kind": "step", "text": "quick stop"}, STEP, END]):
            writer.write_event(RunEvent(event))
        writer.close({"stopped_by": "operator"})
    report = analyse(read_recording(path))
    assert [event.text for event in report.decisive] == ["sigint: on request", "quick stop", "stopped by torque"]
    assert not any(event.is_alarming for event in report.decisive)
    assert "sigint: on request" in _what_stopped_it(report)
    assert _what_stopped_it(replace(report, decisive=report.decisive[-1:])) == "", "a run that completed has no stop"
