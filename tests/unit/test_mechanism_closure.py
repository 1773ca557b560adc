"""Closure tracking of the paper's task: the figures are those of paper.md."""

from math import degrees, tau
from pathlib import Path

import numpy as np
import pytest

from mechanism.cam import CamLimits, compile_cam
from mechanism.closure import track_closure
from mechanism.curve import DesiredCurve, load_curve_csv
from mechanism.errors import SingularError, UnreachableError
from mechanism.five_bar import Closure, Elbow, FiveBar

PAPER = FiveBar(0.15, 0.25, 0.3, 0.15, (0.0, 0.0), (0.25, 0.0))


@pytest.fixture(scope="module")
def curve() -> DesiredCurve:
    return load_curve_csv(Path(__file__).parents[2] / "config" / "desired_path.csv")


def test_paper_servo_displacement(curve: DesiredCurve) -> None:
    track = track_closure(curve, PAPER)
    assert degrees(track.theta5[0]) == pytest.approx(0.0, abs=0.01)
    assert degrees(track.theta5.min()) == pytest.approx(0.0, abs=0.01)
    assert degrees(track.theta5.max()) == pytest.approx(99.78, abs=0.01)
    assert track.structural_error.max() < 1e-6
    assert track.immobile_points == 0
    assert track.net_turns == 0
    assert track.closure is Closure.LEFT
    assert set(track.elbows.tolist()) == {int(Elbow.RIGHT)}
    track.require_mobile(PAPER)


def test_the_track_brings_the_end_effector_to_the_curve(curve: DesiredCurve) -> None:
    track = track_closure(curve, PAPER)
    reached = PAPER.end_effector(track.theta2, track.theta5, Closure.LEFT)
    assert np.abs(reached - curve.points).max() < 1e-6


def test_structural_error_is_the_distance_to_q_s_circle(curve: DesiredCurve) -> None:
    # q longer by 2 mm: the point reached is 2 mm beyond the desired one, on the line from A.
    longer = FiveBar(0.15, 0.252, 0.3, 0.15, (0.0, 0.0), (0.25, 0.0))
    track = track_closure(curve, longer)
    assert track.structural_error == pytest.approx(np.full(360, 2e-3), abs=1e-6)
    joint = longer.crank_end(track.theta2)
    along = (track.actual - joint) / 0.252
    assert np.abs(track.actual - curve.points - 2e-3 * along).max() < 1e-6


def test_immobile_points_are_counted_and_named(curve: DesiredCurve) -> None:
    short = FiveBar(0.15, 0.25, 0.2, 0.05, (0.0, 0.0), (0.25, 0.0))
    track = track_closure(curve, short)
    distance = np.hypot(track.actual[:, 0] - 0.25, track.actual[:, 1])
    beyond = np.flatnonzero((distance > 0.25) | (distance < 0.15))
    assert track.immobile == tuple(beyond.tolist())
    assert track.immobile_points == beyond.size > 0
    with pytest.raises(UnreachableError, match="cannot stretch far enough") as caught:
        track.require_mobile(short)
    assert caught.value.point_index == beyond[0]
    assert caught.value.distance_m == pytest.approx(distance[beyond[0]] - 0.25)


def test_a_link_that_turns_all_the_way_round_gains_a_turn() -> None:
    # Both motors on one axis: the whole linkage turns as one rigid triangle, link s by one turn a cycle.
    bar = FiveBar(0.2, 0.15, 0.15, 0.2, (0.0, 0.0), (0.0, 0.0))
    theta2 = np.arange(72) * (tau / 72)
    points = bar.end_effector(theta2, theta2 - 1.0, Closure.RIGHT)
    curve = DesiredCurve(theta2, points[:, 0], points[:, 1])
    track = track_closure(curve, bar)
    assert track.net_turns == 1
    # The other elbow of the dyad mirrors D in the line through C, and turns just as far.
    assert np.ptp(np.asarray(track.theta5 - theta2)) < 1e-9


def test_the_closure_that_passes_no_singular_position_is_taken(curve: DesiredCurve) -> None:
    # The other elbow's motion is shorter, but the line A to D would have to pass C: the linkage falls over.
    joint_d = [PAPER.servo_angle(float(x), float(y), Elbow.LEFT) for x, y in curve.points]
    other = np.unwrap(np.array(joint_d))
    track = track_closure(curve, PAPER)
    assert np.ptp(other) < np.ptp(track.theta5)
    joint_a = PAPER.crank_end(curve.theta2)
    line, offset = PAPER.servo_end(other) - joint_a, curve.points - joint_a
    side = line[:, 0] * offset[:, 1] - line[:, 1] * offset[:, 0]
    assert side.min() < 0.0 < side.max()


def test_a_curve_that_needs_both_closures_has_none() -> None:
    # Link s is short: D hardly leaves its pivot and cannot decide on which side of A to D the end effector lies.
    bar = FiveBar(0.05, 0.25, 0.25, 0.01, (0.0, 0.0), (0.25, 0.0))
    theta2 = np.arange(12) * (tau / 12)
    left, right = (bar.end_effector(theta2, 0.0, closure) for closure in (Closure.LEFT, Closure.RIGHT))
    points = np.where((np.arange(12) < 6)[:, np.newaxis], left, right)
    curve = DesiredCurve(theta2, points[:, 0], points[:, 1])
    track = track_closure(curve, bar)
    assert track.immobile == ()
    assert track.closure is None
    cam = compile_cam(curve, bar, CamLimits(1e9, 1e9), tau)
    with pytest.raises(SingularError, match="links q and r"):
        cam.require()
