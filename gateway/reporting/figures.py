"""The figures of a run, and how they are written as JSON.

Signs and times. The following error is the demand minus the actual position of the same record, as in object 60F4h:
positive where an axis that moves forwards lags, negative where it lags on its way back, as in the paper's -115 counts
at the start of the return stroke. Demand and actual value of a record belong to the same SYNC. Where in the cycle:
theta2 demanded, modulo one revolution, in degrees.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Final

from gateway.record.histograms import CycleCounts, CycleHistograms, Timing
from gateway.record.lateness import LateRecord
from gateway.record.run_constants import RunConstants
from gateway.record.sample import Phase
from gateway.reporting.cycle_errors import CycleErrors
from gateway.reporting.event_choice import DecisiveEvent
from gateway.reporting.paper_reference import PrecisionPoint

REPORT_VERSION: Final = 1
SMOOTHING_CYCLES: Final = 10
"""Span of the smoothed velocity: the difference of positions so many cycles apart, placed in their middle."""
_DECIMALS: Final = 6


@dataclass(frozen=True, slots=True)
class ErrorFigures:
    """Of an error over many samples; all None where there were none."""

    max: float | None
    min: float | None
    rms: float | None
    max_abs_at_master_deg: float | None
    """theta2 within the cycle where the greatest absolute value is."""


@dataclass(frozen=True, slots=True)
class Extremes:
    """Greatest and least; None where there was nothing."""

    max: float | None
    min: float | None


@dataclass(frozen=True, slots=True)
class TorqueFigures:
    """N m."""

    max: float | None
    min: float | None
    rms: float | None


@dataclass(frozen=True, slots=True)
class Magnitude:
    """Of a quantity that has no sign."""

    max: float | None
    rms: float | None


@dataclass(frozen=True, slots=True)
class Distribution:
    """Percentiles; None where there was nothing."""

    p50: float | None
    p99: float | None
    max: float | None


@dataclass(frozen=True, slots=True)
class AxisFigures:
    """One axis over some phase."""

    samples: int
    """That count: those with a missed TPDO are left out."""
    following_error_counts: ErrorFigures
    following_error_deg: ErrorFigures
    position_actual_counts: Extremes
    displacement_deg: float | None
    """Span of the actual position."""
    demand_displacement_deg: float | None
    """Span of the demand."""
    velocity_actual_counts_per_s: Extremes
    """One-sample differences of the actual position, the paper's way; a multiple of one count a cycle."""
    velocity_smoothed_counts_per_s: Extremes
    """Differences over ``SMOOTHING_CYCLES`` cycles."""
    demand_velocity_rad_per_s: Extremes
    torque_actual_nm: TorqueFigures


@dataclass(frozen=True, slots=True)
class PhaseFigures:
    """Axes (in the order of the samples) and end effector over some phase."""

    samples: int
    axes: tuple[AxisFigures, ...]
    end_effector_error_mm: Magnitude


@dataclass(frozen=True, slots=True)
class CycleFigures:
    """The timing of the cycle over every record, whatever the phase: nothing is left out."""

    period_s: float
    count: int
    counts: CycleCounts
    lost_samples: int
    """Cycles that are missing in the record, by their numbers."""
    sync_period_deviation_us: Distribution
    """|SYNC(k) - SYNC(k-1) - period|."""
    sync_deviation_us: Distribution
    """|SYNC(k) against its ideal instant|."""
    wake_lateness_us: Distribution
    tpdo_arrival_us: Distribution
    """Last TPDO after SYNC."""
    rpdo_lead_us: Extremes
    """Last RPDO before the next SYNC was due."""
    loop_cpu_us_per_cycle: float | None
    """Mean; None where nobody measured it, as in virtual time."""
    histograms: CycleHistograms


@dataclass(frozen=True, slots=True)
class PointFigures:
    """The end effector (mm) where the actual CV input passed a row of the paper's Table II; the mean of all passes."""

    point: PrecisionPoint
    desired_here_mm: tuple[float, float] | None
    """What the cam asks for at this input."""
    actual_mm: tuple[float, float] | None
    passes: int


