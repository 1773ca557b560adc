"""Sessions with feed-forward in virtual time: what is left of the following errors, at every stage of a run."""

import numpy as np
import pytest
from torque_study import PAPER, FastRun, WholeRun, configured

from config.conversion import torque_delay_s
from gateway.record.sample import Phase
from gateway.running.preparation import compile_config


@pytest.fixture(scope="module")
def exact():
    return WholeRun(configured(), 1)


def test_with_the_exact_model_a_count_is_left_on_the_cam_and_on_the_way_down(exact):
    for phase in (Phase.CAM, Phase.RAMP_DOWN):
        errors = exact.errors(phase)
        assert np.all(errors.peak <= 1)
        assert errors.rms[0, 1] < 0.5
    # The way up begins with gravity on the position controllers alone.
    assert np.all(exact.errors(Phase.RAMP_UP).peak <= [12, 2])


def test_a_controlled_stop_keeps_what_the_model_knows():
    assert np.all(WholeRun(configured(), 1, stop_at_s=2.9).errors(Phase.CONTROLLED_STOP).peak <= [1, 2])


def test_no_other_instant_of_the_torque_is_better():
    cam = compile_config(PAPER).profile
    delay_us = torque_delay_s(PAPER) * 1e6
    rms = [
        FastRun(configured(f"{{enabled: true, torque_delay_us: {delay_us + off_us}}}"), profile=cam)
        .cycles(3, speed_rpm=120.0)
        .worst(1)[1]
        for off_us in (-1500.0, 0.0, 1500.0)
    ]
    assert rms[1] < 0.6
    assert rms[0] > rms[1] + 0.1
    assert rms[2] > rms[1] + 0.1
