"""What a user types for a synthesis, and what becomes of it."""

from pathlib import Path

import numpy as np
import pytest

from config.loading import load_config
from gateway.cli.synthesis_commands import MethodName, TimingName
from gateway.errors import UsageError
from gateway.synthesis.machine_files import machine_model
from gateway.synthesis.request import DEFAULT_BUDGET, DEFAULT_STARTS, SynthesisRequest, TimingChoice
from gateway.synthesis.task_options import bounds_with, default_weights, keep_out_zones, weighted_terms
from mechanism.synthesis.search import Method
from mechanism.synthesis.task import PAPER_TERMS, Bounds, Box, Circle, Term, Timing, Variable

PAPER = load_config("paper")
CURVE = Path(PAPER.relative("desired_path_36.csv"))
BASE = Bounds(np.array([0.1, 0.1, 0.1, 0.1, -1, -1, -1, -1.0]), np.ones(8))


def weights(*texts, method=Method.PAPER):
    terms = weighted_terms(texts, default_weights(method, Timing.PRESCRIBED, False))
    return {entry.term: entry.weight for entry in terms}


def test_the_papers_method_weighs_as_the_paper_does():
    assert weights() == {entry.term: entry.weight for entry in PAPER_TERMS}


def test_weights_change_and_add_terms_in_the_order_of_terms():
    changed = weights("peak-torque=20, swept-area=0", "mobility=2e3")
    assert changed[Term.PEAK_TORQUE] == 20.0
    assert changed[Term.SWEPT_AREA] == 0.0
    assert changed[Term.MOBILITY] == 2000.0
    assert changed[Term.STRUCTURAL_ERROR] == 1.0
    assert [term for term in Term if term in changed] == list(changed)
    assert Term.HARMONIC_CONTENT not in weights("harmonic-content=off")


def test_zones_and_free_timing_bring_their_terms():
    assert Term.KEEP_OUT in default_weights(Method.CMA_ES, Timing.PRESCRIBED, True)
    assert Term.TIMING in default_weights(Method.PAPER, Timing.FREE, False)
    assert Term.KEEP_OUT not in default_weights(Method.CMA_ES, Timing.FREE, False)


def test_bounds_are_in_millimetres_and_a_single_number_holds_a_variable():
    bounds = bounds_with(("p=50:200,cv_pivot_x=0", "servo-pivot-y=-10:20"), BASE)
    assert (bounds.lower[Variable.P], bounds.upper[Variable.P]) == pytest.approx((0.05, 0.2))
    assert bounds.lower[Variable.CV_PIVOT_X] == bounds.upper[Variable.CV_PIVOT_X] == 0.0
    assert bounds.lower[Variable.SERVO_PIVOT_Y] == pytest.approx(-0.01)
    assert bounds.upper[Variable.Q] == 1.0
    assert BASE.lower[Variable.P] == 0.1


def test_zones_are_in_millimetres_and_a_box_has_any_two_corners():
    assert keep_out_zones(("circle:100,50,30", "box:60,-20,0,-80")) == (
        Circle(0.1, 0.05, 0.03),
        Box(0.0, -0.08, 0.06, -0.02),
    )


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda: weights("weight=3"), "--weights: weight is no term (there are: structural-error, mobility,"),
        (lambda: weights("mobility"), "--weights: 'mobility' is not NAME=VALUE"),
        (lambda: weights("mobility=-1"), "--weights: mobility is -1, bound 0 to 1e12"),
        (lambda: weights("mobility=nan"), "--weights: mobility: nan is not finite"),
        (lambda: weights("mobility=much"), "--weights: mobility: 'much' is not a number"),
        (
            lambda: weights("structural-error=0,mobility=0,swept-area=0,harmonic-content=0"),
            "--weights: every term has weight 0, at least one must be positive",
        ),
        (lambda: bounds_with(("t=1",), BASE), "--bounds: t is no variable (there are: p, q, r, s, cv_pivot_x,"),
        (lambda: bounds_with(("p=5:1",), BASE), "--bounds: the bounds of P is 5 to 1 mm, but must be in rising order"),
        (lambda: bounds_with(("p=0:1",), BASE), "--bounds: the bounds of P is 0 to 1 mm, but must be positive"),
        (lambda: keep_out_zones(("disc:1,2,3",)), "--keep-out: 'disc:1,2,3' is neither circle:X,Y,RADIUS nor box:"),
        (lambda: keep_out_zones(("circle:1,2",)), "--keep-out: 'circle:1,2' is neither"),
        (lambda: keep_out_zones(("circle:1,2,-3",)), "--keep-out: a keep-out circle is"),
        (lambda: keep_out_zones(("circle:0,0,1",) * 33), "--keep-out: 33 zones, bound 32"),
    ],
)
def test_what_is_no_option_is_told_in_a_sentence(call, sentence):
    with pytest.raises(UsageError) as refusal:
        call()
    assert sentence in str(refusal.value)


