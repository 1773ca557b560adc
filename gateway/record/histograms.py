"""How late things are, as HDR histograms: filled from samples, outside the cycle, of whatever length the run is.

Three significant digits from 1 ns to 100 s. They can be added to each other and kept; ``encoded`` is the text that
every HdrHistogram library and viewer reads.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Any, Final

import numpy as np
from hdrh.histogram import HdrHistogram  # pyright: ignore[reportMissingTypeStubs]
from numpy.typing import NDArray

from gateway.record.sample import MISSED_TPDO_MASK, SampleArray, SampleFlag

LEAST_NS: Final = 1
GREATEST_NS: Final = 100_000_000_000
SIGNIFICANT_DIGITS: Final = 3
_KEPT_BITS: Final = 11
"""Values are rounded down to so many bits before they are counted: what three digits can tell apart."""

Samples = SampleArray
Nanoseconds = NDArray[np.int64]


class Timing(Enum):
    """What the cycle is measured by."""

    SYNC_PERIOD = "sync_period"
    WAKE_LATENESS = "wake_lateness"
    TPDO_ARRIVAL = "tpdo_arrival"
    RPDO_LEAD = "rpdo_lead"
    LOOP_TIME = "loop_time"


def _periods(samples: Samples) -> Nanoseconds:
    periods = samples["sync_period_ns"]
    # The first SYNC has none before it.
    return periods[periods > 0]


def _arrivals(samples: Samples) -> Nanoseconds:
    return samples["tpdo_arrival_ns"][(samples["flags"] & MISSED_TPDO_MASK) == 0]


def _loop_times(samples: Samples) -> Nanoseconds:
    times = samples["loop_cpu_ns"]
    return times[times > 0]


_VALUES: Final[dict[Timing, Callable[[Samples], Nanoseconds]]] = {
    Timing.SYNC_PERIOD: _periods,
    Timing.WAKE_LATENESS: lambda samples: samples["wake_lateness_ns"],
    Timing.TPDO_ARRIVAL: _arrivals,
    # A demand that came too late has no lead; it is counted as missed.
    Timing.RPDO_LEAD: lambda samples: samples["rpdo_lead_ns"],
    Timing.LOOP_TIME: _loop_times,
}


@dataclass(frozen=True, slots=True)
class Spread:
    """Percentiles in microseconds, to three significant digits; None where there was nothing."""

    count: int
    min: float | None
    p1: float | None
    p50: float | None
    p90: float | None
    p99: float | None
    p999: float | None
    """99.9 %."""
    max: float | None


class CycleHistograms:
    """One histogram for each ``Timing``."""

    def __init__(self) -> None:
        self._histograms: dict[Timing, Any] = {
            timing: HdrHistogram(LEAST_NS, GREATEST_NS, SIGNIFICANT_DIGITS) for timing in Timing
        }

    def add(self, samples: Samples) -> None:
        """Count samples in. Values below 0 count as 0: a demand without lead, a SYNC before its time."""
        for timing, histogram in self._histograms.items():
            for value, count in zip(*_grouped(_VALUES[timing](samples)), strict=True):
                histogram.record_value(value, count)

    def spread(self, timing: Timing) -> Spread:
        """The percentiles so far."""
        histogram = self._histograms[timing]
        count: int = histogram.get_total_count()
        if not count:
            return Spread(0, None, None, None, None, None, None, None)
        percentiles = (1.0, 50.0, 90.0, 99.0, 99.9)
        p1, p50, p90, p99, p999 = (histogram.get_value_at_percentile(p) / 1e3 for p in percentiles)
        least, most = histogram.get_min_value() / 1e3, histogram.get_max_value() / 1e3
        return Spread(count, least, p1, p50, p90, p99, p999, most)

    def encoded(self, timing: Timing) -> str:
        """The histogram in HdrHistogram's own form, compressed, base64; values are nanoseconds."""
        text: bytes = self._histograms[timing].encode()
        return text.decode("ascii")


def _grouped(nanoseconds: Nanoseconds) -> tuple[list[int], list[int]]:
    """Values rounded to what the histogram keeps, and how often each is there: thousands of counts, not millions."""
    values = np.clip(nanoseconds.astype(np.int64), 0, GREATEST_NS)
    shifts = np.maximum(np.frexp(values.astype(np.float64))[1].astype(np.int64) - _KEPT_BITS, 0)
    unique, counts = np.unique(values >> shifts << shifts, return_counts=True)
    return unique.tolist(), counts.tolist()


@dataclass(frozen=True, slots=True)
class CycleCounts:
    """What should not happen in a cycle, and did: cycles, or TPDOs of all axes together."""

    missed_tpdo: int = 0
    """TPDOs that were not there at their deadline."""
    late_tpdo: int = 0
    """Cycles in which a TPDO came after its deadline."""
    missed_rpdo_deadline: int = 0
    overruns: int = 0
    sync_lost: int = 0
    bus_errors: int = 0
    send_buffer_full: int = 0

    def __add__(self, other: "CycleCounts") -> "CycleCounts":
        return CycleCounts(*(getattr(self, name) + getattr(other, name) for name in self.__slots__))

    @property
    def total(self) -> int:
        """All together; a late TPDO has been counted as missed already."""
        return sum(getattr(self, name) for name in self.__slots__) - self.late_tpdo


_FLAGS: Final = {
    "late_tpdo": SampleFlag.LATE_TPDO,
    "missed_rpdo_deadline": SampleFlag.MISSED_RPDO_DEADLINE,
    "overruns": SampleFlag.OVERRUN,
    "sync_lost": SampleFlag.SYNC_LOST,
    "bus_errors": SampleFlag.BUS_ERROR,
    "send_buffer_full": SampleFlag.SEND_BUFFER_FULL,
}


def count_cycles(samples: Samples, axes: int) -> CycleCounts:
    """What the flags of these samples say."""
    flags = samples["flags"]
    missed = sum(int(np.count_nonzero(flags & (1 << axis))) for axis in range(axes))
    return CycleCounts(
        missed_tpdo=missed, **{name: int(np.count_nonzero(flags & flag)) for name, flag in _FLAGS.items()}
    )
