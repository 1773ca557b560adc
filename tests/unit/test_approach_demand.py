"""The slow way onto the cam as a demand: both axes within speed, acceleration and jerk, at rest in every corner."""

import math

import numpy as np
import pytest

from config.loading import load_config
from gateway.running.assembly import build_approach
from gateway.running.preparation import compile_config

PAPER = load_config("paper")
PROFILE = compile_config(PAPER).profile
PERIOD_S = PAPER.cycle_s


def walk(approach, corners, stop_after=None):
    """Velocities of both axes, step by step, and where they are at the end, (rad)."""
    demand = approach.demand
    demand.begin(corners, [0, 0])
    velocities = [[0.0, 0.0]]
    while not demand.is_finished:
        demand.step()
        velocities.append(demand.velocities)
        if stop_after is not None and len(velocities) == stop_after:
            demand.controlled_stop()
        assert len(velocities) < 200_000
    return np.array([*velocities, [0.0, 0.0]]), demand


def assert_within_limits(velocities):
    motion = PAPER.motion
    assert np.abs(velocities).max() <= motion.approach_speed_rad_per_s * (1 + 1e-9)
    acceleration = np.diff(velocities, axis=0) / PERIOD_S
    assert np.abs(acceleration).max() <= motion.ramp_acceleration_rad_per_s2 * (1 + 1e-9)
    jerk = np.diff(acceleration, axis=0) / PERIOD_S
    assert np.abs(jerk).max() <= motion.ramp_jerk_rad_per_s3 * (1 + 1e-6)


@pytest.mark.parametrize("start_deg", [(175, -15), (90, 80), (0, 100), (181, 20), (250, 20), (30, 4.0)])
def test_the_way_keeps_the_limits_of_both_axes_and_ends_on_the_cam(start_deg):
    approach = build_approach(PAPER, PROFILE, 1)
    corners = approach.field.path(*map(math.radians, start_deg))
    velocities, demand = walk(approach, corners)
    assert_within_limits(velocities)
    ends = np.array(corners[0]) + velocities.sum(axis=0) * PERIOD_S
    assert ends == pytest.approx(corners[-1], abs=2e-3)
    # Counts from where the axes were held, 4096 a revolution.
    moved = [round((b - a) * 4096 / math.tau) for a, b in zip(corners[0], corners[-1], strict=True)]
    assert demand.targets == pytest.approx(moved, abs=1)


@pytest.mark.parametrize("stop_after", [2, 100, 300, 700])
def test_a_stop_on_the_way_keeps_them_too(stop_after):
    approach = build_approach(PAPER, PROFILE, 1)
    corners = approach.field.path(math.radians(175), math.radians(-15))
    velocities, _ = walk(approach, corners, stop_after)
    assert_within_limits(velocities)
    assert len(velocities) < stop_after + 1500
