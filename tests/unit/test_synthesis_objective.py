"""The terms of the objective: hand-worked numbers, the closure tracking, and the models of kinematics and dynamics."""

from dataclasses import replace
from math import atan2, cos, degrees, pi, radians, sin, sqrt, tau

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from synthesis_samples import PAPER_LINKS, known_mechanism, paper_curve, paper_task, row_of, traced_curve

from config.loading import load_config
from mechanism.cam import CamLimits, compile_cam
from mechanism.closure import track_closure
from mechanism.curve import DesiredCurve, load_curve_csv
from mechanism.dynamics import Dynamics
from mechanism.errors import ParameterError
from mechanism.five_bar import Closure, FiveBar
from mechanism.synthesis import objective
from mechanism.synthesis.candidate import Candidate
from mechanism.synthesis.further_kernels import fill_dynamics
from mechanism.synthesis.machine_model import MachineModel
from mechanism.synthesis.objective import evaluate, prepare, solved_timing, weighted_sum
from mechanism.synthesis.paper_kernels import track
from mechanism.synthesis.task import (
    PAPER_TERMS,
    Bounds,
    Box,
    Circle,
    SynthesisTask,
    Term,
    Timing,
    WeightedTerm,
)
from mechanism.synthesis.tracking_kernels import THETA5, angle_of, whole_blocks
from mechanism.synthesis.vectorised import vectorised_paper_terms

ALL = tuple(WeightedTerm(term) for term in Term if term is not Term.KEEP_OUT)
PARALLEL = FiveBar(0.1, 0.4, 0.4, 0.2, (0.0, 0.0), (0.4, 0.0))


def terms_of(task: SynthesisTask, row: np.ndarray) -> dict[Term, float]:
    values = evaluate(task, row)[0]
    return {entry.term: float(value) for entry, value in zip(task.terms, values, strict=True)}


def random_rows(task: SynthesisTask, count: int, seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).uniform(task.bounds.lower, task.bounds.upper, (count, 8))


@settings(deadline=None)
@given(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3))
def test_angle_is_that_of_the_c_library(y: float, x: float) -> None:
    assert angle_of(y, x) == pytest.approx(atan2(y, x), abs=1e-15, rel=4e-16) or (y == 0.0 and x <= 0.0)


def test_angle_on_the_axes() -> None:
    assert [angle_of(0.0, 1.0), angle_of(1.0, 0.0), angle_of(0.0, -1.0), angle_of(-1.0, 0.0), angle_of(0.0, 0.0)] == [
        0.0,
        pi / 2,
        pi,
        -pi / 2,
        0.0,
    ]


@pytest.mark.parametrize("points", [36, 360])
def test_the_papers_links_fit_the_papers_curve(points: int) -> None:
    task = paper_task(points)
    terms = terms_of(task, PAPER_LINKS)
    # The file has a tenth of a micrometre: that is all the error there may be.
    assert sqrt(terms[Term.STRUCTURAL_ERROR]) / points < 1e-4
    assert terms[Term.MOBILITY] == 0.0


def test_the_papers_links_need_the_papers_servo_motion() -> None:
    task = SynthesisTask.from_curve(load_curve_csv("config/desired_path.csv"), terms=ALL)
    terms = evaluate(task, PAPER_LINKS)[0]
    candidate = Candidate(task, PAPER_LINKS, terms, float(weighted_sum(task, terms[np.newaxis])[0]))
    motion = candidate.servo_motion()
    assert degrees(float(np.ptp(motion.theta5))) == pytest.approx(99.78, abs=0.01)
    assert candidate.value(Term.SERVO_VELOCITY) == pytest.approx(18.96, abs=0.01)
    assert candidate.value(Term.SINGULARITY) == 0.0
    candidate.require_feasible()


