"""From samples to the figures of a run: axis errors, end effector, torque and the timing of the cycle.

Signs and times. The following error is the demand minus the actual position of the same record, as in object 60F4h:
positive where an axis that moves forwards lags, negative where it lags on its way back, as in the paper's -115 counts
at the start of the return stroke. Demand and actual value of a record belong to the same SYNC. Where in the cycle:
theta2 demanded, modulo one revolution, in degrees.

The main figures are of the steady phase, at constant master speed (``Phase.CAM``); ``whole_run`` has the same for
everything during which the axes followed the cam, ramps and controlled stops included. Samples of an axis whose TPDO
was missed hold an old actual value: they are counted, and left out of its figures.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gateway.record.histograms import CycleCounts, CycleHistograms, Timing, count_cycles
from gateway.record.lateness import LateRecord, late_record
from gateway.record.recording import CAM_ATTACHMENT, Recording, RecordingError
from gateway.record.run_constants import RunConstants
from gateway.record.sample import MISSED_TPDO_MASK, Phase, SampleArray
from gateway.reporting.cycle_errors import CycleErrors, cycle_errors
from gateway.reporting.event_choice import DecisiveEvent, decisive_events, event_counts
from gateway.reporting.paper_reference import TABLE_II, PrecisionPoint, is_reference_machine
from mechanism.cam_file import parse_cam_file
from mechanism.cam_profile import CamProfile
from mechanism.errors import CamFileError
from mechanism.five_bar import Closure, FiveBar

REPORT_VERSION: Final = 1
_POSITION_RANGE: Final = 2.0**32
FOLLOWING_PHASES: Final = (Phase.RAMP_UP, Phase.CAM, Phase.RAMP_DOWN, Phase.CONTROLLED_STOP)
"""In these the axes follow the cam, so that a following error means something."""
SMOOTHING_CYCLES: Final = 10
"""Span of the smoothed velocity: the difference of positions so many cycles apart, placed in their middle."""
_DECIMALS: Final = 6

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


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


@dataclass(frozen=True, slots=True)
class RunData:
    """Samples in the units of the figures; arrays have a row a sample, (n,), (n, axes) or (n, 2) for x and y.

    ``is_valid``, (n, axes): the axis' TPDO came. ``desired_mm`` and ``actual_mm`` are None without a mechanism.
    """

    constants: RunConstants
    samples: SampleArray
    phase: NDArray[np.int32]
    master_rad: FloatArray
    """theta2 demanded, unwrapped."""
    master_deg: FloatArray
    """theta2 demanded, 0 to 360."""
    is_valid: BoolArray
    demand_counts: FloatArray
    actual_counts: FloatArray
    """Positions without the wrap of INTEGER32."""
    error_counts: FloatArray
    error_deg: FloatArray
    torque_nm: FloatArray
    angle_rad: FloatArray
    """Joint angles from the actual positions."""
    desired_mm: FloatArray | None
    actual_mm: FloatArray | None

    @property
    def is_steady(self) -> BoolArray:
        """Samples at constant master speed."""
        return self.phase == Phase.CAM

    @property
    def is_following(self) -> BoolArray:
        """Samples during which the axes followed the cam."""
        return np.isin(self.phase, FOLLOWING_PHASES)


def prepare(samples: SampleArray, constants: RunConstants, cam: CamProfile | None = None) -> RunData:
    """Work out errors, angles and points of every sample.

    The desired point is the cam's at the demanded theta2; without ``cam`` it follows from the demanded counts.
    """
    counts_per_revolution = np.array([axis.counts_per_revolution for axis in constants.axes], dtype=np.float64)
    rated = np.array([axis.rated_torque_nm for axis in constants.axes])
    # Positions are INTEGER32 and wrap: the difference is taken modulo 2^32, and the demand made continuous.
    error = (samples["position_demand"] - samples["position_actual"]).astype(np.float64)
    demand = np.unwrap(samples["position_demand"].astype(np.float64), axis=0, period=_POSITION_RANGE)
    actual = demand - error
    axis_bits = 1 << np.arange(len(constants.axes))
    is_valid: BoolArray = (samples["flags"][:, None] & axis_bits) == 0
    master = samples["master_position"].astype(np.float64)
    angle = _angles(actual, constants)
    desired_mm = actual_mm = None
    mechanism = constants.mechanism
    if mechanism is not None:
        m = mechanism
        five_bar = FiveBar(m.p_m, m.q_m, m.r_m, m.s_m, m.cv_pivot_m, m.servo_pivot_m)
        closure = Closure(m.closure)
        if cam is not None:
            theta2, theta5 = master, cam.at_many(master)[:, 0]
        else:
            wanted = _angles(demand, constants)
            theta2, theta5 = wanted[:, constants.master_axis], wanted[:, constants.slave_axis]
        desired_mm = five_bar.end_effector(theta2, theta5, closure) * 1e3
        actual_mm = (
            five_bar.end_effector(angle[:, constants.master_axis], angle[:, constants.slave_axis], closure) * 1e3
        )
    return RunData(
        constants=constants,
        samples=samples,
        phase=samples["phase"],
        master_rad=master,
        master_deg=np.degrees(np.mod(master, math.tau)),
        is_valid=is_valid,
        demand_counts=demand,
        actual_counts=actual,
        error_counts=error,
        error_deg=error * 360.0 / counts_per_revolution,
        torque_nm=samples["torque_actual"] * rated / 1000.0,
        angle_rad=angle,
        desired_mm=desired_mm,
        actual_mm=actual_mm,
    )


def _angles(counts: FloatArray, constants: RunConstants) -> FloatArray:
    zero = np.array([axis.zero_rad for axis in constants.axes])
    scale = np.array([axis.direction * math.tau / axis.counts_per_revolution for axis in constants.axes])
    return zero + scale * counts


def analyse(recording: Recording) -> RunReport:
    """The figures of a recorded run."""
    return report_of_recording(recording, prepare(recording.samples, recording.constants, cam_of(recording)))


def report_of_recording(recording: Recording, data: RunData) -> RunReport:
    """The figures of a recording whose samples are prepared already."""
    events = [event.data for event in recording.events]
    return report_of(
        data,
        recording=str(recording.path),
        recording_is_complete=recording.is_complete,
        stopped_by=recording.stopped_by,
        late=late_record(events),
        decisive=decisive_events(events, recording.metadata.start_ns),
        event_counts=event_counts(events),
    )


def report_of(
    data: RunData,
    *,
    recording: str = "",
    recording_is_complete: bool = True,
    stopped_by: str = "unknown",
    late: LateRecord | None = None,
    decisive: tuple[DecisiveEvent, ...] = (),
    event_counts: Mapping[str, int] | None = None,
) -> RunReport:
    """The figures of prepared samples."""
    return RunReport(
        constants=data.constants,
        steady=phase_figures(data, data.is_steady),
        whole_run=phase_figures(data, data.is_following),
        cycle=cycle_figures(data),
        by_machine_cycle=cycle_errors(data),
        phase_counts={phase: int(np.count_nonzero(data.phase == phase)) for phase in Phase},
        table_ii=tuple(_point_figures(data, TABLE_II)) if is_reference_machine(data.constants.mechanism) else (),
        machine_cycles=_machine_cycles(data),
        recording=recording,
        recording_is_complete=recording_is_complete,
        stopped_by=stopped_by,
        late=late,
        decisive=decisive,
        event_counts=event_counts or {},
    )


def phase_figures(data: RunData, mask: BoolArray) -> PhaseFigures:
    """Figures of the axes and the end effector over the samples of ``mask``."""
    error_mm = np.empty(0)
    if data.desired_mm is not None and data.actual_mm is not None:
        distance = np.hypot(*(data.actual_mm - data.desired_mm).T)
        error_mm = distance[mask & data.is_valid.all(axis=1) & np.isfinite(distance)]
    return PhaseFigures(
        samples=int(np.count_nonzero(mask)),
        axes=tuple(_axis_figures(data, axis, mask) for axis in range(len(data.constants.axes))),
        end_effector_error_mm=Magnitude(_max(error_mm), _rms(error_mm)),
    )


def _axis_figures(data: RunData, axis: int, mask: BoolArray) -> AxisFigures:
    valid = mask & data.is_valid[:, axis]
    position = data.actual_counts[valid, axis]
    torque = data.torque_nm[valid, axis]
    constants = data.constants.axes[axis]
    demand = data.demand_counts[mask, axis]
    degrees = 360.0 / constants.counts_per_revolution
    return AxisFigures(
        samples=len(position),
        following_error_counts=_error_figures(data.error_counts[valid, axis], data.master_deg[valid]),
        following_error_deg=_error_figures(data.error_deg[valid, axis], data.master_deg[valid]),
        position_actual_counts=_extremes(position),
        displacement_deg=float(np.ptp(position)) * degrees if len(position) else None,
        demand_displacement_deg=float(np.ptp(demand)) * degrees if len(demand) else None,
        velocity_actual_counts_per_s=_extremes(_velocity(data, axis, valid, 1)[1]),
        velocity_smoothed_counts_per_s=_extremes(_velocity(data, axis, valid, SMOOTHING_CYCLES)[1]),
        demand_velocity_rad_per_s=_extremes(data.samples["demand_velocity"][mask, axis]),
        torque_actual_nm=TorqueFigures(_max(torque), _min(torque), _rms(torque)),
    )


def _velocity(data: RunData, axis: int, valid: BoolArray, span: int) -> tuple[NDArray[np.intp], FloatArray]:
    """Indices of the samples in the middle of each span of cycles, and the actual velocity there, counts/s.

    Only spans whose ends are valid and exactly ``span`` cycles apart.
    """
    cycle = data.samples["cycle"]
    position = data.actual_counts[:, axis]
    if len(cycle) <= span:
        return np.empty(0, dtype=np.intp), np.empty(0)
    usable = valid[span:] & valid[:-span] & (cycle[span:] - cycle[:-span] == span)
    velocity = (position[span:] - position[:-span]) / (span * data.constants.period_s)
    return np.flatnonzero(usable) + span // 2, velocity[usable]


def cycle_figures(data: RunData) -> CycleFigures:
    """The timing of the cycle over every sample."""
    samples = data.samples
    flags = samples["flags"]
    histograms = CycleHistograms()
    histograms.add(samples)
    # The first SYNC has none before it; across a hole in the record the period says nothing.
    has_period = samples["sync_period_ns"] > 0
    period_ns = data.constants.period_s * 1e9
    numbers = samples["cycle"]
    span = int(numbers[-1] - numbers[0]) + 1 if len(numbers) else 0
    return CycleFigures(
        period_s=data.constants.period_s,
        count=len(samples),
        counts=count_cycles(samples, len(data.constants.axes)),
        lost_samples=max(0, span - len(samples)),
        sync_period_deviation_us=_distribution(np.abs(samples["sync_period_ns"][has_period] - period_ns)),
        sync_deviation_us=_distribution(np.abs(samples["sync_deviation_ns"].astype(np.float64))),
        wake_lateness_us=_distribution(samples["wake_lateness_ns"].astype(np.float64)),
        tpdo_arrival_us=_distribution(samples["tpdo_arrival_ns"][(flags & MISSED_TPDO_MASK) == 0].astype(np.float64)),
        rpdo_lead_us=_extremes(samples["rpdo_lead_ns"] / 1e3),
        loop_cpu_us_per_cycle=float(samples["loop_cpu_ns"].mean()) / 1e3 if samples["loop_cpu_ns"].any() else None,
        histograms=histograms,
    )


def _machine_cycles(data: RunData) -> int:
    steady = data.master_rad[data.is_steady]
    if not len(steady):
        return 0
    # From the first sample to the last there is one period less than the revolutions take.
    one_step = np.median(np.abs(np.diff(steady))) if len(steady) > 1 else 0.0
    return int((abs(steady[-1] - steady[0]) + 1.5 * one_step) / math.tau)


def _point_figures(data: RunData, points: Sequence[PrecisionPoint]) -> list[PointFigures]:
    master = data.constants.master_axis
    usable = data.is_steady & data.is_valid.all(axis=1)
    rows: list[PointFigures] = []
    for point in points:
        actual = _mean_at(data.angle_rad[usable, master], data.actual_mm, usable, math.radians(point.cv_deg))
        desired = _mean_at(data.master_rad[usable], data.desired_mm, usable, math.radians(point.cv_deg))
        rows.append(
            PointFigures(
                point=point,
                desired_here_mm=desired[0] if desired else None,
                actual_mm=actual[0] if actual else None,
                passes=actual[1] if actual else 0,
            )
        )
    return rows


def _mean_at(
    angle: FloatArray, points_mm: FloatArray | None, usable: BoolArray, wanted: float
) -> tuple[tuple[float, float], int] | None:
    """Mean point where the growing ``angle`` passes ``wanted`` + whole turns, linear between samples; and how often."""
    if points_mm is None or len(angle) < 2:
        return None
    rising = np.maximum.accumulate(angle)
    first = math.ceil((rising[0] - wanted) / math.tau)
    last = math.floor((rising[-1] - wanted) / math.tau)
    if first > last:
        return None
    at = [wanted + turn * math.tau for turn in range(first, last + 1)]
    path = points_mm[usable]
    x, y = (float(np.interp(at, rising, path[:, k]).mean()) for k in (0, 1))
    return ((x, y), len(at)) if math.isfinite(x) and math.isfinite(y) else None


def cam_of(recording: Recording) -> CamProfile | None:
    """The cam that the recording carries, if it carries one. Raises ``RecordingError`` for one that is damaged."""
    if not recording.cam_text:
        return None
    try:
        return parse_cam_file(recording.cam_text, f"{recording.path}:{CAM_ATTACHMENT}").cam.profile
    except CamFileError as error:
        raise RecordingError(recording.path, f"carries an unusable cam: {error}") from error


def _error_figures(error: FloatArray, master_deg: FloatArray) -> ErrorFigures:
    if not len(error):
        return ErrorFigures(None, None, None, None)
    where = float(master_deg[int(np.argmax(np.abs(error)))])
    return ErrorFigures(_max(error), _min(error), _rms(error), where)


def _extremes(values: FloatArray) -> Extremes:
    return Extremes(_max(values), _min(values))


def _distribution(nanoseconds: FloatArray) -> Distribution:
    """Percentiles in microseconds; the nearest sample above, so that every figure was really seen."""
    if not len(nanoseconds):
        return Distribution(None, None, None)
    p50, p99 = np.percentile(nanoseconds, (50, 99), method="higher") / 1e3
    return Distribution(float(p50), float(p99), float(nanoseconds.max()) / 1e3)


def _max(values: FloatArray) -> float | None:
    return float(values.max()) if len(values) else None


def _min(values: FloatArray) -> float | None:
    return float(values.min()) if len(values) else None


def _rms(values: FloatArray) -> float | None:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else None


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
