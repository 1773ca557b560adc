"""Orders to a machine in motion: override, pause, jog, phase shift, the slave off its cam and back."""

import math

import numpy as np
import pytest
from guarded_machine import PAPER, SECOND, SERVO, Guarded, at_theta2, changed
from torque_loops import machine_in_torque
from turning_machine import turning_config

from gateway.cyclic.guard import Condition, StopReason
from gateway.cyclic.operation import Order, OrderAnswered
from gateway.record.sample import Phase, SampleLayout
from sim_drive.injection.faults import Fault, FaultKind

LAYOUT = SampleLayout(PAPER.axis_names)


def samples_of(run):
    return np.frombuffer(b"".join(LAYOUT.pack(*sample) for sample in run.samples), LAYOUT.dtype)


class Operated(Guarded):
    def order(self, at_s, order, value):
        """Give an order at this instant, and wait for its answer."""
        self.until(at_s)
        answered = len(self.refusals)
        self.core.order(order, value)
        self.bus.refresh()
        self.bus.run_while(lambda: len(self.refusals) == answered, self.bus.now_ns + SECOND)
        return self

    @property
    def refusals(self):
        return [event.refusal for event in self.events if isinstance(event, OrderAnswered)]


def assert_whole_and_home(run):
    assert run.stopped_by is StopReason.COMPLETED
    assert not run.is_torn
    assert run.strain(0.5).least_sine > 0.75
    home = math.degrees(math.remainder(run.machine.plant.angle(0), math.tau))
    assert home == pytest.approx(0.0, abs=1.5)


def assert_within_the_masters_limits(run):
    """Velocity from plan to plan: differences of the demand's own velocity bound acceleration and jerk."""
    velocity = samples_of(run)["master_velocity"]
    acceleration = np.diff(velocity) / 1e-3
    assert np.abs(acceleration).max() <= PAPER.motion.ramp_acceleration_rad_per_s2 * 1.001
    jerk = np.diff(acceleration) / 1e-3
    assert np.abs(jerk).max() <= PAPER.motion.ramp_jerk_rad_per_s3 * 1.01


def test_override_pause_and_jog_are_smooth_and_the_run_ends_at_home():
    run = Operated(cycles=1)
    run.order(1.9, Order.OVERRIDE, 40.0).order(2.6, Order.OVERRIDE, 0.0)
    run.order(2.7, Order.JOG, 101.0).until(4.2)
    assert run.core.loop.steering.phase is Phase.STANDSTILL
    stood_at = run.core.loop.steering.axes[0].actual
    run.order(4.2, Order.JOG, -6.0).order(5.2, Order.JOG, 0.0).until(6.0)
    # Back at 6 rpm for a second, less the ramps: about a tenth of a revolution.
    assert 300 < stood_at - run.core.loop.steering.axes[0].actual < 420
    run.order(6.0, Order.OVERRIDE, 100.0)
    run.to_end()
    assert [refusal[:20] for refusal in run.refusals] == ["", "", "a jog at 101 rpm is ", "", "", ""]
    assert_whole_and_home(run)
    assert_within_the_masters_limits(run)
    assert run.strain(0.5).cam_distance_rad < math.radians(0.5)


def actual_derivatives(run, smooth_ticks=16):
    """Velocities and accelerations of the links themselves, (n, 2), means over some ticks of the servo."""
    angles = np.array([record.angles_rad for record in run.machine.records])
    span_s = smooth_ticks / 1024.0
    velocity = (angles[smooth_ticks:] - angles[:-smooth_ticks]) / span_s
    return velocity, (velocity[smooth_ticks:] - velocity[:-smooth_ticks]) / span_s


def assert_actual_values_within_limits(run, config):
    velocity, acceleration = actual_derivatives(run)
    samples = samples_of(run)
    torque = np.abs(samples["torque_actual"]).max(axis=0)
    for number, axis in enumerate(config.ordered_axes):
        assert np.abs(velocity[:, number]).max() <= axis.limits.velocity_rad_per_s
        assert np.abs(acceleration[:, number]).max() <= axis.limits.acceleration_rad_per_s2
        assert torque[number] < config.guard.torque.limit_permille
    moving = samples[samples["phase"] == Phase.CAM]
    assert np.abs(moving["position_demand"] - moving["position_actual"]).max() <= 3
    return velocity