def test_structural_error_is_the_squared_sum_of_what_q_misses() -> None:
    """Eq (1): every point moved 2 mm outwards along q; of 12 points the sum is 24 mm, its square 576 mm^2."""
    theta5 = 1.2 + 0.2 * np.sin(np.arange(12) * tau / 12)
    curve = traced_curve(PARALLEL, theta5)
    joint = PARALLEL.crank_end(curve.theta2)
    outwards = curve.points + 0.002 * (curve.points - joint) / PARALLEL.q
    moved = DesiredCurve(curve.theta2, outwards[:, 0], outwards[:, 1])
    task = SynthesisTask.from_curve(moved)
    assert terms_of(task, row_of(PARALLEL))[Term.STRUCTURAL_ERROR] == pytest.approx(576.0)
    # 1.5 mm of it are within tolerance: 12 times 0.5 mm.
    lenient = replace(task, tolerances=np.full(12, 0.0015))
    assert terms_of(lenient, row_of(PARALLEL))[Term.STRUCTURAL_ERROR] == pytest.approx(36.0)


def test_swept_area_and_harmonics_of_a_known_motion() -> None:
    """Eqs (2) and (3): theta5 moves 20 deg sin(theta2) + 3 deg (1 - cos(3 theta2)), s is 200 mm."""
    theta2 = np.arange(24) * tau / 24
    degrees_moved = 20.0 * np.sin(theta2) + 3.0 * (1.0 - np.cos(3.0 * theta2))
    curve = traced_curve(PARALLEL, 1.3 + np.radians(degrees_moved))
    terms = terms_of(SynthesisTask.from_curve(curve), row_of(PARALLEL))
    # 20^2 of order 1, and 3^4 of order 3.
    assert terms[Term.HARMONIC_CONTENT] == pytest.approx(20.0**2 + 3.0**4)
    # 24 times the mean square: 200 of the sine, 9 of the mean and 4.5 of the cosine.
    assert terms[Term.SWEPT_AREA] == pytest.approx(200.0 * sqrt(24 * (200.0 + 9.0 + 4.5)))


def test_harmonics_of_uneven_points_are_near_those_of_even_ones() -> None:
    theta2 = np.arange(180) * tau / 180
    uneven = theta2 + 0.3 * np.sin(theta2)
    moved = np.radians(20.0 * np.sin(uneven))
    ends = PARALLEL.end_effector(uneven, 1.3 + moved, Closure.LEFT)
    curve = DesiredCurve(uneven, ends[:, 0], ends[:, 1])
    terms = terms_of(replace(SynthesisTask.from_curve(curve), harmonics=2), row_of(PARALLEL))
    assert terms[Term.HARMONIC_CONTENT] == pytest.approx(400.0, rel=1e-3)


def test_mobility_is_the_cube_of_the_positions_that_cannot_close() -> None:
    task = paper_task()
    short = PAPER_LINKS.copy()
    short[2] = 0.15
    # By hand: how many end effectors are further than r + s from the servo pivot.
    ends = FiveBar(*short[:4], (0.0, 0.0), (0.25, 0.0))
    curve = paper_curve()
    joint = ends.crank_end(curve.theta2)
    reached = joint + 0.25 * (curve.points - joint) / np.linalg.norm(curve.points - joint, axis=1, keepdims=True)
    count = int(np.sum(np.hypot(reached[:, 0] - 0.25, reached[:, 1]) > 0.3))
    assert 0 < count < 36
    assert terms_of(task, short)[Term.MOBILITY] == count**3


