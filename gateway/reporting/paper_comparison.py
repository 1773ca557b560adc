"""The paper's figures and a reproduction's side by side: rows with a bound, as a table, as Markdown and as JSON."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

from rich import box
from rich.table import Table

from gateway.reporting import paper_reference as paper
from gateway.reporting.number_text import number
from gateway.reporting.paper_figures import Reproduction

ERROR_BOUND_COUNTS: Final = 10.0
CV_ERROR_BOUND_COUNTS: Final = 4.0
CV_BEGINNING_DEG: Final = 20.0
POSITION_BOUND_COUNTS: Final = 10.0
QUANTUM_COUNTS_PER_S: Final = 1024.0
POINT_BOUND_MM: Final = 8.0
LAG_BOUND: Final = 0.9
RATIO_BOUND: Final = 0.3


@dataclass(frozen=True, slots=True)
class FirstCycle:
    """Greatest errors (counts) in the first revolution from rest."""

    master_counts: float
    slave_counts: float

    def to_json(self) -> dict[str, float]:
        """Plain values."""
        return {"cv_error_extreme_counts": self.master_counts, "servo_error_extreme_counts": self.slave_counts}


@dataclass(frozen=True, slots=True)
class TorqueDemand:
    """What the equations of motion ask for along the cam at constant speed, friction left out; N m."""

    maximum: float
    minimum: float
    rms: float

    def to_json(self) -> dict[str, float]:
        """Plain values."""
        return {"max_Nm": round(self.maximum, 3), "min_Nm": round(self.minimum, 3), "rms_Nm": round(self.rms, 3)}


@dataclass(frozen=True, slots=True)
class TunedRun:
    """One tuning and what came of it."""

    name: str
    title: str
    note: str
    gains: dict[str, dict[str, int]]
    steady: Reproduction
    ramped: FirstCycle
    """From rest with the gateway's ramp."""
    at_once: FirstCycle
    """From rest with a demand that moves at full speed from the first sample on."""

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "title": self.title,
            "note": self.note,
            "gains": self.gains,
            "steady_cycle": self.steady.to_json(),
            "first_cycle": {"ramped": self.ramped.to_json(), "at_once": self.at_once.to_json()},
        }


@dataclass(frozen=True, slots=True)
class Row:
    """A figure, the paper's, and each tuning's with whether it is within ``bound``; None where nothing is asked."""

    what: str
    unit: str
    paper: str
    bound: str
    ours: tuple[str, ...]
    is_met: tuple[bool | None, ...]

    def to_json(self, names: Sequence[str]) -> dict[str, Any]:
        """Plain values; ``names`` are the tunings'."""
        return {
            "what": self.what,
            "unit": self.unit,
            "paper": self.paper,
            "bound": self.bound,
            "ours": dict(zip(names, self.ours, strict=True)),
            "is_met": dict(zip(names, self.is_met, strict=True)),
        }


def compare(runs: Sequence[TunedRun], required: tuple[TorqueDemand, TorqueDemand]) -> list[Row]:
    """Every figure of section 3.2 and of Tables I and II; ``required``: torque of master and slave by the model."""
    steady = [run.steady for run in runs]
    return [*_errors(steady), *_motion(steady), *_points(steady), *_torques(steady, required), *_starts(runs)]