@dataclass(frozen=True, slots=True)
class RunReport:
    """All figures of a run."""

    constants: RunConstants
    steady: PhaseFigures
    whole_run: PhaseFigures
    cycle: CycleFigures
    by_machine_cycle: CycleErrors
    phase_counts: dict[Phase, int]
    table_ii: tuple[PointFigures, ...]
    """Empty unless the machine is the paper's."""
    machine_cycles: int
    """Whole revolutions of the master at constant speed."""
    recording: str
    recording_is_complete: bool
    stopped_by: str
    late: LateRecord | None = None
    """Why demands were late; None where nobody kept account of that, as in virtual time."""
    decisive: tuple[DecisiveEvent, ...] = ()
    """What stopped the run, ended it, and became of the machine, in its order."""
    event_counts: Mapping[str, int] = field(default_factory=dict[str, int])
    """Events of each kind, all of them."""

    def to_json(self) -> dict[str, Any]:
        """The report as a JSON object of stable keys: no NaN, figures rounded to 6 decimals, null for "none"."""
        return {
            "report_version": REPORT_VERSION,
            "config": self.constants.config_name,
            **_phase_json(self.steady, self.constants),
            "cycle": _cycle_json(self.cycle),
            "late": None if self.late is None else self.late.to_json(self.cycle.counts.missed_rpdo_deadline),
            "machine_cycles": self.machine_cycles,
            "by_machine_cycle": self.by_machine_cycle.to_json(self.constants.axis_names),
            "phases": {phase.name.lower(): count for phase, count in self.phase_counts.items()},
            "table_ii": [_point_json(row) for row in self.table_ii],
            "whole_run": _phase_json(self.whole_run, self.constants),
            "recording": self.recording,
            "recording_is_complete": self.recording_is_complete,
            "stopped_by": self.stopped_by,
            "events": {
                "counts": dict(self.event_counts),
                "decisive": [asdict(event) for event in self.decisive],
            },
        }


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, _DECIMALS)


def _table(figures: ErrorFigures | Extremes | TorqueFigures | Magnitude | Distribution) -> dict[str, float | None]:
    return {name: _rounded(getattr(figures, name)) for name in figures.__slots__}


def _phase_json(figures: PhaseFigures, constants: RunConstants) -> dict[str, Any]:
    return {
        "samples": figures.samples,
        "axes": {name: _axis_json(axis) for name, axis in zip(constants.axis_names, figures.axes, strict=True)},
        "end_effector_error_mm": _table(figures.end_effector_error_mm),
    }


def _axis_json(axis: AxisFigures) -> dict[str, Any]:
    return {
        "samples": axis.samples,
        "following_error_counts": _table(axis.following_error_counts),
        "following_error_deg": _table(axis.following_error_deg),
        "position_actual_counts": _table(axis.position_actual_counts),
        "displacement_deg": _rounded(axis.displacement_deg),
        "demand_displacement_deg": _rounded(axis.demand_displacement_deg),
        "velocity_actual_counts_per_s": _table(axis.velocity_actual_counts_per_s),
        "velocity_smoothed_counts_per_s": _table(axis.velocity_smoothed_counts_per_s),
        "demand_velocity_rad_per_s": _table(axis.demand_velocity_rad_per_s),
        "torque_actual_Nm": _table(axis.torque_actual_nm),
    }


def _cycle_json(cycle: CycleFigures) -> dict[str, Any]:
    return {
        "period_s": cycle.period_s,
        "count": cycle.count,
        **asdict(cycle.counts),
        "lost_samples": cycle.lost_samples,
        "sync_period_deviation_us": _table(cycle.sync_period_deviation_us),
        "sync_deviation_us": _table(cycle.sync_deviation_us),
        "wake_lateness_us": _table(cycle.wake_lateness_us),
        "tpdo_arrival_us": _table(cycle.tpdo_arrival_us),
        "rpdo_lead_us": _table(cycle.rpdo_lead_us),
        "loop_cpu_us_per_cycle": _rounded(cycle.loop_cpu_us_per_cycle),
        "spread_us": {timing.value: asdict(cycle.histograms.spread(timing)) for timing in Timing},
        "hdr_histograms_ns": {timing.value: cycle.histograms.encoded(timing) for timing in Timing},
    }


def _point_json(row: PointFigures) -> dict[str, Any]:
    def pair(point: tuple[float, float] | None) -> list[float] | None:
        return None if point is None else [round(value, _DECIMALS) for value in point]

    return {
        "cv_deg": row.point.cv_deg,
        "actual_mm": pair(row.actual_mm),
        "desired_mm": pair(row.desired_here_mm),
        "passes": row.passes,
        "paper_desired_mm": pair(row.point.desired_mm),
        "paper_measured_mm": pair(row.point.measured_mm),
    }
