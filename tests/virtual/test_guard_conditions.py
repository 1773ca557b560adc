"""Every condition of the guard, of each axis, at every stage of a run: the reaction, the linkage, and its distance from
the cam."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

import pytest
from guarded_machine import (
    BEFORE_MOTION,
    CV,
    IN_MOTION,
    MOMENTS,
    PAPER,
    SERVO,
    Guarded,
    Host,
    OverTorque,
    changed,
    moments,
)

from drivers.node import Node
from gateway.cyclic.guard import OF_THE_MACHINE, Condition, StopReason
from gateway.record.sample import Phase
from gateway.running.core import GatewayCore
from sim_drive.injection.faults import Direction, Fault, FaultKind

MACHINE = 0
"""In place of a node: the condition is not one axis'."""
LEAST_SINE = 0.79
"""The cam's own least sine is 0.80."""


class Kind(Enum):
    """What the slave can do in the stop; the value: bounds of its distance from the cam in degrees, where the cam is
    steepest (the return stroke) and elsewhere."""

    CONTROLLED = (0.5, 0.5)
    """The stop is a controlled one, or the run goes on."""
    QUICK = (6.0, 1.0)
    """The master stops as fast as its drive can, the slave sees it and has torque."""
    UNTOLD = (15.0, 5.0)
    """The drives hear nothing for a while, and stop by themselves."""
    LOST = (20.0, 5.0)
    """One axis is without torque, or silent."""
    LEAPT = (10.0, 10.0)
    """A resolver has leapt, and its drive has gone after it."""


DONE, REFUSED = StopReason.COMPLETED, StopReason.COMMISSIONING


@dataclass(frozen=True, slots=True)
class Case:
    """How a condition is brought about at an instant, and what the run then does."""

    reason: StopReason
    """Why a run ends whose motion it concerns."""
    before: tuple[StopReason, StopReason, StopReason, StopReason]
    """The same, of one that is being commissioned, homes, enables, stands under guard."""
    kind: Kind
    faults: Callable[[float], tuple[Fault, ...]] = lambda at_s: ()
    replaced: tuple[tuple[str, str], ...] = ()
    host: Callable[[GatewayCore, float], Node] = lambda core, at_s: core
    wish: Condition | None = None
    at_end: StopReason | None = None
    """Why a run ends that has come to its last standstill; None: as in motion."""
    first_phase: Phase = Phase.RAMP_UP
    """Of the motion, that a run never gets to in which something is wrong before the motion."""


def tpdo_lost(node: int, at_s: float, for_s: float) -> Fault:
    return Fault(FaultKind.LOST_FRAMES, node, at_s, for_s, cob_id=0x180 + node, direction=Direction.SENT)


def jump(node: int, counts: int) -> dict[str, object]:
    return {
        "faults": lambda at_s: (Fault(FaultKind.JUMPING_RESOLVER, node, at_s, counts=counts),),
        "kind": Kind.LEAPT,
    }


def cases_of_axis(node: int) -> dict[Condition, Case]:
    """What is one axis'. A resolver that lies before its axis is homed is found right, if it is the one homed last."""
    is_cv = node == CV
    homed = REFUSED if is_cv else DONE
    return {
        Condition.FOLLOWING_ERROR: Case(
            StopReason.FOLLOWING_ERROR,
            (DONE, homed, REFUSED, StopReason.FOLLOWING_ERROR),
            **jump(node, 400),
        ),
        Condition.VELOCITY: Case(
            StopReason.VELOCITY,
            (DONE, homed, REFUSED, StopReason.VELOCITY),
            replaced=(("limit_percent: 130, persistence_cycles: 5", "limit_percent: 130, persistence_cycles: 1"),),
            **jump(node, 40 if is_cv else 70),
        ),
        Condition.TORQUE: Case(
            StopReason.TORQUE,
            (DONE, DONE, DONE, StopReason.TORQUE),
            Kind.CONTROLLED,
            host=lambda core, at_s: OverTorque(core, node, at_s, 0.03),
            replaced=(
                ("limit_permille: 2500, persistence_cycles: 100", "limit_permille: 2500, persistence_cycles: 25"),
                ("limit_permille: 250, persistence_cycles: 8", "limit_permille: 30000, persistence_cycles: 8"),
                ("feed_forward: {enabled: true}", "feed_forward: {enabled: true, load_check_ms: 0}"),
            ),
        ),
        Condition.MISSED_TPDO: Case(
            StopReason.MISSED_TPDO,
            (DONE, DONE, DONE, StopReason.MISSED_TPDO),
            Kind.CONTROLLED,
            lambda at_s: (tpdo_lost(node, at_s, 0.025),),
            (("axis_silent: {persistence_cycles: 5", "axis_silent: {persistence_cycles: 199"),),
        ),
        Condition.AXIS_SILENT: Case(
            StopReason.AXIS_SILENT,
            (REFUSED, REFUSED, StopReason.AXIS_SILENT if is_cv else REFUSED, StopReason.AXIS_SILENT),
            Kind.LOST,
            lambda at_s: (Fault(FaultKind.POWER_CYCLE, node, at_s, 0.5),),
        ),
        Condition.EMERGENCY: Case(
            StopReason.EMERGENCY,
            # A drive that is in fault when it is commissioned is reset.
            (DONE, REFUSED, StopReason.DRIVE_FAULT if is_cv else REFUSED, StopReason.EMERGENCY),
            Kind.LOST,
            lambda at_s: (Fault(FaultKind.OVER_CURRENT, node, at_s),),
        ),
        Condition.EMERGENCY_WARNING: Case(
            DONE,
            (DONE, DONE, DONE, DONE),
            Kind.CONTROLLED,
            lambda at_s: (Fault(FaultKind.ERROR_PASSIVE, node, at_s, 0.1),),
        ),
        Condition.DRIVE_FAULT: Case(
            StopReason.DRIVE_FAULT,
            (DONE, REFUSED, StopReason.DRIVE_FAULT if is_cv else REFUSED, StopReason.DRIVE_FAULT),
            Kind.LOST,
            lambda at_s: (
                Fault(FaultKind.LOST_FRAMES, node, at_s, cob_id=0x080 + node, direction=Direction.SENT),
                Fault(FaultKind.OVER_TEMPERATURE, node, at_s),
            ),
        ),
        Condition.HEARTBEAT_LOST: Case(
            StopReason.HEARTBEAT_LOST,
            # Missed only 200 ms later: the motion may have begun, or the run be over.
            (REFUSED, StopReason.HEARTBEAT_LOST, StopReason.HEARTBEAT_LOST, StopReason.HEARTBEAT_LOST),
            Kind.QUICK,
            lambda at_s: (Fault(FaultKind.MUTE_HEARTBEAT, node, at_s),),
            at_end=DONE,
            first_phase=Phase.CAM,
        ),
    }


