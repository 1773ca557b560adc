"""The report of a run as tables for a terminal, beside the paper's figures where the machine is the paper's."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from gateway.record.histograms import Spread, Timing
from gateway.reporting import paper_reference as paper
from gateway.reporting.figures import AxisFigures, CycleFigures, Distribution, PhaseFigures, RunReport
from gateway.reporting.number_text import NOTHING, number, row_of_numbers

MOST_LINES: Final = 20
_COUNTED_FAULTS = frozenset(
    {
        "TPDOs missed",
        "RPDO deadlines missed",
        "overruns",
        "SYNCs lost",
        "cycles with bus errors",
        "cycles with a full send buffer",
        "samples lost",
    }
)


@dataclass(frozen=True, slots=True)
class Row:
    """A figure: what it is, its unit, its value for each axis, and the paper's for each axis."""

    what: str
    unit: str
    ours: tuple[str, ...]
    paper: tuple[str, ...]


def axis_rows(figures: PhaseFigures, *, master: int, slave: int, is_reference: bool) -> list[Row]:
    """The figures of the axes, in the order of the samples."""
    none = tuple("" for _ in figures.axes)

    def beside(cv: str = "", servo: str = "") -> tuple[str, ...]:
        if not is_reference:
            return none
        return tuple(cv if axis == master else servo if axis == slave else "" for axis in range(len(figures.axes)))

    def pair(high: float | None, low: float | None, decimals: int) -> str:
        return f"{number(high, decimals, sign=True)} / {number(low, decimals, sign=True)}"

    def errors(axis: AxisFigures) -> str:
        return pair(axis.following_error_counts.max, axis.following_error_counts.min, 0)

    def turning(texts: Iterable[str]) -> tuple[str, ...]:
        # How far the master has turned says nothing about the machine.
        return tuple("turns" if axis == master else text for axis, text in enumerate(texts))

    servo_demand = pair(*paper.SERVO_DEMAND_VELOCITY_RAD_PER_S, 2)
    servo_velocity = pair(*paper.SERVO_VELOCITY_COUNTS_PER_S, 0)
    servo_torque, cv_torque = paper.SERVO_TORQUE_NM, paper.CV_TORQUE_NM
    axes = figures.axes
    degrees = [a.following_error_deg for a in axes]
    actual = [a.velocity_actual_counts_per_s for a in axes]
    smooth = [a.velocity_smoothed_counts_per_s for a in axes]
    demand = [a.demand_velocity_rad_per_s for a in axes]
    torque = [a.torque_actual_nm for a in axes]
    return [
        Row(
            "error, max / min",
            "counts",
            tuple(errors(a) for a in axes),
            beside(
                f"at most {number(paper.CV_ERROR_EXTREME_COUNTS)}", number(paper.SERVO_ERROR_EXTREME_COUNTS, sign=True)
            ),
        ),
        Row("error, max / min", "deg", tuple(pair(d.max, d.min, 2) for d in degrees), beside("1.7", "−10.1")),
        Row("error, RMS", "counts", tuple(number(a.following_error_counts.rms, 1) for a in axes), none),
        Row(
            "greatest error at θ2",
            "deg",
            tuple(number(a.following_error_counts.max_abs_at_master_deg, 1) for a in axes),
            beside("start of cycle", "start of return"),
        ),
        Row(
            "displacement, demand",
            "deg",
            turning(number(a.demand_displacement_deg, 2) for a in axes),
            beside("", f"{paper.SERVO_DISPLACEMENT_DEG:.2f}"),
        ),
        Row("displacement, actual", "deg", turning(number(a.displacement_deg, 2) for a in axes), none),
        Row(
            "position, max",
            "counts",
            turning(number(a.position_actual_counts.max) for a in axes),
            beside("", number(paper.SERVO_MAXIMUM_COUNTS)),
        ),
        Row("demand velocity", "rad/s", tuple(pair(v.max, v.min, 2) for v in demand), beside("+6.28", servo_demand)),
        Row(
            "velocity, one sample",
            "counts/s",
            tuple(pair(v.max, v.min, 0) for v in actual),
            beside("", servo_velocity),
        ),
        Row("velocity, smoothed", "counts/s", tuple(pair(v.max, v.min, 0) for v in smooth), none),
        Row(
            "torque, max / min",
            "N m",
            tuple(pair(t.max, t.min, 3) for t in torque),
            beside(pair(cv_torque[0], cv_torque[1], 3), pair(servo_torque[0], servo_torque[1], 3)),
        ),
        Row(
            "torque, RMS",
            "N m",
            tuple(number(t.rms, 3) for t in torque),
            beside(number(cv_torque[2], 3), number(servo_torque[2], 3)),
        ),
    ]


