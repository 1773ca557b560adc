"""The methods: seeded, the same wherever the terms are evaluated and however often interrupted; and what they find."""

import sys
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
from synthesis_samples import (
    NEAR_BOUNDS,
    PAPER_LINKS,
    TRACED_TERMS,
    known_mechanism,
    known_task,
    paper_curve,
    paper_task,
)

from mechanism.cam import CamLimits, compile_cam
from mechanism.errors import ParameterError, SynthesisError
from mechanism.synthesis.candidate import Candidate
from mechanism.synthesis.crank_dyads import (
    CRANK_VARIABLES,
    algebraic_crank,
    radial_errors,
    seeded_population,
    suitable_cranks,
)
from mechanism.synthesis.evolution_kernels import UNIFORM_DRAWS, make_trials
from mechanism.synthesis.genetic_kernels import BITS, DRAWS, STRING, breed, decode, scale_fitness
from mechanism.synthesis.ledger import Ledger
from mechanism.synthesis.objective import evaluate, weighted_sum
from mechanism.synthesis.pareto import PARETO_TERMS
from mechanism.synthesis.run import Run
from mechanism.synthesis.search import Method, Phase, Progress, search
from mechanism.synthesis.state import pack, unpack
from mechanism.synthesis.task import Bounds, SynthesisTask, Term, Timing, WeightedTerm

BUDGET = 1000


def task_for(method: Method) -> SynthesisTask:
    return replace(paper_task(), terms=PARETO_TERMS) if method is Method.PARETO else paper_task()


def last(steps: Iterator[Progress]) -> Progress:
    *_, progress = steps
    assert progress.finished
    return progress


def assert_same(first: Progress, second: Progress) -> None:
    assert first.evaluations == second.evaluations
    np.testing.assert_array_equal(first.best.variables, second.best.variables)
    np.testing.assert_array_equal(first.best.terms, second.best.terms)
    assert first.best.objective == second.best.objective
    assert len(first.front) == len(second.front)
    for one, other in zip(first.front, second.front, strict=True):
        np.testing.assert_array_equal(one.variables, other.variables)


@pytest.mark.parametrize("method", list(Method))
def test_a_seed_gives_one_result(method: Method) -> None:
    task = task_for(method)
    first = last(search(task, method, 3, BUDGET))
    # How often it reports changes nothing, nor what others have drawn from numpy's global generator.
    np.random.seed(5)
    assert_same(first, last(search(task, method, 3, BUDGET, report_every=7)))
    other = last(search(task, method, 4, BUDGET))
    assert not np.array_equal(first.best.variables, other.best.variables)
    assert first.evaluations <= BUDGET
    assert first.phase is Phase.POLISH


@pytest.mark.parametrize("method", list(Method))
def test_who_evaluates_changes_nothing(method: Method) -> None:
    task = task_for(method)
    sizes: list[int] = []

    def elsewhere(population: np.ndarray) -> np.ndarray:
        sizes.append(population.shape[0])
        middle = population.shape[0] // 2
        return np.concatenate((evaluate(task, population[:middle]), evaluate(task, population[middle:])))

    progress = last(search(task, method, 3, BUDGET, evaluate_population=elsewhere))
    assert_same(last(search(task, method, 3, BUDGET)), progress)
    # What is left are the crank dyads, whose error is not a mechanism's evaluation.
    assert 0.5 * progress.evaluations < sum(sizes) <= progress.evaluations


@pytest.mark.parametrize("method", list(Method))
@pytest.mark.parametrize("steps", [2, 10_000])
def test_an_interrupted_search_comes_to_the_same(method: Method, steps: int) -> None:
    task = task_for(method)
    whole = last(search(task, method, 11, BUDGET))
    begun = search(task, method, 11, BUDGET)
    state = b""
    for progress in islice(begun, steps):
        state = progress.state
    begun.close()  # type: ignore[attr-defined]
    calls: list[int] = []

    def counted(population: np.ndarray) -> np.ndarray:
        calls.append(population.shape[0])
        return evaluate(task, population)

    # Twice, so that what is saved after going on is whole as well.
    again = search(task, method, 11, BUDGET, state=state, evaluate_population=counted)
    state = next(again).state
    again.close()  # type: ignore[attr-defined]
    resumed = last(search(task, method, 11, BUDGET, state=state, evaluate_population=counted))
    assert_same(whole, resumed)
    # And it is not simply done again.
    assert sum(calls) < whole.evaluations


