"""The cam profile by closed forms, and the compiler on the paper's task and on tasks that it has to refuse."""

from dataclasses import replace
from math import isnan, nan, tau
from pathlib import Path

import numpy as np
import pytest

from mechanism.cam import CamLimits, CompiledCam, compile_cam
from mechanism.cam_profile import CamProfile
from mechanism.curve import DesiredCurve, load_curve_csv
from mechanism.errors import (
    CamLimitError,
    CurveError,
    MechanismError,
    ParameterError,
    SingularError,
    UnreachableError,
)
from mechanism.five_bar import Closure, FiveBar

PATH = Path(__file__).parents[2] / "config" / "desired_path.csv"
PAPER = FiveBar(0.15, 0.25, 0.3, 0.15, (0.0, 0.0), (0.25, 0.0))
LIMITS = CamLimits(velocity_rad_per_s=25.0, acceleration_rad_per_s2=400.0)


@pytest.fixture(scope="module")
def curve() -> DesiredCurve:
    return load_curve_csv(PATH)


@pytest.fixture(scope="module")
def compiled(curve: DesiredCurve) -> CompiledCam:
    return compile_cam(curve, PAPER, LIMITS, tau)


def sine_profile(net_turns: int = 0) -> CamProfile:
    theta2 = np.arange(256) * (tau / 256)
    return CamProfile.through(theta2, np.sin(theta2) + net_turns * theta2, net_turns)


@pytest.mark.parametrize("theta2", [0.0, 0.1, 1.0, 3.0, 6.28, -0.5, -40.0, 1000.0])
def test_a_sine_and_its_derivatives(theta2: float) -> None:
    assert sine_profile().at(theta2) == pytest.approx(
        (np.sin(theta2), np.cos(theta2), -np.sin(theta2), -np.cos(theta2)), abs=1e-7
    )


@pytest.mark.parametrize("net_turns", [1, -2])
def test_whole_turns_add_up(net_turns: int) -> None:
    profile = sine_profile(net_turns)
    for theta2 in (0.3, 5.0, 5.0 + 7 * tau, -100.0):
        theta5, first, _, _ = profile.at(theta2)
        assert theta5 == pytest.approx(np.sin(theta2) + net_turns * theta2, abs=1e-9)
        assert first == pytest.approx(np.cos(theta2) + net_turns, abs=1e-8)


def test_a_curve_that_starts_anywhere_gives_the_same_profile() -> None:
    theta2 = np.arange(256) * (tau / 256)
    for start in (-1.0, 0.7, 5.0):
        angles = theta2 + start
        profile = CamProfile.through(angles, np.sin(angles) + angles, 1)
        assert profile.at(1.0)[0] == pytest.approx(np.sin(1.0) + 1.0, abs=1e-8)


def test_not_a_number_in_not_a_number_out() -> None:
    for theta2 in (nan, float("inf"), -1e300):
        assert all(isnan(value) for value in sine_profile().at(theta2))


def test_at_many_is_at() -> None:
    profile = sine_profile(1)
    theta2 = np.linspace(-20.0, 20.0, 400).reshape(20, 20)
    many = profile.at_many(theta2)
    assert many.shape == (20, 20, 4)
    assert all(tuple(many[i, j]) == profile.at(theta2[i, j]) for i in range(20) for j in range(20))


def test_profiles_that_cannot_be_are_refused() -> None:
    with pytest.raises(ParameterError, match="power of two"):
        CamProfile(np.zeros((1000, 6)))
    with pytest.raises(ParameterError, match="shape"):
        CamProfile(np.zeros((1024, 4)))
    with pytest.raises(ParameterError, match="finite"):
        CamProfile(np.full((8, 6), nan))
    with pytest.raises(CurveError, match="4 points are too few"):
        CamProfile.through([0.0, 1.0, 2.0, 3.0], [0.0] * 4)


def test_paper_figures(compiled: CompiledCam) -> None:
    report = compiled.report
    assert compiled.require() is compiled
    assert compiled.closure is Closure.LEFT
    assert report.displacement_deg == pytest.approx(99.78, abs=0.01)
    assert report.velocity_maximum.value == pytest.approx(4.48, rel=1e-3)
    assert report.velocity_minimum.value == pytest.approx(-18.96, rel=1e-3)
    assert report.acceleration_minimum.value == pytest.approx(-317.0, rel=5e-3)
    assert report.acceleration_maximum.value == pytest.approx(310.0, rel=5e-3)
    assert report.jerk_maximum.value == pytest.approx(1.2e4, rel=0.03)
    assert report.structural_error.value < 1e-6
    assert report.path_error.value < 1e-6
    assert report.immobile_points == 0
    assert report.crank_sine.value == pytest.approx(0.8, abs=1e-6)
    # 18.96 rad/s over 1 ms of 4096 counts a revolution
    assert report.step_counts.value == pytest.approx(18.96e-3 * 4096 / tau, rel=1e-3)
    assert report.profile_error_counts.value < 1e-3
    assert report.image_error_counts.value < 0.01


def test_extremes_are_no_less_than_a_dense_evaluation(compiled: CompiledCam) -> None:
    theta2 = np.random.default_rng(7).uniform(0.0, tau, 200_000)
    motion = compiled.profile.at_many(theta2) * [1.0, tau, tau**2, tau**3]
    report = compiled.report
    pairs = (
        (report.position_minimum, report.position_maximum),
        (report.velocity_minimum, report.velocity_maximum),
        (report.acceleration_minimum, report.acceleration_maximum),
        (report.jerk_minimum, report.jerk_maximum),
    )
    for order, (least, greatest) in enumerate(pairs):
        assert least.value <= motion[:, order].min() + 1e-9 * abs(least.value)
        assert greatest.value >= motion[:, order].max() - 1e-9 * abs(greatest.value)
        at = compiled.profile.at(greatest.theta2_rad)[order] * tau**order
        assert at == pytest.approx(greatest.value, rel=1e-9)


