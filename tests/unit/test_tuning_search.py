"""The search for gains, what it may do, and what the shipped gains do."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from config.loading import load_config
from gateway.cli.app import app
from gateway.running.preparation import compile_config
from gateway.tuning.controller import Gains
from gateway.tuning.margins import gain_array, loop_model
from gateway.tuning.search import GainSearch, TuningGoals, search_gains, state_tuning
from gateway.tuning.steady_cycle import SteadyCycle
from sim_drive.closed_loop import closed_loop_of

PAPER = load_config("paper")
PRESENT = gain_array(tuple(Gains.from_section(axis.emulation.gains) for axis in PAPER.ordered_axes))
SLACK = np.array([[8000, 0, 0, 120_000, 120_000], [4000, 0, 0, 45_000, 45_000]], dtype=float)


@pytest.fixture(scope="module")
def cam():
    return compile_config(PAPER)


@pytest.fixture(scope="module")
def cycle(cam):
    return SteadyCycle(closed_loop_of(PAPER), PAPER, cam.profile)


@pytest.fixture(scope="module")
def coarse(cam):
    return loop_model(PAPER, cam.profile, cam.closure, 12, 80)


def make_search(cycle, coarse, goals=None):
    return GainSearch(cycle, coarse, (1.5, 1.5), goals or TuningGoals())


def test_the_shipped_gains_reach_their_goals_with_their_margins(cam, cycle):
    stated = state_tuning(cycle, loop_model(PAPER, cam.profile, cam.closure), PRESENT)
    assert stated.robustness.problems() == []
    assert stated.robustness.margins.gain_dB.value >= 8.0
    assert stated.robustness.delay_margin_s >= 0.002
    assert stated.figures.peak_counts[0] <= 8
    assert stated.figures.peak_counts[1] <= 15


def test_gains_and_bandwidths_are_each_others_inverse(cycle, coarse):
    search = make_search(cycle, coarse)
    bandwidths = search.bandwidths(PRESENT)
    assert search.gains(bandwidths) == pytest.approx(PRESENT, abs=1.0)
    # Twice the bandwidth of the master's position loop is twice its K_P, and with that its K_I.
    faster = search.gains(bandwidths * [1, 2, 1, 1, 1, 1])
    assert faster[0, [0, 1, 3]] == pytest.approx(PRESENT[0, [0, 1, 3]] * [2, 2, 1], rel=0.01)


@pytest.mark.slow
def test_a_search_is_its_seeds_and_ends_no_worse_than_it_began(cycle, coarse):
    def run(seed):
        search = make_search(cycle, coarse)
        before = make_search(cycle, coarse).cost(SLACK)
        found = search_gains(search, SLACK, 60, seed)
        assert search.evaluations == 60
        assert search.best_cost <= before
        return found.tolist()

    assert run(3) == run(3)


def test_a_search_that_is_stopped_keeps_its_best(cycle, coarse):
    search = make_search(cycle, coarse)
    told = []
    found = search_gains(search, SLACK, 500, 1, told.append, lambda: len(told) >= 7)
    assert len(told) == 7
    assert (found == search.best).all()
    assert told[-1].best_figures == search.best_figures


def test_missing_a_bound_costs_more_the_further_it_is_missed(cycle, coarse):
    costs = [make_search(cycle, coarse, TuningGoals(gain_margin_dB=bound)).cost(PRESENT) for bound in (8.0, 14.0, 20.0)]
    assert costs[0] < costs[1] < costs[2]
    wild = PRESENT * np.array([[1, 1, 1, 4, 1], [1, 1, 1, 4, 1]])
    assert make_search(cycle, coarse).cost(wild) > 900


def cli(*arguments):
    return CliRunner().invoke(app, ["tune", *arguments], catch_exceptions=True)


@pytest.mark.slow
def test_check_tells_the_margins_and_refuses_unstable_gains(tmp_path, capfd):
    done = cli("paper", "--check", "--json")
    assert done.exit_code == 0
    told = json.loads(done.stdout)
    assert told["problems"] == []
    assert told["margins"]["gain_margin_dB"]["value"] == pytest.approx(8.45, abs=0.3)
    # Held still at the position where the model, at speed, has its least.
    assert told["measured"]["gain_margin_dB"]["value"] == pytest.approx(8.9, abs=0.5)
    wild = tmp_path / "wild.yaml"
    wild.write_text(PAPER.text.replace("K_V: 103000", "K_V: 903000"))
    done = cli(str(wild), "--check")
    assert done.exit_code == 1
    assert (
        capfd.readouterr().err == f"drive-gateway: {wild}: the gains make the loop unstable\n"
        or done.stderr.endswith("wild.yaml: the gains make the loop unstable\n")
    )


def test_a_shipped_configuration_is_not_written_over():
    done = cli("paper", "--evaluations", "1")
    assert "ships with the program and is not changed (give --output FILE)" in str(done.exception)


@pytest.mark.slow
def test_tune_finds_writes_and_tries_gains(tmp_path):
    config = tmp_path / "machine.yaml"
    slack = (
        PAPER.text.replace("feed_forward: {enabled: true}", "")
        .replace("K_P: 6800, K_I: 130, K_D: 0, K_V: 103000, K_F: 103000", "K_P: 8000, K_V: 120000, K_F: 120000")
        .replace("K_P: 5000, K_I: 200, K_D: 0, K_V: 58000, K_F: 58000", "K_P: 4000, K_V: 45000, K_F: 45000")
    )
    config.write_text(slack)
    done = cli(str(config), "--evaluations", "900", "--on-machine", "--virtual-time", "--json")
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    after = told["after"]["steady_cycle"]
    assert after["servo"]["peak_counts"] <= 15
    assert after["cv"]["peak_counts"] <= 8
    assert told["after"]["margins"]["gain_margin_dB"]["value"] >= 8.0
    assert not told["on_machine"]["is_aborted"]
    written = load_config(str(config))
    gains = [Gains.from_section(axis.emulation.gains).to_json() for axis in written.ordered_axes]
    assert gains == list(told["on_machine"]["in_force"].values())
