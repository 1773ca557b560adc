"""What a synthesis task refuses: one sentence that names what, where and the bound."""

from dataclasses import replace

import numpy as np
import pytest
from synthesis_samples import NEAR_BOUNDS, paper_curve, paper_task

from mechanism.errors import CurveError, MechanismError, ParameterError, SynthesisError
from mechanism.synthesis.machine_model import MachineModel
from mechanism.synthesis.task import Bounds, Box, Circle, SynthesisTask, Term, Timing, WeightedTerm


def circle_task(count: int, **changes: object) -> SynthesisTask:
    theta2 = np.arange(count) * 2.0 * np.pi / max(count, 1)
    values: dict[str, object] = {
        "theta2": theta2,
        "x": 0.1 * np.cos(theta2),
        "y": 0.1 * np.sin(theta2),
        "bounds": NEAR_BOUNDS,
    }
    return SynthesisTask(**{**values, **changes})  # type: ignore[arg-type]


@pytest.mark.parametrize("timing", list(Timing))
def test_too_few_points(timing: Timing) -> None:
    with pytest.raises(CurveError, match=r"4 points are too few .* at least 5"):
        circle_task(4, timing=timing)


def test_unordered_and_repeated_angles() -> None:
    theta2 = np.arange(8) * np.pi / 4
    for swapped, why in (((0, 2, 1, 3, 4, 5, 6, 7), "not in rising order"), ((0, 1, 1, 3, 4, 5, 6, 7), "is repeated")):
        with pytest.raises(CurveError, match=f"row 3: theta2 = .* {why}"):
            circle_task(8, theta2=theta2[list(swapped)])


def test_open_curve() -> None:
    with pytest.raises(CurveError, match="does not cover one revolution"):
        circle_task(20, theta2=np.linspace(0.0, 3.0, 20))


@pytest.mark.parametrize("timing", list(Timing))
def test_not_a_number(timing: Timing) -> None:
    x = np.linspace(0.0, 0.1, 8)
    x[5] = np.nan
    with pytest.raises(CurveError, match="row 6: x is nan"):
        circle_task(8, x=x, timing=timing)


def test_all_points_the_same() -> None:
    with pytest.raises(CurveError, match="all points of the curve are the same"):
        circle_task(8, x=np.zeros(8), y=np.ones(8))


def test_prescribed_timing_needs_angles() -> None:
    with pytest.raises(CurveError, match="needs a theta2 for every point"):
        circle_task(8, theta2=None)
    assert circle_task(8, theta2=None, timing=Timing.FREE).count == 8


def test_lists_of_different_lengths() -> None:
    with pytest.raises(CurveError, match=r"not .* lists of the same length"):
        circle_task(8, y=np.zeros(7))
    with pytest.raises(CurveError, match="7 tolerances for 8 points"):
        circle_task(8, tolerances=np.zeros(7))


def test_tolerance_out_of_bounds() -> None:
    tolerances = np.zeros(8)
    tolerances[2] = -0.001
    with pytest.raises(CurveError, match="row 3: the tolerance is -1 mm"):
        circle_task(8, tolerances=tolerances)


def test_too_many_points() -> None:
    with pytest.raises(CurveError, match="1001 points are too many"):
        circle_task(1001)


@pytest.mark.parametrize(
    ("index", "low", "high", "why"),
    [
        (0, -0.1, 0.2, "the bounds of P is -100 to 200 mm, but must be positive"),
        (3, 0.3, 0.2, "the bounds of S is 300 to 200 mm, but must be in rising order"),
        (6, 0.0, np.inf, "the bounds of SERVO_PIVOT_X is 0 to inf mm, but must be finite"),
    ],
)
def test_impossible_bounds(index: int, low: float, high: float, why: str) -> None:
    lower, upper = NEAR_BOUNDS.lower.copy(), NEAR_BOUNDS.upper.copy()
    lower[index], upper[index] = low, high
    with pytest.raises(ParameterError) as error:
        Bounds(lower, upper)
    assert str(error.value) == why


def test_bounds_of_another_length() -> None:
    with pytest.raises(ParameterError, match="7 and 8 values"):
        Bounds(NEAR_BOUNDS.lower[:7], NEAR_BOUNDS.upper)


def test_bounds_follow_the_curve() -> None:
    """A curve 30 mm wide and 40 mm high is 50 mm across: lengths 2.5 to 125 mm, pivots 75 mm about its middle."""
    bounds = Bounds.for_curve([0.0, 0.03, 0.0], [0.01, 0.05, 0.02])
    np.testing.assert_allclose(bounds.lower, [0.0025] * 4 + [-0.06, -0.045, -0.06, -0.045])
    np.testing.assert_allclose(bounds.upper, [0.125] * 4 + [0.09, 0.105, 0.09, 0.105])
    assert bounds.contains(bounds.lower)
    assert not bounds.contains(bounds.upper + 1e-6)


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"terms": ()}, "no term is to be weighed"),
        ({"terms": (WeightedTerm(Term.POWER), WeightedTerm(Term.POWER))}, "the term power is given twice"),
        ({"terms": (WeightedTerm(Term.POWER, 0.0),)}, "every term has weight 0"),
        ({"terms": (WeightedTerm(Term.KEEP_OUT),)}, "no zone is given"),
        ({"speed_rad_per_s": 0.0}, "speed is 0 rad/s"),
        ({"harmonics": 0}, "harmonics is 0, but must be 1 to 64"),
        ({"minimum_sine": 1.0}, "minimum_sine is 1.0"),
    ],
)
def test_impossible_settings(changes: dict[str, object], why: str) -> None:
    with pytest.raises((ParameterError, SynthesisError), match=why):
        replace(paper_task(), **changes)  # type: ignore[arg-type]


def test_impossible_parts() -> None:
    for make in (
        lambda: WeightedTerm(Term.POWER, -1.0),
        lambda: WeightedTerm(Term.POWER, float("nan")),
        lambda: Circle(0.0, 0.0, 0.0),
        lambda: Box(0.0, 0.0, 0.0, 1.0),
        lambda: Box(0.0, 0.0, float("nan"), 1.0),
        lambda: MachineModel(width_m=(0.1, 0.1, 0.1, -0.1)),
        lambda: MachineModel(rotor_inertia_kg_m2=(0.0, 1.0)),
        lambda: MachineModel(coulomb_velocity_rad_per_s=float("inf")),
    ):
        with pytest.raises(MechanismError):
            make()


def test_arrays_cannot_be_written_to() -> None:
    task = paper_task()
    with pytest.raises(ValueError, match="read-only"):
        task.x[0] = 1.0
    assert task.source == paper_curve().source
