"""Feed-forward torques: by hand where the linkage weighs nothing, against finite differences where it does."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from config.conversion import (
    closure_at_home,
    controller_gains,
    drive_damping,
    nominal_parameters,
    torque_delay_s,
    torque_offset_limit,
)
from config.loading import ConfigError, load_config, parse_config
from gateway.cyclic.demand import CamDemand
from gateway.cyclic.feed_forward import FeedForward
from gateway.cyclic.torque_offsets import TorqueOffsets, build_feed_forward, build_torque_offsets, torque_lead_s
from gateway.errors import GatewayError
from gateway.running.drive_settings import axis_units
from gateway.running.operation_setup import slave_law
from gateway.running.preparation import compile_config, plan, prepare
from gateway.units import AxisUnits
from mechanism.cam_profile import CamProfile
from mechanism.dynamics import Dynamics, DynamicsParameters, LinkParameters
from mechanism.five_bar import Closure, FiveBar
from mechanism.law_proof import Pace, finish
from mechanism.motion import plan_run
from mechanism.slave_law import SlaveLaw

PAPER = load_config("paper")
NOTHING = LinkParameters(0.0, 0.0, 0.0, 0.0)
LINKAGE = FiveBar(0.15, 0.25, 0.3, 0.15, (0.0, 0.0), (0.25, 0.0))
UNITS = AxisUnits(4096, 0.0, 1.5)


def with_feed_forward(text="{enabled: true}", config=PAPER):
    kept = "\n".join(line for line in config.text.splitlines() if not line.startswith("feed_forward:"))
    return parse_config(f"{kept}\nfeed_forward: {text}\n", config.path)


@pytest.fixture(scope="module")
def cam():
    return compile_config(PAPER).profile


def swinging(depth=0.4):
    """theta5 = depth (1 - cos theta2): slope depth sin, curvature depth cos."""
    theta2 = np.arange(256) * math.tau / 256
    return CamProfile.through(theta2, depth * (1.0 - np.cos(theta2)))


def test_motors_alone_take_what_a_hand_works_out():
    motors = DynamicsParameters(
        LINKAGE, NOTHING, NOTHING, NOTHING, NOTHING, 0.0, (0.002, 0.003), (0.0, -9.80665), (0.01, 0.02), (0.04, 0.05)
    )
    model = FeedForward(motors, Closure.LEFT, swinging(), 0.1, (0.004, 0.005))
    # At theta2 = 90 deg: theta5' = 0.4, theta5'' = 0. With 5 rad/s and 7 rad/s^2: omega5 = 2, alpha5 = 2.8.
    master, slave = model.torques(math.pi / 2, 5.0, 7.0)
    assert master == pytest.approx(0.002 * 7.0 + (0.01 - 0.004) * 5.0 + 0.04, abs=1e-6)
    assert slave == pytest.approx(0.003 * 2.8 + (0.02 - 0.005) * 2.0 + 0.05, abs=1e-6)
    # At theta2 = 0: theta5' = 0, theta5'' = 0.4: the axis reverses, and dry friction has no direction there.
    _, slave = model.torques(0.0, 5.0, 7.0)
    assert slave == pytest.approx(0.003 * 0.4 * 25.0, abs=1e-5)


def test_accelerations_along_the_cam_are_those_of_the_motion_itself(cam):
    parameters = nominal_parameters(PAPER)
    closure = compile_config(PAPER).closure
    model = FeedForward(parameters, closure, cam, 0.1)
    dynamics = Dynamics(parameters, closure)
    motion = plan_run(0.3, 6.0, 1, 20.0, 200.0)
    h = 1e-4
    for t in (0.05, 0.21, 0.4, 0.9, 1.2):
        theta5 = [cam.at(motion.at(t + k * h)[0])[0] for k in (-1, 0, 1)]
        position, velocity, acceleration = motion.at(t)
        omega5, alpha5 = (theta5[2] - theta5[0]) / (2 * h), (theta5[2] - 2 * theta5[1] + theta5[0]) / h**2
        expected = dynamics.torque((position, theta5[1]), (velocity, omega5), (acceleration, alpha5), 0.1)
        assert model.torques(position, velocity, acceleration) == pytest.approx(expected, rel=2e-3, abs=2e-4)


def test_where_the_linkage_does_not_close_no_torque_is_asked_for():
    parameters = nominal_parameters(PAPER)
    apart = CamProfile.through(np.arange(64) * math.tau / 64, np.full(64, math.pi))
    short = FiveBar(0.15, 0.05, 0.05, 0.15, (0.0, 0.0), (0.25, 0.0))
    torn = DynamicsParameters(short, parameters.p, parameters.q, parameters.r, parameters.s, 0.0, (0.1, 0.1))
    assert FeedForward(torn, Closure.LEFT, apart, 0.1).torques(math.pi, 6.0, 0.0) == (0.0, 0.0)


def test_the_torque_leads_by_what_the_drive_needs_less_half_a_cycle():
    drives = [axis.emulation for axis in PAPER.ordered_axes]
    assert [drive.torque_time_constant_s for drive in drives] == [0.001, 0.001]
    # Half a servo period, those that the output waits, and 1 ms of amplifier.
    delay = (0.5 + drives[0].output_delay_periods) / 1024 + 0.001
    assert torque_delay_s(PAPER) == pytest.approx(delay)
    # A torque that is held from one cycle before its target on acts half a cycle before it.
    assert torque_lead_s(PAPER.cycle_s, torque_delay_s(PAPER)) == pytest.approx(delay - 0.0005)
    assert torque_delay_s(with_feed_forward("{torque_delay_us: 700}")) == pytest.approx(0.0007)


def test_offsets_are_those_of_the_lead_later_within_the_bound(cam):
    model = build_feed_forward(PAPER, cam)
    ahead = TorqueOffsets((UNITS, UNITS), (9.0, 9.0), 0.001, model)
    now = TorqueOffsets((UNITS, UNITS), (9.0, 9.0), 0.0, model)
    position, velocity, acceleration, plain = 5.2, 6.0, 10.0, SlaveLaw(cam)
    later = now.at(position + 0.001 * 6.0 + 0.5e-6 * 10.0, velocity + 0.01, acceleration, plain)
    assert ahead.at(position, velocity, acceleration, plain) == later
    assert later == [round(t * 1000 / 1.5) for t in model.torques(5.206005, 6.01, 10.0)]
    bounded = TorqueOffsets((UNITS, UNITS), (0.3, 0.03), 0.0, model)
    assert all(abs(offset) > bound for offset, bound in zip(later, (200, 20), strict=True))
    assert [abs(offset) for offset in bounded.at(position, velocity, acceleration, plain)] == [200, 20]


def test_a_shifted_slave_is_fed_the_torque_of_where_it_is_and_a_parked_one_none(cam):
    law = slave_law(PAPER, cam)
    finish(law.change_shift(0.2, math.tau, Pace(math.tau, 2.0, 30.0, 500.0)))
    while law.is_shifting:
        law.advance(1.0, 0.001)
    model = build_feed_forward(PAPER, cam)
    offsets = TorqueOffsets((UNITS, UNITS), (9.0, 9.0), 0.0, model)
    theta2, omega2, alpha2 = 5.3, 6.0, 10.0
    theta5, slope, curvature, _ = cam.at(theta2 + 0.2)
    alpha5 = curvature * omega2**2 + slope * alpha2
    parameters = nominal_parameters(PAPER)
    expected = Dynamics(parameters, closure_at_home(PAPER)).torque(
        (theta2, theta5), (omega2, slope * omega2), (alpha2, alpha5), PAPER.feed_forward.coulomb_velocity_rad_per_s
    )
    damping = drive_damping(PAPER, "cv") * omega2, drive_damping(PAPER, "servo") * slope * omega2
    fed = [round((torque - own) * 1000 / 1.5) for torque, own in zip(expected, damping, strict=True)]
    assert offsets.at(theta2, omega2, alpha2, law) == fed
    assert abs(fed[1] - offsets.at(theta2, omega2, alpha2, SlaveLaw(cam))[1]) > 50
    engagement = finish(law.prove_engagement(False, 1.0, 0.0, math.tau))
    law.engage(engagement, theta2)
    window = engagement.state.end - engagement.state.start
    middle = 1.0 + math.tau + window / 2.0
    law.advance(middle, 0.001)
    theta5, omega5, alpha5 = law.motion(middle, omega2, alpha2)
    half = [torque / 2.0 for torque in model.torques_of_motion(middle, theta5, omega2, omega5, alpha2, alpha5)]
    assert offsets.at(middle, omega2, alpha2, law) == [round(torque * 1000 / 1.5) for torque in half]
    law.advance(middle + window, 0.001)
    assert offsets.at(middle + window, omega2, alpha2, law) == [0, 0]


SWINGING = SlaveLaw(swinging(0.8))
FIRM = TorqueOffsets(
    (UNITS, UNITS), (4.5, 4.5), 0.001, FeedForward(nominal_parameters(PAPER), Closure.LEFT, swinging(0.8), 0.1)
)


@given(st.floats(-1e4, 1e4), st.floats(-100, 100), st.floats(-1e4, 1e4), st.floats(0, 1))
def test_no_motion_makes_an_offset_that_is_no_integer16_within_the_bound(position, velocity, acceleration, share):
    offsets = FIRM.at(position, velocity, acceleration, SWINGING, share)
    assert all(type(offset) is int and abs(offset) <= 3000 for offset in offsets)


def test_gains_become_torques_by_equation_6():
    gains = controller_gains(PAPER.axes["servo"])
    section = PAPER.axes["servo"].emulation.gains
    # One count of error is K_P / 256 units of 10 / 2048 V at 0.45 N m / V; 4096 counts are a turn.
    assert gains.proportional_Nm_per_rad == pytest.approx(section.K_P / 256 * 10 / 2048 * 0.45 * 4096 / math.tau)
    # One count a servo period is 2 pi / 4096 * 1024 rad/s.
    assert gains.damping_Nms_per_rad == pytest.approx(section.K_V / 256 * 10 / 2048 * 0.45 / (math.tau / 4))
    surplus = with_feed_forward("{axes: {servo: {drive_damping_Nms: 0.25}}}")
    assert drive_damping(surplus, "servo") == 0.25
    assert drive_damping(PAPER, "cv") == pytest.approx(
        controller_gains(PAPER.axes["cv"]).velocity_Nms_per_rad - controller_gains(PAPER.axes["cv"]).damping_Nms_per_rad
    )


def test_the_model_is_the_machine_but_for_what_is_given():
    config = with_feed_forward(
        "{enabled: true, end_effector_mass_kg: 0.02, gravity_m_s2: [0, -5],"
        " links: {q: {mass_kg: 0.05}},"
        " axes: {cv: {inertia_kgm2: 0.001, torque_limit_Nm: 1.25}, servo: {viscous_Nms: 0.007, coulomb_Nm: 0}}}"
    )
    model = nominal_parameters(config)
    assert (model.q.mass_kg, model.q.com_m, model.p.mass_kg) == (0.05, 0.125, 0.596)
    assert model.end_effector_mass_kg == 0.02
    assert model.gravity_m_s2 == (0.0, -5.0)
    assert model.rotor_inertia_kg_m2 == (0.001, 0.00012)
    assert model.viscous_N_m_s == (0.005, 0.007)
    assert model.coulomb_N_m == (0.04, 0.0)
    assert torque_offset_limit(config, "cv") == 1.25
    assert torque_offset_limit(config, "servo") == 4.5


@pytest.mark.parametrize(
    ("section", "sentence"),
    [
        ("{axes: {servo: {inertia_kgm2: -0.001}}}", "feed_forward.axes.servo.inertia_kgm2: -0.001"),
        ("{axes: {slave: {viscous_Nms: 0.1}}}", "feed_forward.axes.slave: there is no such axis"),
        ("{coulomb_velocity_rad_per_s: 0}", "feed_forward.coulomb_velocity_rad_per_s: 0"),
    ],
)
def test_a_section_that_cannot_be_is_refused(section, sentence):
    with pytest.raises(ConfigError, match=sentence):
        with_feed_forward(section)


def test_a_motion_that_needs_more_torque_than_the_bound_is_refused_before_anything_moves():
    config = with_feed_forward("{enabled: true, axes: {servo: {torque_limit_Nm: 0.5}}}")
    with pytest.raises(GatewayError, match=r"^feed_forward: axis servo needs 0\.\d+ Nm at theta2 = 3\d\d\.\d deg"):
        prepare(config, 1)


def make_demand(cam, enabled=True):
    config = with_feed_forward() if enabled else PAPER
    units = tuple(axis_units(axis) for axis in config.ordered_axes)
    offsets = build_torque_offsets(with_feed_forward(), cam, units) if enabled else None
    demand = CamDemand(cam, units, 0.001, 6.0, 30.0, offsets)
    demand.begin(plan(config, 1), (0, 0))
    return demand


def test_offsets_come_in_smoothly_and_stay_through_a_controlled_stop(cam):
    demand = make_demand(cam)
    steps, before = [], [0, 0]
    for _ in range(1500):
        demand.step()
        steps.append([abs(now - then) for now, then in zip(demand.torque_offsets, before, strict=True)])
        before = demand.torque_offsets
    assert np.max(steps[:250]) <= 4
    # Where the slave reverses, its dry friction changes sides: 100 mNm, 67 per mille, within a few cycles.
    assert np.all(np.max(steps, axis=0) <= [10, 67])
    demand.controlled_stop()
    while not demand.is_finished:
        demand.step()
        steps.append([abs(now - then) for now, then in zip(demand.torque_offsets, before, strict=True)])
        before = demand.torque_offsets
    assert np.all(np.max(steps[1500:], axis=0) <= [10, 67])
    # At rest what remains is gravity: the model at this place without any motion.
    demand.step()
    still = build_feed_forward(PAPER, cam).torques(demand.master_position, 0.0, 0.0)
    assert demand.torque_offsets == [round(torque * 1000 / 1.5) for torque in still]
    assert any(demand.torque_offsets)


def test_without_feed_forward_no_torque_is_asked_for(cam):
    demand = make_demand(cam, enabled=False)
    for _ in range(700):
        demand.step()
        assert demand.torque_offsets == [0, 0]


class Shown:
    """Stands in for torque offsets that learn, and keeps whether what it was shown was good to learn from."""

    is_learning = True
    learned = None

    def __init__(self):
        self.steady = []

    def at(self, position, velocity, acceleration, law, share):
        return [0, 0]

    def observe(self, position, velocity, errors, is_steady):
        self.steady.append(is_steady)


def test_nothing_is_learned_while_the_slave_is_moved_apart_from_the_cam(cam):
    shown = Shown()
    demand = CamDemand(cam, (UNITS, UNITS), 0.001, 6.0, 30.0, shown)
    demand.begin(plan(PAPER, 1), (0, 0))
    for _ in range(260):
        demand.observer.observe(1.0, 6.0, (0, 0), True)
        demand.step()
    # Until the offsets are wholly in force, what the axes show is not what they would show with them.
    assert shown.steady.index(True) == 250
    demand.law.shift, demand.law.is_plain = 0.01, False
    demand.observer.observe(1.0, 6.0, (0, 0), True)
    assert not shown.steady[-1]
    demand.law.shift, demand.law.is_plain = 0.0, True
    demand.observer.observe(1.0, 6.0, (0, 0), False)
    assert not shown.steady[-1]
