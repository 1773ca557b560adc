"""The written report of a synthesis: one page that needs nothing else, its figures as PNG, and all numbers as JSON."""

import json
from html import escape
from math import isfinite
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gateway.reporting.number_text import number
from gateway.reporting.report_page import PAGE_HEAD, STYLE
from gateway.synthesis.linkage_motion import LinkageMotion
from gateway.synthesis.machine_files import MachineFiles, variables_mm
from gateway.synthesis.report_plots import SynthesisData, synthesis_plots
from gateway.synthesis.run_search import SearchStatus
from gateway.synthesis.search_slice import Found
from gateway.synthesis.task_options import slug
from mechanism.synthesis.candidate import Candidate
from mechanism.synthesis.task import Term

Float = NDArray[np.floating[Any]]

HTML_NAME: Final = "report.html"
JSON_NAME: Final = "report.json"
MAXIMUM_FRONT_ROWS: Final = 100

_STYLE: Final = """
.tiles { grid-template-columns: repeat(auto-fit, minmax(170px, 1fr)); }
.tile strong { font-size: 1.3rem; }
"""
_PAGE: Final = (
    PAGE_HEAD
    + """<header><h1>{title}</h1><p>{subtitle}</p></header>
<section class="tiles">{tiles}</section>
{complaints}
<h2>Mechanism</h2>
{positions}
{lengths}
<h2>Objective</h2>
{terms}
{front}
<h2>Motion at {speed} rpm</h2>
{servo}
{path}
<h2>Torque</h2>
{torque}
{torques}
<h2>Search</h2>
{convergence}
{search}
<footer>Masses of the links follow from their lengths; torques come from the dynamic model of these links, both rotors,
gravity and friction at constant CV speed. The mechanism's file holds all of it.</footer>
</main>
</body>
</html>
"""
)


def write_synthesis_report(
    folder: Path, data: SynthesisData, machine: MachineFiles, document: dict[str, Any]
) -> list[Path]:
    """Write report.html, report.json (``document``) and a PNG a figure into ``folder``, which is made.

    Files of these names are replaced. Returns them all, the page first. Raises OSError.
    """
    plots = synthesis_plots(data)
    contents: dict[str, bytes] = {
        HTML_NAME: render_synthesis_page(data, machine).encode(),
        JSON_NAME: (json.dumps(document, indent=2, allow_nan=False) + "\n").encode(),
        **{f"{plot.stem}.png": plot.png(data) for plot in plots},
    }
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in contents.items():
        (folder / name).write_bytes(content)
    return [folder / name for name in contents]


def render_synthesis_page(data: SynthesisData, machine: MachineFiles) -> str:
    """The page as HTML."""
    figures = {
        plot.stem: f'<figure id="{plot.stem}">{plot.svg(data)}<figcaption><b>{escape(plot.title)}.</b> '
        f"{escape(plot.caption)}</figcaption></figure>"
        for plot in synthesis_plots(data)
    }
    status, settings = data.status, data.status.settings
    notes = "".join(f"<p>{escape(text)}</p>" for text in (*data.problems, *machine.notes))
    return _PAGE.format(
        scripts="",
        title=escape(f"{machine.config.name}: a mechanism for {Path(data.candidate.task.source or 'a curve').name}"),
        subtitle=escape(
            f"method {settings.method.value}, {settings.starts} start{'s' if settings.starts > 1 else ''} from seed "
            f"{settings.seed}, {number(status.evaluations)} mechanisms evaluated"
            + ("" if status.is_finished else "; interrupted before its end")
        ),
        style=STYLE + _STYLE,
        tiles=_tiles(data, machine),
        complaints=f"<h2>To be noted</h2>{notes}" if notes else "",
        positions=figures["positions"],
        lengths=_lengths(data.candidate),
        terms=_terms(data.candidate),
        front=figures.get("front", "") + _front_table(data),
        speed=f"{machine.config.motion.speed_rpm:g}",
        servo=figures["servo"],
        path=figures["path"],
        torque=figures["torque"],
        torques=_torques(data.motion),
        convergence=figures["convergence"],
        search=_starts(status),
    )


