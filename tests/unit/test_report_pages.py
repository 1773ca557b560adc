"""The report's page, figures and tables, and the monitor's view, from runs made by hand."""

import io
import json
import math
import re
from collections.abc import Iterator
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from recording_samples import CONSTANTS, WITHOUT_MECHANISM, steady_run
from rich.console import Console

from gateway.errors import GatewayError
from gateway.record.recording import RecordingError, RecordingMetadata, RecordingWriter, read_recording
from gateway.record.ring import RingReader, RingWriter, RunEvent, RunState
from gateway.record.run_constants import RunConstants
from gateway.record.sample import Phase, SampleArray, missed_tpdo_flag
from gateway.reporting.analysis import analyse, report_of
from gateway.reporting.monitor import Monitor, last_cycle, monitor, render_view, sparkline
from gateway.reporting.plots import overlay, plots_of, to_png, to_svg
from gateway.reporting.report import write_report
from gateway.reporting.report_text import render_report
from gateway.reporting.run_data import prepare


def record(path: Path, samples: SampleArray, constants: RunConstants = CONSTANTS) -> Path:
    metadata = RecordingMetadata(constants, "name: <script>alert(1)</script>\n", product_version="1.2.3")
    with RecordingWriter(path, metadata) as writer:
        writer.write_samples(samples)
        writer.write_event(RunEvent({"at_ns": 1_500_000_000, "kind": "end", "text": "a & b <i>", "stopped_by": "ok"}))
    return path


class _Page(HTMLParser):
    """Collects what a page would load, and whether its elements close."""

    def __init__(self) -> None:
        super().__init__()
        self.loaded: list[str] = []
        self.ids: list[str] = []
        self.text: list[str] = []
        self.tags: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        for name, value in attrs:
            if name == "id" and value:
                self.ids.append(value)
            if name in ("src", "href", "xlink:href") and value and not value.startswith("#"):
                self.loaded.append(value)

    def handle_data(self, data: str) -> None:
        self.text.append(data)


def test_the_report_is_a_page_of_its_own_with_figures_and_json(tmp_path: Path) -> None:
    samples = steady_run()
    samples["position_actual"][250, 1] = 72
    source = record(tmp_path / "a.mcap", samples)
    written = write_report(source, tmp_path / "out" / "report")
    names = [path.name for path in written]
    assert names[:2] == ["report.html", "report.json"]
    assert {"servo.png", "cv.png", "path.png", "torque.png", "cycles.png", "run.png", "timing.png"} == set(names[2:])
    for path in written[2:]:
        assert path.read_bytes().startswith(b"\x89PNG\r\n\x1a\n")
    assert json.loads(written[1].read_text()) == analyse(read_recording(source)).to_json()
    html = written[0].read_text()
    page = _Page()
    page.feed(html)
    assert page.loaded == []
    assert page.tags.count("svg") == 7
    assert "script" not in page.tags
    assert len(page.ids) == len(set(page.ids))
    text = " ".join(page.text)
    assert "+28 counts" in text
    assert "a & b <i>" in text
    assert "name: <script>alert(1)</script>" in text
    # every reference within the page has its target
    for target in set(re.findall(r'(?:xlink:href="#|url\(#)([^")]+)', html)):
        assert target in page.ids


@pytest.mark.slow
def test_the_same_recording_gives_the_same_report(tmp_path: Path) -> None:
    source = record(tmp_path / "a.mcap", steady_run())
    pages = [write_report(source, tmp_path / name)[0].read_bytes() for name in ("one", "two")]
    assert pages[0] == pages[1]
    data = prepare(steady_run(), CONSTANTS)
    assert to_png(plots_of(data)[1], data) == (tmp_path / "one" / "cv.png").read_bytes()


def test_figures_of_the_page_take_their_colours_from_it() -> None:
    data = prepare(steady_run(), CONSTANTS)
    for plot in plots_of(data):
        svg = to_svg(plot, data)
        colours = set(re.findall(r"(?:fill|stroke): (#[0-9a-f]{6})", svg))
        assert colours <= {"#000000", "#ffffff"}, (plot.stem, colours)
        assert "var(--ink)" in svg