def test_a_state_is_for_one_search_only() -> None:
    task = paper_task()
    state = next(search(task, Method.PAPER, 1, BUDGET)).state
    for other, method, seed, budget in (
        (paper_task(12), Method.PAPER, 1, BUDGET),
        (task, Method.DIFFERENTIAL_EVOLUTION, 1, BUDGET),
        (task, Method.PAPER, 2, BUDGET),
        (task, Method.PAPER, 1, BUDGET + 1),
        (replace(task, minimum_sine=0.2), Method.PAPER, 1, BUDGET),
    ):
        with pytest.raises(SynthesisError, match="belongs to another search"):
            search(other, method, seed, budget, state=state)


@pytest.mark.parametrize("cut", [0, 10, 60, -8])
def test_a_damaged_state_is_refused(cut: int) -> None:
    state = next(search(paper_task(), Method.PAPER, 1, BUDGET)).state
    with pytest.raises(SynthesisError, match="the saved state is"):
        search(paper_task(), Method.PAPER, 1, BUDGET, state=state[:cut])


def test_state_packs_what_it_is_given() -> None:
    arrays = {"b": np.arange(6.0).reshape(2, 3), "a": np.arange(4), "empty": np.zeros((0, 8))}
    header, back = unpack(pack({"x": [1, 2**100]}, arrays))
    assert header == {"x": [1, 2**100]}
    for name, array in arrays.items():
        np.testing.assert_array_equal(back[name], array)
        assert back[name].dtype == array.dtype


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"budget": 499}, "the budget is 499, but must be 500 to"),
        ({"seed": -1}, "the seed is -1"),
        ({"population": 3}, "the population is 3"),
        ({"population": 5000}, "the population is 5000, but must be at most 800"),
        ({"report_every": 0}, "report_every is 0"),
    ],
)
def test_impossible_settings_of_a_search(changes: dict[str, int], why: str) -> None:
    settings = {"seed": 1, "budget": BUDGET, **changes}
    with pytest.raises(ParameterError, match=why):
        search(paper_task(), Method.PAPER, **settings)  # type: ignore[arg-type]


def test_an_odd_population_is_none_for_the_papers_method() -> None:
    with pytest.raises(ParameterError, match="but must be even"):
        next(search(paper_task(), Method.PAPER, 1, BUDGET, population=41))


def test_terms_of_another_shape_are_refused() -> None:
    with pytest.raises(SynthesisError, match=r"an array of shape \(40, 3\), expected \(40, 4\)"):
        next(search(paper_task(), Method.PAPER, 1, BUDGET, evaluate_population=lambda p: np.zeros((p.shape[0], 3))))


@pytest.mark.parametrize(("method", "package"), [(Method.CMA_ES, "cma"), (Method.PARETO, "pymoo.algorithms.moo.nsga2")])
def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch, method: Method, package: str) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(SynthesisError, match=f"needs the package {package.split('.')[0]}"):
        next(search(task_for(method), method, 1, BUDGET))


def test_a_better_method_finds_a_better_mechanism_than_the_papers_links() -> None:
    task = paper_task()
    links = weighted_sum(task, evaluate(task, PAPER_LINKS))[0]
    best = last(search(task, Method.DIFFERENTIAL_EVOLUTION, 1, 10_000, report_every=1000)).best
    assert best.objective < 0.5 * links
    assert best.value(Term.MOBILITY) == 0.0
    assert NEAR_BOUNDS.contains(best.variables)


def test_polishing_never_loses() -> None:
    task = paper_task()
    before = after = np.inf
    for progress in search(task, Method.PAPER, 2, 5000):
        assert progress.best.objective <= after
        after = progress.best.objective
        before = after if progress.phase is Phase.SEARCH else before
    assert after < before