def test_kernels_agree_with_plain_numpy() -> None:
    task = replace(paper_task(), bounds=Bounds.for_curve(paper_curve().x, paper_curve().y))
    rows = random_rows(task, 400)
    expected = np.empty((400, 4))
    vectorised_paper_terms(task, rows, prepare(task).fourier, expected)
    np.testing.assert_allclose(evaluate(task, rows), expected, rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("points", [5, 7, 8, 9, 36])
def test_tracking_is_that_of_the_cam(points: int) -> None:
    """The same elbows, and so the same theta5, as `track_closure` chooses, feasible or not; blocks of any rest."""
    curve = paper_curve(points)
    task = SynthesisTask.from_curve(curve)
    rows = prepare(task).rows
    choices = np.zeros(whole_blocks(curve.theta2.size), dtype=np.int64)
    near = PAPER_LINKS + np.random.default_rng(2).normal(0.0, 0.02, (30, 8))
    for row in np.concatenate((random_rows(task, 30), near)):
        expected = track_closure(curve, task.five_bar(row))
        track(rows, choices, curve.theta2.size, row, task.minimum_sine)
        difference = rows[THETA5 : THETA5 + curve.theta2.size] - expected.theta5
        np.testing.assert_allclose(np.abs((difference + pi) % tau - pi), 0.0, atol=1e-9)


@pytest.mark.parametrize("count", [1, 7, 8, 64, 65, 130])
def test_side_by_side_as_one_by_one(count: int) -> None:
    """Blocks of mechanisms side by side give to the last bit what the kernels of single ones give."""
    task = replace(paper_task(), bounds=Bounds.for_curve(paper_curve().x, paper_curve().y))
    rows = random_rows(task, count, count)
    one_by_one = evaluate(replace(task, terms=(*PAPER_TERMS, WeightedTerm(Term.SINGULARITY))), rows)
    np.testing.assert_array_equal(evaluate(task, rows), one_by_one[:, :4])


def test_result_does_not_depend_on_the_other_rows() -> None:
    task = replace(paper_task(), terms=ALL)
    rows = random_rows(task, 20)
    together = evaluate(task, rows)
    np.testing.assert_array_equal(together[7:9], evaluate(task, rows[7:9]))
    np.testing.assert_array_equal(together, evaluate(task, rows))


def test_terms_come_in_the_order_of_the_task() -> None:
    task = paper_task()
    turned = replace(task, terms=(PAPER_TERMS[3], PAPER_TERMS[0]))
    np.testing.assert_array_equal(evaluate(turned, PAPER_LINKS)[0], evaluate(task, PAPER_LINKS)[0][[3, 0]])


def test_without_kernels_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    task = paper_task()
    rows = random_rows(task, 50)
    compiled = evaluate(task, rows)
    monkeypatch.setattr(objective, "COMPILED", False)
    np.testing.assert_allclose(evaluate(task, rows), compiled, rtol=1e-11, atol=1e-11)


@settings(max_examples=25, deadline=None)
@given(angle=st.floats(-3.0, 3.0), x=st.floats(-1.0, 1.0), y=st.floats(-1.0, 1.0), seed=st.integers(0, 1000))
def test_turning_and_moving_everything_changes_nothing(angle: float, x: float, y: float, seed: int) -> None:
    """Also the closures stay: no term depends on the frame of reference (gravity aside)."""
    task = paper_task()
    row = random_rows(task, 1, seed)[0]
    c, s = cos(angle), sin(angle)

    def move(px: np.ndarray, py: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return x + c * px - s * py, y + s * px + c * py

    assert task.theta2 is not None
    moved_x, moved_y = move(task.x, task.y)
    moved = replace(task, theta2=task.theta2 + angle, x=moved_x, y=moved_y)
    other = row.copy()
    other[4], other[5] = move(row[4], row[5])
    other[6], other[7] = move(row[6], row[7])
    np.testing.assert_allclose(evaluate(moved, other), evaluate(task, row), rtol=1e-7, atol=1e-7)


def test_transmission_is_the_least_sine_of_both_angles() -> None:
    theta5 = 1.2 + 0.3 * np.sin(np.arange(36) * tau / 36)
    curve = traced_curve(PARALLEL, theta5)
    task = replace(SynthesisTask.from_curve(curve), terms=ALL)
    terms = terms_of(task, row_of(PARALLEL))
    sines = PARALLEL.transmission_sines(curve.theta2, theta5, Closure.LEFT)
    assert terms[Term.TRANSMISSION_ANGLE] == pytest.approx(1.0 - float(np.min(np.abs(sines))))
    assert terms[Term.SINGULARITY] == 0.0
    # With a bound between the sines, the positions below it count.
    bound = float(np.median(np.abs(sines[:, 0])))
    count = int(np.sum(np.abs(sines[:, 0]) < bound))
    assert terms_of(replace(task, minimum_sine=bound), row_of(PARALLEL))[Term.SINGULARITY] == count**3


def test_velocity_and_acceleration_are_the_cams() -> None:
    curve = paper_curve(120)
    task = replace(SynthesisTask.from_curve(curve), terms=ALL, speed_rad_per_s=3.0)
    terms = terms_of(task, PAPER_LINKS)
    cam = compile_cam(curve, task.five_bar(PAPER_LINKS), CamLimits(1e3, 1e5), 3.0)
    theta5 = cam.cam.profile.at_many(curve.theta2)
    assert terms[Term.SERVO_VELOCITY] == pytest.approx(float(np.max(np.abs(theta5[:, 1]))) * 3.0, rel=1e-3)
    assert terms[Term.SERVO_ACCELERATION] == pytest.approx(float(np.max(np.abs(theta5[:, 2]))) * 9.0, rel=1e-2)


def test_machine_model_is_the_shipped_machine() -> None:
    """The masses of config/paper.yaml, which were worked out by hand from the same bars."""
    shipped = load_config("paper").machine.links
    model = MachineModel()
    for index, (name, length) in enumerate((("p", 0.15), ("q", 0.25), ("r", 0.3), ("s", 0.15))):
        link, expected = model.link(index, length), getattr(shipped, name)
        assert link.mass_kg == pytest.approx(expected.mass_kg, rel=1e-9)
        assert link.com_m == pytest.approx(expected.com_m, rel=1e-9)
        assert link.inertia_com_kg_m2 == pytest.approx(expected.inertia_com_kgm2, rel=1e-9)


def test_kernels_see_the_same_machine() -> None:
    task = paper_task()
    five_bar = task.five_bar(PAPER_LINKS)
    parameters = np.zeros(33)
    fill_dynamics(PAPER_LINKS, prepare(task).machine, parameters)
    np.testing.assert_allclose(parameters, task.machine.dynamics(five_bar).to_array(), rtol=1e-14)


def test_torque_and_power_of_a_known_motion() -> None:
    """theta5 = 1.2 + 0.3 sin(theta2) at 5 rad/s: velocity and acceleration by hand, torque by `Dynamics`."""
    theta2 = np.arange(72) * tau / 72
    curve = traced_curve(PARALLEL, 1.2 + 0.3 * np.sin(theta2))
    task = replace(SynthesisTask.from_curve(curve), terms=ALL, speed_rad_per_s=5.0)
    terms = terms_of(task, row_of(PARALLEL))
    model = Dynamics(task.machine.dynamics(PARALLEL), Closure.LEFT)
    torques = np.array(
        [model.torque((t, 1.2 + 0.3 * sin(t)), (5.0, 1.5 * cos(t)), (0.0, -7.5 * sin(t)), 0.1) for t in theta2.tolist()]
    )
    power = np.maximum(torques[:, 0] * 5.0, 0.0) + np.maximum(torques[:, 1] * 1.5 * np.cos(theta2), 0.0)
    assert terms[Term.SERVO_VELOCITY] == pytest.approx(1.5, rel=1e-6)
    assert terms[Term.SERVO_ACCELERATION] == pytest.approx(7.5, rel=1e-4)
    assert terms[Term.PEAK_TORQUE] == pytest.approx(float(np.max(np.abs(torques[:, 1]))), rel=1e-4)
    assert terms[Term.CV_PEAK_TORQUE] == pytest.approx(float(np.max(np.abs(torques[:, 0]))), rel=1e-4)
    assert terms[Term.POWER] == pytest.approx(float(power.mean()), rel=1e-4)


def test_torque_of_an_immobile_mechanism_is_a_number() -> None:
    task = replace(paper_task(), terms=ALL)
    short = PAPER_LINKS.copy()
    short[2] = 0.05
    terms = terms_of(task, short)
    assert terms[Term.PEAK_TORQUE] == terms[Term.POWER] == 1e6
    assert terms[Term.TRANSMISSION_ANGLE] == 1.0
    assert np.all(np.isfinite(evaluate(task, random_rows(task, 200))))


def keep_out(*zones: Circle | Box) -> float:
    curve = traced_curve(PARALLEL, np.full(8, radians(100.0)))
    task = SynthesisTask(
        theta2=curve.theta2,
        x=curve.x,
        y=curve.y,
        bounds=Bounds.for_curve(curve.x, curve.y),
        terms=(WeightedTerm(Term.KEEP_OUT),),
        keep_out=zones,
    )
    return float(evaluate(task, row_of(PARALLEL))[0, 0])


def test_keep_out_zones_measure_the_links_inside() -> None:
    """p turns about (0, 0) in 8 steps of 45 deg, s stands still at 100 deg from (0.4, 0)."""
    # A circle of 20 mm about the servo pivot holds 20 mm of s in every position.
    assert keep_out(Circle(0.4, 0.0, 0.02)) == pytest.approx(8 * 0.02)
    # A circle on p's way holds 2 times 5 mm of it in one position only.
    assert keep_out(Circle(0.05, 0.0, 0.005)) == pytest.approx(0.01)
    # s, 200 mm long, crosses a box 10 mm high in every position: 10 mm / sin(100 deg) each.
    assert keep_out(Box(0.2, 0.05, 0.45, 0.06)) == pytest.approx(8 * 0.01 / sin(radians(100.0)))
    # p straight down within a box from 20 to 60 mm below its pivot, and nothing else near it.
    assert keep_out(Box(-0.001, -0.06, 0.001, -0.02)) == pytest.approx(0.04)
    assert keep_out(Circle(0.05, 0.0, 0.005), Box(-0.001, -0.06, 0.001, -0.02)) == pytest.approx(0.05)
    assert keep_out(Circle(-1.0, 0.0, 0.3), Box(-1.0, -1.0, -0.9, -0.9)) == 0.0


@pytest.mark.parametrize("seed", range(6))
def test_free_timing_solves_for_the_angles_of_a_known_mechanism(seed: int) -> None:
    """With its own lengths a traced curve is met exactly; a crank that goes round gives its angles back."""
    five_bar, curve = known_mechanism(seed)
    task = replace(SynthesisTask.from_curve(curve), timing=Timing.FREE, theta2=None, terms=ALL)
    row = row_of(five_bar)
    terms = terms_of(task, row)
    assert terms[Term.STRUCTURAL_ERROR] < 1e-15
    solved = solved_timing(task, row)
    # Every solved angle puts the crank's end at q from its point, whichever of the two it is.
    distance = np.linalg.norm(five_bar.crank_end(solved) - curve.points, axis=1)
    np.testing.assert_allclose(distance, five_bar.q, rtol=1e-9)
    if terms[Term.TIMING] == 0.0:
        assert np.all(np.diff(solved) > 0.0)
        assert solved[-1] - solved[0] < tau


def test_free_timing_gives_the_papers_angles_back() -> None:
    curve = paper_curve()
    task = replace(SynthesisTask.from_curve(curve), timing=Timing.FREE, theta2=None, terms=ALL)
    assert terms_of(task, PAPER_LINKS)[Term.TIMING] == 0.0
    # Near the dead points p and q are nearly in line, and a tenth of a micrometre is worth much.
    np.testing.assert_allclose(np.degrees(solved_timing(task, PAPER_LINKS) - curve.theta2), 0.0, atol=1e-3)
    prescribed = terms_of(replace(SynthesisTask.from_curve(curve), terms=ALL), PAPER_LINKS)
    freely = terms_of(task, PAPER_LINKS)
    assert freely[Term.SWEPT_AREA] == pytest.approx(prescribed[Term.SWEPT_AREA], rel=1e-6)
    assert freely[Term.HARMONIC_CONTENT] == pytest.approx(prescribed[Term.HARMONIC_CONTENT], rel=1e-3)
    # Parabolas over 10 degrees blunt the return stroke's peak.
    assert freely[Term.SERVO_VELOCITY] == pytest.approx(prescribed[Term.SERVO_VELOCITY], rel=0.1)


def test_free_timing_counts_what_does_not_go_round() -> None:
    """A crank far away sees the curve go to and fro: its angle cannot rise all the way."""
    task = replace(paper_task(), timing=Timing.FREE, theta2=None, terms=ALL)
    far = np.array([0.4, 0.2, 0.3, 0.3, 0.9, 0.9, 0.25, 0.0])
    assert terms_of(task, far)[Term.TIMING] >= 1.0


def test_population_of_another_shape_is_refused() -> None:
    with pytest.raises(ParameterError, match=r"the shape of a population is \(2, 7\)"):
        evaluate(paper_task(), np.zeros((2, 7)))
