"""Gains into drives, and tuning on the machine, with the emulated machine in virtual time."""

import math

import pytest

from config.loading import load_config, parse_config
from drivers import objects
from gateway.errors import GatewayError
from gateway.running.preparation import prepare
from gateway.tuning.controller import Gains
from gateway.tuning.on_machine import VirtualTimeMachine, gain_path, trial_config, tune_on_machine
from sim_drive.assembly import build_machine

SHIPPED = load_config("paper")
# Without the model's torque offsets: what the gains do is to be seen.
PAPER = parse_config(SHIPPED.text.replace("feed_forward: {enabled: true}", ""), SHIPPED.path)
TRIAL = trial_config(PAPER)
PRESENT = tuple(Gains.from_section(axis.emulation.gains) for axis in PAPER.ordered_axes)
GOALS = (8.0, 15.0)


def held_gains(machine):
    return tuple(
        Gains(*(drive.axis.entry(objects.CONTROLLER_GAINS, n).value for n in range(1, 6))) for drive in machine.drives
    )


class Bench:
    def __init__(self, config=TRIAL):
        self.machine = build_machine(config)
        self.trials = VirtualTimeMachine(prepare(config, 1), self.machine)


def test_gains_go_into_the_drives_and_out_of_them():
    bench = Bench()
    assert bench.trials.read_gains() == PRESENT
    new = (Gains(7000, 100, 0, 90_000, 90_000), Gains(4000, 150, 10, 50_000, 49_000))
    bench.trials.write_gains(new)
    assert held_gains(bench.machine) == new
    assert bench.trials.read_gains() == new


def test_a_drive_that_refuses_a_gain_leaves_the_old_ones_on_both():
    bench = Bench()
    slave = bench.machine.drives[1].axis
    entry = slave.entry(objects.CONTROLLER_GAINS, 4)
    take = entry.on_write

    def refuse(value, now_ns):
        from drivers.sdo import AbortCode

        return AbortCode.VALUE_RANGE_EXCEEDED if value == 55_555 else take(value, now_ns)

    entry.on_write = refuse
    with pytest.raises(Exception, match="0609"):
        bench.trials.write_gains((Gains(1), Gains(1, K_V=55_555)))
    assert held_gains(bench.machine) == PRESENT


def test_the_way_to_other_gains_goes_in_bounded_steps():
    path = gain_path((Gains(1000, 0, 0, 8000), Gains(100)), (Gains(2000, 90, 0, 4000), Gains(100)), 1.25)
    # A factor of 2 is ln 2 / ln 1.25 = 3.1 steps of 1.25: four of 2^(1/4).
    assert [pair[0].K_P for pair in path] == [1189, 1414, 1682, 2000]
    assert [pair[0].K_V for pair in path] == [6727, 5657, 4757, 4000]
    assert [pair[0].K_I for pair in path] == [22, 45, 68, 90]
    assert {pair[1] for pair in path} == {Gains(100)}
    with pytest.raises(GatewayError, match="must be above 1"):
        gain_path(PRESENT, PRESENT, 1.0)


@pytest.mark.slow
def test_better_gains_are_tried_step_by_step_and_stay():
    slack = (Gains(8000, 0, 0, 120_000, 120_000), Gains(4000, 0, 0, 45_000, 45_000))
    bench = Bench()
    bench.trials.write_gains(slack)
    told = []
    tuning = tune_on_machine(
        bench.trials, PRESENT, GOALS, largest_step=1.5, on_trial=lambda run, n, of: told.append((n, of))
    )
    assert not tuning.is_aborted
    assert told == [(1, 2), (2, 2)]
    before, after = tuning.trials
    assert before.gains == slack
    assert before.peak_counts[1] > 20
    assert after.peak_counts[1] <= 15
    assert after.peak_counts[0] <= 8
    assert tuning.in_force == held_gains(bench.machine) == PRESENT


def test_bad_gains_stop_the_machine_on_the_cam_and_the_old_ones_stay_in_force():
    """With gains that are laxer from step to step an error limit is met on the way; the linkage rests on the cam."""
    limit = 20
    bench = Bench(trial_config(PAPER, (60, limit)))
    bad = (PRESENT[0], Gains(3000, 0, 0, 45_000, 45_000))
    tuning = tune_on_machine(bench.trials, bad, GOALS)
    assert tuning.is_aborted
    assert tuning.trials[-1].stopped_by == "following_error"
    assert tuning.trials[-1].gains != PRESENT
    assert tuning.in_force == held_gains(bench.machine) == PRESENT
    plant = bench.machine.plant
    assert plant.torn_at_s is None
    assert not any(drive.is_powered for drive in bench.machine.drives)
    theta2, theta5 = plant.angle(0), plant.angle(1)
    on_cam = prepare(PAPER, 1).cam.profile.at(theta2)[0]
    assert abs(theta5 - on_cam) * 4096 / math.tau < limit


def test_a_machine_that_does_not_run_is_left_as_it_is():
    strict = trial_config(PAPER, (2, 2))
    bench = Bench(strict)
    with pytest.raises(
        GatewayError, match="does not run with the gains that it has, which stay: stopped by following_er"
    ):
        tune_on_machine(bench.trials, PRESENT, GOALS)
    assert held_gains(bench.machine) == PRESENT


def test_trials_are_guarded_below_the_drives_own_window_and_stop_on_the_cam():
    assert [axis.limits.gateway_error_counts for axis in TRIAL.ordered_axes] == [60, 90]
    assert [axis.limits.following_error_counts for axis in TRIAL.ordered_axes] == [200, 300]
    assert TRIAL.guard.following_error.reaction.value == "controlled_stop"
    text = PAPER.text.replace(
        "following_error_counts: 300", "following_error_counts: 300\n      guarded_error_counts: 301"
    )
    with pytest.raises(Exception, match="guarded_error_counts: 301 can never be met, the drive faults at"):
        parse_config(text, PAPER.path)