def test_no_feasible_mechanism_names_the_term() -> None:
    """Links r and s of at most 60 mm whose pivot is half a metre away cannot close anywhere."""
    lower, upper = NEAR_BOUNDS.lower.copy(), NEAR_BOUNDS.upper.copy()
    lower[2:4], upper[2:4] = 0.05, 0.06
    lower[6:8], upper[6:8] = 0.8, 0.9
    best = last(
        search(replace(paper_task(), bounds=Bounds(lower, upper)), Method.DIFFERENTIAL_EVOLUTION, 1, BUDGET)
    ).best
    with pytest.raises(SynthesisError, match=r"mobility cannot be met .* in 36 positions") as error:
        best.require_feasible()
    assert error.value.term == Term.MOBILITY.value


def test_a_tolerance_that_cannot_be_met_is_named() -> None:
    """A crank held at 50 mm cannot follow: the error is what is left, and counts only where tolerances are given."""
    lower, upper = NEAR_BOUNDS.lower.copy(), NEAR_BOUNDS.upper.copy()
    lower[0] = upper[0] = 0.05
    task = replace(paper_task(), bounds=Bounds(lower, upper), tolerances=np.full(36, 0.0005))
    best = last(search(task, Method.DIFFERENTIAL_EVOLUTION, 1, BUDGET)).best
    assert best.value(Term.MOBILITY) == 0.0
    with pytest.raises(
        SynthesisError, match=r"structural error cannot be met \(point \d+, theta2 = .*tolerance 0.500 mm"
    ) as error:
        best.require_feasible()
    assert error.value.term == Term.STRUCTURAL_ERROR.value
    Candidate(replace(task, tolerances=None), best.variables, best.terms, best.objective).require_feasible()


def test_free_cranks_stand_where_they_can_go_round() -> None:
    """Of the seeded quarter, q + p and q - p are the curve's greatest and least distance from the pivot."""
    task = replace(known_task(0), timing=Timing.FREE, theta2=None)
    run = Run(task, Ledger(task, lambda rows: evaluate(task, rows), 1000), 1, 800, True, None, 1, None)
    rows = run.spread(seeded_population(run, np.random.default_rng(1), 40))[:10]
    distance = np.hypot(task.x - rows[:, 4:5], task.y - rows[:, 5:6])
    np.testing.assert_allclose(rows[:, 0] + rows[:, 1], distance.max(axis=1), rtol=1e-9)
    np.testing.assert_allclose(rows[:, 1] - rows[:, 0], distance.min(axis=1), rtol=1e-9)
    error = evaluate(task, rows)[:, 0]
    np.testing.assert_allclose(error, 0.0, atol=1e-9)


def test_held_variables_stay() -> None:
    lower, upper = NEAR_BOUNDS.lower.copy(), NEAR_BOUNDS.upper.copy()
    for index in (4, 5, 7):
        lower[index] = upper[index] = 0.0
    for method in (Method.PAPER, Method.DIFFERENTIAL_EVOLUTION, Method.CMA_ES):
        best = last(search(replace(paper_task(), bounds=Bounds(lower, upper)), method, 1, BUDGET)).best
        assert best.variables[[4, 5, 7]].tolist() == [0.0, 0.0, 0.0]


def test_the_front_has_nothing_that_another_beats() -> None:
    progress = last(search(task_for(Method.PARETO), Method.PARETO, 1, 2500, report_every=10))
    values = np.array([[c.value(e.term) for e in PARETO_TERMS] for c in progress.front])
    assert len(progress.front) > 5
    # Mobility and singularity are constraints.
    assert np.all(values[:, [1, 2]] == 0.0)
    weighed = values[:, [0, 3, 4]]
    for row in weighed:
        assert not np.any(np.all(weighed <= row, axis=1) & np.any(weighed < row, axis=1))


def test_a_front_needs_two_terms() -> None:
    task = replace(paper_task(), terms=(WeightedTerm(Term.POWER), WeightedTerm(Term.MOBILITY)))
    with pytest.raises(SynthesisError, match="at least two terms"):
        next(search(task, Method.PARETO, 1, BUDGET))


@pytest.mark.parametrize("seed", range(8))
def test_algebra_gives_a_traced_curves_crank_back(seed: int) -> None:
    five_bar, curve = known_mechanism(seed)
    task = SynthesisTask.from_curve(curve, terms=TRACED_TERMS)
    crank = algebraic_crank(task)
    assert crank is not None
    np.testing.assert_allclose(crank, [five_bar.p, five_bar.q, *five_bar.cv_pivot], atol=1e-7)


