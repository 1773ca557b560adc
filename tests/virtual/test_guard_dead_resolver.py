"""A resolver that dies, or leaps, where the demand says least: at rest, while enabling, in slow motion, in a stop."""

import math

import pytest
from guarded_machine import CV, SERVO, Guarded, StopReason

from gateway.cyclic.guard import Condition
from gateway.errors import CommissioningError
from sim_drive.injection.faults import Fault, FaultKind

FROZEN = (Condition.FROZEN_ACTUAL, Condition.UNANSWERED_TORQUE)


@pytest.mark.parametrize(
    ("node", "at_s", "farthest_deg"),
    [
        # Standing: a count of error, and the integrator does the rest.
        (SERVO, 0.20, 50.0),
        (CV, 0.20, 2.0),
        pytest.param(SERVO, 0.26, 50.0, marks=pytest.mark.slow, id="start of the ramp"),
        pytest.param(SERVO, 0.50, 15.0, marks=pytest.mark.slow, id="slow servo"),
        pytest.param(SERVO, 4.20, 7.0, marks=pytest.mark.slow, id="end of the ramp down"),
        pytest.param(SERVO, 4.25, 60.0, marks=pytest.mark.slow, id="last degree"),
        pytest.param(CV, 4.30, 2.0, marks=pytest.mark.slow, id="last degree of the master"),
    ],
)
def test_a_resolver_that_dies_where_nothing_moves_does_not_tear_the_linkage(node, at_s, farthest_deg):
    run = Guarded(Fault(FaultKind.FROZEN_RESOLVER, node, at_s)).to_end()
    assert run.trips[0].condition in FROZEN
    assert run.trips[0].axis == ("cv", "servo")[node - 1]
    assert run.stopped_by in {StopReason.FROZEN_ACTUAL, StopReason.UNANSWERED_TORQUE}
    assert run.is_without_torque
    assert not run.is_torn
    strain = run.strain(at_s)
    assert strain.least_sine > 0.7
    assert math.degrees(strain.cam_distance_rad) < farthest_deg


@pytest.mark.parametrize("after_s", [0.005, pytest.param(0.02, marks=pytest.mark.slow)])
def test_a_servo_resolver_that_dies_in_a_quick_stop_takes_its_torque(after_s):
    run = Guarded(Fault(FaultKind.FROZEN_RESOLVER, SERVO, 2.71 + after_s)).until(2.71)
    run.core.request_quick_stop()
    run.to_end()
    assert [trip.condition for trip in run.trips] == [Condition.FROZEN_ACTUAL]
    assert not run.is_torn
    assert math.degrees(run.strain(2.71).cam_distance_rad) < 8.0


@pytest.mark.parametrize(
    ("node", "at_s", "counts"),
    # Enabling lasts from 0.131 to 0.148 s: the CV axis is held from 0.14 s on, the servo axis to its end.
    [(SERVO, 0.138, 150), (CV, 0.138, -400), (CV, 0.142, 150), (SERVO, 0.144, -150)],
)
def test_a_resolver_that_leaps_while_its_axis_is_enabled_moves_nothing(node, at_s, counts):
    run = Guarded(Fault(FaultKind.JUMPING_RESOLVER, node, at_s, counts=counts)).to_end()
    assert isinstance(run.core.failure, CommissioningError)
    assert ("cv", "servo")[node - 1] in str(run.core.failure)
    assert run.is_without_torque
    assert math.degrees(run.strain(at_s).cam_distance_rad) < 2.0


@pytest.mark.parametrize(("node", "counts"), [(CV, 150), (SERVO, -150)])
def test_a_resolver_that_leaps_at_rest_is_too_fast_for_its_axis(node, counts):
    run = Guarded(Fault(FaultKind.JUMPING_RESOLVER, node, 0.2, counts=counts)).to_end()
    assert run.stopped_by is StopReason.VELOCITY
    assert math.degrees(run.strain(0.2).cam_distance_rad) < 5.0