def test_desired_point_is_the_curve(compiled: CompiledCam, curve: DesiredCurve) -> None:
    assert compiled.desired_point(0.0) == pytest.approx((0.220, 0.240), abs=1e-9)
    assert np.abs(compiled.desired_points(curve.theta2 + 3 * tau) - curve.points).max() < 1e-6
    assert compiled.end_effector.shape == (720, 2)
    assert compiled.end_effector[0] == pytest.approx([0.220, 0.240], abs=1e-9)


def test_every_broken_limit_is_reported(curve: DesiredCurve) -> None:
    limits = CamLimits(
        velocity_rad_per_s=15.0,
        acceleration_rad_per_s2=300.0,
        jerk_rad_per_s3=1e4,
        position_minimum_rad=0.1,
        position_maximum_rad=1.0,
        minimum_transmission_sine=0.79,
        step_counts=5.0,
    )
    found = compile_cam(curve, PAPER, limits, tau).violations
    assert sorted(error.what for error in found if isinstance(error, CamLimitError)) == [
        "acceleration",
        "acceleration",
        "jerk",
        "position",
        "position",
        "step in one bus cycle",
        "velocity",
    ]
    assert [error.which for error in found if isinstance(error, SingularError)] == ["links r and s"]
    assert all("\n" not in str(error) for error in found)


def test_require_raises_the_first_violation_with_its_values(curve: DesiredCurve) -> None:
    cam = compile_cam(curve, PAPER, replace(LIMITS, velocity_rad_per_s=15.0), tau)
    message = r"^the cam's velocity is -18\.9601 rad/s at theta2 = 325\.0\d deg, limit -15 rad/s$"
    with pytest.raises(CamLimitError, match=message) as caught:
        cam.require()
    assert caught.value.value == pytest.approx(-18.96, rel=1e-3)
    assert caught.value.limit == -15.0


def test_a_limit_that_is_just_touched_is_kept(curve: DesiredCurve) -> None:
    assert compile_cam(curve, PAPER, replace(LIMITS, position_minimum_rad=0.0), tau).violations == ()


def test_twice_the_speed_is_twice_the_velocity_and_four_times_the_acceleration(curve: DesiredCurve) -> None:
    fast = compile_cam(curve, PAPER, LIMITS, -2 * tau)
    assert fast.report.velocity_minimum.value == pytest.approx(-2 * 4.48, rel=1e-3)
    assert fast.report.velocity_maximum.value == pytest.approx(2 * 18.96, rel=1e-3)
    assert fast.report.acceleration_maximum.value == pytest.approx(4 * 310.0, rel=5e-3)
    assert len(fast.violations) == 3


def test_a_crank_that_is_too_short_misses_the_curve(curve: DesiredCurve) -> None:
    cam = compile_cam(curve, replace(PAPER, p=0.14), LIMITS, tau)
    with pytest.raises(UnreachableError, match=r"10\.000 mm \(bound 1\.000 mm\): link q") as caught:
        cam.require()
    assert caught.value.bound_m == 1e-3


def test_a_servo_link_that_is_too_short_is_immobile_and_never_a_traceback(curve: DesiredCurve) -> None:
    cam = compile_cam(curve, replace(PAPER, r=0.2, s=0.05), LIMITS, tau)
    assert any(isinstance(error, UnreachableError) and "stretch" in str(error) for error in cam.violations)
    assert any(isinstance(error, SingularError) for error in cam.violations)


def test_coarse_knots_lose_resolution(curve: DesiredCurve) -> None:
    cam = compile_cam(curve, PAPER, LIMITS, tau, knots=16, image_points=16)
    reported = {error.what for error in cam.violations if isinstance(error, CamLimitError)}
    assert {"distance from the curve's spline", "binary table's error"} <= reported


@pytest.mark.parametrize(
    "wrong",
    [
        {"master_speed_rad_per_s": 0.0},
        {"master_speed_rad_per_s": nan},
        {"cycle_s": 0.0},
        {"counts_per_revolution": 0},
        {"knots": 1000},
        {"image_points": 0},
    ],
)
def test_impossible_parameters_are_refused(curve: DesiredCurve, wrong: dict[str, float]) -> None:
    with pytest.raises(ParameterError, match=next(iter(wrong)).replace("image_points", "knots")):
        compile_cam(curve, PAPER, LIMITS, **{"master_speed_rad_per_s": tau, **wrong})  # pyright: ignore


@pytest.mark.parametrize("wrong", [0.0, -1.0, nan])
def test_impossible_limits_are_refused(wrong: float) -> None:
    with pytest.raises(ParameterError, match="velocity"):
        CamLimits(wrong, 1.0)
    with pytest.raises(MechanismError):
        CamLimits(1.0, 1.0, minimum_transmission_sine=1.5)


def test_figures_are_flat_numbers_with_units(compiled: CompiledCam) -> None:
    figures = compiled.report.figures()
    assert figures["displacement_deg"] == pytest.approx(99.78, abs=0.01)
    assert figures["velocity_minimum_rad_per_s_at_master_deg"] == pytest.approx(325.0, abs=0.1)
    assert all(isinstance(value, (int, float)) for value in figures.values())
