"""The command from a wanted curve to a machine: synthesize."""

from collections.abc import Callable
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from gateway.cli.synthesis_progress import SynthesisProgress
from gateway.cli.terminal import (
    EXIT_NO,
    JsonOption,
    OverwriteOption,
    complain,
    messages,
    print_json,
    require_absent,
    results,
)

if TYPE_CHECKING:
    from gateway.synthesis.session import SynthesisOutcome, SynthesisSession
    from gateway.synthesis.workers import Workers

SYNTHESIZE_EPILOG = """CURVE is a CSV file with the columns theta2_deg,x_mm,y_mm, or x_mm,y_mm where only the order of
the points is given; tolerance_mm may follow. Or it is a DXF or SVG drawing with one closed path.

Examples:

\b
  drive-gateway synthesize curve.csv -o machine.yaml
  drive-gateway synthesize curve.csv --method paper --seed 3 -o machine.yaml
  drive-gateway synthesize curve.csv --weights transmission-angle=200 --bounds p=60:200,cv_pivot_x=0 -o machine.yaml
  drive-gateway synthesize curve.csv --method pareto --weights swept-area=0 --pareto knee -o machine.yaml
  drive-gateway synthesize --resume machine.resume.json -o machine.yaml
  drive-gateway check machine.yaml && drive-gateway run machine.yaml --virtual-time

The first Ctrl-C ends the search, keeps the best mechanism so far and leaves a file to resume from; a second one does
not wait for slices in hand.
"""
REFUSED_WITH_RESUME = (
    "curve",
    "method",
    "seed",
    "budget",
    "generations",
    "population",
    "starts",
    "weights",
    "bounds",
    "keep_out",
    "tolerance",
    "timing",
    "points",
    "mm_per_unit",
    "speed_rpm",
    "template",
)
"""What an interrupted search has settled already."""


class MethodName(Enum):
    """mechanism.synthesis.search.Method by its names, which --help needs without what takes a second to import."""

    PAPER = "paper"
    DIFFERENTIAL_EVOLUTION = "differential-evolution"
    CMA_ES = "cma-es"
    PARETO = "pareto"


class TimingName(Enum):
    """gateway.synthesis.request.TimingChoice by its names."""

    PRESCRIBED = "prescribed"
    EVEN = "even"
    FREE = "free"