def _errors(steady: Sequence[Reproduction]) -> list[Row]:
    servo, cv = [s.slave for s in steady], [s.master for s in steady]
    return [
        _row(
            "servo error, extreme",
            "counts",
            number(paper.SERVO_ERROR_EXTREME_COUNTS, sign=True),
            f"±{ERROR_BOUND_COUNTS:g}",
            [number(a.error_extreme_counts, sign=True) for a in servo],
            [abs(a.error_extreme_counts - paper.SERVO_ERROR_EXTREME_COUNTS) <= ERROR_BOUND_COUNTS for a in servo],
        ),
        _row(
            "at θ2",
            "deg",
            "start of the return",
            "in the return",
            [
                f"{number(s.slave.error_extreme_at_deg)} of {number(s.return_from_deg)} to {number(s.return_to_deg)}"
                for s in steady
            ],
            [s.return_from_deg <= s.slave.error_extreme_at_deg <= s.return_to_deg for s in steady],
        ),
        _row(
            "servo lags in",
            "% of the cycle",
            "most",
            f"> {LAG_BOUND * 100:g}",
            [number(s.lag_share * 100.0) for s in steady],
            [s.lag_share > LAG_BOUND for s in steady],
        ),
        _row(
            "CV error, extreme",
            "counts",
            number(paper.CV_ERROR_EXTREME_COUNTS),
            f"±{CV_ERROR_BOUND_COUNTS:g}",
            [number(a.error_extreme_counts, sign=True) for a in cv],
            [abs(abs(a.error_extreme_counts) - paper.CV_ERROR_EXTREME_COUNTS) <= CV_ERROR_BOUND_COUNTS for a in cv],
        ),
        _row(
            "at θ2",
            "deg",
            "beginning of the cycle",
            f"< {CV_BEGINNING_DEG:g}",
            [number(a.error_extreme_at_deg) for a in cv],
            [a.error_extreme_at_deg < CV_BEGINNING_DEG for a in cv],
        ),
    ]


def _motion(steady: Sequence[Reproduction]) -> list[Row]:
    high, low = paper.SERVO_VELOCITY_COUNTS_PER_S
    ratio = paper.POWER_KW[0] / paper.POWER_KW[1]
    ratios = [s.power_ratio for s in steady]
    return [
        _row(
            "servo position, maximum",
            "counts",
            number(paper.SERVO_MAXIMUM_COUNTS),
            f"±{POSITION_BOUND_COUNTS:g}",
            [number(s.slave_maximum_counts) for s in steady],
            [abs(s.slave_maximum_counts - paper.SERVO_MAXIMUM_COUNTS) <= POSITION_BOUND_COUNTS for s in steady],
        ),
        _row(
            "servo velocity, one sample",
            "counts/s",
            f"{number(high, sign=True)} / {number(low, sign=True)}",
            f"±{QUANTUM_COUNTS_PER_S:g}",
            [
                f"{number(s.slave.velocity_max_counts_per_s, sign=True)} / "
                f"{number(s.slave.velocity_min_counts_per_s, sign=True)}"
                for s in steady
            ],
            [
                abs(s.slave.velocity_max_counts_per_s - high) <= QUANTUM_COUNTS_PER_S
                and abs(s.slave.velocity_min_counts_per_s - low) <= QUANTUM_COUNTS_PER_S
                for s in steady
            ],
        ),
        _row(
            "CV velocity error, one sample",
            "counts/s",
            number(paper.CV_VELOCITY_ERROR_COUNTS_PER_S),
            f"≤ {QUANTUM_COUNTS_PER_S:g}",
            [number(s.master_velocity_error_counts_per_s) for s in steady],
            [s.master_velocity_error_counts_per_s <= QUANTUM_COUNTS_PER_S for s in steady],
        ),
        _row(
            "power, CV : servo",
            "",
            f"{ratio:.2f} : 1",
            f"2 ±{RATIO_BOUND:g}",
            [f"{number(r, 2)} : 1" for r in ratios],
            [None if r is None else abs(r - 2.0) <= RATIO_BOUND for r in ratios],
        ),
        _row(
            "energy drawn a cycle, CV / servo",
            "J",
            "",
            "",
            [f"{number(s.master.energy_per_cycle_J, 1)} / {number(s.slave.energy_per_cycle_J, 1)}" for s in steady],
        ),
    ]


