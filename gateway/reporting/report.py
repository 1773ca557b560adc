"""The written report of a run: one page that needs nothing else, its figures as PNG, and the figures as JSON."""

import json
from html import escape
from pathlib import Path
from typing import Final

from gateway.record.lateness import IN_WORDS, LateKind
from gateway.record.recording import Recording, RecordingError, read_recording
from gateway.reporting import paper_reference as paper
from gateway.reporting.analysis import report_of_recording
from gateway.reporting.event_choice import choose_events, is_alarming
from gateway.reporting.figures import RunReport
from gateway.reporting.number_text import number
from gateway.reporting.plots import Plot, plots_of, to_png, to_svg
from gateway.reporting.report_page import PAGE, STYLE
from gateway.reporting.report_text import (
    MOST_LINES,
    axis_rows,
    cycle_rows,
    headline,
    is_bad,
    is_verdict_bad,
    late_row,
    point,
)
from gateway.reporting.run_data import RunData, cam_of, prepare

HTML_NAME: Final = "report.html"
JSON_NAME: Final = "report.json"


def write_report(recording_path: Path, out_dir: Path) -> list[Path]:
    """Read a recording and write report.html, report.json and one PNG a figure into ``out_dir``, which is made.

    Files of these names are replaced. Returns them all, the page first. Raises ``RecordingError``.
    """
    recording = read_recording(recording_path)
    data = prepare(recording.samples, recording.constants, cam_of(recording))
    report = report_of_recording(recording, data)
    if not len(recording.samples):
        raise RecordingError(recording_path, "holds no cycle to report on")
    plots = plots_of(data)
    contents: dict[str, bytes] = {
        HTML_NAME: render_page(recording, data, report, plots).encode(),
        JSON_NAME: (json.dumps(report.to_json(), indent=2, allow_nan=False) + "\n").encode(),
        **{f"{plot.stem}.png": to_png(plot, data) for plot in plots},
    }
    try:
        out_dir.mkdir(parents=True, exist_ok=True)
        for name, content in contents.items():
            (out_dir / name).write_bytes(content)
    except OSError as error:
        raise RecordingError(out_dir, f"report cannot be written: {error.strerror}") from error
    return [out_dir / name for name in contents]


def render_page(recording: Recording, data: RunData, report: RunReport, plots: tuple[Plot, ...]) -> str:
    """The page as HTML."""
    figures = {plot.stem: _figure(plot, data) for plot in plots}
    return PAGE.format(
        scripts="",
        title=escape(f"{report.constants.config_name}: axis errors"),
        style=STYLE,
        heading=escape(f"{report.constants.config_name}, axis errors"),
        subtitle=escape(headline(report).partition(": ")[2]),
        tiles=_tiles(report),
        stopped=_what_stopped_it(report),
        axes=_axes_table(report),
        servo=figures["servo"] + figures["cv"],
        path=figures.get("path", "") + _table_ii(report),
        torque=figures["torque"],
        run=_whole_run_table(report) + figures["run"] + figures["cycles"],
        timing=_cycle_table(report) + _late_table(recording, report) + figures["timing"],
        events=_events(recording),
        about=_about(recording, report),
        config=escape(recording.config_text) or "none was attached",
    )


def _figure(plot: Plot, data: RunData) -> str:
    return (
        f'<figure id="{plot.stem}">{to_svg(plot, data)}'
        f"<figcaption><b>{escape(plot.title)}.</b> {escape(plot.caption)}</figcaption></figure>"
    )