def test_the_command_lines_names_are_the_programs():
    assert {name.value for name in MethodName} == {method.value for method in Method}
    assert {name.value for name in TimingName} == {choice.value for choice in TimingChoice}
    assert set(DEFAULT_BUDGET) == set(DEFAULT_STARTS) == set(Method)


def test_a_request_becomes_a_task():
    settings = SynthesisRequest(
        curve=CURVE, template=PAPER, method=Method.PAPER, generations=30, tolerance_mm=0.2, speed_rpm=30.0
    ).settings()
    task = settings.task
    assert settings.budget == 30 * 40
    assert settings.starts == 8
    assert task.count == 36
    assert task.tolerances is not None
    assert task.tolerances.tolist() == pytest.approx([0.0002] * 36)
    assert task.speed_rad_per_s == pytest.approx(np.pi)
    assert task.timing is Timing.PRESCRIBED
    assert task.minimum_sine == PAPER.machine.minimum_transmission_sine


def test_a_curve_without_angles_is_timed_by_the_search_or_evenly(tmp_path):
    path = tmp_path / "loop.csv"
    path.write_text("x_mm,y_mm\n10,0\n0,10\n-10,0\n0,-10\n5,-5\n")
    assert SynthesisRequest(path, PAPER, Method.CMA_ES).settings().task.timing is Timing.FREE
    even = SynthesisRequest(path, PAPER, Method.CMA_ES, timing=TimingChoice.EVEN).settings().task
    assert even.timing is Timing.PRESCRIBED
    assert even.theta2 is not None
    assert even.theta2[1] == pytest.approx(2 * np.pi / 5)
    with pytest.raises(UsageError, match="has no theta2_deg to prescribe"):
        SynthesisRequest(path, PAPER, Method.CMA_ES, timing=TimingChoice.PRESCRIBED).settings()


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"budget": 600, "generations": 3}, "--budget and --generations say the same thing"),
        ({"generations": 0}, "--generations 0, bound 1 or more"),
        ({"budget": 10}, "--budget 10, bound 500 to"),
        ({"starts": 0}, "--starts 0, bound 1 to 1024"),
        ({"seed": -1}, "--seed -1, bound 0 to"),
        ({"tolerance_mm": -0.1}, "--tolerance -0.1, bound 0 or more"),
        ({"speed_rpm": 0.0}, "--speed-rpm 0.0, bound above 0 to 133.7"),
        ({"speed_rpm": 200.0}, "--speed-rpm 200.0, bound above 0 to 133.7"),
    ],
)
def test_numbers_out_of_their_bounds(changes, sentence):
    with pytest.raises(UsageError) as refusal:
        SynthesisRequest(CURVE, PAPER, Method.DIFFERENTIAL_EVOLUTION, **changes).settings()
    assert sentence in str(refusal.value)


def test_the_references_links_are_taken_apart_into_bars_and_end_masses():
    """p: 150 x 40 x 10 mm of steel (0.471 kg) with 125 g at its end; q, r, s: aluminium, 12 g at the end of s."""
    model = machine_model(PAPER)
    assert model.linear_density_kg_per_m == pytest.approx((3.14, 0.162, 0.162, 0.162))
    assert model.end_mass_kg == pytest.approx((0.125, 0.0, 0.0, 0.012), abs=1e-12)
    link = model.link(0, 0.150)
    assert (link.mass_kg, link.com_m) == pytest.approx((0.596, 0.09072986577181207))
    # Twice as long: the bar doubles, the end mass stays: (0.942 x 0.15 + 0.125 x 0.3) / 1.067.
    assert model.link(0, 0.300).com_m == pytest.approx((0.942 * 0.15 + 0.125 * 0.3) / 1.067)
