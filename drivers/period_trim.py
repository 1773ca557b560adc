"""What a timer must be set to so that the mean of its periods is right: a core without I/O.

The kernel's broadcast manager sets its timer anew after each frame, so that every period is longer than what was asked
for by as much as the timer was late; a period in a thousand of the machine's time, and more where timers are coarse.
"""

from typing import Final

WINDOW: Final = 200
"""Periods between two corrections."""
FARTHEST: Final = 0.1
"""A period is taken to be away from the right one by this share of it at most, and corrected by no more: what is later
than that is the host's doing, not the timer's."""
LEAST_US: Final = 0.75
"""What a correction must amount to; timers are set in whole microseconds."""


class PeriodTrim:
    """Watches the periods of one timer."""

    __slots__ = ("_count", "_farthest_ns", "_interval_us", "_period_ns", "_sum_ns", "interval_us")

    def __init__(self, period_us: int) -> None:
        """``period_us``: what the periods are to be, and what the timer is set to at first."""
        self.interval_us = period_us
        """What the timer is to be set to."""
        self._interval_us = float(period_us)
        self._period_ns = period_us * 1000
        self._farthest_ns = round(self._period_ns * FARTHEST)
        self._sum_ns = 0
        self._count = 0

    def observe(self, period_ns: int) -> bool:
        """One period has passed, and has taken this long; returns whether ``interval_us`` has changed."""
        away_ns = period_ns - self._period_ns
        if not -self._farthest_ns <= away_ns <= self._farthest_ns:
            away_ns = self._farthest_ns if away_ns > 0 else -self._farthest_ns
        self._sum_ns += away_ns
        self._count += 1
        if self._count < WINDOW:
            return False
        mean_us = self._sum_ns / (1000 * self._count)
        self._sum_ns = self._count = 0
        if abs(mean_us) < LEAST_US:
            return False
        nominal_us = self._period_ns / 1000
        self._interval_us = min(max(self._interval_us - mean_us, nominal_us * (1.0 - FARTHEST)), nominal_us)
        before, self.interval_us = self.interval_us, round(self._interval_us)
        return self.interval_us != before