@pytest.mark.parametrize(
    "kind",
    [
        "one record",
        "stopped",
        *(
            pytest.param(kind, marks=pytest.mark.slow)
            for kind in ("never moved", "all missed", "many cycles", "no mechanism")
        ),
    ],
)
def test_poor_runs_have_a_report_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    monkeypatch.setattr("gateway.reporting.report.to_png", lambda _plot, _data: b"")  # drawn as SVG by the same code
    samples = steady_run(600, records_a_turn=20 if kind == "many cycles" else 1000)
    constants = CONSTANTS
    if kind == "one record":
        samples = samples[:1]
    elif kind == "never moved":
        samples["phase"] = Phase.COMMISSIONING
    elif kind == "all missed":
        samples["flags"] = missed_tpdo_flag(0) | missed_tpdo_flag(1)
    elif kind == "no mechanism":
        constants = WITHOUT_MECHANISM
    elif kind == "stopped":
        samples["phase"][300:] = Phase.QUICK_STOP
        samples["position_actual"][300:] = 10**6  # where the linkage cannot be
    written = write_report(record(tmp_path / "a.mcap", samples, constants), tmp_path / "out")
    assert ("path.png" in {path.name for path in written}) == (kind != "no mechanism")
    json.loads(written[1].read_text(), parse_constant=pytest.fail)


