"""From samples to the figures of a run: axis errors, end effector, torque and the timing of the cycle.

The main figures are of the steady phase, at constant master speed (``Phase.CAM``); ``whole_run`` has the same for
everything during which the axes followed the cam, ramps and controlled stops included. Samples of an axis whose TPDO
was missed hold an old actual value: they are counted, and left out of its figures.
"""

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from gateway.record.histograms import CycleHistograms, count_cycles
from gateway.record.lateness import LateRecord, late_record
from gateway.record.recording import Recording
from gateway.record.sample import MISSED_TPDO_MASK, Phase
from gateway.reporting.cycle_errors import cycle_errors
from gateway.reporting.event_choice import DecisiveEvent, decisive_events, event_counts
from gateway.reporting.figures import (
    SMOOTHING_CYCLES,
    AxisFigures,
    CycleFigures,
    Distribution,
    ErrorFigures,
    Extremes,
    Magnitude,
    PhaseFigures,
    PointFigures,
    RunReport,
    TorqueFigures,
)
from gateway.reporting.paper_reference import TABLE_II, PrecisionPoint, is_reference_machine
from gateway.reporting.run_data import BoolArray, FloatArray, RunData, cam_of, prepare


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
