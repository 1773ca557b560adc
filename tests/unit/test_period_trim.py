"""A timer whose periods are too long by what it is late."""

import random
import statistics

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.period_trim import WINDOW, PeriodTrim


def run(trim, lateness_us, count):
    """Periods (us) of a timer that is set anew ``lateness_us()`` after each of its frames."""
    periods = []
    for _ in range(count):
        periods.append(trim.interval_us + lateness_us())
        trim.observe(round(periods[-1] * 1000))
    return periods


def test_the_first_correction_by_hand():
    trim = PeriodTrim(1000)
    changes = [trim.observe(1_044_600) for _ in range(WINDOW)]
    assert changes == [False] * (WINDOW - 1) + [True]
    assert trim.interval_us == 955
    # What is left, -0.4 us, is less than a timer can be set to.
    assert not any(trim.observe(999_600) for _ in range(3 * WINDOW))
    assert trim.interval_us == 955


@given(st.floats(0.0, 80.0), st.floats(0.0, 20.0), st.sampled_from([500, 1000, 4000]), st.integers(0, 1 << 30))
def test_the_mean_period_becomes_the_right_one(least_us, spread_us, period_us, seed):
    trim = PeriodTrim(period_us)
    source = random.Random(seed)
    late = min(least_us, period_us * 0.05)
    periods = run(trim, lambda: late + source.expovariate(1.0) * spread_us * 0.5, 40 * WINDOW)
    settled = periods[20 * WINDOW :]
    assert abs(statistics.fmean(settled) - period_us) < 2.5


def test_a_host_that_is_away_now_and_then_does_not_shorten_the_period_for_good():
    trim = PeriodTrim(1000)
    source = random.Random(5)
    # One SYNC in a hundred is 5 ms late: 50 us in the mean, of which 1 us counts.
    periods = run(trim, lambda: 5000.0 if source.random() < 0.01 else 10.0, 30 * WINDOW)
    assert 985 <= trim.interval_us <= 991
    assert statistics.median(periods) == pytest.approx(1000.0, abs=3.0)


def test_what_is_asked_for_stays_within_a_tenth_and_is_never_too_long():
    trim = PeriodTrim(1000)
    run(trim, lambda: 700.0, 100 * WINDOW)
    assert trim.interval_us == 900
    run(trim, lambda: -50.0, 100 * WINDOW)
    assert trim.interval_us == 1000