def cycle_rows(cycle: CycleFigures) -> list[tuple[str, str]]:
    """The timing of the cycle as (what, figure)."""

    def spread(figures: Distribution | Spread) -> str:
        return row_of_numbers(figures.p50, figures.p99, figures.max)

    counts = cycle.counts
    periods, leads, times = (
        cycle.histograms.spread(timing) for timing in (Timing.SYNC_PERIOD, Timing.RPDO_LEAD, Timing.LOOP_TIME)
    )
    return [
        ("cycles recorded", f"{number(cycle.count)} of {cycle.period_s * 1e3:g} ms"),
        ("TPDOs missed", number(counts.missed_tpdo)),
        ("cycles with a late TPDO", number(counts.late_tpdo)),
        ("RPDO deadlines missed", number(counts.missed_rpdo_deadline)),
        ("overruns", number(counts.overruns)),
        ("SYNCs lost", number(counts.sync_lost)),
        ("cycles with bus errors", number(counts.bus_errors)),
        ("cycles with a full send buffer", number(counts.send_buffer_full)),
        ("samples lost", number(cycle.lost_samples)),
        ("SYNC period, least / p50 / max", row_of_numbers(periods.min, periods.p50, periods.max)),
        ("|SYNC period − cycle|, p50 / p99 / max", spread(cycle.sync_period_deviation_us)),
        ("wake-up lateness, p50 / p99 / max", spread(cycle.wake_lateness_us)),
        ("last TPDO after SYNC, p50 / p99 / max", spread(cycle.tpdo_arrival_us)),
        ("last RPDO before SYNC, least / p1 / p50", row_of_numbers(cycle.rpdo_lead_us.min, leads.p1, leads.p50)),
        ("processor time of the loop a cycle, mean", f"{number(cycle.loop_cpu_us_per_cycle, 1)} µs"),
        ("processor time of the loop a cycle, p50 / p99 / max", spread(times)),
    ]


def late_row(report: RunReport) -> tuple[str, str] | None:
    """Why deadlines were missed, as a row of the cycle's table; None where nobody kept account of it."""
    if report.late is None:
        return None
    return "missed RPDO deadlines, and why", report.late.account.verdict(report.cycle.counts.missed_rpdo_deadline)


def is_verdict_bad(report: RunReport) -> bool:
    """Whether a demand was late without its being explained by what is not the gateway's."""
    missed = report.cycle.counts.missed_rpdo_deadline
    return report.late is not None and missed > report.late.account.explained


def is_bad(what: str, figure: str) -> bool:
    """Whether a row of ``cycle_rows`` counts something that should not have happened, and did."""
    return what in _COUNTED_FAULTS and figure != "0"


def headline(report: RunReport) -> str:
    """The run in one line."""
    cycles = f"{report.machine_cycles} machine cycle{'' if report.machine_cycles == 1 else 's'} at constant speed"
    whole = "" if report.recording_is_complete else "; the recording was never finished"
    return f"{report.constants.config_name}: {cycles}, end: {report.stopped_by}{whole}"


