"""The demand's start: no target jumps, and positions wrap as INTEGER32."""

import itertools
import math

import numpy as np
import pytest

from gateway.cyclic.demand import CamDemand
from gateway.units import AxisUnits, wrap_counts
from mechanism.cam_profile import CamProfile
from mechanism.motion import plan_run

UNITS = AxisUnits(4096, 0.0, 1.5)


def make_demand(units=UNITS):
    theta2 = np.arange(64) * math.tau / 64
    profile = CamProfile.through(theta2, 0.5 * (1.0 - np.cos(theta2)))
    return CamDemand(profile, (units, units), 0.001, 6.0, 30.0)


def test_what_an_axis_is_away_from_the_start_is_taken_back_smoothly():
    demand = make_demand()
    demand.begin(plan_run(0.0, math.tau, 1, 6.0, 30.0), (4096 * 3 - 15, 12))
    previous = [4096 * 3 - 15, 12]
    for step in range(400):
        demand.step()
        assert abs(demand.targets[0] - previous[0]) <= 2
        assert abs(demand.targets[1] - previous[1]) <= 1
        previous = demand.targets
        if step == 260:
            plain = UNITS.counts(demand.master_position)
            assert demand.targets[0] == plain + 3 * 4096


@pytest.mark.parametrize(
    ("counts", "wrapped"),
    [(0, 0), (2**31 - 1, 2**31 - 1), (2**31, -(2**31)), (-(2**31) - 1, 2**31 - 1), (2**32 + 5, 5)],
)
def test_wrap(counts, wrapped):
    assert wrap_counts(counts) == wrapped


def test_an_axis_that_turns_for_ever_passes_the_range_of_its_position():
    units = AxisUnits(1 << 24, 0.0, 1.5)
    demand = make_demand(units)
    demand.begin(plan_run(0.0, 2 * math.tau, 3, 60.0, 600.0), (127 * (1 << 24), 0))
    seen = []
    for _ in range(2500):
        demand.step()
        seen.append(demand.targets[0])
    assert max(seen) > 2**31 - (1 << 22)
    assert min(seen) < -(2**31) + (1 << 22)
    steps = [wrap_counts(b - a) for a, b in itertools.pairwise(seen)]
    assert min(steps) >= 0
    assert max(steps) <= 2 * (1 << 24) * 0.001 + 2


def test_a_stop_before_the_first_step_stays_where_the_plan_begins():
    demand = make_demand()
    demand.begin(plan_run(math.tau / 4, math.tau, 1, 6.0, 30.0), (1024, UNITS.counts(0.5)))
    demand.controlled_stop()
    for _ in range(10):
        demand.step()
    assert demand.targets == [1024, UNITS.counts(0.5)]
    assert demand.is_finished
