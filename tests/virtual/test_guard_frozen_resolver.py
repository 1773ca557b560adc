"""A resolver of either axis freezes, at any instant of a run: the linkage stays whole, and how near its cam."""

import math

import pytest
from guarded_machine import CV, MOMENTS, SERVO, Guarded, moments

from gateway.cyclic.guard import Condition, StopReason
from gateway.record.sample import Phase
from sim_drive.injection.faults import Fault, FaultKind

LEAST_SINE, BOUND_RAD = 0.79, math.radians(15.0)
"""Where the demand tells: the cam's own least sine is 0.80."""
SLOW_RAD_PER_S = 0.05
"""Half a count in 15 ms: of an axis that is asked for less, only what its torque does tells."""
LEAST_SINE_AT_REST, BOUND_AT_REST_RAD = 0.79, math.radians(15.0)
"""There its torque tells, by the model."""
LEAST_SINE_UNSEEN, BOUND_UNSEEN_RAD = 0.72, math.radians(50.0)
"""Dead before its axis is enabled; the servo's load is too small to be missed."""
NOTICED = {Condition.FROZEN_ACTUAL, Condition.UNANSWERED_TORQUE}
STEP_S = 0.2
RUN_S = 4.7
GRID = [f"{n * STEP_S:.1f}" for n in range(1, round(RUN_S / STEP_S))]


@pytest.mark.parametrize("node", [CV, SERVO])
@pytest.mark.parametrize(
    "when",
    [
        when if when in {"standstill", "slow ramp down"} else pytest.param(when, marks=pytest.mark.slow)
        for when in (*MOMENTS, *GRID)
    ],
)
def test_a_resolver_that_freezes_never_tears_the_linkage(node, when):
    at_s = moments()[when].at_s if when in MOMENTS else float(when)
    run = Guarded(Fault(FaultKind.FROZEN_RESOLVER, node, at_s)).until(at_s)
    phase, demand = run.place[1], run.core.session.demand
    is_telling = phase is Phase.CAM or (
        phase in {Phase.RAMP_UP, Phase.RAMP_DOWN} and abs(demand.velocities[node - 1]) > SLOW_RAD_PER_S
    )
    run.to_end()
    assert not run.is_torn
    assert run.is_without_torque
    assert run.strain(run.bus.now_ns * 1e-9 - 0.2).rest_s == 0.0
    strain = run.strain(at_s)
    least_sine, bound_rad = (LEAST_SINE, BOUND_RAD) if is_telling else (LEAST_SINE_AT_REST, BOUND_AT_REST_RAD)
    if phase is Phase.COMMISSIONING:
        least_sine, bound_rad = LEAST_SINE_UNSEEN, BOUND_UNSEEN_RAD
    assert strain.least_sine > least_sine
    assert strain.cam_distance_rad < bound_rad
    if run.stopped_by is StopReason.COMMISSIONING:
        # The CV axis carries so much at home that it shows at once.
        assert node == CV
        assert phase is Phase.COMMISSIONING
        assert "look at its resolver" in str(run.core.failure)
        assert strain.cam_distance_rad < math.radians(2.0)
    elif run.stopped_by is StopReason.COMPLETED:
        # Within the last counts of the way, or after them, there is nothing left that could show it.
        assert not is_telling
        assert strain.cam_distance_rad < math.radians(0.5)
    else:
        assert (run.trips[0].condition, run.trips[0].axis) in {(one, ("cv", "servo")[node - 1]) for one in NOTICED}
        assert run.stopped_by is StopReason(run.trips[0].condition.value)
