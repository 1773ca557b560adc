"""Curves and tasks for the tests of the synthesis."""

from dataclasses import replace
from math import tau
from pathlib import Path

import numpy as np

from mechanism.curve import DesiredCurve, load_curve_csv
from mechanism.five_bar import Closure, FiveBar
from mechanism.synthesis.task import Bounds, SynthesisTask, Term, Timing, WeightedTerm

CURVE_FILE = Path(__file__).parents[2] / "config" / "desired_path.csv"

PAPER_LINKS = np.array([0.150, 0.250, 0.300, 0.150, 0.0, 0.0, 0.250, 0.0])
"""The paper's mechanism, as a row of a population."""

NEAR_BOUNDS = Bounds([0.05] * 4 + [-0.1, -0.1, 0.1, -0.1], [0.4] * 4 + [0.1, 0.1, 0.4, 0.1])
"""Bounds about the size of the paper's machine."""

TRACED_TERMS = (
    WeightedTerm(Term.STRUCTURAL_ERROR),
    WeightedTerm(Term.MOBILITY),
    WeightedTerm(Term.SINGULARITY),
)


def paper_curve(points: int = 36) -> DesiredCurve:
    """So many evenly spaced points of the shipped curve."""
    curve = load_curve_csv(CURVE_FILE)
    step = curve.theta2.size // points
    return DesiredCurve(curve.theta2[::step], curve.x[::step], curve.y[::step])


def paper_task(points: int = 36) -> SynthesisTask:
    """The paper's task with bounds about the size of its machine."""
    return SynthesisTask.from_curve(paper_curve(points), NEAR_BOUNDS)


def traced_curve(five_bar: FiveBar, theta5: np.ndarray, closure: Closure = Closure.LEFT) -> DesiredCurve:
    """What a five-bar traces when its servo moves so over evenly spaced crank angles."""
    theta2 = np.arange(theta5.size) * tau / theta5.size
    points = five_bar.end_effector(theta2, theta5, closure)
    assert np.all(np.isfinite(points))
    return DesiredCurve(theta2, points[:, 0], points[:, 1])


def row_of(five_bar: FiveBar) -> np.ndarray:
    """A five-bar as a row of a population."""
    return five_bar.to_array()


def known_mechanism(seed: int, points: int = 36) -> tuple[FiveBar, DesiredCurve]:
    """A five-bar at random with a servo motion of three harmonics, far from singular, and the curve that it traces."""
    random = np.random.default_rng(seed)
    theta2 = np.arange(points) * tau / points
    while True:
        lengths = random.uniform(0.1, 0.4, 4)
        servo, cv = random.uniform(-0.4, 0.4, 2), random.uniform(-0.2, 0.2, 2)
        five_bar = FiveBar(
            *(float(v) for v in lengths), (float(cv[0]), float(cv[1])), (float(servo[0]), float(servo[1]))
        )
        amplitudes = random.normal(size=(3, 2)) * np.array([[0.5], [0.25], [0.1]])
        orders = np.arange(1, 4)[:, np.newaxis] * theta2
        theta5 = random.uniform(0.0, tau) + (
            amplitudes[:, :1] * np.cos(orders) + amplitudes[:, 1:] * np.sin(orders)
        ).sum(0)
        ends = five_bar.end_effector(theta2, theta5, Closure.LEFT)
        if np.all(np.isfinite(ends)):
            sines = five_bar.transmission_sines(theta2, theta5, Closure.LEFT)
            if float(np.min(np.abs(sines[:, 0]))) > 0.2:
                return five_bar, DesiredCurve(theta2, ends[:, 0], ends[:, 1])


def known_task(seed: int, timing: Timing = Timing.PRESCRIBED) -> SynthesisTask:
    """To find a known mechanism again within wide bounds."""
    task = SynthesisTask.from_curve(known_mechanism(seed)[1], terms=TRACED_TERMS)
    if timing is Timing.FREE:
        task = replace(task, timing=timing, theta2=None, terms=(*TRACED_TERMS, WeightedTerm(Term.TIMING)))
    return task
