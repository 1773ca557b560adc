"""After a stop: which axis is commissioned anew, what becomes of its fault and reference, and that nothing moves."""

import itertools

import pytest
from guarded_machine import CV, PAPER, SERVO, Guarded, at_theta2, moments
from test_approach_from_anywhere import Again

from drivers.cia402 import State, state_of
from drivers.master import BootUpReceived, EmergencyReceived
from gateway.cyclic.guard import StopReason
from gateway.record.sample import Phase
from gateway.running.machine_session import StepReached
from gateway.running.recovery import AxisRecovered
from sim_drive.injection.faults import Fault, FaultKind

AT_S = at_theta2(100)
LOST_REFERENCE = "its reference is lost: bring the linkage to its home position"


def recover(*faults):
    frames = []
    run = Guarded(*faults, cycles=2, trace=lambda at_ns, frame: frames.append((at_ns * 1e-9, frame))).to_end()
    return run, [(at_s, frame) for at_s, frame in frames if at_s >= AT_S]


def outcomes(run):
    return {event.axis: event for event in run.events if isinstance(event, AxisRecovered)}


def resets_of(frames, node):
    """Rising edges of the fault reset bit in the controlwords sent to a node."""
    words = [frame.data[0] for _, frame in frames if frame.cob_id == 0x200 + node]
    return sum(1 for one, two in itertools.pairwise(words) if not one & 0x80 and two & 0x80)


def restarts_of(frames, node):
    return sum(1 for _, frame in frames if frame.cob_id == 0 and frame.data == bytes((0x82, node)))


def assert_at_rest(run):
    phases = [Phase(int(sample[12])) for sample in run.samples]
    stopped = phases.index(Phase.QUICK_STOP)
    assert not {Phase.RAMP_UP, Phase.CAM, Phase.APPROACH} & set(phases[stopped:])
    assert run.is_without_torque
    assert run.strain(run.bus.now_ns * 1e-9 - 0.2).rest_s == 0.0


def test_a_fault_is_reset_by_one_edge_and_the_run_may_begin_anew_from_there():
    run, frames = recover(Fault(FaultKind.OVER_CURRENT, SERVO, AT_S))
    told = outcomes(run)
    assert told["servo"].text == "fault reset, ready for a new run"
    assert told["cv"].text == "ready for a new run"
    assert [resets_of(frames, node) for node in (CV, SERVO)] == [0, 1]
    assert [restarts_of(frames, node) for node in (CV, SERVO)] == [0, 0]
    assert [state_of(axis.statusword) for axis in run.core.loop.steering.axes] == [State.SWITCH_ON_DISABLED] * 2
    # What happens while the axes are recovered is told once, and in its order.
    steps = [event.step for event in run.events if isinstance(event, StepReached)]
    assert steps[-3:] == ["disabling the axes", "recovering the axes", "done"]
    assert_at_rest(run)
    assert [e.code for e in run.events if isinstance(e, EmergencyReceived) and e.node_id == SERVO] == [0x2310, 0]
    Again(run).to_end().assert_approached_and_ran_home()


@pytest.mark.slow
def test_a_cause_that_goes_on_keeps_its_fault():
    run, frames = recover(Fault(FaultKind.SAFE_TORQUE_OFF, CV, AT_S))
    assert not outcomes(run)["cv"].is_ready
    assert "has a fault that cannot be reset (last EMCY FF30h)" in outcomes(run)["cv"].text
    assert resets_of(frames, CV) == 1
    assert state_of(run.core.loop.steering.axes[0].statusword) is State.FAULT
    assert_at_rest(run)