def synthesis_document(
    status: SearchStatus,
    candidate: Candidate,
    machine: MachineFiles | None,
    motion: LinkageMotion | None,
    front: tuple[Found, ...] = (),
) -> dict[str, Any]:
    """Everything about a synthesis as JSON values; lengths in mm."""
    settings = status.settings
    document: dict[str, Any] = {
        "method": settings.method.value,
        "seed": settings.seed,
        "starts": settings.starts,
        "budget": settings.budget,
        "evaluations": status.evaluations,
        "is_finished": status.is_finished,
        "objective": _plain(candidate.objective),
        "variables": variables_mm(candidate),
        "terms": {
            slug(entry.term): {"value": _plain(float(value)), "weight": entry.weight}
            for entry, value in zip(candidate.task.terms, candidate.terms, strict=True)
        },
        "seeds": [
            {"seed": start.seed, "evaluations": start.evaluations, "objective": _plain(start.best.objective)}
            for start in status.starts
            if start.best is not None
        ],
    }
    if machine is not None:
        document["machine"] = str(machine.path)
        document["curve"] = str(machine.curve_path)
        document["is_runnable"] = not machine.violations
        document["problems"] = [str(error) for error in machine.violations]
        document["notes"] = list(machine.notes)
        document["figures"] = machine.prepared.cam.report.figures()
        document["speed_rpm"] = machine.config.motion.speed_rpm
    if motion is not None:
        document["torque_nm"] = {
            name: {"minimum": low, "maximum": high, "rms": rms} for name, low, high, rms in torque_figures(motion)
        }
    if front:
        document["front"] = [
            {
                "objective": _plain(found.objective),
                "variables": variables_mm(found.candidate(candidate.task)),
                "terms": {
                    slug(entry.term): _plain(value)
                    for entry, value in zip(candidate.task.terms, found.terms, strict=True)
                },
            }
            for found in front
        ]
    return document


def torque_figures(motion: LinkageMotion) -> list[tuple[str, float, float, float]]:
    """Least, greatest and RMS torque (N m) of the CV and the servo motor (the paper's Table I)."""
    return [
        (
            name,
            float(motion.torque[:, axis].min()),
            float(motion.torque[:, axis].max()),
            float(np.sqrt(np.mean(motion.torque[:, axis] ** 2))),
        )
        for axis, name in enumerate(("cv", "servo"))
    ]


def _plain(value: float) -> float | None:
    return float(value) if isfinite(value) else None


def _tiles(data: SynthesisData, machine: MachineFiles) -> str:
    report = machine.prepared.cam.report
    servo = torque_figures(data.motion)[1]
    tiles = (
        (
            "structural error, greatest",
            f"{number(report.structural_error.value * 1e3, 3)} mm",
            f"limit {machine.config.motion.structural_error_limit_mm:g} mm",
            report.structural_error.value * 1e3 > machine.config.motion.structural_error_limit_mm,
        ),
        (
            "servo swing",
            f"{number(report.displacement_deg, 2)}°",
            " to ".join(number(v.value, 2, sign=True) for v in (report.velocity_minimum, report.velocity_maximum))
            + " rad/s",
            False,
        ),
        (
            "servo torque, greatest",
            f"{number(max(-servo[1], servo[2]), 3)} N m",
            f"RMS {number(servo[3], 3)} N m",
            False,
        ),
        (
            "least transmission sine",
            number(min(report.crank_sine.value, report.servo_sine.value), 3),
            f"limit {machine.config.machine.minimum_transmission_sine:g}",
            min(report.crank_sine.value, report.servo_sine.value) < machine.config.machine.minimum_transmission_sine,
        ),
        (
            "check",
            _readiness(len(data.problems)),
            machine.path.name,
            bool(data.problems),
        ),
    )
    return "".join(
        f'<div class="tile{" bad" if bad else ""}"><span>{escape(what)}</span><strong>{escape(figure)}</strong>'
        f"<small>{escape(below)}</small></div>"
        for what, figure, below, bad in tiles
    )