def test_110_percent_runs_and_its_limits_hold_in_the_actual_values():
    run = Operated(cycles=3).order(1.9, Order.OVERRIDE, 110.0).until(2.6)
    assert samples_of(run)["master_velocity"][-1] == pytest.approx(1.1 * math.tau)
    run.to_end()
    assert run.refusals == [""]
    assert run.trips == []
    assert_whole_and_home(run)
    velocity = assert_actual_values_within_limits(run, PAPER)
    # The return stroke at 66 rpm: 3.0176 x 6.9115 rad/s, and what the mean over 16 ms leaves of it.
    assert np.abs(velocity[:, 1]).max() == pytest.approx(20.86, abs=0.35)


@pytest.mark.slow
def test_a_slow_configuration_has_room_for_more_than_three_times_its_speed():
    slow = changed(("speed_rpm: 60", "speed_rpm: 20"))
    run = Operated(config=slow, cycles=2).order(2.0, Order.OVERRIDE, 333.0).order(2.1, Order.OVERRIDE, 330.0)
    run.until(3.3)
    assert samples_of(run)["master_velocity"][-1] == pytest.approx(3.3 * math.tau / 3.0)
    run.to_end()
    assert [refusal[:24] for refusal in run.refusals] == ["333 % is too fast, at 33", ""]
    assert_whole_and_home(run)
    assert_actual_values_within_limits(run, slow)


@pytest.mark.slow
def test_a_stop_of_a_machine_that_waits_ends_the_run():
    run = Operated(cycles=1).order(1.9, Order.OVERRIDE, 0.0).until(3.5)
    run.core.request_stop()
    run.bus.refresh()
    run.to_end()
    assert run.stopped_by is StopReason.OPERATOR
    assert run.is_without_torque


@pytest.mark.slow
def test_a_phase_shift_moves_the_slave_along_its_cam_and_back():
    run = Operated(cycles=3).order(at_theta2(10), Order.PHASE_SHIFT, 5.0)
    # It takes 0.56 s, by the jerk with which the master ramps: (60 x 0.0873 / 30)^(1/3).
    run.until(at_theta2(130) + 1.0)
    theta2, theta5 = (run.machine.plant.angle(axis) for axis in (0, 1))
    shifted = run.prepared.cam.profile.at(theta2 + math.radians(5.0))[0]
    assert theta5 == pytest.approx(shifted, abs=math.radians(2.5))
    assert theta5 - run.prepared.cam.profile.at(theta2)[0] > math.radians(1.0)
    run.order(at_theta2(140) + 1.0, Order.PHASE_SHIFT, 0.0).to_end()
    assert run.refusals == ["", ""]
    assert run.core.loop.steering._demand is None
    assert_whole_and_home(run)
    assert run.trips == []


@pytest.mark.parametrize("degrees", [-6.0, pytest.param(6.0, marks=pytest.mark.slow)])
def test_a_shifted_slave_is_fed_forward_as_on_its_cam(degrees):
    """Behind soft loops it lagged by 43 counts in the return stroke, of 2 on the cam itself."""
    run = Operated(cycles=2, config=machine_in_torque()).order(at_theta2(10), Order.PHASE_SHIFT, degrees).to_end()
    assert run.refusals == [""]
    samples = samples_of(run)
    errors = np.abs(samples["position_demand"] - samples["position_actual"])[samples["phase"] == Phase.CAM]
    assert len(errors) > 1500
    assert np.all(errors.max(axis=0) <= [2, 3])


@pytest.mark.slow
def test_the_slave_leaves_its_cam_at_an_angle_and_returns_at_another():
    run = Operated(cycles=3).order(at_theta2(180), Order.DISENGAGE, 200.0)
    run.until(at_theta2(280))
    parked = run.machine.plant.angle(1)
    run.until(at_theta2(280) + 0.4)
    assert run.machine.plant.angle(1) == pytest.approx(parked, abs=math.radians(1.0))
    assert run.order(at_theta2(280) + 0.45, Order.DISENGAGE, 10.0).refusals[-1] == "the slave is off its cam already"
    run.order(at_theta2(280) + 0.5, Order.ENGAGE, 200.0).to_end()
    assert run.refusals == ["", "the slave is off its cam already", ""]
    samples = samples_of(run)
    limits = PAPER.axes["servo"].limits
    step = np.abs(np.diff(samples["position_demand"][samples["phase"] == Phase.CAM, 1])).max()
    assert step * math.tau / 4096 / 1e-3 < limits.velocity_rad_per_s
    assert run.stopped_by is StopReason.COMPLETED
    assert run.strain(at_theta2(280)).least_sine > 0.4
    assert run.trips == []


