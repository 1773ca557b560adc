"""A search in slices: the same result however it is cut, interrupted, kept in a file, or spread over workers."""

import json
from itertools import pairwise
from pathlib import Path

import pytest

from config.loading import load_config
from gateway.errors import UsageError
from gateway.synthesis.request import SynthesisRequest
from gateway.synthesis.run_search import SearchRun, SearchStatus, StartState
from gateway.synthesis.search_slice import Found, SearchSlice, _OpenSearches, run_slice
from gateway.synthesis.state_file import SavedSearch, read_state_file, saved_document, write_state_file
from gateway.synthesis.workers import InProcess, LocalProcesses, make_workers
from mechanism.synthesis.search import Method, search

PAPER = load_config("paper")
CURVE = Path(PAPER.relative("desired_path_36.csv"))


def settings(method=Method.DIFFERENTIAL_EVOLUTION, budget=2000, starts=2, **others):
    return SynthesisRequest(CURVE, PAPER, method, seed=5, budget=budget, starts=starts, **others).settings()


def essence(status):
    return [(s.seed, s.evaluations, s.best.variables, s.best.objective, s.is_finished) for s in status.starts]


def run(status, workers=None, **hooks):
    return SearchRun(status, workers or InProcess(), **hooks).run()


@pytest.fixture(scope="module")
def whole():
    return run(SearchStatus.beginning(settings()))


def test_every_start_is_a_search_of_its_own_seed(whole):
    for start in whole.starts:
        last = list(search(settings().task, Method.DIFFERENTIAL_EVOLUTION, start.seed, 2000, report_every=7))[-1]
        assert last.finished
        assert start.best.variables == tuple(last.best.variables.tolist())
        assert start.best.objective == last.best.objective
    assert [start.seed for start in whole.starts] == [5, 6]
    assert whole.best.objective == min(start.best.objective for start in whole.starts)


def test_improvements_fall_and_end_at_the_best(whole):
    for start in whole.starts:
        evaluations, values = zip(*start.improvements, strict=True)
        assert list(evaluations) == sorted(evaluations)
        assert all(a > b for a, b in pairwise(values))
        assert values[-1] == start.best.objective


@pytest.mark.parametrize("method", [Method.PAPER, Method.DIFFERENTIAL_EVOLUTION])
def test_an_interrupted_search_goes_on_from_its_file_to_the_same_result(method, tmp_path):
    wanted = run(SearchStatus.beginning(settings(method)))
    status = SearchStatus.beginning(settings(method))
    interruptions = 0
    while not status.is_finished:
        before = status.evaluations
        asked = iter([False, False, True])
        part = run(status, is_stopping=lambda asked=asked: next(asked))
        path = tmp_path / "s.resume.json"
        write_state_file(path, SavedSearch(part, PAPER.text))
        status = read_state_file(path).status
        assert status.evaluations > before
        interruptions += 1
    assert interruptions >= 3
    assert essence(status) == essence(wanted)
    assert [s.improvements[-1] for s in status.starts] == [s.improvements[-1] for s in wanted.starts]


def test_a_slice_is_the_same_from_a_saved_state_and_from_the_open_search():
    task = settings().task
    first = run_slice(SearchSlice(task, Method.DIFFERENTIAL_EVOLUTION, 0, 5, 2000, None, None, 400))
    again = SearchSlice(task, Method.DIFFERENTIAL_EVOLUTION, 0, 5, 2000, None, first.state, 400)
    # The first of these goes on with the open search, the second has to take up the state.
    one, other = run_slice(again), run_slice(again)
    assert one.state == other.state
    assert one.best.variables == other.best.variables
    assert one.evaluations == other.evaluations > first.evaluations


@pytest.mark.parametrize("method", [Method.PAPER, Method.DIFFERENTIAL_EVOLUTION])
def test_processes_that_know_nothing_of_each_other_bring_a_search_to_its_end(method, monkeypatch):
    """No slice may end within the local improvement, which a saved state begins anew: it would never end."""
    monkeypatch.setattr(_OpenSearches, "keep", lambda *_: None)
    one = settings(method, starts=1)
    state, slices = None, 0
    while slices < 30:
        result = run_slice(SearchSlice(one.task, method, 0, 5, one.budget, None, state, one.slice_evaluations))
        state, slices = result.state, slices + 1
        if result.is_finished:
            break
    assert result.is_finished
    assert slices > 3
    assert result.best.variables == run(SearchStatus.beginning(one)).best.variables


def test_a_file_keeps_everything(whole, tmp_path):
    path = tmp_path / "s.json"
    write_state_file(path, SavedSearch(whole, "text of a template", is_speed_fixed=True))
    back = read_state_file(path)
    assert (back.template, back.is_speed_fixed) == ("text of a template", True)
    assert saved_document(back) == saved_document(SavedSearch(whole, "text of a template", is_speed_fixed=True))


