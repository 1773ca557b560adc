"""Runs side by side: following errors and torque of each, in a table and on one page."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from gateway.errors import GatewayError, UsageError
from gateway.record.recording import Recording, read_recording
from gateway.reporting.figure import Figure, Theme, new_figure, render_png
from gateway.reporting.run_data import RunData, cam_of, prepare

MAX_RUNS: Final = 12
_BINS: Final = 360
_WHOLE_CYCLE: Final = 0.97
"""Share of the most samples of a machine cycle from which one counts as whole."""
_SIZE_INCHES: Final = (10.5, 7.5)
_COLOURS: Final = ("#5b6675", "#0b7a75", "#c2500a", "#4053c8", "#c21f3a", "#7a4fb5", "#8a6d00", "#1c2430")

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class AxisComparison:
    """One axis of one run at constant speed; counts and N m.

    ``peak`` and ``rms`` of the following error over the whole of it; ``last_peak`` and ``last_rms`` of the last whole
    machine cycle alone, which is what learning has come to.
    """

    peak: float
    rms: float
    last_peak: float
    last_rms: float
    torque_rms_Nm: float
    offset_rms_permille: float

    def to_json(self) -> dict[str, float]:
        """Plain values."""
        return {name: round(float(getattr(self, name)), 6) for name in self.__slots__}


@dataclass(frozen=True, slots=True)
class ComparedRun:
    """One run: ``label``, how it ended, whole machine cycles, and its axes."""

    label: str
    stopped_by: str
    speed_rpm: float
    machine_cycles: float
    axes: tuple[AxisComparison, ...]
    data: RunData

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        names = self.data.constants.axis_names
        return {
            "label": self.label,
            "stopped_by": self.stopped_by,
            "speed_rpm": round(self.speed_rpm, 4),
            "machine_cycles": round(self.machine_cycles, 3),
            "axes": {name: axis.to_json() for name, axis in zip(names, self.axes, strict=True)},
        }


def compare_runs(paths: list[Path], labels: list[str]) -> list[ComparedRun]:
    """Read and judge recordings of the same axes; ``labels`` as many as there are paths, or none.

    Raises UsageError for runs of other axes or a wrong number of labels, GatewayError for one that never ran at
    constant speed, RecordingError for a file that cannot be read.
    """
    if len(paths) > MAX_RUNS:
        raise UsageError(f"{len(paths)} runs, but at most {MAX_RUNS} go on one page")
    if labels and len(labels) != len(paths):
        raise UsageError(f"{len(labels)} labels for {len(paths)} runs")
    recordings = [read_recording(path) for path in paths]
    names = recordings[0].constants.axis_names
    for recording in recordings[1:]:
        if recording.constants.axis_names != names:
            other = ", ".join(recording.constants.axis_names)
            raise UsageError(f"{recording.path}: is of other axes ({other}) than {paths[0]} ({', '.join(names)})")
    return [_judge(one, label) for one, label in zip(recordings, labels or _labels(paths), strict=True)]


def _labels(paths: list[Path]) -> list[str]:
    """File names, with their folder's where two are the same."""
    stems = [path.stem for path in paths]
    return [f"{path.parent.name}/{path.stem}" if stems.count(path.stem) > 1 else path.stem for path in paths]


def _judge(recording: Recording, label: str) -> ComparedRun:
    data = prepare(recording.samples, recording.constants, cam_of(recording))
    steady = data.is_steady
    if not steady.any():
        raise GatewayError(f"{recording.path}: holds no motion at constant speed to compare")
    turns = data.master_rad / (2.0 * np.pi)
    travelled = float(abs(turns[steady][-1] - turns[steady][0]))
    last = steady & (np.abs(turns - turns[steady][-1]) < 1.0)
    axes: list[AxisComparison] = []
    for axis in range(len(data.constants.axes)):
        valid = data.is_valid[:, axis]
        error, ending = data.error_counts[steady & valid, axis], data.error_counts[last & valid, axis]
        offset = data.samples["torque_offset"][steady, axis].astype(np.float64)
        axes.append(
            AxisComparison(
                _peak(error), _rms(error), _peak(ending), _rms(ending), _rms(data.torque_nm[steady, axis]), _rms(offset)
            )
        )
    speed = float(np.median(np.abs(data.samples["master_velocity"][steady]))) * 60.0 / (2.0 * np.pi)
    return ComparedRun(label, recording.stopped_by, speed, travelled, tuple(axes), data)


