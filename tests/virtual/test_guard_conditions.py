"""Every condition of the guard in every phase of a run: the reaction, the linkage, and how far it gets from the cam."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import pytest
from guarded_machine import CV, PAPER, SERVO, Guarded, Host, changed

from gateway.cyclic.guard import Condition, StopReason
from gateway.record.sample import Phase
from sim_drive.injection.faults import Direction, Fault, FaultKind

CONTROLLED_BOUND_RAD = math.radians(6.0)
"""How far link s may get from the cam in a controlled stop; in an undisturbed run it is 5.3 deg (60 counts)."""
QUICK_BOUND_RAD = math.radians(20.0)
LEAST_SINE = 0.7
"""A resolver that jumps by 13 deg has its drive carry the link there before anybody can know."""
PHASE_AT_S = {
    "commissioning": 0.03,
    "enabling": 0.075,
    "ramp up": 1.0,
    "cam": 2.4,
    "return stroke": 2.71,
    "ramp down": 3.3,
}
MOTION = ("ramp up", "cam", "return stroke", "ramp down")


@dataclass(frozen=True, slots=True)
class Case:
    """How a condition is brought about at an instant, and why the run is then said to end."""

    reason: StopReason
    faults: Callable[[float], tuple[Fault, ...]] = lambda at_s: ()
    replaced: tuple[tuple[str, str], ...] = ()
    away_s: float = 0.0
    late_s: float = 0.0
    wish: Condition | None = None
    is_controlled: bool = False


def both(kind, at_s, for_s=None, **more):
    return tuple(Fault(kind, node, at_s, for_s, **more) for node in (CV, SERVO))


def no_tpdo(node, at_s, for_s):
    return Fault(FaultKind.LOST_FRAMES, node, at_s, for_s, cob_id=0x180 + node, direction=Direction.SENT)


CASES = {
    Condition.FOLLOWING_ERROR: Case(
        StopReason.FOLLOWING_ERROR, lambda at_s: (Fault(FaultKind.JUMPING_RESOLVER, SERVO, at_s, counts=400),)
    ),
    Condition.CAM_WINDOW: Case(
        StopReason.CAM_WINDOW,
        lambda at_s: (Fault(FaultKind.JUMPING_RESOLVER, SERVO, at_s, counts=140),),
        (("cam_window: {limit_deg: 20", "cam_window: {limit_deg: 9"),),
    ),
    Condition.VELOCITY: Case(
        StopReason.VELOCITY,
        lambda at_s: (Fault(FaultKind.JUMPING_RESOLVER, CV, at_s, counts=40),),
        (("limit_percent: 130, persistence_cycles: 5", "limit_percent: 130, persistence_cycles: 1"),),
    ),
    Condition.TORQUE: Case(
        StopReason.TORQUE,
        lambda at_s: (Fault(FaultKind.JUMPING_RESOLVER, SERVO, at_s, counts=150),),
        (("limit_permille: 2500, persistence_cycles: 100", "limit_permille: 2500, persistence_cycles: 2"),),
        is_controlled=True,
    ),
    Condition.END_EFFECTOR_ERROR: Case(
        StopReason.END_EFFECTOR_ERROR,
        lambda at_s: (Fault(FaultKind.JUMPING_RESOLVER, SERVO, at_s, counts=-140),),
        (("limit_mm: 50, persistence_cycles: 5", "limit_mm: 20, persistence_cycles: 1"),),
    ),
    Condition.FROZEN_ACTUAL: Case(
        StopReason.FROZEN_ACTUAL, lambda at_s: (Fault(FaultKind.FROZEN_RESOLVER, SERVO, at_s),)
    ),
    Condition.MISSED_TPDO: Case(
        StopReason.MISSED_TPDO,
        lambda at_s: (no_tpdo(CV, at_s, 0.025), no_tpdo(SERVO, at_s, 0.025)),
        is_controlled=True,
    ),
    Condition.AXIS_SILENT: Case(StopReason.AXIS_SILENT, lambda at_s: (Fault(FaultKind.POWER_CYCLE, CV, at_s, 0.5),)),
    Condition.MISSED_DEADLINE: Case(StopReason.MISSED_DEADLINE, late_s=0.03, is_controlled=True),
    Condition.EMERGENCY: Case(StopReason.EMERGENCY, lambda at_s: (Fault(FaultKind.OVER_CURRENT, SERVO, at_s),)),
    Condition.EMERGENCY_WARNING: Case(
        StopReason.COMPLETED, lambda at_s: (Fault(FaultKind.ERROR_PASSIVE, SERVO, at_s, 0.1),)
    ),
    Condition.DRIVE_FAULT: Case(
        StopReason.DRIVE_FAULT,
        lambda at_s: (
            Fault(FaultKind.LOST_FRAMES, CV, at_s, cob_id=0x080 + CV, direction=Direction.SENT),
            Fault(FaultKind.OVER_TEMPERATURE, CV, at_s),
        ),
    ),
    Condition.HEARTBEAT_LOST: Case(
        StopReason.HEARTBEAT_LOST, lambda at_s: (Fault(FaultKind.MUTE_HEARTBEAT, CV, at_s),)
    ),
    Condition.BUS_OFF: Case(
        StopReason.BUS_OFF,
        lambda at_s: both(FaultKind.BUS_OFF, at_s, 0.5),
        (("missed_tpdo: {persistence_cycles: 20", "missed_tpdo: {persistence_cycles: 200"),),
    ),
    Condition.SYNC_LOST: Case(StopReason.SYNC_LOST, away_s=0.025),
    Condition.OPERATOR_STOP: Case(StopReason.OPERATOR, wish=Condition.OPERATOR_STOP, is_controlled=True),
    Condition.SIGINT: Case(StopReason.OPERATOR, wish=Condition.SIGINT, is_controlled=True),
    Condition.SIGTERM: Case(
        StopReason.OPERATOR,
        replaced=(("sigterm: {reaction: controlled_stop", "sigterm: {reaction: quick_stop"),),
        wish=Condition.SIGTERM,
    ),
}


def carry_out(condition, phase):
    case, at_s = CASES[condition], PHASE_AT_S[phase]
    run = Guarded(
        *case.faults(at_s),
        config=changed(*case.replaced) if case.replaced else PAPER,
        host=lambda core: Host(core, (at_s, at_s + case.away_s), (at_s, at_s + case.late_s)),
    )
    if case.wish is not None:
        run.until(at_s)
        run.core.request_stop(case.wish)
        run.bus.refresh()
    return run.to_end()


def check(condition, phase):
    case, at_s = CASES[condition], PHASE_AT_S[phase]
    run = carry_out(condition, phase)
    assert run.core.is_done
    assert not run.is_torn
    assert run.is_without_torque
    # Afterwards nothing moves, whatever comes back to life.
    assert run.strain(run.bus.now_ns * 1e-9 - 0.2).rest_s == 0.0
    strain = run.strain(at_s)
    if phase in MOTION or condition is not Condition.FROZEN_ACTUAL:
        # With a resolver that froze before the first motion the axis sinks unseen, as far as its load takes it.
        assert strain.least_sine > LEAST_SINE
        assert strain.cam_distance_rad < QUICK_BOUND_RAD
    if phase in MOTION:
        assert run.stopped_by is case.reason
        if case.reason is StopReason.COMPLETED:
            assert [trip.condition for trip in run.trips] == [condition]
        else:
            assert condition in {trip.condition for trip in run.trips}
        stops = {Phase.CONTROLLED_STOP, Phase.QUICK_STOP} & run.phases
        if case.is_controlled:
            assert stops == {Phase.CONTROLLED_STOP}
            if condition is not Condition.TORQUE:
                assert strain.cam_distance_rad < CONTROLLED_BOUND_RAD
        elif case.reason is not StopReason.COMPLETED:
            assert stops == {Phase.QUICK_STOP}
    elif run.stopped_by is not StopReason.COMPLETED and phase == "commissioning":
        assert Phase.CAM not in run.phases


def test_no_condition_is_left_out():
    assert set(CASES) == set(Condition)


@pytest.mark.parametrize(
    ("condition", "phase"),
    [
        (Condition.CAM_WINDOW, "return stroke"),
        (Condition.MISSED_DEADLINE, "ramp up"),
        (Condition.SYNC_LOST, "ramp down"),
    ],
)
def test_a_sample_of_conditions(condition, phase):
    check(condition, phase)


@pytest.mark.slow
@pytest.mark.parametrize("phase", PHASE_AT_S)
@pytest.mark.parametrize("condition", Condition)
def test_every_condition_in_every_phase(condition, phase):
    check(condition, phase)