def render_report(report: RunReport) -> RenderableType:
    """Tables for a rich console: axes (steady phase), end effector, the whole run, the cycle."""
    constants = report.constants
    is_reference = paper.is_reference_machine(constants.mechanism)
    parts: list[RenderableType] = [Text(headline(report), style="bold"), Text()]
    axes = _table("Axes, at constant master speed (error = demand − actual)")
    axes.add_column("")
    axes.add_column("unit", style="dim")
    for name in constants.axis_names:
        axes.add_column(name, justify="right")
    if is_reference:
        for name in constants.axis_names:
            axes.add_column(f"paper, {name}", justify="right", style="cyan")
    for row in axis_rows(
        report.steady, master=constants.master_axis, slave=constants.slave_axis, is_reference=is_reference
    ):
        axes.add_row(row.what, row.unit, *row.ours, *(row.paper if is_reference else ()))
    parts.append(axes)
    parts.append(_whole_run_table(report))
    if report.by_machine_cycle.count > 1:
        parts.append(_by_cycle_table(report))
    parts.append(_end_effector(report))
    if report.table_ii:
        parts.append(_table_ii(report))
    cycle = _table("Cycle, over every record", has_header=False)
    cycle.add_column("")
    cycle.add_column("", justify="right")
    for what, figure in cycle_rows(report.cycle):
        cycle.add_row(what, Text(figure, style="bold red" if is_bad(what, figure) else ""))
    parts.append(cycle)
    verdict = late_row(report)
    if verdict is not None:
        parts.append(Text(": ".join(verdict), style="bold red" if is_verdict_bad(report) else ""))
    parts.extend(_decisive_lines(report))
    if report.recording:
        parts.append(Text(f"recording: {report.recording}", style="dim"))
    return Group(*parts)


def _decisive_lines(report: RunReport) -> list[Text]:
    """What stopped the run and became of the machine; nothing after a run that just completed."""
    told = [event for event in report.decisive if event.kind != "end"]
    if not told:
        return []
    lines = [Text(), Text("What stopped it, and what became of the machine", style="bold")]
    for event in told[:MOST_LINES]:
        style = "bold red" if event.is_alarming else ""
        lines.append(Text(f"  {event.at_s:9.3f} s  {event.kind}: {event.text}", style=style))
    if len(told) > MOST_LINES:
        lines.append(Text(f"  and {len(told) - MOST_LINES} more, see the report's page", style="dim"))
    return lines


def _table(title: str, has_header: bool = True) -> Table:
    return Table(
        title=title,
        title_justify="left",
        title_style="bold",
        box=box.SIMPLE_HEAD,
        pad_edge=False,
        # A narrow table would break its title.
        min_width=len(title),
        show_header=has_header,
    )


def _whole_run_table(report: RunReport) -> Table:
    table = _table("Axes, whole run (ramps included)")
    table.add_column("")
    table.add_column("unit", style="dim")
    for name in report.constants.axis_names:
        table.add_column(name, justify="right")
    errors = [axis.following_error_counts for axis in report.whole_run.axes]
    extremes = [f"{number(e.max, sign=True)} / {number(e.min, sign=True)}" for e in errors]
    table.add_row("error, max / min", "counts", *extremes)
    table.add_row("error, RMS", "counts", *(number(e.rms, 1) for e in errors))
    return table


def _by_cycle_table(report: RunReport) -> Table:
    errors = report.by_machine_cycle
    table = _table("Error by machine cycle, greatest / RMS, counts")
    table.add_column("")
    shown = errors.shown()
    for cycle in shown:
        table.add_column(number(cycle), justify="right")
    for axis, name in enumerate(report.constants.axis_names):
        peak, rms = errors.peak[:, axis].tolist(), errors.rms[:, axis].tolist()
        table.add_row(name, *(f"{number(peak[cycle - 1])} / {number(rms[cycle - 1], 1)}" for cycle in shown))
    return table


def _end_effector(report: RunReport) -> Table:
    table = _table("End effector, distance from the desired point")
    table.add_column("")
    table.add_column("max, mm", justify="right")
    table.add_column("RMS, mm", justify="right")
    for what, figures in (("constant speed", report.steady), ("whole run", report.whole_run)):
        error = figures.end_effector_error_mm
        table.add_row(what, number(error.max, 2), number(error.rms, 2))
    return table


def point(value: tuple[float, float] | None, decimals: int = 1) -> str:
    """A point as text; a dash for None."""
    return NOTHING if value is None else f"({number(value[0], decimals)}, {number(value[1], decimals)})"


def _table_ii(report: RunReport) -> Table:
    table = _table("End effector at actual CV input, mm (the paper's Table II)")
    for name in ("CV input", "actual", "desired", "paper, desired", "paper, measured"):
        table.add_column(name, justify="right", style="cyan" if name.startswith("paper") else "")
    for row in report.table_ii:
        table.add_row(
            f"{row.point.cv_deg:g}°",
            point(row.actual_mm),
            point(row.desired_here_mm),
            point(row.point.desired_mm, 0),
            point(row.point.measured_mm, 0),
        )
    return table