CASES: dict[tuple[Condition, int], Case] = {
    **{(condition, node): case for node in (CV, SERVO) for condition, case in cases_of_axis(node).items()},
    # Cam and end effector are watched in motion alone; at rest a leap is too fast.
    (Condition.CAM_WINDOW, MACHINE): Case(
        StopReason.CAM_WINDOW,
        (DONE, DONE, REFUSED, StopReason.VELOCITY),
        replaced=(("cam_window: {limit_deg: 20", "cam_window: {limit_deg: 9"),),
        at_end=StopReason.VELOCITY,
        **jump(SERVO, 140),
    ),
    (Condition.END_EFFECTOR_ERROR, MACHINE): Case(
        StopReason.END_EFFECTOR_ERROR,
        (DONE, DONE, REFUSED, StopReason.VELOCITY),
        replaced=(("limit_mm: 50, persistence_cycles: 5", "limit_mm: 20, persistence_cycles: 1"),),
        at_end=StopReason.VELOCITY,
        **jump(SERVO, -140),
    ),
    (Condition.MISSED_DEADLINE, MACHINE): Case(
        StopReason.MISSED_DEADLINE,
        (DONE, StopReason.MISSED_DEADLINE, StopReason.MISSED_DEADLINE, StopReason.MISSED_DEADLINE),
        Kind.CONTROLLED,
        host=lambda core, at_s: Host(core, late=(at_s, at_s + 0.03)),
    ),
    (Condition.BUS_OFF, MACHINE): Case(
        StopReason.BUS_OFF,
        (REFUSED, REFUSED, REFUSED, StopReason.BUS_OFF),
        Kind.UNTOLD,
        lambda at_s: tuple(Fault(FaultKind.BUS_OFF, node, at_s, 0.5) for node in (CV, SERVO)),
        (("missed_tpdo: {persistence_cycles: 20", "missed_tpdo: {persistence_cycles: 199"),),
    ),
    (Condition.SYNC_LOST, MACHINE): Case(
        StopReason.SYNC_LOST,
        (DONE, DONE, DONE, StopReason.SYNC_LOST),
        Kind.UNTOLD,
        host=lambda core, at_s: Host(core, away=(at_s, at_s + 0.025)),
    ),
    **{
        (wish, MACHINE): Case(StopReason.OPERATOR, (StopReason.OPERATOR,) * 4, Kind.CONTROLLED, wish=wish, at_end=DONE)
        for wish in (Condition.OPERATOR_STOP, Condition.SIGINT)
    },
    (Condition.SIGTERM, MACHINE): Case(
        StopReason.OPERATOR,
        (StopReason.OPERATOR,) * 4,
        Kind.QUICK,
        replaced=(("sigterm: {reaction: controlled_stop", "sigterm: {reaction: quick_stop"),),
        wish=Condition.SIGTERM,
        at_end=DONE,
    ),
}
AXIS_NAMES = {MACHINE: "", CV: "cv", SERVO: "servo"}


def carry_out(case: Case, moment: str) -> Guarded:
    """The run to its end; at the instant it is where the moment's name says."""
    instant = moments()[moment]
    at_s = instant.at_s
    run = Guarded(
        *case.faults(at_s),
        config=changed(*case.replaced) if case.replaced else PAPER,
        host=lambda core: case.host(core, at_s),
    ).until(at_s)
    assert run.place == (instant.step, instant.phase)
    if case.wish is not None:
        run.core.request_stop(case.wish)
        run.bus.refresh()
    return run.to_end()


