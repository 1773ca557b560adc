"""A resolver that dies, or leaps, where the demand says least: at rest, while enabling, in slow motion, in a stop."""

import math

import pytest
from guarded_machine import CV, PAPER, SERVO, Guarded, StopReason, at_theta2
from torque_loops import machine_in_torque

from gateway.cyclic.guard import Condition
from gateway.errors import CommissioningError
from sim_drive.injection.faults import Direction, Fault, FaultKind

FROZEN = (Condition.FROZEN_ACTUAL, Condition.UNANSWERED_TORQUE)


@pytest.mark.parametrize(
    ("node", "at_s", "farthest_deg"),
    [
        # Standing: a count of error, and the integrator does the rest.
        (SERVO, 0.20, 10.0),
        (CV, 0.20, 1.0),
        pytest.param(CV, 0.15, 1.0, marks=pytest.mark.slow, id="while it takes up its load"),
        pytest.param(SERVO, 0.26, 15.0, marks=pytest.mark.slow, id="start of the ramp"),
        pytest.param(SERVO, 0.50, 7.0, marks=pytest.mark.slow, id="slow servo"),
        pytest.param(SERVO, 4.20, 7.0, marks=pytest.mark.slow, id="end of the ramp down"),
        pytest.param(SERVO, 4.25, 10.0, marks=pytest.mark.slow, id="last degree"),
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


@pytest.mark.parametrize(
    "at_s", [4.226, *(pytest.param(at_s, marks=pytest.mark.slow) for at_s in (0.206, 0.309, 0.412, 0.515, 4.1, 4.2))]
)
def test_a_servo_resolver_that_dies_in_slow_motion_is_seen_behind_a_soft_loop_too(at_s):
    """Its torque changes slowly there, and the demand says little: it was carried off until the linkage tore."""
    run = Guarded(Fault(FaultKind.FROZEN_RESOLVER, SERVO, at_s), config=machine_in_torque()).to_end()
    assert run.trips[0].condition in FROZEN
    strain = run.strain(at_s)
    assert strain.least_sine > 0.77
    assert math.degrees(strain.cam_distance_rad) < 30.0


@pytest.mark.parametrize("after_s", [0.005, pytest.param(0.02, marks=pytest.mark.slow)])
def test_a_servo_resolver_that_dies_in_a_quick_stop_takes_its_torque(after_s):
    run = Guarded(Fault(FaultKind.FROZEN_RESOLVER, SERVO, 2.71 + after_s)).until(2.71)
    run.core.request_quick_stop()
    run.to_end()
    assert [trip.condition for trip in run.trips] == [Condition.FROZEN_ACTUAL]
    assert not run.is_torn
    assert math.degrees(run.strain(2.71).cam_distance_rad) < 8.0


@pytest.mark.parametrize(
    ("at_s", "after_s", "for_s"),
    [(1.8382, 0.0477, 0.09), pytest.param(1.7257, 0.0407, 9.0, marks=pytest.mark.slow)],
)
def test_a_servo_resolver_that_dies_where_a_quick_stop_ends_takes_its_torque(at_s, after_s, for_s):
    """The master stands already, and so does the demand; the servo axis is on its way to it."""
    leap = Fault(FaultKind.JUMPING_RESOLVER, CV, at_s, 0.05, counts=200)
    run = Guarded(leap, Fault(FaultKind.FROZEN_RESOLVER, SERVO, at_s + after_s, for_s)).to_end()
    assert run.trips[-1].condition is Condition.UNANSWERED_TORQUE
    strain = run.strain(at_s)
    assert strain.least_sine > 0.79
    assert math.degrees(strain.cam_distance_rad) < 20.0


@pytest.mark.parametrize(
    ("at_s", "swapped_s", "for_s", "counts"),
    [
        (1.546, 0.0679, 0.003, 500),
        pytest.param(0.8446, 0.05, 0.03, -500, marks=pytest.mark.slow),
        pytest.param(2.719, 0.1, 0.003, -500, marks=pytest.mark.slow),
        pytest.param(2.753, 0.2971, 0.003, 250, marks=pytest.mark.slow),
    ],
)
def test_a_leap_of_a_servo_whose_drive_sees_every_other_sync_does_not_make_it_swing(at_s, swapped_s, for_s, counts):
    """Of two SYNCs swapped both come at once, every 2 ms."""
    swapped = Fault(
        FaultKind.REORDERED_FRAMES, SERVO, at_s - swapped_s, 0.43, cob_id=0x80, direction=Direction.RECEIVED
    )
    run = Guarded(swapped, Fault(FaultKind.JUMPING_RESOLVER, SERVO, at_s, for_s, counts=counts)).to_end()
    assert not run.is_torn
    strain = run.strain(at_s - swapped_s)
    assert strain.least_sine > 0.79
    assert math.degrees(strain.cam_distance_rad) < 30.0


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


@pytest.mark.parametrize("is_in_torque", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("node", "at_s", "for_s", "counts", "farthest_deg"),
    [
        # Back in the quick stop that it has led to, or not at all: up to 20 deg of the master, or 30 of the slave.
        (CV, 3.145, 0.0885, -250, 6.0),
        (CV, 1.0586, 0.003, 250, 4.0),
        (SERVO, 2.18, 0.3, -500, 9.0),
        pytest.param(CV, 3.86, 9.0, 500, 6.0, marks=pytest.mark.slow),
        pytest.param(CV, 3.98, 9.0, -100, 9.0, marks=pytest.mark.slow),
        pytest.param(CV, 1.666, 0.09, -500, 10.0, marks=pytest.mark.slow),
        pytest.param(SERVO, 1.737, 9.0, 500, 9.0, marks=pytest.mark.slow),
        pytest.param(SERVO, 2.778, 0.01, 500, 8.0, marks=pytest.mark.slow),
        pytest.param(SERVO, 2.2, 0.02, 100, 6.0, marks=pytest.mark.slow),
        pytest.param(SERVO, 3.2, 9.0, -60, 5.0, marks=pytest.mark.slow),
    ],
)
def test_a_resolver_that_leaps_in_motion_stops_the_machine_near_its_cam(
    is_in_torque, node, at_s, for_s, counts, farthest_deg
):
    fault = Fault(FaultKind.JUMPING_RESOLVER, node, at_s, for_s, counts=counts)
    run = Guarded(fault, config=machine_in_torque() if is_in_torque else PAPER).to_end()
    assert run.stopped_by in {StopReason.FOLLOWING_ERROR, StopReason.VELOCITY, StopReason.CAM_WINDOW}
    assert run.is_without_torque
    assert not run.is_torn
    strain = run.strain(at_s)
    assert strain.least_sine > 0.79
    assert math.degrees(strain.cam_distance_rad) < farthest_deg
    assert strain.rest_s < 0.2


@pytest.mark.parametrize(
    "at_s", [0.03, 0.12, 0.146, pytest.param(0.1, marks=pytest.mark.slow), pytest.param(0.14, marks=pytest.mark.slow)]
)
def test_an_axis_that_cannot_be_seen_to_carry_its_load_is_not_left_to_sink(at_s):
    """0.146 s: the CV axis has torque, and has begun to take up its load."""
    run = Guarded(Fault(FaultKind.FROZEN_RESOLVER, CV, at_s)).to_end()
    assert isinstance(run.core.failure, CommissioningError)
    assert "axis cv: holds with" in str(run.core.failure)
    assert run.is_without_torque
    assert math.degrees(run.strain(at_s).cam_distance_rad) < 2.0


def leaps_at_the_bound():
    """Of the leap limits, 23.7 counts of the CV axis and 42.4 of the servo axis: what is told, and what just is not."""
    for node, counts in ((CV, (23, -24, 25)), (SERVO, (41, 42, -43, 44))):
        for leap in counts:
            for after_s in (0.006, 0.0095, 0.0137):
                is_slow = not (node == SERVO and abs(leap) in (42, 43) and after_s == 0.006)
                yield pytest.param(node, leap, after_s, marks=pytest.mark.slow if is_slow else ())


@pytest.mark.parametrize(("node", "counts", "after_s"), list(leaps_at_the_bound()))
@pytest.mark.parametrize("is_lost", [False, True])
def test_a_small_leap_in_a_quick_stop_is_not_the_measure_of_what_comes_after_it(is_lost, node, counts, after_s):
    at_s = at_theta2(335.0)
    leap = Fault(FaultKind.JUMPING_RESOLVER, node, at_s + after_s, 9.0, counts=counts)
    if is_lost:
        run = Guarded(Fault(FaultKind.OVER_CURRENT, CV, at_s), leap, is_brakeless=True).to_end()
    else:
        run = Guarded(leap).until(at_s)
        run.core.request_quick_stop()
        run.bus.refresh()
        run.to_end()
    assert not run.is_torn
    assert math.degrees(run.strain(at_s).cam_distance_rad) < 12.0
    assert max(abs(axis.leapt) for axis in run.core.loop.steering.axes) < 60


def tpdo_lost(node, at_s):
    return Fault(FaultKind.LOST_FRAMES, node, at_s, 0.0012, cob_id=0x180 + node, direction=Direction.SENT)


@pytest.mark.parametrize("lost", ["way out", "way back"])
@pytest.mark.parametrize(
    ("node", "counts"),
    [
        (CV, 150),
        (SERVO, -200),
        pytest.param(CV, -100, marks=pytest.mark.slow),
        pytest.param(SERVO, 150, marks=pytest.mark.slow),
    ],
)
def test_a_glitch_beside_a_lost_tpdo_stops_nothing(node, counts, lost):
    at_s = 2.2
    glitch = Fault(FaultKind.JUMPING_RESOLVER, node, at_s, 0.003, counts=counts)
    run = Guarded(glitch, tpdo_lost(node, at_s + (0.0029 if lost == "way back" else -0.0001))).to_end()
    assert run.stopped_by is StopReason.COMPLETED
    assert math.degrees(run.strain(at_s).cam_distance_rad) < 3.0
    assert [axis.leapt for axis in run.core.loop.steering.axes] == [0, 0]


@pytest.mark.parametrize("lost", ["way out", "way back"])
@pytest.mark.parametrize(
    ("node", "counts"),
    [
        (CV, -150),
        (SERVO, 150),
        pytest.param(CV, 150, marks=pytest.mark.slow),
        pytest.param(SERVO, -200, marks=pytest.mark.slow),
    ],
)
def test_a_leap_beside_a_lost_tpdo_in_a_stop_takes_nothing_along(node, counts, lost):
    """The CV axis runs out without torque and brake, the servo axis stays on its cam."""
    at_s = at_theta2(335.0)
    glitch = Fault(FaultKind.JUMPING_RESOLVER, node, at_s + 0.012, 0.005, counts=counts)
    lost_at_s = at_s + (0.0169 if lost == "way back" else 0.0119)
    run = Guarded(Fault(FaultKind.OVER_CURRENT, CV, at_s), glitch, tpdo_lost(node, lost_at_s), is_brakeless=True)
    run.to_end()
    assert math.degrees(run.strain(at_s).cam_distance_rad) < 8.0


def test_many_glitches_leave_nothing_behind():
    glitches = [Fault(FaultKind.JUMPING_RESOLVER, CV, 2.0 + 0.03 * n, 0.002, counts=60) for n in range(60)]
    run = Guarded(*glitches, cycles=3).to_end()
    assert run.stopped_by is StopReason.COMPLETED
    assert not run.trips


@pytest.mark.parametrize(
    "back_s",
    [0.078, 0.079, *(pytest.param(0.05 + 0.001 * n, marks=pytest.mark.slow) for n in range(40) if n not in (28, 29))],
)
def test_a_leap_that_goes_back_as_the_stop_ends_does_not_set_the_slave_off(back_s):
    """The slave's drive is told to stop when the master has stood for 50 ms, and not with a target that jumps."""
    run = Guarded(Fault(FaultKind.JUMPING_RESOLVER, SERVO, 2.205, back_s - 0.005, counts=-100)).until(2.2)
    run.core.request_quick_stop()
    run.bus.refresh()
    run.to_end()
    assert not run.is_torn
    strain = run.strain(2.2)
    assert math.degrees(strain.cam_distance_rad) < 4.0
    assert strain.least_sine > 0.79


@pytest.mark.parametrize(
    ("kind", "at_s"),
    [
        (FaultKind.LOST_FRAMES, 1.749),
        *(
            pytest.param(kind, at_s, marks=pytest.mark.slow)
            for kind in (FaultKind.LOST_FRAMES, FaultKind.LATE_FRAMES)
            for at_s in (1.321, 1.749, 2.749, 3.214, 3.856)
            if (kind, at_s) != (FaultKind.LOST_FRAMES, 1.749)
        ),
    ],
)
def test_a_slave_whose_loop_hears_nothing_of_it_is_left_to_its_drive(kind, at_s):
    """A loop closed over the bus gives the torque that it gave last: the slave was carried off by up to 160 deg."""
    fault = {
        FaultKind.LOST_FRAMES: {"cob_id": 0x182, "direction": Direction.SENT},
        # SYNC so late that every TPDO misses its deadline.
        FaultKind.LATE_FRAMES: {"cob_id": 0x80, "direction": Direction.RECEIVED, "delay_s": 0.00046},
    }[kind]
    run = Guarded(Fault(kind, SERVO, at_s, 0.4, **fault), config=machine_in_torque()).to_end()
    assert run.stopped_by is StopReason.AXIS_SILENT
    strain = run.strain(at_s)
    assert strain.least_sine > 0.79
    assert math.degrees(strain.cam_distance_rad) < 12.0