@pytest.mark.parametrize(
    ("fault", "text"),
    [
        (Fault(FaultKind.POWER_CYCLE, SERVO, AT_S, 0.7), f"commissioned anew, {LOST_REFERENCE}"),
        pytest.param(
            Fault(FaultKind.NODE_RESET, SERVO, AT_S), f"commissioned anew, {LOST_REFERENCE}", marks=pytest.mark.slow
        ),
        pytest.param(
            Fault(FaultKind.BUS_OFF, SERVO, AT_S, 0.3),
            "commissioned anew, fault reset, ready for a new run",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_the_axis_that_was_lost_is_commissioned_anew_and_that_one_alone(fault, text):
    run, frames = recover(fault)
    assert outcomes(run)["servo"].text == text
    assert outcomes(run)["cv"].text == "ready for a new run"
    assert [restarts_of(frames, node) for node in (CV, SERVO)] == [0, 1]
    assert run.core.failure is None
    told = [
        event for event in run.events if isinstance(event, (BootUpReceived, AxisRecovered)) and event.at_ns > AT_S * 1e9
    ]
    assert len(told) == len(set(told))
    assert [type(event) for event in told[-3:]] == [BootUpReceived, AxisRecovered, AxisRecovered]
    assert_at_rest(run)


@pytest.mark.parametrize(
    "after_s", [0.008, *(pytest.param(n / 1000, marks=pytest.mark.slow) for n in range(1, 31) if n != 8)]
)
def test_an_axis_that_loses_its_supply_while_it_is_recovered_is_not_called_ready(after_s):
    run, _ = recover(Fault(FaultKind.OVER_CURRENT, SERVO, AT_S))
    recovering_ns = next(e.at_ns for e in run.events if isinstance(e, StepReached) and "recovering" in e.step)
    lost_s = recovering_ns * 1e-9 + after_s
    run, _ = recover(Fault(FaultKind.OVER_CURRENT, SERVO, AT_S), Fault(FaultKind.POWER_CYCLE, SERVO, lost_s, 0.008))
    told = outcomes(run)["servo"]
    assert told.is_ready == (told.at_ns < lost_s * 1e9)
    assert told.is_ready or told.text.endswith(LOST_REFERENCE)
    assert outcomes(run)["cv"].is_ready
    assert_at_rest(run)


LOSSES = {
    FaultKind.POWER_CYCLE: (0.7, StopReason.AXIS_SILENT, f"commissioned anew, {LOST_REFERENCE}"),
    FaultKind.NODE_RESET: (None, StopReason.HEARTBEAT_LOST, f"commissioned anew, {LOST_REFERENCE}"),
    FaultKind.BUS_OFF: (0.3, StopReason.AXIS_SILENT, "commissioned anew, fault reset, ready for a new run"),
    FaultKind.OVER_CURRENT: (None, StopReason.EMERGENCY, "fault reset, ready for a new run"),
}
"""By kind: how long it lasts, why the run is then said to end, and what becomes of the axis."""


@pytest.mark.slow
@pytest.mark.parametrize("phase", ["fast ramp up", "cam", "return stroke", "fast ramp down"])
@pytest.mark.parametrize(("node", "name", "other"), [(CV, "cv", "servo"), (SERVO, "servo", "cv")])
@pytest.mark.parametrize("kind", LOSSES)
def test_either_axis_may_be_lost_in_any_phase(kind, node, name, other, phase):
    for_s, reason, text = LOSSES[kind]
    at_s = moments()[phase].at_s
    frames = []
    run = Guarded(Fault(kind, node, at_s, for_s), trace=lambda at_ns, frame: frames.append((at_ns, frame))).to_end()
    frames = [(at_ns, frame) for at_ns, frame in frames if at_ns >= at_s * 1e9]
    assert run.stopped_by is reason
    assert run.core.failure is None
    assert {axis: event.text for axis, event in outcomes(run).items()} == {name: text, other: "ready for a new run"}
    is_anew = kind is not FaultKind.OVER_CURRENT
    assert (restarts_of(frames, node), restarts_of(frames, CV + SERVO - node)) == (is_anew, 0)
    assert resets_of(frames, CV + SERVO - node) == 0
    assert resets_of(frames, node) == ("fault reset" in text)
    assert not run.is_torn
    assert_at_rest(run)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [FaultKind.POWER_CYCLE, FaultKind.NODE_RESET, FaultKind.BUS_OFF])
@pytest.mark.parametrize(("node", "name"), [(CV, "cv"), (SERVO, "servo")])
@pytest.mark.parametrize("phase", ["commissioning", "homing"])
def test_an_axis_that_is_lost_before_the_motion_ends_the_run_without_any(kind, node, name, phase):
    run = Guarded(Fault(kind, node, moments()[phase].at_s, LOSSES[kind][0])).to_end()
    assert run.stopped_by is StopReason.COMMISSIONING
    assert f"axis {name}: node {node}" in str(run.core.failure)
    assert run.phases <= {Phase.COMMISSIONING, Phase.DISABLED}
    assert run.is_without_torque


@pytest.mark.slow
def test_a_machine_that_has_lost_all_references_runs_again_from_home():
    """The supply of the whole cabinet fails: both axes are homed again, once somebody has brought the linkage home."""
    run, _ = recover(Fault(FaultKind.POWER_CYCLE, CV, AT_S, 0.7), Fault(FaultKind.POWER_CYCLE, SERVO, AT_S, 0.7))
    assert {event.text for event in outcomes(run).values()} == {f"commissioned anew, {LOST_REFERENCE}"}
    assert not any(event.is_ready for event in outcomes(run).values())
    assert_at_rest(run)
    again = Again(run, 0.0, 0.0).to_end()
    steps = [event.step for event in again.events if isinstance(event, StepReached)]
    assert {"homing axis cv", "homing axis servo"} <= set(steps)
    assert not any("homed already" in step or "approaching" in step for step in steps)
    assert (again.core.failure, again.core.stopped_by) == (None, StopReason.COMPLETED)


@pytest.mark.slow
@pytest.mark.parametrize(("node", "lost", "kept"), [(CV, "cv", "servo"), (SERVO, "servo", "cv")])
def test_an_axis_without_a_reference_is_not_homed_away_from_home(node, lost, kept):
    run, _ = recover(Fault(FaultKind.NODE_RESET, node, AT_S))
    again = Again(run).to_end()
    assert f"axis {lost} has lost its reference while axis {kept} stands" in str(again.core.failure)
    assert not any(drive.is_powered for drive in again.machine.drives)
    assert Phase.APPROACH not in {Phase(int(sample[12])) for sample in again.samples}


@pytest.mark.slow
def test_a_node_that_stays_away_is_given_up():
    run, frames = recover(Fault(FaultKind.POWER_CYCLE, CV, AT_S))
    assert outcomes(run)["cv"].text == f"node 1 has not come back within {PAPER.recovery.timeout_s:g} s"
    assert restarts_of(frames, CV) == 0
    assert "did not confirm that they are disabled" in str(run.core.failure)