def _points(steady: Sequence[Reproduction]) -> list[Row]:
    rows: list[Row] = []
    for index, point in enumerate(paper.TABLE_II):
        x, y = point.measured_mm
        rows.append(
            _row(
                f"end effector at CV {point.cv_deg:g} deg",
                "mm",
                f"({number(x)}, {number(y)})",
                f"within {POINT_BOUND_MM:g}",
                [
                    f"({number(s.points_mm[index][0], 1)}, {number(s.points_mm[index][1], 1)}), "
                    f"{number(s.distances_mm[index], 1)} off"
                    for s in steady
                ],
                [s.distances_mm[index] <= POINT_BOUND_MM for s in steady],
            )
        )
    return rows


def _torques(steady: Sequence[Reproduction], required: tuple[TorqueDemand, TorqueDemand]) -> list[Row]:
    rows: list[Row] = []
    tables = (("CV", paper.CV_TORQUE_NM), ("servo", paper.SERVO_TORQUE_NM))
    for axis, (name, (high, low, rms)) in enumerate(tables):
        table = f"{number(high, 3, sign=True)} / {number(low, 3, sign=True)} / {number(rms, 3)}"
        need = required[axis]
        model = f"{number(need.maximum, 3, sign=True)} / {number(need.minimum, 3, sign=True)} / {number(need.rms, 3)}"
        rows.append(
            _row(f"{name} torque by the model, max/min/RMS", "N m", table, "", [model for _ in steady]),
        )
        axes = [s.master if axis == 0 else s.slave for s in steady]
        rows.append(
            _row(
                f"{name} torque in the run, max/min/RMS",
                "N m",
                "",
                "",
                [
                    f"{number(a.torque_max_Nm, 3, sign=True)} / {number(a.torque_min_Nm, 3, sign=True)} / "
                    f"{number(a.torque_rms_Nm, 3)}"
                    for a in axes
                ],
            )
        )
    return rows


def _starts(runs: Sequence[TunedRun]) -> list[Row]:
    def pair(first: FirstCycle) -> str:
        return f"{number(first.master_counts, sign=True)} / {number(first.slave_counts, sign=True)}"

    return [
        _row("first cycle, ramped from rest, errors CV / servo", "counts", "", "", [pair(run.ramped) for run in runs]),
        _row(
            "first cycle, at once from rest, errors CV / servo", "counts", "", "", [pair(run.at_once) for run in runs]
        ),
    ]


def _row(
    what: str, unit: str, theirs: str, bound: str, ours: Sequence[str], is_met: Sequence[bool | None] | None = None
) -> Row:
    verdicts = tuple(None for _ in ours) if is_met is None else tuple(is_met)
    return Row(what, unit, theirs, bound, tuple(ours), verdicts)


def _verdict(text: str, is_met: bool | None) -> str:
    return text if is_met is None else f"{text} {'✓' if is_met else '✗'}"


def to_table(rows: Sequence[Row], names: Sequence[str]) -> Table:
    """The comparison for a terminal; ✓ is within the bound, ✗ is not."""
    table = Table(box=box.SIMPLE_HEAD, title="The paper's figures and the emulated machine's", title_justify="left")
    for heading in ("figure", "paper", "bound", *names):
        table.add_column(heading)
    for row in rows:
        cells = [_verdict(text, met) for text, met in zip(row.ours, row.is_met, strict=True)]
        table.add_row(f"{row.what} ({row.unit})" if row.unit else row.what, row.paper, row.bound, *cells)
    return table


def to_markdown(rows: Sequence[Row], names: Sequence[str]) -> str:
    """The comparison as a Markdown table."""
    lines = [
        "| figure | unit | paper | bound | " + " | ".join(names) + " |",
        "| --- | --- | --- | --- |" + " --- |" * len(names),
    ]
    for row in rows:
        cells = [_verdict(text, met) for text, met in zip(row.ours, row.is_met, strict=True)]
        lines.append("| " + " | ".join([row.what, row.unit, row.paper, row.bound, *cells]) + " |")
    return "\n".join(lines) + "\n"
