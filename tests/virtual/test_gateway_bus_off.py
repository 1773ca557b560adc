"""The gateway's own controller goes bus-off and comes back, or does not: in every phase, for any time and reaction."""

import itertools
import math

import pytest
from guarded_machine import CV, IN_MOTION, PAPER, SERVO, Guarded, changed, moments

from config.guard_section import Reaction
from drivers.cia402 import State, state_of
from drivers.controller import ControllerChanged, ErrorState
from drivers.controller_outage import ControllerOutage
from drivers.nmt import SYNC_COB_ID
from gateway.cyclic.guard import Condition, StopReason
from gateway.record.sample import Phase, SampleFlag
from gateway.running.event_text import describe
from gateway.running.recovery import AxisRecovered

MS = 1_000_000
AT_S = {"before the first answer": 0.0005, "return stroke": 2.71}
"""Beside ``moments``, whose return stroke is at another angle."""
PHASES = (
    "before the first answer",
    "commissioning",
    "homing",
    "enabling",
    "standstill",
    "fast ramp up",
    "cam",
    "return stroke",
    "fast ramp down",
)
SPANS_S = (0.003, 0.010, 0.030, 0.060, 0.150, 0.500)
"""Shorter and longer than what the drives wait for: 40 ms for SYNC, 200 ms for the gateway's heartbeat."""
LEAST_SINE = 0.79
BOUND_CAM_RAD = math.radians(6.0)
QUICK_BOUND_RAD = math.radians(20.0)

GIVEN_UP_TEXT = "the gateway's CAN controller has been bus-off for 5 s and is not back"


def reacting(reaction):
    rule = "bus_off: {persistence_cycles: 30, reaction: "
    return changed((rule + Reaction.QUICK_STOP.value, rule + reaction.value))


def instant(phase):
    return AT_S[phase] if phase in AT_S else moments()[phase].at_s


class Outage:
    """A run whose controller is off for a span, and all frames that the drives could see."""

    def __init__(self, at_s, for_s, config=PAPER, second=()):
        self.frames = []
        self.at_ns = round(at_s * 1e9)
        self.back_ns = None if for_s is None else round((at_s + for_s) * 1e9)
        self.run = Guarded(
            config=config,
            trace=lambda at_ns, frame: self.frames.append((at_ns, frame)),
            host=lambda core: ControllerOutage(core, [(self.at_ns, self.back_ns), *second]),
        ).to_end()

    def sent_by_gateway(self, from_ns, to_ns):
        own = (0x000, SYNC_COB_ID, 0x200 + CV, 0x200 + SERVO, 0x600 + CV, 0x600 + SERVO, 0x77F)
        return [frame for at_ns, frame in self.frames if from_ns < at_ns <= to_ns and frame.cob_id in own]

    def assert_stopped_in_order(self, phase):
        run = self.run
        assert run.core.is_done
        assert run.stopped_by is StopReason.BUS_OFF
        assert not run.is_torn
        assert run.is_without_torque
        assert run.strain(run.bus.now_ns * 1e-9 - 0.2).rest_s == 0.0
        strain = run.strain(self.at_ns * 1e-9)
        assert strain.least_sine > LEAST_SINE
        assert strain.cam_distance_rad < BOUND_CAM_RAD
        assert run.trips[0].condition is Condition.BUS_OFF
        if phase in IN_MOTION:
            assert run.core.failure is None
            phases = [Phase(int(sample[12])) for sample in run.samples]
            after = set(phases[phases.index(Phase.QUICK_STOP) :])
            assert after == {Phase.QUICK_STOP, Phase.DISABLED}, "no motion is begun again"
            told = {event.axis: event for event in run.events if isinstance(event, AxisRecovered)}
            assert set(told) == {"cv", "servo"}
            assert all(event.is_ready for event in told.values())
            assert not {State.OPERATION_ENABLED, State.FAULT} & {
                state_of(axis.statusword) for axis in run.core.loop.steering.axes
            }
        else:
            assert Phase.CAM not in run.phases
            if phase != "standstill":
                assert str(run.core.failure).startswith("the gateway's CAN controller has gone bus-off; look at")


def check(phase, for_s):
    outage = Outage(instant(phase), for_s)
    outage.assert_stopped_in_order(phase)
    # A frame that was being sent when the controller went off is on the wire; nothing after it is.
    assert not outage.sent_by_gateway(outage.at_ns + MS, outage.back_ns)
    return outage


@pytest.mark.parametrize(("phase", "for_s"), [("return stroke", 0.010), ("cam", 0.5), ("commissioning", 0.15)])
def test_a_sample_of_outages(phase, for_s):
    check(phase, for_s)


@pytest.mark.slow
@pytest.mark.parametrize("for_s", SPANS_S)
@pytest.mark.parametrize("phase", PHASES)
def test_an_outage_of_any_length_in_any_phase_ends_the_run_in_order(phase, for_s):
    check(phase, for_s)