def expected_reason(case: Case, moment: str) -> StopReason:
    if moment in BEFORE_MOTION:
        return case.before[BEFORE_MOTION.index(moment)]
    return case.at_end if moment == "end" and case.at_end is not None else case.reason


def assert_stops(case: Case, moment: str, run: Guarded, reason: StopReason) -> None:
    """Which stop it was, and that nothing moved that had not to."""
    stops = {Phase.CONTROLLED_STOP, Phase.QUICK_STOP} & run.phases
    if moment in IN_MOTION and reason is not DONE:
        assert stops == {Phase.CONTROLLED_STOP if case.kind is Kind.CONTROLLED else Phase.QUICK_STOP}
    elif moment in BEFORE_MOTION and reason is not DONE:
        assert case.first_phase not in run.phases, "it was set in motion"
    else:
        assert {Phase.RAMP_UP, Phase.CAM, Phase.RAMP_DOWN} <= run.phases, "it did not go on to its end"
        assert Phase.CONTROLLED_STOP not in stops


def assert_linkage(case: Case, moment: str, run: Guarded) -> None:
    """How far it got from the cam, and from a singular position."""
    strain = run.strain(moments()[moment].at_s)
    bound_deg = case.kind.value[0 if moment == "return stroke" else 1]
    assert math.degrees(strain.cam_distance_rad) < bound_deg
    assert strain.least_sine > LEAST_SINE
    if case.kind is Kind.CONTROLLED and Phase.CONTROLLED_STOP in run.phases:
        assert_demand_is_gentle(run)


def assert_demand_is_gentle(run: Guarded) -> tuple[float, float]:
    acceleration, jerk = run.master_peaks(Phase.CONTROLLED_STOP)
    assert acceleration < 1.001 * PAPER.motion.ramp_acceleration_rad_per_s2
    assert jerk < 1.001 * PAPER.motion.ramp_jerk_rad_per_s3
    return acceleration, jerk


def check(condition: Condition, node: int, moment: str) -> None:
    case = CASES[condition, node]
    run = carry_out(case, moment)
    assert run.core.is_done
    assert not run.is_torn
    assert run.is_without_torque
    # Afterwards nothing moves, whatever comes back to life.
    assert run.strain(run.bus.now_ns * 1e-9 - 0.2).rest_s == 0.0
    reason = expected_reason(case, moment)
    assert run.stopped_by is reason
    trips = [(trip.condition, trip.axis) for trip in run.trips]
    if moment in IN_MOTION or reason is case.reason is not DONE:
        assert (condition, AXIS_NAMES[node]) in trips or (reason is StopReason.OPERATOR and moment in BEFORE_MOTION)
    assert_stops(case, moment, run, reason)
    assert_linkage(case, moment, run)


def test_no_condition_is_left_out():
    nodes = {condition: {node for other, node in CASES if other is condition} for condition in Condition}
    # Which of the two it is that notices a dead resolver is a matter of the instant: test_guard_frozen_resolver.
    dead = {Condition.FROZEN_ACTUAL, Condition.UNANSWERED_TORQUE}
    assert dead.isdisjoint(condition for condition, _ in CASES)
    nodes |= {condition: {CV, SERVO} for condition in dead}
    assert nodes == {condition: {MACHINE} if condition in OF_THE_MACHINE else {CV, SERVO} for condition in Condition}
    assert tuple(moments()) == MOMENTS


SAMPLE = {
    (Condition.CAM_WINDOW, MACHINE, "return stroke"),
    (Condition.MISSED_DEADLINE, MACHINE, "homing"),
    (Condition.SYNC_LOST, MACHINE, "fast ramp down"),
    (Condition.EMERGENCY, SERVO, "standstill"),
    (Condition.FOLLOWING_ERROR, SERVO, "enabling"),
    (Condition.DRIVE_FAULT, CV, "end"),
}
"""What is not left to the slow tests."""


@pytest.mark.parametrize(
    ("condition", "node", "moment"),
    [
        pytest.param(
            *cell,
            marks=[] if cell in SAMPLE else pytest.mark.slow,
            id="-".join((cell[0].value, AXIS_NAMES[cell[1]] or "machine", cell[2])),
        )
        for cell in ((*key, moment) for key in CASES for moment in MOMENTS)
    ],
)
def test_every_condition_of_each_axis_at_every_stage(condition, node, moment):
    check(condition, node, moment)


@pytest.mark.parametrize(
    "moment", ["return stroke", *(pytest.param(name, marks=pytest.mark.slow) for name in ("cam", "cam, farther"))]
)
def test_a_controlled_stop_from_full_speed_is_as_fast_as_its_limits_and_no_faster(moment):
    case = CASES[Condition.OPERATOR_STOP, MACHINE]
    run = carry_out(case, moment)
    assert_linkage(case, moment, run)
    limits = PAPER.motion.ramp_acceleration_rad_per_s2, PAPER.motion.ramp_jerk_rad_per_s3
    assert assert_demand_is_gentle(run) == pytest.approx(limits, rel=1e-3)