def test_an_empty_recording_has_no_report(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="holds no cycle"):
        write_report(record(tmp_path / "a.mcap", steady_run(0)), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_damaged_cam_is_one_sentence(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "a.mcap", RecordingMetadata(CONSTANTS, cam_text='{"format": 1}')) as writer:
        writer.write_samples(steady_run(10))
    with pytest.raises(RecordingError, match="carries an unusable cam"):
        analyse(read_recording(tmp_path / "a.mcap"))


def test_overlaid_cycles_have_their_mean_and_extremes_at_each_angle() -> None:
    samples = steady_run(3600, records_a_turn=360)
    samples["master_position"] += math.radians(0.5)  # one sample in the middle of each degree
    turn = np.arange(3600) // 360
    samples["position_actual"][:, 1] = 100 - turn  # error 0 in the first cycle, 9 in the tenth
    data = prepare(samples, CONSTANTS)
    lines = overlay(data, data.error_counts[:, 1], data.is_steady)
    assert len(lines.cycles) == 10
    assert len(lines.grid_deg) == 360
    assert np.allclose(lines.mean, 4.5)
    assert set(lines.low) == {0.0}
    assert set(lines.high) == {9.0}


def test_thinned_lines_keep_their_extremes() -> None:
    samples = steady_run(40_000, records_a_turn=40_000)
    samples["position_actual"][12_345, 1] = -777
    data = prepare(samples, CONSTANTS)
    ((_, error),) = overlay(data, data.error_counts[:, 1], data.is_steady).cycles
    assert len(error) <= 1500
    assert error.max() == 877.0


def test_png_is_the_size_of_its_figure() -> None:
    data = prepare(steady_run(), CONSTANTS)
    png = to_png(plots_of(data)[1], data)
    width, height = int.from_bytes(png[16:20]), int.from_bytes(png[20:24])
    assert (width, height) == (round(8.6 * 160), round(3.2 * 160))


def _printed(renderable: object) -> str:
    console = Console(width=140, file=io.StringIO())
    console.print(renderable)
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def test_the_tables_stand_beside_the_papers_figures_only_for_its_machine() -> None:
    samples = steady_run()
    samples["position_actual"][5, 1] = 215
    reference = _printed(render_report(report_of(prepare(samples, CONSTANTS), stopped_by="completed")))
    assert re.search(r"error, max / min +counts .*\+0 / −115 +at most 19 +−115", reference)
    assert "(−52, 147)" in reference
    assert "end: completed" in reference
    other = _printed(render_report(report_of(prepare(samples, WITHOUT_MECHANISM))))
    assert "paper" not in other
    assert "+0 / −115" in other


# -- monitor -------------------------------------------------------------------------------------------------------


@pytest.fixture
def ring(tmp_path: Path) -> Iterator[RingWriter]:
    with RingWriter.create("hand-made", CONSTANTS, directory=tmp_path) as writer:
        yield writer


def put(ring: RingWriter, samples: SampleArray) -> None:
    for row in samples:
        values: list[float] = []
        for name in ring.layout.dtype.names or ():
            values.extend(np.ravel(row[name]).tolist())
        ring.append(*values)


def test_the_view_is_of_the_last_cycle_alone(ring: RingWriter) -> None:
    samples = steady_run(2100)
    samples["position_actual"][500, 1] = 0  # error 100, in the first cycle: forgotten
    samples["position_actual"][1500, 1] = 93
    samples["position_actual"][2099, 1] = 97
    samples["torque_actual"][1200, 1] = -800
    samples["torque_actual"][2099, 1] = 500
    samples["statusword"][2099] = [0x1237, 0x0218]
    samples["flags"][100] = missed_tpdo_flag(1)
    samples["flags"][200] = missed_tpdo_flag(0) | missed_tpdo_flag(1)
    samples["sync_period_ns"][1800] = 1_025_000
    put(ring, samples)
    with RingReader(ring.path) as reader:
        watcher = Monitor(reader)
        assert watcher.view() is None
        watcher.update()
        view = watcher.view()
    assert view is not None
    servo = view.axes[1]
    assert (servo.error_counts, servo.error_max_abs_counts) == (3, 7)
    assert servo.error_rms_counts == pytest.approx(math.sqrt((49 + 9) / 1000), abs=1e-3)
    assert servo.state == "fault"
    assert (servo.torque_nm, servo.torque_max_abs_nm, servo.torque_of_rated) == (0.25, 0.4, 0.5)
    assert (view.machine_cycle, view.master_deg, view.master_rpm) == (2, pytest.approx(35.64), 60.0)
    assert view.counts.missed_tpdo == 3
    assert view.sync_period_deviation_us == (0.0, 0.0, 25.0)
    assert view.phase == "cam"
    # 97 counts are in the last part of what is known: 35.64 deg is in part 4 of 48
    assert servo.errors_over_cycle[4] is not None
    assert servo.errors_over_cycle[4] > 0
    text = _printed(render_view(view, 2.5))
    assert "no sign of life for 2.5 s" in text
    assert "fault" in text
    assert "operation enabled" in text


def test_a_standing_machine_is_shown_by_its_last_second() -> None:
    samples = steady_run(3000)
    samples["master_position"] = 1.0
    samples["master_velocity"] = 0.0
    assert last_cycle(samples)["cycle"].tolist() == list(range(2000, 3000))
    assert len(last_cycle(samples[:0])) == 0


def test_what_was_overwritten_before_the_monitor_came_is_not_its_loss(ring: RingWriter) -> None:
    put(ring, steady_run(9000))
    with RingReader(ring.path) as reader:
        watcher = Monitor(reader)
        watcher.update()
        assert watcher.view().lost_samples == 0  # type: ignore[union-attr]
        put(ring, steady_run(9000))
        watcher.update()
        assert watcher.view().lost_samples == 9000 - 8191  # type: ignore[union-attr]


def test_the_monitor_prints_lines_of_json_until_the_run_is_over(ring: RingWriter) -> None:
    put(ring, steady_run(100))
    ring.append_event(5_000_000_000, "step", "homing")
    ring.append_event(6_250_000_000, "step", "enable")
    ring.set_state(RunState.FINISHED)
    console = Console(file=io.StringIO())
    monitor(ring.path, as_json=True, console=console)
    assert isinstance(console.file, io.StringIO)
    (line,) = console.file.getvalue().splitlines()
    view = json.loads(line)
    assert view["run_state"] == "finished"
    assert view["axes"]["servo"]["error_counts"] == 0
    assert view["events"] == ["0.000 s  step: homing", "1.250 s  step: enable"]
    assert set(view["wake_lateness_us"]) == {"p50", "p99", "max"}


def test_the_live_view_ends_with_the_run(ring: RingWriter) -> None:
    put(ring, steady_run(100))
    ring.set_state(RunState.FAILED)
    console = Console(file=io.StringIO(), width=120)
    monitor(ring.path, console=console)
    assert isinstance(console.file, io.StringIO)
    assert console.file.getvalue().endswith("the run of hand-made failed\n")


def test_no_run_is_one_sentence() -> None:
    with pytest.raises(GatewayError, match="no run of nobody-runs-this is going on"):
        monitor("nobody-runs-this")


def test_a_run_that_ended_before_its_first_cycle_has_nothing_to_show_once(ring: RingWriter) -> None:
    ring.set_state(RunState.FAILED)
    with pytest.raises(GatewayError, match="ended before its first cycle"):
        monitor(ring.path, once=True)


@pytest.mark.parametrize(
    ("values", "text"),
    [((0.0, 7.0, None, 3.5), "▁█ ▅"), ((2.0, 2.0), "▁▁"), ((None, None), "  ")],
)
def test_sparklines_span_from_the_least_to_the_greatest(values: tuple[float | None, ...], text: str) -> None:
    assert sparkline(values) == text


def test_another_machine_keeps_its_own_name_in_the_figures() -> None:
    axes = tuple(replace(axis, name=name) for axis, name in zip(CONSTANTS.axes, ("crank", "slide"), strict=True))
    data = prepare(steady_run(), replace(CONSTANTS, axes=axes))
    titles = [plot.title for plot in plots_of(data)]
    assert titles[0] == "Servo axis (slide) over the machine cycle"
    assert titles[1] == "CV axis (crank) over the machine cycle"
