"""How an axis that stands would move by the model: against the equations of motion, and what is taken for no drive."""

import math
from dataclasses import replace

import pytest

from config.conversion import closure_at_home, nominal_parameters
from config.guard_section import FRICTION_SLACK
from config.loading import load_config
from gateway.cyclic.axis_channel import AxisChannel
from gateway.cyclic.free_motion import LOAD_SHARE, FreeMotion
from gateway.running.drive_settings import axis_units
from mechanism.dynamics import Dynamics

PAPER = load_config("paper")
PARAMETERS, CLOSURE = nominal_parameters(PAPER), closure_at_home(PAPER)
MODEL = Dynamics(PARAMETERS, CLOSURE)
COUNTS = 1024, 569
"""90 deg and 50 deg."""
AT_REST = 0.0, 0.0
COUNT_RAD = math.tau / 4096


def make(counts=COUNTS):
    channels = [AxisChannel(name, 1, axis_units(axis), 100) for name, axis in PAPER.axes.items()]
    for channel, count in zip(channels, counts, strict=True):
        channel.actual = count
    return channels, FreeMotion(channels, PARAMETERS, CLOSURE, 1e-3)


def needed(channels, number, acceleration):
    """Torque of an axis for this acceleration from rest, the other one held: Nm."""
    theta = tuple(channel.units.angle(channel.actual) for channel in channels)
    alpha = tuple(acceleration if axis == number else 0.0 for axis in (0, 1))
    return MODEL.torque(theta, AT_REST, alpha)[number]


def slack(number, load):
    return FRICTION_SLACK * PARAMETERS.coulomb_N_m[number] + LOAD_SHARE * abs(load)


@pytest.mark.parametrize("number", [0, 1])
@pytest.mark.parametrize("acceleration", [-400.0, -3.0, 3.0, 400.0])
def test_what_is_beyond_load_and_friction_accelerates_the_axis_as_the_equations_of_motion_say(number, acceleration):
    channels, free = make()
    load = needed(channels, number, 0.0)
    torque = needed(channels, number, acceleration) + math.copysign(slack(number, load), acceleration)
    told = free.acceleration(number, channels[number].units.permille(torque), None)
    # Within the per mille in which a torque is told.
    rounding = 0.00075 * abs(acceleration / (needed(channels, number, acceleration) - load))
    assert told * COUNT_RAD * 1e6 == pytest.approx(acceleration, abs=rounding)


@pytest.mark.parametrize("number", [0, 1])
def test_what_the_load_its_friction_or_the_offset_explains_is_no_drive(number):
    channels, free = make()
    permille = channels[number].units.permille
    load = needed(channels, number, 0.0)
    for share in (-0.99, 0.0, 0.99):
        assert free.acceleration(number, permille(load + share * slack(number, load)), None) == 0.0
    # All that the offset foresees, and a bit more, on an axis whose load at rest is another one.
    assert free.acceleration(number, 900, 880) == 0.0
    assert free.acceleration(number, 900, 0) > 0.0
    # More than the offset foresees, but less than the load: which way it would go, nobody can say.
    between = permille(load) // 2
    assert free.acceleration(number, between, permille(load)) == 0.0
    assert free.acceleration(number, between, -1000) == 0.0
    assert free.slack_permille[number] == permille(FRICTION_SLACK * PARAMETERS.coulomb_N_m[number])


def test_a_leap_of_a_resolver_moves_no_load():
    channels, free = make()
    before = free.acceleration(0, -900, None)
    channels[0].actual += 700
    assert free.acceleration(0, -900, None) != before
    channels[0].leapt = 700
    assert free.acceleration(0, -900, None) == before


def test_a_linkage_that_does_not_close_has_no_load():
    # Links p and s straight away from each other: A and D are 552 mm apart, q and r together 550.
    five_bar = replace(PARAMETERS.five_bar, servo_pivot=(0.252, 0.0))
    channels, _ = make((2048, 0))
    free = FreeMotion(channels, replace(PARAMETERS, five_bar=five_bar), CLOSURE, 1e-3)
    assert free.acceleration(0, 3000, None) == 0.0
    channels[0].actual = 1024
    assert free.acceleration(0, 3000, None) > 0.0