@pytest.mark.parametrize(
    ("order", "value", "sentence"),
    [
        pytest.param(
            Order.PHASE_SHIFT, 170.0, "the linkage would come to a transmission sine of", marks=pytest.mark.slow
        ),
        pytest.param(Order.OVERRIDE, -1.0, "would turn the machine back", marks=pytest.mark.slow),
        pytest.param(Order.WINDOW, 0.5, "a window of 0.5 deg is not 1 to 360 deg", marks=pytest.mark.slow),
        (
            Order.OVERRIDE,
            111.0,
            "111 % is too fast, at 110 % axis servo's acceleration is at its limit of 400 rad/s^2 where theta2 = 310",
        ),
        pytest.param(Order.ENGAGE, 0.0, "the slave is on its cam already", marks=pytest.mark.slow),
    ],
)
def test_what_would_break_something_is_refused_and_changes_nothing(order, value, sentence):
    run = Operated(cycles=1).order(at_theta2(10), order, value)
    run.until(at_theta2(60))
    assert sentence in run.refusals[0]
    assert run.core.loop.steering._demand.law.is_plain


def test_before_the_motion_every_order_is_refused():
    assert Operated().order(0.05, Order.OVERRIDE, 50.0).until(0.06).refusals == [
        "the machine is not in motion on its cam"
    ]


@pytest.mark.parametrize("is_in_torque", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "after_s", [0.07, *(pytest.param(n * 0.07, marks=pytest.mark.slow) for n in range(16) if n != 1)]
)
def test_a_resolver_that_dies_with_the_slave_off_its_cam_does_not_let_it_run_away(after_s, is_in_torque):
    """Its demand stands, and no torque offset foresees its load: it made eight revolutions, and tore the linkage."""
    at_s = at_theta2(250) + after_s
    config = machine_in_torque() if is_in_torque else PAPER
    run = Operated(Fault(FaultKind.FROZEN_RESOLVER, SERVO, at_s), cycles=3, config=config)
    run.order(at_theta2(180), Order.DISENGAGE, 200.0).until(at_s)
    parked = run.machine.plant.angle(1)
    run.to_end()
    assert [trip.condition for trip in run.trips][:1] == [Condition.UNANSWERED_TORQUE]
    assert not run.is_torn
    farthest = max(
        abs(record.angles_rad[1] - parked) for record in run.machine.records if record.at_ns >= at_s * SECOND
    )
    assert math.degrees(farthest) < (80.0 if is_in_torque else 30.0)


@pytest.mark.slow
def test_a_quick_stop_with_the_slave_off_its_cam_leaves_it_there():
    run = Operated(cycles=3).order(at_theta2(180), Order.DISENGAGE, 200.0).until(at_theta2(280) + 0.3)
    parked = run.machine.plant.angle(1)
    run.core.request_quick_stop()
    run.bus.refresh()
    run.to_end()
    # The brake of the master swings the slave, which holds its place, by 2.6 deg.
    assert run.machine.plant.angle(1) == pytest.approx(parked, abs=math.radians(4.0))
    assert run.is_without_torque
    assert not run.is_torn


def test_a_slave_that_turns_on_and_on_returns_in_the_revolution_in_which_it_was_parked(tmp_path):
    run = Operated(config=turning_config(tmp_path), cycles=4).order(1.5, Order.DISENGAGE, 30.0).until(4.6)
    parked = run.machine.plant.angle(1)
    run.order(4.8, Order.ENGAGE, 100.0)
    # The master, of whose motion no feed-forward knows, swings it by 1.4 deg.
    assert run.machine.plant.angle(1) == pytest.approx(parked, abs=math.radians(3.0))
    run.to_end()
    assert run.refusals == ["", ""]
    assert run.stopped_by is StopReason.COMPLETED
    assert run.trips == []
    master, slave = (run.machine.plant.angle(axis) for axis in (0, 1))
    # It has missed whole revolutions while it was parked, and stands at home as the master does.
    missed = (master - (slave - math.pi / 2)) / math.tau
    assert round(missed) >= 1
    assert missed == pytest.approx(round(missed), abs=0.01)
    samples = samples_of(run)
    moving = (samples["phase"] >= Phase.RAMP_UP) & (samples["phase"] <= Phase.CONTROLLED_STOP)
    steps = np.abs(np.diff(samples["position_demand"][moving, 1].astype(np.int64)))
    # No jump: 9 counts a cycle are 13.8 rad/s, on its way back behind the master at 45 rpm.
    assert steps.max() <= 12