def synthesize(
    context: typer.Context,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="MACHINE.yaml", help="Configuration to write.")],
    curve: Annotated[Path | None, typer.Argument(metavar="CURVE", help="Curve: CSV, DXF or SVG.")] = None,
    method: Annotated[MethodName, typer.Option(help="How to search.")] = MethodName.DIFFERENTIAL_EVOLUTION,
    seed: Annotated[int, typer.Option(help="Seed of the first start; each further start has the next one.")] = 0,
    budget: Annotated[int | None, typer.Option(help="Mechanisms to evaluate, a start  [default: by method]")] = None,
    generations: Annotated[int | None, typer.Option(help="The same as generations of the population.")] = None,
    population: Annotated[int | None, typer.Option(help="Mechanisms in a generation  [default: by method]")] = None,
    starts: Annotated[int | None, typer.Option(help="Independent searches, best wins  [default: by method]")] = None,
    workers: Annotated[int, typer.Option(help="Processes of this machine that share the starts.")] = 1,
    dask: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="dask scheduler whose workers share the starts, e.g. tcp://127.0.0.1:8786. Nothing but this address "
            "is contacted; dask exchanges pickled objects, so name only a cluster that you trust.",
        ),
    ] = None,
    weights: Annotated[
        list[str] | None, typer.Option(metavar="TERM=WEIGHT,...", help="Change weights of terms, or add terms.")
    ] = None,
    bounds: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=LOW:HIGH,...", help="Bounds of p q r s cv_pivot_x cv_pivot_y servo_pivot_x ..., mm."
        ),
    ] = None,
    keep_out: Annotated[
        list[str] | None, typer.Option(metavar="ZONE", help="circle:X,Y,RADIUS or box:X1,Y1,X2,Y2 in mm; repeatable.")
    ] = None,
    tolerance: Annotated[float | None, typer.Option(help="Tolerance of every point, mm  [default: from CURVE]")] = None,
    timing: Annotated[
        TimingName | None, typer.Option(help="Crank angles of the points  [default: prescribed if CURVE has them]")
    ] = None,
    points: Annotated[int, typer.Option(help="Points to take from a drawing.")] = 36,
    mm_per_unit: Annotated[
        float | None, typer.Option(help="Unit of a drawing, mm  [default: as the file says]")
    ] = None,
    speed_rpm: Annotated[float | None, typer.Option(help="CV speed, kept  [default: template's, or less]")] = None,
    template: Annotated[
        str, typer.Option(metavar="CONFIG", help="Configuration with drives, limits and bus.")
    ] = "paper",
    pareto: Annotated[
        str | None, typer.Option(metavar="CHOICE", help="Of a Pareto front: knee, best (weighted sum), or a number.")
    ] = None,
    report: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder of the report  [default: MACHINE-report]")
    ] = None,
    with_report: Annotated[bool, typer.Option("--write-report/--no-report", help="Write the report.")] = True,
    resume: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Go on with an interrupted search, to the same result.")
    ] = None,
    is_overwriting: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Find link lengths, pivots and a servo motion for a wanted curve, as a machine for check, compile and run."""
    from config.loading import load_config, parse_config
    from gateway.errors import UsageError
    from gateway.synthesis.choice import check_choice
    from gateway.synthesis.request import SynthesisRequest, TimingChoice
    from gateway.synthesis.run_search import SearchStatus
    from gateway.synthesis.session import SynthesisSession
    from gateway.synthesis.state_file import read_state_file
    from gateway.synthesis.workers import make_workers
    from mechanism.synthesis.search import Method

    make = make_workers(workers, dask)
    require_absent(output, is_overwriting or resume is not None)
    if resume is not None:
        _refuse_settled(context)
        saved = read_state_file(resume)
        status, machine, is_speed_fixed = saved.status, parse_config(saved.template, resume), saved.is_speed_fixed
    elif curve is None:
        raise UsageError("CURVE is missing (or give --resume FILE)")
    else:
        machine = load_config(template)
        request = SynthesisRequest(
            curve=curve,
            template=machine,
            method=Method(method.value),
            seed=seed,
            budget=budget,
            generations=generations,
            population=population,
            starts=starts,
            weights=tuple(weights or ()),
            bounds=tuple(bounds or ()),
            keep_out=tuple(keep_out or ()),
            tolerance_mm=tolerance,
            timing=None if timing is None else TimingChoice(timing.value),
            points=points,
            mm_per_unit=mm_per_unit,
            speed_rpm=speed_rpm,
        )
        status, is_speed_fixed = SearchStatus.beginning(request.settings()), speed_rpm is not None
    check_choice(pareto, status.settings.method)
    folder = (report or output.with_name(f"{output.stem}-report")) if with_report else None
    session = SynthesisSession(status, machine, output, is_speed_fixed)
    _search(session, make)
    _finish(session, pareto, folder, as_json)


def _refuse_settled(context: typer.Context) -> None:
    from gateway.errors import UsageError

    for name in REFUSED_WITH_RESUME:
        source = context.get_parameter_source(name)
        if source is not None and source.name == "COMMANDLINE":
            option = "CURVE" if name == "curve" else f"--{name.replace('_', '-')}"
            raise UsageError(f"{option} cannot be given with --resume: the interrupted search has settled it")


def _search(session: "SynthesisSession", make: "Callable[[], Workers]") -> None:
    from gateway.synthesis.workers import WorkersLostError

    progress = SynthesisProgress(messages())
    try:
        with progress.shown():
            session.search(make, progress.update)
    except WorkersLostError as error:
        complain([str(error), f"go on with --resume {session.resume_path}"], EXIT_NO)


def _finish(session: "SynthesisSession", pareto: str | None, folder: Path | None, as_json: bool) -> None:
    from gateway.synthesis.report import HTML_NAME
    from mechanism.errors import SynthesisError

    status = session.status
    interrupted = f"interrupted after {status.evaluations} evaluations: go on with --resume {session.resume_path}"
    if status.best is None:
        complain([interrupted], EXIT_NO)
    try:
        outcome = session.finish(pareto, folder)
    except SynthesisError as error:
        complain([str(error), *([] if status.is_finished else [interrupted])], EXIT_NO)
    if as_json:
        print_json(outcome.document())
    else:
        _show(outcome)
    console = messages()
    for note in outcome.machine.notes:
        console.print(f"note: {note}", soft_wrap=True, markup=False)
    if outcome.report is not None:
        console.print(f"report: {outcome.report / HTML_NAME}", soft_wrap=True, markup=False)
    sentences = [*outcome.problems, *([] if status.is_finished else [interrupted])]
    if sentences:
        complain(sentences, EXIT_NO)


def _show(outcome: "SynthesisOutcome") -> None:
    from gateway.synthesis.report import term_rows, torque_figures

    console = results()
    bar, report = outcome.candidate.five_bar(), outcome.machine.prepared.cam.report
    table = Table(title=f"{outcome.machine.path}: terms of the mechanism", title_justify="left")
    table.add_column("")
    for name in ("value", "unit", "weight", "weighted"):
        table.add_column(name, justify="left" if name == "unit" else "right")
    for row in term_rows(outcome.candidate):
        table.add_row(*row)
    console.print(table)
    lengths = ", ".join(f"{name} {value * 1e3:.3f}" for name, value in zip("pqrs", bar.to_array()[:4], strict=True))
    pivots = " and ".join(f"({x * 1e3:.3f}, {y * 1e3:.3f})" for x, y in (bar.cv_pivot, bar.servo_pivot))
    console.print(f"links (mm): {lengths}; pivots of CV and servo axis: {pivots}", soft_wrap=True, markup=False)
    torques = "; ".join(
        f"{name} motor {low:+.3f} to {high:+.3f} N m" for name, low, high, _ in torque_figures(outcome.motion)
    )
    console.print(
        f"servo axis: swing {report.displacement_deg:.2f} deg, velocity {report.velocity_minimum.value:+.2f} to "
        f"{report.velocity_maximum.value:+.2f} rad/s at {outcome.machine.config.motion.speed_rpm:g} rpm; {torques}",
        soft_wrap=True,
        markup=False,
    )
    if outcome.front:
        console.print(f"the Pareto front has {len(outcome.front)} mechanisms, numbered in the report and in --json")
