"""A resolver of either axis freezes, at any instant of a run: the linkage stays whole, and near its cam."""

import math

import pytest
from guarded_machine import CV, SERVO, Guarded

from gateway.cyclic.guard import Condition, StopReason
from sim_drive.injection.faults import Fault, FaultKind

LEAST_SINE = 0.75
"""The cam's own least sine is 0.80."""
BOUND_RAD = math.radians(20.0)
"""That of an axis that is lost: see ``test_guard_conditions``."""
RUN_S = 4.6
STEP_S = 0.1
SAMPLE = (0.4,)
"""Instants that are not left to the slow tests: a servo axis that hardly moves."""


@pytest.mark.xfail(strict=False, reason="an axis that hardly moves sinks unseen")
@pytest.mark.parametrize("node", [CV, SERVO])
@pytest.mark.parametrize(
    "at_s",
    [
        at_s if at_s in SAMPLE else pytest.param(at_s, marks=pytest.mark.slow)
        for at_s in (round(n * STEP_S, 3) for n in range(1, round(RUN_S / STEP_S)))
    ],
)
def test_a_resolver_that_freezes(node, at_s):
    run = Guarded(Fault(FaultKind.FROZEN_RESOLVER, node, at_s)).to_end()
    assert not run.is_torn
    assert run.is_without_torque
    strain = run.strain(at_s)
    assert strain.least_sine > LEAST_SINE
    assert strain.cam_distance_rad < BOUND_RAD
    assert run.strain(run.bus.now_ns * 1e-9 - 0.2).rest_s == 0.0
    if run.stopped_by is not StopReason.COMPLETED:
        assert Condition.FROZEN_ACTUAL in {trip.condition for trip in run.trips}
