"""Ways onto the cam: clear of singular positions, on one closure, and none where there is none."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from turning_machine import CLOSURE as DOUBLE_CRANK_CLOSURE
from turning_machine import LINKS as DOUBLE_CRANK
from turning_machine import servo_angle, turning_config

from config.conversion import five_bar
from config.loading import load_config
from gateway.running.preparation import compile_config, prepare
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


def ways_from_everywhere(field, links, closure, low, high, count):
    """Seeded starts all over the reachable space: the sine there, and the least one on the way (0: refused)."""
    chance = np.random.default_rng(5)
    found = []
    for theta2, theta5 in zip(chance.uniform(0.0, math.tau, count), chance.uniform(low, high, count), strict=True):
        here = np.nan_to_num(np.abs(links.transmission_sines(theta2, theta5, closure)[..., 0]))
        try:
            corners = field.path(float(theta2), float(theta5))
        except ApproachError:
            found.append((float(here), 0.0))
            continue
        sines = sines_along(corners, links, closure)
        assert np.all(sines * int(closure) < 0.0)
        found.append((float(here), float(np.abs(sines).min())))
    return np.array(found)


def assert_bound_is_kept(found, bound=0.1):
    here, least = found.T
    # Every start from which the linkage may move at all is brought onto the cam.
    assert np.all((least > 0.0) == (here >= bound))
    # A line is looked at every quarter of a degree; what lies between is no more than this below the bound.
    assert least[least > 0.0].min() >= bound * 0.998


def test_from_everywhere_within_the_servos_limits_the_bound_is_kept():
    low, high = math.radians(-10 - 12), math.radians(110 + 12)
    found = ways_from_everywhere(FIELD, LINKS, Closure.LEFT, low, high, 1000)
    assert_bound_is_kept(found)
    assert (found[:, 1] > 0.0).mean() > 0.97


@pytest.fixture(scope="module")
def turning(tmp_path_factory):
    config = turning_config(tmp_path_factory.mktemp("turning"))
    return config, compile_config(config).profile


def test_a_slave_that_gains_turns_has_ways_onto_its_cam_from_everywhere(turning):
    _, profile = turning
    assert profile.net_turns == 1
    field = ApproachField(DOUBLE_CRANK, DOUBLE_CRANK_CLOSURE, profile, 0.1)
    found = ways_from_everywhere(field, DOUBLE_CRANK, DOUBLE_CRANK_CLOSURE, -1000.0, 1000.0, 1000)
    assert_bound_is_kept(found)
    # 4 % of its positions are barred, and none of the others is.
    assert 0.94 < (found[:, 1] > 0.0).mean() < 0.98


@pytest.mark.parametrize("turns", [-3, 0, 7])
def test_a_way_onto_a_turning_cam_ends_in_the_nearest_revolution_of_both(turning, turns):
    _, profile = turning
    field = ApproachField(DOUBLE_CRANK, DOUBLE_CRANK_CLOSURE, profile, 0.1)
    theta2 = 1.0 + turns * math.tau
    theta5 = 1.0 + 4 * math.tau
    corners = field.path(theta2, theta5)
    last2, last5 = corners[-1]
    assert math.remainder(last5 - servo_angle(last2), math.tau) == pytest.approx(0.0, abs=1e-6)
    assert max(abs(last2 - theta2), abs(last5 - theta5)) < math.pi


def test_a_slave_that_gains_turns_can_have_no_position_limits(turning, tmp_path):
    _, profile = turning
    with pytest.raises(ApproachError, match="can have no limits of its position"):
        ApproachField(DOUBLE_CRANK, DOUBLE_CRANK_CLOSURE, profile, 0.1, (0.0, 9.0))
    jerk = "jerk_rad_per_s3: 20000.0\n"
    limited = turning_config(tmp_path, ((jerk, jerk + "      position_deg: [-1000, 1000]\n"),))
    [violation] = prepare(limited, is_strict=False).violations
    assert "axes.servo.limits.position_deg: the servo axis gains 1 turn on its cam" in str(violation)
