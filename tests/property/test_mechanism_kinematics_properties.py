"""Kinematic identities over random linkages."""

from math import cos, hypot, isnan, pi, sin

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from mechanism.closure import track_closure
from mechanism.curve import DesiredCurve
from mechanism.errors import UnreachableError
from mechanism.five_bar import Closure, Elbow, FiveBar

lengths = st.floats(0.05, 0.5)
angles = st.floats(-10.0, 10.0)
coordinates = st.floats(-0.5, 0.5)


@st.composite
def linkages(draw: st.DrawFn) -> FiveBar:
    return FiveBar(
        draw(lengths),
        draw(lengths),
        draw(lengths),
        draw(lengths),
        (draw(coordinates), draw(coordinates)),
        (draw(coordinates), draw(coordinates)),
    )


@settings(deadline=None, derandomize=True)
@given(linkages(), angles, angles, st.sampled_from(list(Closure)))
def test_both_chains_end_at_the_end_effector(bar: FiveBar, theta2: float, theta5: float, closure: Closure) -> None:
    point = bar.end_effector(theta2, theta5, closure)
    if isnan(point[0]):
        with pytest.raises(UnreachableError) as caught:
            bar.forward(theta2, theta5, closure)
        assert caught.value.distance_m > 0.0
        return
    theta3, theta4, (x, y) = bar.forward(theta2, theta5, closure)
    assert hypot(point[0] - x, point[1] - y) < 1e-12
    # Close to a stretched or folded position the square root doubles the digits that are lost.
    assert (
        hypot(
            bar.cv_pivot[0] + bar.p * cos(theta2) + bar.q * cos(theta3) - x,
            bar.cv_pivot[1] + bar.p * sin(theta2) + bar.q * sin(theta3) - y,
        )
        < 1e-7
    )
    assert (
        hypot(
            bar.servo_pivot[0] + bar.s * cos(theta5) + bar.r * cos(theta4) - x,
            bar.servo_pivot[1] + bar.s * sin(theta5) + bar.r * sin(theta4) - y,
        )
        < 1e-7
    )


@settings(deadline=None, derandomize=True)
@given(linkages(), angles, angles, st.sampled_from(list(Closure)))
def test_inverse_undoes_forward_by_one_of_the_elbows(
    bar: FiveBar, theta2: float, theta5: float, closure: Closure
) -> None:
    point = bar.end_effector(theta2, theta5, closure)
    assume(not isnan(point[0]))
    sines = np.abs(bar.transmission_sines(theta2, theta5, closure))
    assume(sines.min() > 1e-3)
    found = [bar.servo_angle(float(point[0]), float(point[1]), elbow) for elbow in Elbow]
    assert min(abs((angle - theta5 + pi) % (2 * pi) - pi) for angle in found) < 1e-7
    assert bar.closure_at(theta2, theta5, float(point[0]), float(point[1])) is closure


@settings(deadline=None, derandomize=True)
@given(
    st.lists(st.tuples(st.floats(-0.25, 0.25), st.floats(-pi, pi)), min_size=1, max_size=3),
    st.floats(0.0, 0.5),
    st.sampled_from(list(Closure)),
)
def test_closure_tracking_finds_a_motion_that_is_known(
    waves: list[tuple[float, float]], offset: float, closure: Closure
) -> None:
    bar = FiveBar(0.15, 0.25, 0.3, 0.15, (0.0, 0.0), (0.25, 0.0))
    theta2 = np.arange(180) * (2 * pi / 180)
    theta5 = (offset + 0.3) * int(closure) + sum(
        size * np.sin((k + 1) * theta2 + phase) for k, (size, phase) in enumerate(waves)
    )
    points = bar.end_effector(theta2, theta5, closure)
    assume(not np.any(np.isnan(points)))
    sines = np.abs(bar.transmission_sines(theta2, theta5, closure))
    assume(sines.min() > 0.15)
    track = track_closure(DesiredCurve(theta2, points[:, 0], points[:, 1]), bar)
    assert track.closure is not None
    assert track.immobile == ()
    assert track.structural_error.max() < 1e-12
    if track.closure is closure:
        turns = np.round((track.theta5[0] - theta5[0]) / (2 * pi)) * 2 * pi
        if np.abs(track.theta5 - theta5 - turns).max() < 1e-9:
            return
    # Another motion may be chosen only where it too traces the curve in one closure, moving link s no more.
    reached = bar.end_effector(theta2, track.theta5, track.closure)
    assert np.abs(reached - points).max() < 1e-9

    def effort(angle: np.ndarray) -> float:
        return float(np.sum(np.diff(np.append(angle, angle[0] + 2 * pi * track.net_turns)) ** 2))

    def own_effort(angle: np.ndarray) -> float:
        return float(np.sum(np.diff(np.append(angle, angle[0])) ** 2))

    assert effort(np.asarray(track.theta5)) <= own_effort(np.asarray(theta5)) + 1e-12
