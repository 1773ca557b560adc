"""An axis is lost in motion: what the other one does keeps the linkage away from its singular positions."""

import math
from itertools import product

import pytest
from guarded_machine import CV, PAPER, SERVO, Guarded, at_theta2, changed, moments

from gateway.cyclic.guard import StopReason
from gateway.record.sample import Phase
from sim_drive.injection.faults import Fault, FaultKind

BOUND_RAD = math.radians(20.0)
"""How far from the cam the servo axis may get if the lost axis has a brake."""
BOUND_SINE = 0.75
"""The cam's own least sine is 0.80."""
SLOW_BOUND_RAD = math.radians(5.0)
"""The same where the cam is not steep: at standstill and on the ramps."""
SLOW_BOUND_SINE = 0.79
BOUND_REST_S = 0.1
IDLE = changed(
    *(
        (f"{key}: {{reaction: quick_stop}}", f"{key}: {{reaction: warn}}")
        for key in ("emergency", "drive_fault", "heartbeat_lost")
    ),
    ("persistence_cycles: 1, reaction: quick_stop", "reaction: warn"),
    ("limit_deg: 20, reaction: quick_stop", "limit_deg: 20, reaction: warn"),
    ("limit_percent: 130, persistence_cycles: 5, reaction: quick_stop", "limit_percent: 130, reaction: warn"),
    ("limit_mm: 50, persistence_cycles: 5, reaction: quick_stop", "limit_mm: 50, reaction: warn"),
    ("persistence_cycles: 5, reaction: quick_stop}\n  missed_dead", "reaction: warn}\n  missed_dead"),
    (
        "limit_permille: 2500, persistence_cycles: 100, reaction: controlled_stop",
        "limit_permille: 2500, reaction: warn",
    ),
    ("persistence_cycles: 4, reaction: disable", "persistence_cycles: 3, reaction: warn"),
    ("persistence_cycles: 20, reaction: controlled_stop", "reaction: warn"),
    ("limit_cycles: 20, reaction: quick_stop", "limit_cycles: 20, reaction: warn"),
)
"""A gateway that looks on."""
LOSSES = [
    FaultKind.OVER_CURRENT,
    FaultKind.OVER_VOLTAGE,
    FaultKind.FROZEN_RESOLVER,
    FaultKind.POWER_CYCLE,
    FaultKind.BUS_OFF,
]


def lose(kind, node, at_s, config=PAPER):
    return Guarded(Fault(kind, node, at_s), config=config, cycles=2).to_end(limit_s=at_s + 5.0)


def assert_linkage_kept(run, at_s, bound_rad=BOUND_RAD, bound_sine=BOUND_SINE):
    strain = run.strain(at_s, at_s + 1.0)
    assert not run.is_torn
    assert strain.least_sine > bound_sine
    assert strain.cam_distance_rad < bound_rad
    assert strain.rest_s < BOUND_REST_S
    assert run.is_without_torque
    assert run.stopped_by is not StopReason.COMPLETED


@pytest.mark.parametrize(
    ("kind", "node", "theta2"),
    [
        (FaultKind.OVER_CURRENT, SERVO, 5),
        pytest.param(FaultKind.FROZEN_RESOLVER, CV, 320, marks=pytest.mark.slow),
        pytest.param(FaultKind.OVER_CURRENT, CV, 330, marks=pytest.mark.slow),
        pytest.param(FaultKind.POWER_CYCLE, SERVO, 325, marks=pytest.mark.slow),
    ],
)
def test_whichever_axis_is_lost_the_other_keeps_the_linkage_together(kind, node, theta2):
    """In the return stroke, where the cam is steepest, and where a gateway that looks on tears the linkage."""
    at_s = at_theta2(theta2)
    assert_linkage_kept(lose(kind, node, at_s), at_s)


@pytest.mark.slow
@pytest.mark.parametrize("node", [CV, SERVO])
@pytest.mark.parametrize("kind", LOSSES)
@pytest.mark.parametrize("theta2", [186, 310])
def test_the_linkage_is_kept_together_whatever_is_lost_wherever(kind, node, theta2):
    at_s = at_theta2(theta2)
    assert_linkage_kept(lose(kind, node, at_s), at_s)


