"""The drive's watch over SYNC, as a configuration names it: what the object is to hold, and what is refused."""

import pytest

from config.loading import ConfigError, load_config, parse_config
from config.watchdog_section import SyncWatchdogSection

PAPER = load_config("paper")
LINE = "sync_watchdog: {index: 0x3050, bits: 16, unit: cycles, cycles: 40}"


@pytest.mark.parametrize(
    ("unit", "cycles", "cycle_us", "value"),
    [
        ("cycles", 40, 1000, 40),
        ("ms", 40, 1000, 40),
        ("100us", 40, 1000, 400),
        ("us", 40, 1000, 40_000),
        # 41 cycles of 250 us are 10.25 ms: never less than what was asked for.
        ("ms", 41, 250, 11),
        ("100us", 41, 250, 103),
        ("us", 3, 600, 1800),
    ],
)
def test_the_value_in_the_drives_own_unit(unit: str, cycles: int, cycle_us: int, value: int) -> None:
    section = SyncWatchdogSection.model_validate({"index": 0x2015, "bits": 32, "unit": unit, "cycles": cycles})
    assert section.value(cycle_us) == value


@pytest.mark.parametrize(
    ("new", "sentence"),
    [
        (
            "sync_watchdog: {index: 0x3050, bits: 16, unit: us, cycles: 66}",
            "axes.cv.sync_watchdog.cycles: 66 cycles of 1000 us are 66000 us, which does not fit the object's 16 bits",
        ),
        (
            "sync_watchdog: {index: 0x3050, cycles: 20}",
            "axes.cv.sync_watchdog.cycles: 20 is not above guard.sync_lost.limit_cycles (20), the drive would fault",
        ),
        ("sync_watchdog: {index: 0x3050, bits: 8, cycles: 256}", "cycles: 256 does not fit the object's 8 bits"),
        ("sync_watchdog: {index: 0x0FFF, cycles: 40}", "axes.cv.sync_watchdog.index"),
        ("sync_watchdog: {index: 0x3050, cycles: 1}", "axes.cv.sync_watchdog.cycles"),
        ("sync_watchdog: {index: 0x3050, unit: minutes, cycles: 40}", "axes.cv.sync_watchdog.unit"),
    ],
)
def test_a_watchdog_that_cannot_be_is_refused(new: str, sentence: str) -> None:
    with pytest.raises(ConfigError) as refused:
        parse_config(PAPER.text.replace(LINE, new, 1), PAPER.path)
    assert sentence in str(refused.value)


def test_65_cycles_in_microseconds_still_fit_16_bits() -> None:
    parse_config(PAPER.text.replace(LINE, "sync_watchdog: {index: 0x3050, unit: us, cycles: 65}"), PAPER.path)
