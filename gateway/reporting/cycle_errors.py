"""Following errors machine cycle by machine cycle: what learning makes of them, or wear, or warming up."""

from dataclasses import dataclass
from math import tau
from typing import Any, Final

import numpy as np

from gateway.reporting.run_data import FloatArray, RunData

MOST_LISTED: Final = 1000
"""Of more machine cycles than this, so many are listed, evenly spread, the first and the last among them."""
SHOWN: Final = (1, 2, 3, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000)
"""Machine cycles that a terminal is shown, and the last."""
_ROUNDING: Final = 1e-3
"""Share of a cycle's turn."""
_DECIMALS: Final = 6


@dataclass(frozen=True, slots=True, eq=False)
class CycleErrors:
    """Of each whole revolution at constant speed, counted from its beginning: arrays (revolutions, axes), counts.

    NaN where an axis has sent nothing for a whole revolution.
    """

    peak: FloatArray
    rms: FloatArray

    @property
    def count(self) -> int:
        """How many whole revolutions there were."""
        return len(self.peak)

    def shown(self) -> list[int]:
        """Numbers, from 1, of the machine cycles worth showing where there is little room."""
        numbers = [number for number in SHOWN if number < self.count]
        return [*numbers, self.count] if self.count else []

    def to_json(self, axis_names: tuple[str, ...]) -> dict[str, Any]:
        """Plain values; null where there is none."""
        listed = np.unique(np.linspace(0, self.count - 1, min(self.count, MOST_LISTED)).round().astype(np.int64))

        def column(values: FloatArray, axis: int) -> list[float | None]:
            return [None if np.isnan(value) else round(float(value), _DECIMALS) for value in values[listed, axis]]

        return {
            "machine_cycle": (listed + 1).tolist(),
            "axes": {
                name: {"peak_counts": column(self.peak, axis), "rms_counts": column(self.rms, axis)}
                for axis, name in enumerate(axis_names)
            },
        }


def cycle_errors(data: RunData) -> CycleErrors:
    """Greatest absolute and RMS following error of every axis in every whole revolution at constant speed."""
    axes = len(data.constants.axes)
    steady = np.flatnonzero(data.is_steady)
    if not len(steady):
        return CycleErrors(np.empty((0, axes)), np.empty((0, axes)))
    turned = np.abs(data.master_rad[steady] - data.master_rad[steady[0]]) / tau
    step = float(np.median(np.diff(turned))) if len(turned) > 1 else 0.0
    # From the first sample to the last there is one step less than the revolutions take.
    count = int(np.floor(turned[-1] + 1.5 * step))
    peak, rms = np.full((count, axes), np.nan), np.full((count, axes), np.nan)
    number = np.floor(turned + _ROUNDING * step).astype(np.int64)
    for axis in range(axes):
        usable = data.is_valid[steady, axis] & (number < count)
        error = data.error_counts[steady[usable], axis]
        cycle = number[usable]
        seen = np.bincount(cycle, minlength=count)
        squares = np.bincount(cycle, weights=error * error, minlength=count)
        has = seen > 0
        rms[has, axis] = np.sqrt(squares[has] / seen[has])
        greatest = np.zeros(count)
        np.maximum.at(greatest, cycle, np.abs(error))
        peak[has, axis] = greatest[has]
    return CycleErrors(peak, rms)