def _peak(values: Float) -> float:
    return float(np.abs(values).max(initial=0.0))


def _rms(values: Float) -> float:
    return float(np.sqrt(np.square(values).mean())) if len(values) else 0.0


def comparison_png(runs: list[ComparedRun]) -> bytes:
    """One page: above, each axis' following error over the last machine cycle; below, its RMS from cycle to cycle."""
    return render_png(lambda theme: _draw(runs, theme), "Runs side by side")


def _draw(runs: list[ComparedRun], theme: Theme) -> Figure:
    names = runs[0].data.constants.axis_names
    figure = new_figure(*_SIZE_INCHES)
    panels = figure.subplots(2, len(names), squeeze=False)
    for axis, name in enumerate(names):
        above, below = panels[0, axis], panels[1, axis]
        for number, run in enumerate(runs):
            colour = _COLOURS[number % len(_COLOURS)]
            degrees, error = _last_cycle(run.data, axis)
            above.plot(degrees, error, color=colour, linewidth=1.0, label=run.label)
            cycles, rms = _rms_by_cycle(run.data, axis)
            below.plot(cycles, rms, "o-", markersize=3.0, linewidth=1.0, color=colour, label=run.label)
        above.axhline(0.0, color=theme.muted, linewidth=0.6)
        above.set_title(f"axis {name}: following error in the last machine cycle")
        above.set_xlabel("theta2, deg")
        above.set_xlim(0.0, 360.0)
        below.set_title(f"axis {name}: RMS of each machine cycle")
        below.set_xlabel("machine cycle at constant speed")
        below.set_ylim(bottom=0.0)
        below.xaxis.set_major_locator(MaxNLocator(integer=True))
    panels[0, 0].set_ylabel("counts")
    panels[1, 0].set_ylabel("counts")
    panels[0, 0].legend(loc="best")
    return figure


def _last_cycle(data: RunData, axis: int) -> tuple[Float, Float]:
    """Degrees, and the following error averaged over each degree, of the last machine cycle at constant speed."""
    turns = data.master_rad / (2.0 * np.pi)
    mask = data.is_steady & data.is_valid[:, axis]
    mask &= np.abs(turns - turns[data.is_steady][-1]) < 1.0
    slot = np.minimum((data.master_deg[mask] * (_BINS / 360.0)).astype(np.int64), _BINS - 1)
    count = np.bincount(slot, minlength=_BINS)
    total = np.bincount(slot, weights=data.error_counts[mask, axis], minlength=_BINS)
    seen = count > 0
    middles: Float = np.linspace(0.0, 360.0, _BINS, endpoint=False) + 180.0 / _BINS
    return middles[seen], total[seen] / count[seen]


def _rms_by_cycle(data: RunData, axis: int) -> tuple[Float, Float]:
    mask = data.is_steady & data.is_valid[:, axis]
    turns = np.abs(data.master_rad[mask] - data.master_rad[data.is_steady][0]) / (2.0 * np.pi)
    number = np.floor(turns + 1e-9).astype(np.int64)
    square = np.square(data.error_counts[mask, axis])
    count = np.bincount(number)
    whole = count > _WHOLE_CYCLE * count.max()
    rms: Float = np.sqrt(np.bincount(number, weights=square) / np.maximum(count, 1))
    numbers: Float = np.arange(1, len(count) + 1, dtype=np.float64)
    return numbers[whole], rms[whole]