def test_a_task_with_everything_in_it_comes_back_whole(tmp_path):
    loop = tmp_path / "loop.csv"
    loop.write_text("x_mm,y_mm,tolerance_mm\n10,0,1\n0,10,1\n-10,0,1\n0,-10,2\n5,-5,1\n")
    rich = SynthesisRequest(
        loop,
        PAPER,
        Method.CMA_ES,
        keep_out=("circle:100,50,30", "box:0,-80,60,-20"),
        weights=("power=3", "servo-velocity=0"),
        bounds=("p=5:20",),
        population=12,
    ).settings()
    path = tmp_path / "s.json"
    write_state_file(path, SavedSearch(SearchStatus.beginning(rich), "t"))
    back = read_state_file(path).status.settings
    for name in ("terms", "timing", "keep_out", "machine", "speed_rad_per_s", "harmonics", "minimum_sine", "source"):
        assert getattr(back.task, name) == getattr(rich.task, name)
    for name in ("x", "y", "tolerances"):
        assert getattr(back.task, name).tolist() == getattr(rich.task, name).tolist()
    assert back.task.theta2 is None
    assert back.task.bounds.lower.tolist() == rich.task.bounds.lower.tolist()
    assert (back.method, back.seed, back.budget, back.starts, back.population) == (Method.CMA_ES, 0, 20_000, 4, 12)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda text: text[:-40], "truncated or no file of an interrupted search"),
        (lambda text: "[]", "no file of an interrupted search (its format is not"),
        (lambda text: text.replace('"budget": 2000', '"budget": 2001'), "its checksum is wrong"),
        (lambda text: text.replace('"version": 1', '"version": 2'), "version 2, only 1 is known"),
        (lambda text: text.replace('"seed": 5', '"seed": NaN'), "truncated or no file"),
    ],
)
def test_a_file_that_is_not_whole_is_refused(whole, tmp_path, change, sentence):
    text = json.dumps(saved_document(SavedSearch(whole, "t")))
    changed = change(text)
    assert changed != text
    path = tmp_path / "s.json"
    path.write_text(changed)
    with pytest.raises(UsageError) as refusal:
        read_state_file(path)
    assert sentence in str(refusal.value)


def test_a_front_has_nobody_that_is_beaten():
    """Terms in the order of `Term`; equal weights. (1, 5) and (5, 1) stand, (5, 5) is beaten, twins count once."""
    two = settings(
        weights=("structural-error=1", "mobility=0", "swept-area=1", "harmonic-content=0"), method=Method.PAPER
    )
    founds = [Found((float(i),), terms, 0.0) for i, terms in enumerate([(5, 9, 1, 0), (5, 0, 5, 0), (1, 3, 5, 0)])]
    twin = Found((9.0,), (5, 0, 1, 0), 0.0)
    status = SearchStatus(two, (StartState(5, front=tuple(founds)), StartState(6, front=(twin,))))
    assert [found.variables for found in status.front()] == [(2.0,), (0.0,)]


def test_a_mechanism_that_cannot_move_is_no_best_while_another_start_has_one_that_can():
    paper = settings(method=Method.PAPER)
    stuck, sound = Found((1.0,), (0, 27, 10, 0), 34.5), Found((2.0,), (0, 0, 80, 0), 60.0)
    starts = (StartState(5, best=stuck), StartState(6, best=sound), StartState(7))
    assert SearchStatus(paper, starts).best is sound
    assert SearchStatus(paper, (starts[0], starts[2])).best is stuck
    assert SearchStatus(paper, (starts[2],)).best is None


def test_worker_numbers_and_addresses():
    for count, address, sentence in (
        (0, None, "--workers 0, bound 1 to 256"),
        (257, None, "--workers 257, bound 1 to 256"),
        (2, "tcp://127.0.0.1:1", "--workers and --dask exclude each other"),
    ):
        with pytest.raises(UsageError, match=sentence):
            make_workers(count, address)
    with pytest.raises(UsageError, match="an address looks like tcp://"):
        make_workers(1, "127.0.0.1:8786")()


@pytest.mark.slow
def test_two_processes_find_what_one_does_and_one_that_dies_costs_nothing_but_time(whole):
    import os
    import signal

    workers = LocalProcesses(2)
    killed: list[int] = []

    def kill_once(status):
        if not killed:
            killed.append(workers.process_ids[0])
            os.kill(killed[0], signal.SIGKILL)

    try:
        status = run(SearchStatus.beginning(settings()), workers, on_progress=kill_once)
    finally:
        workers.close()
    assert killed
    assert essence(status) == essence(whole)