def _readiness(problems: int) -> str:
    return "ready to run" if problems == 0 else f"{problems} problem{'s' if problems > 1 else ''}"


def _table(head: list[str], rows: list[list[str]], left: int = 0) -> str:
    def cells(row: list[str], tag: str) -> str:
        first, *others = row
        html = f'<th scope="row">{escape(first)}</th>' if tag == "td" else f"<th>{escape(first)}</th>"
        for index, cell in enumerate(others, start=1):
            html += f"<{tag}{' class=left' if index <= left else ''}>{escape(cell)}</{tag}>"
        return f"<tr>{html}</tr>"

    body = "".join(cells(row, "td") for row in rows)
    return f'<div class="scroll"><table><thead>{cells(head, "th")}</thead><tbody>{body}</tbody></table></div>'


def _lengths(candidate: Candidate) -> str:
    bar = candidate.five_bar()
    head = ["", "p", "q", "r", "s", "CV pivot", "servo pivot"]
    pivots = [f"({number(x * 1e3, 2)}, {number(y * 1e3, 2)})" for x, y in (bar.cv_pivot, bar.servo_pivot)]
    lengths = [number(value * 1e3, 2) for value in (bar.p, bar.q, bar.r, bar.s)]
    model = candidate.task.machine
    masses = [number(model.link(index, value).mass_kg, 3) for index, value in enumerate((bar.p, bar.q, bar.r, bar.s))]
    return _table(head, [["length, place (mm)", *lengths, *pivots], ["mass (kg)", *masses, "", ""]])


def significant(value: float) -> str:
    """A term's value: six digits, whatever its size."""
    return f"{value:.6g}".replace("-", "−")


_UNITS: Final = {
    Term.STRUCTURAL_ERROR: "mm²",
    Term.SWEPT_AREA: "mm deg",
    Term.PEAK_TORQUE: "N m",
    Term.CV_PEAK_TORQUE: "N m",
    Term.POWER: "W",
    Term.SERVO_VELOCITY: "rad/s",
    Term.SERVO_ACCELERATION: "rad/s²",
    Term.KEEP_OUT: "m",
}


def term_rows(candidate: Candidate) -> list[list[str]]:
    """Term, value, unit, weight, weighted value, and the sum."""
    rows = [
        [
            entry.term.value,
            significant(float(value)),
            _UNITS.get(entry.term, ""),
            f"{entry.weight:g}",
            significant(float(value) * entry.weight),
        ]
        for entry, value in zip(candidate.task.terms, candidate.terms, strict=True)
    ]
    return [*rows, ["weighted sum", "", "", "", significant(candidate.objective)]]


def _terms(candidate: Candidate) -> str:
    return _table(["term", "value", "unit", "weight", "weighted"], term_rows(candidate))


def _front_table(data: SynthesisData) -> str:
    if not data.front:
        return ""
    task = data.candidate.task
    head = ["number", *(entry.term.value for entry in task.terms), "p, q, r, s (mm)"]
    rows: list[list[str]] = []
    for index, found in enumerate(data.front[:MAXIMUM_FRONT_ROWS]):
        chosen = " (chosen)" if found is data.chosen else ""
        lengths = ", ".join(number(value * 1e3, 1) for value in found.variables[:4])
        rows.append([f"{index + 1}{chosen}", *(f"{value:.4g}" for value in found.terms), lengths])
    return _table(head, rows)


def _torques(motion: LinkageMotion) -> str:
    rows = [
        [f"{'CV' if name == 'cv' else 'servo'} motor", number(low, 4), number(high, 4), number(rms, 4)]
        for name, low, high, rms in torque_figures(motion)
    ]
    return _table(["", "least (N m)", "greatest (N m)", "RMS (N m)"], rows)


def _starts(status: SearchStatus) -> str:
    best = status.best_start
    rows = [
        [
            f"{start.seed}{' (best)' if start is best else ''}",
            number(start.evaluations),
            number(start.generation),
            "" if start.best is None else significant(start.best.objective),
        ]
        for start in status.starts
    ]
    return _table(["seed", "evaluations", "generations", "objective"], rows)