def test_cranks_of_a_curve_that_none_traces_are_the_least_squares() -> None:
    """An ellipse run through with the crank's angle: no small change of p, q or pivot is better."""
    theta2 = np.arange(36) * np.pi / 18
    task = SynthesisTask(
        theta2=theta2,
        x=0.2 * np.cos(theta2 + 0.5),
        y=0.3 + 0.1 * np.sin(theta2),
        bounds=NEAR_BOUNDS,
        terms=TRACED_TERMS,
    )
    cranks, evaluations = suitable_cranks(task, np.random.default_rng(1))
    assert evaluations > 0
    best = cranks[0]
    cost = float(np.sum(radial_errors(task, best) ** 2))
    columns = list(CRANK_VARIABLES)
    for k in range(4):
        for change in (-1e-4, 1e-4):
            other = np.clip(best + change * np.eye(4)[k], task.bounds.lower[columns], task.bounds.upper[columns])
            assert float(np.sum(radial_errors(task, other) ** 2)) >= cost - 1e-15


@pytest.mark.parametrize("seed", range(2))
def test_a_known_mechanisms_curve_is_met_again(seed: int) -> None:
    task = known_task(seed)
    best = last(search(task, Method.DIFFERENTIAL_EVOLUTION, seed, 10_000, report_every=1000)).best
    best.require_feasible()
    assert float(np.max(best.servo_motion().structural_error)) < 1e-6 * task.size_m


def test_free_timing_finds_a_mechanism() -> None:
    task = known_task(1, Timing.FREE)
    best = last(search(task, Method.DIFFERENTIAL_EVOLUTION, 1, 10_000, report_every=1000)).best
    best.require_feasible()
    assert np.all(np.diff(best.curve().theta2) > 0.0)
    assert float(np.max(best.servo_motion().structural_error)) < 1e-6 * task.size_m


@pytest.mark.parametrize("timing", list(Timing))
def test_what_is_found_compiles_into_a_cam(timing: Timing) -> None:
    """Under its real torque and transmission angle the paper's curve leads near the paper's links again."""
    faults = (Term.MOBILITY, Term.SINGULARITY) + ((Term.TIMING,) if timing is Timing.FREE else ())
    wanted = ((Term.STRUCTURAL_ERROR, 1.0), (Term.TRANSMISSION_ANGLE, 100.0), (Term.PEAK_TORQUE, 10.0))
    terms = tuple(WeightedTerm(*pair) for pair in (*wanted, *((term, 1e4) for term in faults)))
    task = replace(paper_task(), terms=terms, timing=timing)
    best = last(search(task, Method.DIFFERENTIAL_EVOLUTION, 1, 10_000, report_every=1000)).best
    best.require_feasible()
    compile_cam(best.curve(), best.five_bar(), CamLimits(50.0, 5000.0, structural_error_m=5e-4), 6.0).require()
    if timing is Timing.PRESCRIBED:
        np.testing.assert_allclose(best.variables[:4], PAPER_LINKS[:4], atol=0.03)
    links = evaluate(task, PAPER_LINKS)
    assert best.terms[1] < links[0, 1]
    assert best.objective < weighted_sum(task, links)[0]


def test_strings_decode_from_bound_to_bound() -> None:
    codes = np.array([[0] * 8, [2**BITS - 1] * 8, [341] * 8])
    population = np.empty((3, 8))
    decode(codes, np.full(8, -1.0), np.full(8, 2.0), population)
    np.testing.assert_allclose(population[:, 0], [-1.0, 2.0, 0.0])


def test_fitness_keeps_its_average_and_gives_the_best_twice_of_it() -> None:
    """Objectives 1, 2, 4, 4 have reciprocals 1, 1/2, 1/4, 1/4 of mean 1/2: the line through (1/2, 1/2) and (1, 1)."""
    fitness = np.empty(4)
    scale_fitness(np.array([1.0, 2.0, 4.0, 4.0]), fitness)
    np.testing.assert_allclose(fitness, [1.0, 0.5, 0.25, 0.25])
    # 1, 1/2, 1/2 have mean 2/3: the least would come to 1/3 at twice the mean for the best.
    three = np.empty(3)
    scale_fitness(np.array([1.0, 2.0, 2.0]), three)
    np.testing.assert_allclose(three, [4.0 / 3.0, 1.0 / 3.0, 1.0 / 3.0])
    # 1, 1, 1/2: now it would fall below 0, so the line is laid through 0 there and the best get less.
    scale_fitness(np.array([1.0, 1.0, 2.0]), three)
    np.testing.assert_allclose(three, [1.25, 1.25, 0.0])
    scale_fitness(np.array([3.0, 3.0, np.inf]), three)
    assert three[2] == 0.0
    scale_fitness(np.full(3, np.inf), three)
    assert np.all(three == 1.0)


