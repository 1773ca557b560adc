"""Ways onto the cam: clear of singular positions, on one closure, and none where there is none."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from config.conversion import five_bar
from config.loading import load_config
from gateway.running.preparation import compile_config
from mechanism.approach import ApproachField
from mechanism.cam_profile import CamProfile
from mechanism.errors import ApproachError
from mechanism.five_bar import Closure, FiveBar

PAPER = load_config("paper")
LINKS = five_bar(PAPER)
CAM = compile_config(PAPER).profile
FIELD = ApproachField(LINKS, Closure.LEFT, CAM, 0.1, (math.radians(-10), math.radians(110)))


def sines_along(corners, links=LINKS, closure=Closure.LEFT):
    found = []
    for start, end in itertools.pairwise(corners):
        share = np.linspace(0.0, 1.0, 2001)
        theta2 = start[0] + share * (end[0] - start[0])
        theta5 = start[1] + share * (end[1] - start[1])
        found.append(links.transmission_sines(theta2, theta5, closure)[:, 0])
    return np.concatenate(found)


@settings(max_examples=25, deadline=None)
@given(st.floats(-400.0, 400.0), st.floats(-20.0, 120.0))
def test_every_way_ends_on_the_cam_on_one_closure_and_clear_of_singular_positions(theta2_deg, theta5_deg):
    start = math.radians(theta2_deg), math.radians(theta5_deg)
    here = abs(float(LINKS.transmission_sines(*start, Closure.LEFT)[..., 0]))
    try:
        corners = FIELD.path(*start)
    except ApproachError:
        # The singular position at (180 deg, 0) is the only one within the servo's limits.
        assert here < 0.15
        return
    assert corners[0] == start
    theta2, theta5 = corners[-1]
    assert theta5 == pytest.approx(CAM.at(theta2)[0], abs=1e-12)
    sines = sines_along(corners)
    assert np.all(sines < 0.0)
    assert np.abs(sines).min() > 0.095


def test_the_servo_axis_goes_alone_where_it_can():
    corners = FIELD.path(1.0, 1.5)
    assert len(corners) == 2
    assert corners[1][0] == 1.0


def test_a_way_leads_round_a_singular_position():
    """From (175, -15) deg the straight way up passes q folded onto r; the master has to move."""
    straight = sines_along([(math.radians(175), math.radians(-15)), (math.radians(175), CAM.at(math.radians(175))[0])])
    assert np.abs(straight).min() < 0.1
    corners = FIELD.path(math.radians(175), math.radians(-15))
    assert abs(corners[-1][0] - math.radians(175)) > 0.2


@pytest.mark.parametrize(
    ("theta2_deg", "theta5_deg", "sentence"),
    [
        (180.0, 0.0, "where the transmission sine is 0.000 (bound 0.1); bring it away from there by hand"),
        (10.0, 140.0, "theta5 = 140.0 deg, beyond the servo axis' limits (-10 to 110 deg)"),
    ],
)
def test_where_there_is_no_way_it_is_said_in_a_sentence(theta2_deg, theta5_deg, sentence):
    with pytest.raises(ApproachError, match="the linkage stands at") as caught:
        FIELD.path(math.radians(theta2_deg), math.radians(theta5_deg))
    assert sentence in str(caught.value)


def test_two_islands_have_no_way_between_them():
    """Long r: the linkage closes only where A and D are far apart, which it is on two sides of a gap."""
    links = FiveBar(0.1, 0.12, 0.3, 0.1, (0.0, 0.0), (0.25, 0.0))
    theta2 = np.arange(64) * math.tau / 64
    grid = np.radians(np.arange(-180.0, 180.0, 10.0))
    sines = np.abs(links.transmission_sines(np.zeros(36), grid, Closure.LEFT)[:, 0])
    inside = grid[np.nan_to_num(sines) > 0.3]
    assert 0 < inside.size < 36
    cam = CamProfile.through(theta2, np.full(64, inside[0]), knots=64)
    field = ApproachField(links, Closure.LEFT, cam, 0.1)
    with pytest.raises(ApproachError):
        field.path(0.0, float(grid[~(np.nan_to_num(sines) > 0.1)][0]))


def test_a_cam_that_turns_on_is_refused():
    turning = CamProfile.through(np.arange(64) * math.tau / 64, np.arange(64) * math.tau / 64, net_turns=1, knots=64)
    with pytest.raises(ApproachError, match="turns on and on"):
        ApproachField(LINKS, Closure.LEFT, turning, 0.1)
