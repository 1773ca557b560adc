"""A machine that was stopped away from home goes slowly onto its cam, and runs."""

import itertools
import math

import pytest
from guarded_machine import SECOND, Guarded, at_theta2
from turning_machine import CLOSURE, turning_config
from turning_machine import LINKS as DOUBLE_CRANK

from drivers.virtual_time import VirtualBus
from gateway.cyclic.guard import StopReason
from gateway.record.sample import Phase
from gateway.running.assembly import build_core


class Again:
    """A second session with the machine of a first one, whose axes have meanwhile been brought to other angles."""

    def __init__(self, first, theta2_deg=None, theta5_deg=None):
        config = first.config
        self.machine, self.samples = first.machine, []
        if theta2_deg is not None:
            self.machine.plant.set_motion((math.radians(theta2_deg), math.radians(theta5_deg)), (0.0, 0.0))
        bus = VirtualBus([self.machine], config.bus.bit_rate, start_ns=first.bus.now_ns)
        bus.run_until(first.bus.now_ns + SECOND // 2)
        self.prepared = first.prepared
        self.core = build_core(config, self.prepared.cam.profile, self.prepared.plan, self, approach_cycles=1)
        self.events = []
        self.config = config
        self.bus = VirtualBus(
            [self.core, self.machine],
            config.bus.bit_rate,
            start_ns=bus.now_ns,
            on_event=lambda _, event: self.events.append(event),
        )

    def append(self, *values):
        self.samples.append(values)

    def to_end(self):
        self.bus.run_while(lambda: not self.core.is_done, self.bus.now_ns + 30 * SECOND)
        return self

    def assert_approached_and_ran_home(self):
        assert self.core.failure is None
        assert self.core.stopped_by is StopReason.COMPLETED
        phases = [Phase(int(sample[12])) for sample in self.samples]
        assert Phase.APPROACH in phases
        assert Phase.CAM in phases
        assert self.machine.plant.torn_at_s is None
        assert math.degrees(math.remainder(self.machine.plant.angle(0), math.tau)) == pytest.approx(0.0, abs=1.5)
        # On the slow way no axis is faster than it may be: 0.5 rad/s are 0.33 counts a cycle, so one at most.
        demands = [sample[14:16] for sample, phase in zip(self.samples, phases, strict=True) if phase is Phase.APPROACH]
        steps = [abs(b - a) for one, two in itertools.pairwise(demands) for a, b in zip(one, two, strict=True)]
        assert max(steps) <= 1


@pytest.fixture(scope="module")
def stopped():
    """Stopped by its operator in the return stroke."""
    run = Guarded(cycles=2).until(at_theta2(300))
    run.core.request_stop()
    run.bus.refresh()
    return run.to_end()


def test_a_machine_that_was_stopped_goes_on_from_where_it_stands(stopped):
    again = Again(stopped).to_end()
    again.assert_approached_and_ran_home()


@pytest.mark.slow
@pytest.mark.parametrize(("theta2", "theta5"), [(175, -15), (90, 80), (0, 100), (181, 20), (330, 0), (250, 20)])
def test_from_wherever_the_linkage_was_moved_by_hand(theta2, theta5):
    first = Guarded(cycles=1).to_end()
    turns = round(math.degrees(first.machine.plant.angle(0)) / 360.0) * 360.0
    Again(first, theta2 + turns, theta5).to_end().assert_approached_and_ran_home()


@pytest.mark.slow
def test_a_stop_on_the_way_is_one_and_a_place_without_a_way_is_refused():
    first = Guarded(cycles=1).to_end()
    turns = round(math.degrees(first.machine.plant.angle(0)) / 360.0) * 360.0
    again = Again(first, 90.0 + turns, 80.0)
    again.bus.run_until(again.bus.now_ns + SECOND)
    assert again.core.loop.steering.phase is Phase.APPROACH
    again.core.request_stop()
    again.bus.refresh()
    again.to_end()
    assert again.core.stopped_by is StopReason.OPERATOR
    assert Phase.CAM not in {Phase(int(sample[12])) for sample in again.samples}
    refused = Again(again, 180.0 + turns, 3.6)
    refused.to_end()
    assert "bound 0.1" in str(refused.core.failure)
    assert not any(drive.is_powered for drive in refused.machine.drives)


def stopped_turning_machine(folder):
    run = Guarded(config=turning_config(folder), cycles=3).until(3.5)
    run.core.request_stop()
    run.bus.refresh()
    return run.to_end()


@pytest.mark.slow
def test_a_slave_that_turns_on_and_on_is_brought_back_onto_its_cam_in_any_revolution(tmp_path):
    first = stopped_turning_machine(tmp_path)
    theta2, theta5 = (math.degrees(first.machine.plant.angle(axis)) for axis in (0, 1))
    assert theta5 > 400.0
    # Moved by hand, the slave by more than a revolution.
    again = Again(first, theta2 - 100.0, theta5 + 400.0).to_end()
    again.assert_approached_and_ran_home()
    sine = abs(DOUBLE_CRANK.transmission_sines(*(again.machine.plant.angle(n) for n in (0, 1)), CLOSURE)[0])
    assert sine == pytest.approx(abs(DOUBLE_CRANK.transmission_sines(0.0, math.pi / 2, CLOSURE)[0]), abs=1e-2)


@pytest.mark.slow
@pytest.mark.parametrize(("theta2", "theta5"), [(0, 0), (120, 120), (200, 330), (60, 300), (270, 45)])
def test_a_slave_that_turns_from_wherever_it_was_moved_by_hand(theta2, theta5, tmp_path):
    first = stopped_turning_machine(tmp_path)
    Again(first, theta2 + 720.0, theta5).to_end().assert_approached_and_ran_home()