def bits_of(codes: np.ndarray) -> str:
    return "".join(f"{int(code):0{BITS}b}" for code in codes)


def test_children_are_cut_and_flipped_where_the_draws_say() -> None:
    ones, zeros = 2**BITS - 1, 0
    codes = np.array([[ones] * 8, [zeros] * 8])
    fitness = np.array([1.0, 3.0])
    draws = np.ones((1, DRAWS))
    # The wheel: the first quarter is the mother of ones, the rest the father of zeros.
    draws[0, :4] = 0.24, 0.26, 0.84, 0.5
    children = np.empty_like(codes)
    breed(codes, fitness, draws, 0.85, 0.03, children)
    cut = 1 + int(0.5 * (STRING - 1))
    assert bits_of(children[0]) == "1" * cut + "0" * (STRING - cut)
    assert bits_of(children[1]) == "0" * cut + "1" * (STRING - cut)
    # No crossover at 0.85 and above; one bit of each child flips.
    draws[0, 2] = 0.85
    draws[0, 4 + 3 * BITS] = 0.029
    draws[0, 4 + STRING + 7 * BITS + 9] = 0.029
    breed(codes, fitness, draws, 0.85, 0.03, children)
    assert children[0].tolist() == [ones] * 3 + [ones - 1] + [ones] * 4
    assert children[1].tolist() == [zeros] * 7 + [2**9]


def test_trials_are_made_as_the_draws_say() -> None:
    """Three members and one archived: best, partners, rate and scale are those of the draws, worked out by hand."""
    unit = np.array([[0.2] * 8, [0.4] * 8, [0.9] * 8])
    archive = np.array([[0.5] * 8])
    memory = np.array([[0.5, -1.0], [0.5, 0.5]])
    uniform = np.full((3, UNIFORM_DRAWS), 0.999)
    # Member 0: slot 0 (rate 0.5), best of two is the first of the order (2), partner 1 (the first that is not itself),
    # second partner the last of the pool, which is the archive; the sure variable is the last, the first is taken too.
    uniform[0, :4] = 0.0, 0.0, 0.0, 0.999
    uniform[0, 5] = 0.49
    # Member 1: slot 1, whose rate is 0 for good; best is the other of two (0), partner 2, second the other member, 0.
    uniform[1, :5] = 0.999, 0.999, 0.999, 0.0, 0.0
    trials, rates, scales = np.empty((3, 8)), np.empty(3), np.empty(3)
    order = np.array([2, 0, 1])
    make_trials(
        unit, order, archive, memory, uniform, np.zeros(3), np.array([0.0, -9.0, 99.0]), 0.7, trials, rates, scales
    )
    np.testing.assert_allclose(rates, [0.5, 0.0, 0.0])
    np.testing.assert_allclose(scales, [0.5, 0.4, 1.0])
    # 0.2 + 0.5 (0.9 - 0.2) + 0.5 (0.4 - 0.5) = 0.5
    np.testing.assert_allclose(trials[0], [0.5] + [0.2] * 6 + [0.5])
    # 0.4 + 0.4 (0.2 - 0.4) + 0.4 (0.9 - 0.2) = 0.6
    np.testing.assert_allclose(trials[1], [0.6] + [0.4] * 7)
    # Member 2: best 0, partner 1, second 3 (archive): 0.9 - 0.7 - 0.1 = 0.1.
    np.testing.assert_allclose(trials[2], [0.9] * 7 + [0.1])
    assert np.all((trials >= 0.0) & (trials <= 1.0))


def test_the_shipped_curve_is_the_papers() -> None:
    assert paper_curve(360).theta2.size == 360