@pytest.mark.parametrize(
    ("reaction", "offset_s"),
    [
        (Reaction.QUICK_STOP, 0.0),
        (Reaction.CONTROLLED_STOP, 0.0007),
        *(
            pytest.param(reaction, n * 1e-4, marks=pytest.mark.slow)
            for reaction in (Reaction.QUICK_STOP, Reaction.CONTROLLED_STOP)
            for n in range(10)
        ),
    ],
)
def test_the_first_demand_after_the_return_is_where_the_drives_were_left(reaction, offset_s):
    """No target that the drives see is farther from the one before than the cam makes it in a cycle."""
    outage = Outage(instant("return stroke") + offset_s, 0.0107, reacting(reaction))
    assert outage.run.stopped_by is StopReason.BUS_OFF
    for node, bound in ((CV, 9), (SERVO, 15)):
        demands = [(at_ns, frame) for at_ns, frame in outage.frames if frame.cob_id == 0x200 + node]
        targets = [int.from_bytes(frame.data[2:6], "little", signed=True) for _, frame in demands]
        last = max(n for n, (at_ns, _) in enumerate(demands) if at_ns <= outage.at_ns + MS)
        assert demands[last + 1][0] > outage.back_ns
        steps = [abs(two - one) for one, two in itertools.pairwise(targets[last - 3 : last + 4])]
        # A stop on the cam goes on as it was; one that follows the master has to find it first, for which it has 20 ms.
        before = max(steps[:3]) + 1 if reaction is Reaction.CONTROLLED_STOP else bound
        assert max(steps[3:]) <= before, (node, steps)


def test_the_outage_is_told_recorded_and_counted():
    outage = Outage(instant("cam"), 0.06)
    run = outage.run
    changes = [event for event in run.events if isinstance(event, ControllerChanged)]
    assert [change.state for change in changes] == [ErrorState.OFF, ErrorState.ACTIVE]
    texts = [describe(event)[1] for event in run.events]
    assert "bus off: the gateway's own controller has left the bus, quick stop" in texts
    assert "the gateway's CAN controller is bus-off" in texts
    cycles = [int(sample[0]) for sample in run.samples]
    assert cycles == list(range(cycles[0], cycles[0] + len(cycles))), "the recording has no gap"
    lost = SampleFlag.SEND_BUFFER_FULL | SampleFlag.BUS_ERROR | SampleFlag.MISSED_RPDO_DEADLINE
    flagged = [sample for sample in run.samples if int(sample[13]) & lost == lost]
    assert 58 <= len(flagged) <= 62, "one for every cycle of the outage"


@pytest.mark.parametrize(
    "phase", ["cam", *(pytest.param(name, marks=pytest.mark.slow) for name in PHASES if name != "cam")]
)
def test_a_controller_that_stays_away_is_given_up(phase):
    outage = Outage(instant(phase), None)
    run = outage.run
    assert (run.stopped_by, str(run.core.failure)) == (StopReason.BUS_LOST, GIVEN_UP_TEXT)
    assert run.core.is_done
    assert not run.is_torn
    assert run.is_without_torque, "the drives have stopped by themselves"
    assert run.strain(outage.at_ns * 1e-9).cam_distance_rad < BOUND_CAM_RAD
    assert not outage.sent_by_gateway(outage.at_ns + MS, run.bus.now_ns)


@pytest.mark.parametrize(
    ("phase", "for_s"), [("return stroke", 0.010), pytest.param("cam", 0.006, marks=pytest.mark.slow)]
)
def test_an_axis_that_has_to_be_set_in_motion_again_is_not_taken_for_frozen(phase, for_s):
    run = Outage(instant(phase), for_s, reacting(Reaction.CONTROLLED_STOP)).run
    assert {trip.condition for trip in run.trips} == {Condition.BUS_OFF}


@pytest.mark.slow
@pytest.mark.parametrize("reaction", [Reaction.CONTROLLED_STOP, Reaction.DISABLE])
@pytest.mark.parametrize("for_s", [0.010, 0.150, None])
def test_the_table_says_what_is_done(reaction, for_s):
    run = Outage(instant("return stroke"), for_s, reacting(reaction)).run
    assert run.stopped_by is (StopReason.BUS_LOST if for_s is None else StopReason.BUS_OFF)
    assert not run.is_torn
    assert run.is_without_torque
    assert run.strain(instant("return stroke")).cam_distance_rad < QUICK_BOUND_RAD
    if for_s == 0.010 and reaction is Reaction.CONTROLLED_STOP:
        assert {Phase.CONTROLLED_STOP, Phase.QUICK_STOP} & run.phases == {Phase.CONTROLLED_STOP}


@pytest.mark.slow
@pytest.mark.parametrize("again_s", [0.005, 0.060, 0.105, 0.2])
def test_a_controller_that_goes_off_again_while_the_axes_are_recovered_still_ends_the_run(again_s):
    at_s = instant("cam")
    second_ns = round((at_s + 0.15 + again_s) * 1e9)
    run = Outage(at_s, 0.15, second=[(second_ns, second_ns + 300 * MS)]).run
    assert run.core.is_done
    assert run.stopped_by is StopReason.BUS_OFF
    assert run.is_without_torque
    assert not {Phase.RAMP_UP, Phase.CAM} & {Phase(int(s[12])) for s in run.samples if s[1] > second_ns}