@pytest.mark.parametrize(
    ("kind", "node", "moment"),
    [
        pytest.param(
            kind,
            node,
            moment,
            marks=[] if (kind, node, moment) == (FaultKind.BUS_OFF, SERVO, "fast ramp up") else pytest.mark.slow,
        )
        for kind in (FaultKind.OVER_CURRENT, FaultKind.POWER_CYCLE, FaultKind.BUS_OFF)
        for node in (CV, SERVO)
        for moment in ("standstill", "slow ramp up", "fast ramp up", "fast ramp down", "slow ramp down")
    ],
)
def test_an_axis_that_is_lost_at_standstill_or_on_a_ramp(kind, node, moment):
    at_s = moments()[moment].at_s
    run = Guarded(Fault(kind, node, at_s)).to_end(limit_s=at_s + 5.0)
    assert_linkage_kept(run, at_s, SLOW_BOUND_RAD, SLOW_BOUND_SINE)
    assert (Phase.RAMP_UP in run.phases) is (moment != "standstill")


def test_a_gateway_that_looks_on_tears_the_linkage():
    """The yardstick: the servo axis is lost where the cam begins, and the CV axis goes on half a revolution."""
    at_s = at_theta2(5)
    run = lose(FaultKind.OVER_CURRENT, SERVO, at_s, IDLE)
    assert run.is_torn
    looking_on = run.strain(at_s)
    assert looking_on.least_sine < 0.1
    # What the joints bear in between: less than a third, at either shaft.
    reacting = lose(FaultKind.OVER_CURRENT, SERVO, at_s).strain(at_s)
    assert max(reacting.shaft_torques_Nm) < max(looking_on.shaft_torques_Nm) / 3.0


STOPS = {
    "controlled": ("cam, farther", 0.28, Phase.CONTROLLED_STOP),
    "quick": ("return stroke", 0.01, Phase.QUICK_STOP),
}
"""When it is called for, how much later the axis is lost, and in which phase."""


@pytest.mark.parametrize(
    ("stop", "kind", "node"),
    [
        pytest.param(
            *cell,
            marks=[]
            if cell in {("controlled", FaultKind.OVER_CURRENT, SERVO), ("quick", FaultKind.POWER_CYCLE, CV)}
            else pytest.mark.slow,
        )
        for cell in product(STOPS, (FaultKind.OVER_CURRENT, FaultKind.POWER_CYCLE), (CV, SERVO))
    ],
)
def test_an_axis_that_is_lost_in_the_middle_of_a_stop(stop, kind, node):
    """The controlled stop then becomes a quick one; the quick one goes on with the axis that is left."""
    called, after_s, phase = STOPS[stop]
    at_s = moments()[called].at_s
    run = Guarded().until(at_s)
    (run.core.request_stop if stop == "controlled" else run.core.request_quick_stop)()
    run.bus.refresh()
    lost_s = at_s + after_s
    run.until(lost_s)
    assert run.place[1] is phase
    # In the return stroke, at more than half of its speed.
    assert run.core.session.demand.velocities[1] < -10.0
    run.inject(Fault(kind, node, 0.0, 0.5 if kind is FaultKind.POWER_CYCLE else None)).to_end()
    assert run.stopped_by is StopReason.OPERATOR
    assert run.phases >= {Phase.QUICK_STOP, Phase.DISABLED}
    assert_linkage_kept(run, lost_s)


def test_the_slave_follows_a_master_that_runs_out_without_torque_and_brake():
    """The slave, which has torque, stays on the cam of a master that swings freely until that comes to rest."""
    at_s = at_theta2(32)
    run = Guarded(Fault(FaultKind.BROKEN_BRAKE, CV, 1.0), Fault(FaultKind.OVER_CURRENT, CV, at_s), cycles=2).to_end()
    strain = run.strain(at_s)
    assert not run.is_torn
    assert strain.least_sine > BOUND_SINE
    assert strain.cam_distance_rad < BOUND_RAD
    assert Phase.QUICK_STOP in run.phases
    assert run.is_without_torque
    # Far from a dead stop: it swung for more than a second.
    assert strain.rest_s > 1.0