def _tiles(report: RunReport) -> str:
    constants = report.constants
    reference = paper.is_reference_machine(constants.mechanism)
    tiles: list[tuple[str, str, str, bool]] = []
    beside = {
        constants.slave_axis: paper.SERVO_ERROR_EXTREME_COUNTS,
        constants.master_axis: paper.CV_ERROR_EXTREME_COUNTS,
    }
    for axis in (constants.slave_axis, constants.master_axis):
        figures = report.steady.axes[axis].following_error_counts
        extreme = max((figures.max, figures.min), key=lambda value: abs(value or 0.0))
        note = f"paper {number(beside[axis], sign=True)}" if reference else f"RMS {number(figures.rms, 1)}"
        name = constants.axes[axis].name
        tiles.append((f"{name}, greatest error", f"{number(extreme, sign=True)} counts", note, False))
    distance = report.steady.end_effector_error_mm
    tiles.append(
        ("end effector, greatest error", f"{number(distance.max, 2)} mm", f"RMS {number(distance.rms, 2)} mm", False)
    )
    cycle = report.cycle
    counts, missed = cycle.counts, cycle.counts.total
    seen = [
        f"{number(count)} {what}"
        for count, what, is_always in (
            (counts.missed_tpdo, "TPDO", True),
            (counts.missed_rpdo_deadline, "deadline", True),
            (counts.overruns, "overrun", True),
            (counts.sync_lost, "SYNC", True),
            (counts.bus_errors, "bus error", False),
            (counts.send_buffer_full, "buffer full", False),
        )
        if count or is_always
    ]
    note = f"{', '.join(seen)}; of {number(cycle.count)} cycles"
    tiles.append(("missed in the cycle", number(missed), note, missed > 0))
    return "".join(
        f'<div class="tile{" bad" if bad else ""}"><span>{escape(what)}</span><strong>{escape(figure)}</strong>'
        f"<small>{escape(below)}</small></div>"
        for what, figure, below, bad in tiles
    )


def _what_stopped_it(report: RunReport) -> str:
    """The guard's trips, failures, and what became of the axes; nothing after a run that just completed."""
    told = [event for event in report.decisive if event.kind != "end"]
    if not told:
        return ""
    body = "".join(
        _row(
            [f"{event.at_s:.3f} s", event.kind.replace("_", " "), event.text],
            classes=("left", "left bad" if event.is_alarming else "left"),
        )
        for event in told[:MOST_LINES]
    )
    more = f"<p>And {len(told) - MOST_LINES} more, see Events.</p>" if len(told) > MOST_LINES else ""
    table = f'<div class="scroll"><table class="narrow"><tbody>{body}</tbody></table></div>'
    return f"<h2>What stopped it, and what became of the machine</h2>{table}{more}"


def _row(cells: list[str], tag: str = "td", classes: tuple[str, ...] = ()) -> str:
    first, *others = cells
    padded = (*classes, *[""] * len(others))
    html = f'<th scope="row">{escape(first)}</th>' if tag == "td" else f"<th>{escape(first)}</th>"
    for cell, name in zip(others, padded, strict=False):
        html += f'<{tag} class="{name}">{escape(cell)}</{tag}>' if name else f"<{tag}>{escape(cell)}</{tag}>"
    return f"<tr>{html}</tr>"


def _axes_table(report: RunReport) -> str:
    constants = report.constants
    reference = paper.is_reference_machine(constants.mechanism)
    names = list(constants.axis_names)
    head = ["", "unit", *names, *([f"paper, {name}" for name in names] if reference else [])]
    classes = ("unit", *[""] * len(names), *["paper"] * len(names))
    rows = axis_rows(report.steady, master=constants.master_axis, slave=constants.slave_axis, is_reference=reference)
    body = "".join(
        _row([row.what, row.unit, *row.ours, *(row.paper if reference else ())], classes=classes) for row in rows
    )
    return f'<div class="scroll"><table><thead>{_row(head, "th", classes)}</thead><tbody>{body}</tbody></table></div>'


def _whole_run_table(report: RunReport) -> str:
    errors = [axis.following_error_counts for axis in report.whole_run.axes]
    extremes = [f"{number(e.max, sign=True)} / {number(e.min, sign=True)}" for e in errors]
    distance = report.whole_run.end_effector_error_mm
    rows = [
        ["error, max / min", "counts", *extremes],
        ["error, RMS", "counts", *(number(e.rms, 1) for e in errors)],
        ["end effector error, max", "mm", number(distance.max, 2), *[""] * (len(errors) - 1)],
    ]
    head = _row(["ramps included", "unit", *report.constants.axis_names], "th", ("unit",))
    body = "".join(_row(row, classes=("unit",)) for row in rows)
    return f'<div class="scroll"><table><thead>{head}</thead><tbody>{body}</tbody></table></div>'


