"""Kinematics by hand-worked positions: 7-24-25 and 3-4-5 triangles at theta2 = theta5 = 0 of the paper's linkage."""

from math import atan2, isnan, nan, radians

import numpy as np
import pytest

from mechanism.errors import ParameterError, UnreachableError
from mechanism.five_bar import Closure, Elbow, FiveBar, intersect

PAPER = FiveBar(0.15, 0.25, 0.3, 0.15, (0.0, 0.0), (0.25, 0.0))


def test_forward_at_the_reference_position() -> None:
    theta3, theta4, (x, y) = PAPER.forward(0.0, 0.0, Closure.LEFT)
    assert (x, y) == pytest.approx((0.220, 0.240), abs=1e-15)
    assert theta3 == pytest.approx(atan2(24, 7), abs=1e-14)
    assert theta4 == pytest.approx(atan2(4, -3), abs=1e-14)


def test_forward_of_the_other_closure_is_the_mirror_image() -> None:
    _, _, (x, y) = PAPER.forward(0.0, 0.0, Closure.RIGHT)
    assert (x, y) == pytest.approx((0.220, -0.240), abs=1e-15)


def test_transmission_sines_at_the_reference_position() -> None:
    # sin(theta3 - theta4) = sin3 cos4 - cos3 sin4 = (24/25)(-3/5) - (7/25)(4/5); sin(theta4 - 0) = 4/5
    sines = PAPER.transmission_sines(0.0, 0.0, Closure.LEFT)
    assert sines == pytest.approx([-0.8, 0.8], abs=1e-14)


def test_servo_angle_of_both_elbows() -> None:
    assert PAPER.servo_angle(0.220, 0.240, Elbow.RIGHT) == pytest.approx(0.0, abs=1e-14)
    other = PAPER.servo_angle(0.220, 0.240, Elbow.LEFT)
    # D mirrored in the line from the servo pivot to C, whose bearing is atan2(240, -30) = 97.125 deg: 194.25 - 360.
    assert other == pytest.approx(radians(-165.74996730219638), abs=1e-12)


def test_servo_angle_out_of_reach_is_nan_and_reach_says_by_how_much() -> None:
    assert isnan(PAPER.servo_angle(0.25, 0.5, Elbow.LEFT))
    assert PAPER.servo_reach(0.25, 0.5) == pytest.approx(0.05)
    assert PAPER.servo_reach(0.25, 0.1) == pytest.approx(-0.05)
    assert PAPER.servo_reach(0.22, 0.24) == 0.0


@pytest.mark.parametrize(
    ("b", "gap"), [((10.0, 0.0), 5.0), ((0.5, 0.0), -0.5), ((0.0, 0.0), -1.0)], ids=["apart", "inside", "concentric"]
)
def test_intersect_says_by_how_much_the_circles_miss(b: tuple[float, float], gap: float) -> None:
    x, y, measured = intersect(0.0, 0.0, 2.0, *b, 3.0, 1)
    assert isnan(x)
    assert isnan(y)
    assert measured == pytest.approx(gap)


def test_equal_circles_about_one_centre_have_no_single_intersection() -> None:
    x, _, gap = intersect(0.0, 0.0, 2.0, 0.0, 0.0, 2.0, 1)
    assert isnan(x)
    assert gap != 0.0


def test_forward_out_of_reach_raises_with_the_distance() -> None:
    far = FiveBar(0.1, 0.1, 0.1, 0.1, (0.0, 0.0), (1.0, 0.0))
    with pytest.raises(UnreachableError, match=r"theta2 = 180\.00 deg is out of reach by 1000\.000 mm") as caught:
        far.forward(radians(180.0), 0.0, Closure.LEFT)
    assert caught.value.distance_m == pytest.approx(1.0)


def test_end_effector_is_vectorised_and_broadcasts() -> None:
    points = PAPER.end_effector(np.zeros((2, 3)), 0.0, Closure.LEFT)
    assert points.shape == (2, 3, 2)
    assert points[1, 2] == pytest.approx([0.22, 0.24])


def test_jacobian_is_the_finite_difference_of_the_end_effector() -> None:
    step = 1e-6
    for theta2, theta5 in ((0.0, 0.0), (1.0, 0.7), (4.0, 1.3)):
        jacobian = PAPER.jacobian(theta2, theta5, Closure.LEFT)
        by2 = PAPER.end_effector([theta2 + step, theta2 - step], theta5, Closure.LEFT)
        by5 = PAPER.end_effector(theta2, [theta5 + step, theta5 - step], Closure.LEFT)
        assert jacobian[:, 0] == pytest.approx((by2[0] - by2[1]) / (2 * step), abs=1e-8)
        assert jacobian[:, 1] == pytest.approx((by5[0] - by5[1]) / (2 * step), abs=1e-8)


def test_closure_at_finds_the_way_it_is_assembled() -> None:
    assert PAPER.closure_at(0.0, 0.0, 0.22, 0.24) is Closure.LEFT
    assert PAPER.closure_at(0.0, 0.0, 0.22, -0.24) is Closure.RIGHT


@pytest.mark.parametrize("length", [0.0, -0.1, nan, float("inf")])
def test_impossible_lengths_are_refused(length: float) -> None:
    with pytest.raises(ParameterError, match="link length q"):
        FiveBar(0.15, length, 0.3, 0.15, (0.0, 0.0), (0.25, 0.0))


def test_paper_table_ii_points_are_on_q_s_circle_within_rounding() -> None:
    # Table II: desired end effector (mm) at CV input; paper.md: 249.5 to 249.8 mm from the crank's end.
    for angle, x, y in ((217.0, -46.0, 148.0), (102.0, 186.0, 270.0), (4.0, 230.0, 247.0)):
        joint = PAPER.crank_end(radians(angle)) * 1e3
        assert 249.4 < np.hypot(x - joint[0], y - joint[1]) < 249.9
