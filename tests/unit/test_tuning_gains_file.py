"""Gains back into a configuration's text."""

import pytest

from config.loading import ConfigError, load_config, parse_config
from gateway.tuning.controller import Gains
from gateway.tuning.gains_file import with_gains

PAPER = load_config("paper")
NEW = (Gains(1, 2, 3, 4, 5), Gains(60, 0, 0, 70, 80))


def lines_that_differ(before, after):
    return [(a, b) for a, b in zip(before.splitlines(), after.splitlines(), strict=True) if a != b]


def test_only_the_numbers_change():
    text = with_gains(PAPER.text, PAPER.path, PAPER.axis_names, NEW)
    assert [after.strip() for _, after in lines_that_differ(PAPER.text, text)] == [
        "gains: {K_P: 1, K_I: 2, K_D: 3, K_V: 4, K_F: 5}",
        "gains: {K_P: 60, K_I: 0, K_D: 0, K_V: 70, K_F: 80}",
    ]
    assert len(text.splitlines()) == len(PAPER.text.splitlines())


def test_a_block_with_comments_and_missing_gains_keeps_its_style():
    flow = next(line for line in PAPER.text.splitlines() if "gains: {K_P: 5000" in line)
    block = "      gains:   # found by hand\n        K_V: 45_000 # damping\n        K_P: 4000\n\n      # the amplifier"
    text = PAPER.text.replace(flow, block)
    changed = with_gains(text, PAPER.path, PAPER.axis_names, (NEW[0], Gains(6, 7, 0, 9, 0)))
    assert "      gains:   # found by hand\n        K_V: 9 # damping\n        K_P: 6\n        K_I: 7\n" in changed
    assert "\n\n      # the amplifier\n" in changed
    section = parse_config(changed, PAPER.path).ordered_axes[1].emulation.gains
    assert (section.K_P, section.K_I, section.K_D, section.K_V, section.K_F) == (6, 7, 0, 9, 0)


def test_axes_are_found_by_their_names_in_any_order():
    start, end = PAPER.text.index("  cv:\n"), PAPER.text.index("\n\n", PAPER.text.index("  servo:\n"))
    servo = PAPER.text.index("  servo:\n")
    text = (
        PAPER.text[:start] + PAPER.text[servo:end] + "\n" + PAPER.text[start:servo].rstrip() + "\n" + PAPER.text[end:]
    )
    changed = parse_config(with_gains(text, PAPER.path, PAPER.axis_names, NEW), PAPER.path)
    assert [axis.emulation.gains.K_P for axis in changed.ordered_axes] == [1, 60]


def test_what_is_no_configuration_is_refused():
    with pytest.raises(ConfigError, match="no mapping"):
        with_gains("- 1\n", PAPER.path, PAPER.axis_names, NEW)