def _table_ii(report: RunReport) -> str:
    if not report.table_ii:
        return ""
    classes = ("", "", "paper", "paper")
    head = _row(["CV input", "actual (mm)", "desired (mm)", "paper, desired", "paper, measured"], "th", classes)
    body = "".join(
        _row(
            [
                f"{row.point.cv_deg:g}°",
                point(row.actual_mm),
                point(row.desired_here_mm),
                point(row.point.desired_mm, 0),
                point(row.point.measured_mm, 0),
            ],
            classes=classes,
        )
        for row in report.table_ii
    )
    return f'<div class="scroll"><table><thead>{head}</thead><tbody>{body}</tbody></table></div>'


def _cycle_table(report: RunReport) -> str:
    rows = cycle_rows(report.cycle)
    body = "".join(_row([what, figure], classes=("bad",) if is_bad(what, figure) else ()) for what, figure in rows)
    verdict = late_row(report)
    if verdict is not None:
        body += _row([*verdict], classes=("left bad" if is_verdict_bad(report) else "left",))
    return f'<div class="scroll"><table class="narrow"><tbody>{body}</tbody></table></div>'


def _late_table(recording: Recording, report: RunReport) -> str:
    """The worst late demands, one a row; nothing where there is none."""
    late = report.late
    if late is None or not late.worst:
        return ""
    start = recording.metadata.start_ns
    head = _row(["late by", "what", "cycle", "at", "because of", "explained"], "th", ("left", "", "", "left"))
    body = "".join(
        _row(
            [
                f"{number(demand.missed_by_us)} µs",
                "demand" if demand.what is LateKind.RPDO_DEADLINE else "SYNC",
                number(demand.cycle),
                f"{(demand.at_ns - start) / 1e9:.3f} s",
                ", ".join(f"{IN_WORDS[cause]} {number(span)} µs" for cause, span in demand.shares_us),
                "yes" if demand.is_explained else "no",
            ],
            classes=("left", "", "", "left", "" if demand.is_explained else "bad"),
        )
        for demand in late.worst
    )
    title = f"<summary>The worst {len(late.worst)}, first those that are not explained</summary>"
    table = f'<div class="scroll"><table><thead>{head}</thead><tbody>{body}</tbody></table></div>'
    return f'<details id="late">{title}{table}</details>'


def _events(recording: Recording) -> str:
    choice = choose_events([event.data for event in recording.events])
    if not choice.shown:
        return "<p>None was recorded.</p>"
    start = recording.metadata.start_ns
    body = "".join(
        _row(
            [
                f"{(int(event['at_ns']) - start) / 1e9:.3f} s",
                str(event.get("source", "")),
                str(event.get("kind", "")).replace("_", " "),
                str(event.get("text", "")),
            ],
            classes=("left", "left", "left bad" if is_alarming(event) else "left"),
        )
        for event in choice.shown
    )
    rest = choice.left_out_text()
    told = f"<p>Not shown here, and in the recording: {escape(rest)}.</p>" if rest else ""
    return f'<div class="scroll"><table><tbody>{body}</tbody></table></div>{told}'


def _about(recording: Recording, report: RunReport) -> str:
    lost = {key: value for key, value in recording.outcome.items() if key.startswith("lost_") and value != "0"}
    facts = [
        ("recording", recording.path.name + ("" if recording.is_complete else ", never finished")),
        ("made by", f"drive-gateway {recording.metadata.product_version}"),
        ("stopped by", report.stopped_by),
        ("phases, cycles", ", ".join(f"{p.name.lower()} {n}" for p, n in report.phase_counts.items() if n)),
        ("cam", "attached" if recording.cam_text else "none attached: desired points follow from the demanded counts"),
        *((key.replace("_", " "), value) for key, value in lost.items()),
    ]
    body = "".join(_row([what, fact], classes=("left",)) for what, fact in facts)
    return f'<div class="scroll"><table class="narrow"><tbody>{body}</tbody></table></div>'
