"""From a wanted curve to a machine that runs: the command, its files, its report, and what it says of bad input."""

import json
import os
import re
import signal
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from config.conversion import desired_curve, dynamics_parameters
from config.loading import load_config
from gateway.cli import main
from gateway.synthesis.machine_files import machine_model, write_machine
from gateway.synthesis.request import SynthesisRequest
from gateway.synthesis.run_search import SearchStatus
from gateway.synthesis.session import SynthesisSession
from gateway.synthesis.state_file import read_state_file
from gateway.synthesis.workers import InProcess
from mechanism.curve import load_curve_csv
from mechanism.dynamics import Dynamics
from mechanism.five_bar import FiveBar
from mechanism.synthesis.candidate import Candidate
from mechanism.synthesis.search import Method
from mechanism.synthesis.task import PAPER_TERMS, SynthesisTask

PAPER = load_config("paper")
CURVE = PAPER.relative("desired_path_36.csv")
POINTS = CURVE.read_text()
QUICK = ("--budget", "6000", "--starts", "1", "--no-report")


@pytest.fixture
def run(monkeypatch, capsys, tmp_path):
    """Run the command line in an empty folder; returns (exit status, stdout, stderr)."""
    monkeypatch.chdir(tmp_path)

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["drive-gateway", *map(str, arguments)])
        with pytest.raises(SystemExit) as end:
            main()
        captured = capsys.readouterr()
        assert "Traceback" not in captured.err
        return end.value.code, captured.out, captured.err

    return call


def test_what_is_found_goes_straight_into_check_and_compile(run):
    status, out, _ = run("synthesize", CURVE, "-o", "m.yaml", *QUICK, "--json")
    assert status == 0
    document = json.loads(out)
    assert document["is_runnable"] is True
    assert document["evaluations"] <= 6000
    machine = load_config("m.yaml")
    # The machine is the mechanism that the search reports, in nanometres, and its curve is the one wanted.
    assert machine.machine.five_bar.p_mm == document["variables"]["p_mm"]
    assert machine.machine.five_bar.servo_pivot_mm[1] == document["variables"]["servo_pivot_y_mm"]
    wanted, written = load_curve_csv(CURVE), desired_curve(machine)
    assert written.points == pytest.approx(wanted.points, abs=1e-12)
    assert written.theta2 == pytest.approx(wanted.theta2, abs=1e-10)
    # All points lie on q's circle, whose crank turns about the CV pivot; worked from the file alone.
    bar = machine.machine.five_bar
    crank = np.array(bar.cv_pivot_mm) + bar.p_mm * np.stack((np.cos(wanted.theta2), np.sin(wanted.theta2)), axis=1)
    distance = np.hypot(*(wanted.points * 1e3 - crank).T)
    assert np.abs(distance - bar.q_mm).max() == pytest.approx(document["figures"]["structural_error_mm"], abs=1e-6)
    assert np.abs(distance - bar.q_mm).max() < 0.5
    status, out, err = run("check", "m.yaml", "--json")
    assert (status, json.loads(out)["is_runnable"], err) == (0, True, "")
    assert run("compile", "m.yaml", "-o", "cam.json")[0] == 0


def test_the_papers_method_gives_the_same_file_from_the_same_seed(run):
    """Feasible, but far from the curve after so few evaluations, and the command says which term that is."""
    for name in ("a.yaml", "b.yaml"):
        status, _, err = run("synthesize", CURVE, "-o", name, "--method", "paper", "--no-report")
        assert status == 1
        assert "the term structural error cannot be met within the bounds" in err
    assert Path("a.yaml").read_text().replace("a-curve", "b-curve").replace("name: a\n", "name: b\n") == (
        Path("b.yaml").read_text()
    )
    assert Path("a-curve.csv").read_bytes() == Path("b-curve.csv").read_bytes()
    assert Path("a.yaml").read_text().startswith("# Found by drive-gateway synthesize: method paper, seed 0, starts 8")


def test_a_signal_ends_the_search_and_the_file_left_leads_to_the_same_result(run, tmp_path):
    settings = SynthesisRequest(CURVE, PAPER, Method.DIFFERENTIAL_EVOLUTION, budget=4000, starts=2).settings()
    whole = SynthesisSession(SearchStatus.beginning(settings), PAPER, tmp_path / "whole.yaml").search(InProcess)
    session = SynthesisSession(SearchStatus.beginning(settings), PAPER, tmp_path / "m.yaml")
    session.search(InProcess, lambda _: os.kill(os.getpid(), signal.SIGINT))
    assert 0 < session.status.evaluations < whole.evaluations
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    kept = read_state_file(session.resume_path)
    assert kept.status.best.objective == session.status.best.objective
    status, out, _ = run("synthesize", "--resume", "m.resume.json", "-o", "m.yaml", "--no-report", "--json")
    assert status == 0
    assert json.loads(out)["objective"] == whole.best.objective
    assert json.loads(out)["evaluations"] == whole.evaluations
    assert not session.resume_path.exists()


def test_a_search_is_kept_on_disk_every_few_seconds(tmp_path):
    settings = SynthesisRequest(CURVE, PAPER, Method.DIFFERENTIAL_EVOLUTION, budget=4000, starts=1).settings()
    hands = iter(range(0, 1000, 6))
    session = SynthesisSession(SearchStatus.beginning(settings), PAPER, tmp_path / "m.yaml", clock=lambda: next(hands))
    seen = []
    session.search(InProcess, lambda status: seen.append((session.resume_path.exists(), status.is_finished)))
    assert seen[0] == (False, False)
    assert seen[2] == (True, False)
    assert not session.resume_path.exists()


@pytest.mark.parametrize(
    ("curve", "sentence"),
    [
        ("\n".join(POINTS.splitlines()[:5]), "4 points are too few"),
        (POINTS.replace("20,261.7624", "20,nan"), "row 3: x_mm is nan, not a finite number"),
        (POINTS.replace("\n20,", "\n10,"), "row 3: theta2 = 10 deg is repeated"),
        (POINTS.replace("\n20,", "\n5,"), "row 3: theta2 = 5 deg is not in rising order"),
        ("\n".join(POINTS.splitlines()[:19]), "the curve does not cover one revolution"),
        ("x_mm,y_mm\n" + "".join(f"{i},{i * i}\n" for i in range(30)), "the curve is open: its last point lies"),
        ("theta_deg,x_mm,y_mm\n0,1,2\n", "the columns are 'theta_deg,x_mm,y_mm', expected 'theta2_deg,x_mm,y_mm'"),
    ],
)
def test_a_curve_that_is_none(run, tmp_path, curve, sentence):
    (tmp_path / "c.csv").write_text(curve)
    status, out, err = run("synthesize", "c.csv", "-o", "m.yaml", *QUICK)
    assert (status, out) == (2, "")
    assert err.startswith("drive-gateway: c.csv: ")
    assert sentence in err
    assert len(err.splitlines()) == 1
    assert not Path("m.yaml").exists()


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ((), "CURVE is missing (or give --resume FILE)"),
        ((CURVE, "--weights", "fun=1"), "--weights: fun is no term"),
        ((CURVE, "--pareto", "knee"), "--pareto knee: only --method pareto has a front to choose from"),
        ((CURVE, "--method", "pareto", "--pareto", "0"), "--pareto 0: neither knee nor best nor a number from 1 on"),
        ((CURVE, "--workers", "2", "--dask", "tcp://127.0.0.1:1"), "--workers and --dask exclude each other"),
        ((CURVE, "--dask", "127.0.0.1:1"), "an address looks like tcp://"),
        ((CURVE, "--template", "nothing"), "nothing: no such file, nor a shipped configuration"),
        (("none.csv",), "none.csv: cannot be read"),
        (("--resume", "none.json"), "none.json: cannot be read"),
        (("--resume", "none.json", "--seed", "3"), "--seed cannot be given with --resume"),
        ((CURVE, "--resume", "none.json"), "CURVE cannot be given with --resume"),
    ],
)
def test_wrong_use(run, arguments, sentence):
    status, out, err = run("synthesize", *arguments, "-o", "m.yaml")
    assert (status, out) == (2, "")
    assert sentence in err
    assert len(err.splitlines()) == 1


@pytest.mark.parametrize(
    ("bounds", "term"),
    [
        ("r=5:10,s=5:10", "the term mobility cannot be met (links r and s cannot close in"),
        ("p=20:40", "the term structural error cannot be met within the bounds: point"),
    ],
)
def test_bounds_without_a_mechanism_are_told_by_the_term(run, bounds, term):
    status, _, err = run("synthesize", CURVE, "-o", "m.yaml", *QUICK, "--bounds", bounds)
    assert status == 1
    assert term in err


def test_a_tolerance_that_is_missed_is_told_by_its_point(run, tmp_path):
    rows = POINTS.splitlines()
    (tmp_path / "c.csv").write_text("\n".join([f"{rows[0]},tolerance_mm", *(f"{row},0.01" for row in rows[1:]), ""]))
    status, _, err = run("synthesize", "c.csv", "-o", "m.yaml", *QUICK, "--bounds", "p=20:40")
    assert status == 1
    assert re.search(r"the term structural error cannot be met \(point \d+, theta2 = \d+\.00 deg, is missed by", err)
    assert "tolerance 0.010 mm" in err


@pytest.mark.slow
def test_a_drive_that_cannot_follow_gets_a_lower_speed_unless_it_is_asked_for(tmp_path):
    """The reference at 80 rpm: its jerk, 12 175 rad/s^3 at 60 rpm, would be 28 859, and the limit is 20 000."""
    task = SynthesisTask.from_curve(desired_curve(PAPER), terms=PAPER_TERMS)
    fast = replace(task, speed_rad_per_s=80 * np.pi / 30)
    bar = FiveBar(0.15, 0.25, 0.3, 0.15, (0.0, 0.0), (0.25, 0.0))
    found = Candidate(fast, bar.to_array(), np.zeros(4), 0.0)
    slower = write_machine(tmp_path / "m.yaml", found, PAPER, "made for a test")
    assert slower.violations == ()
    assert 60.0 < slower.config.motion.speed_rpm < 80.0 * (20_000 / 28_859) ** (1 / 3)
    assert f"the speed is {slower.config.motion.speed_rpm:g} rpm instead of 80" in slower.notes[0]
    kept = write_machine(tmp_path / "m.yaml", found, PAPER, "made for a test", is_speed_fixed=True)
    assert kept.config.motion.speed_rpm == pytest.approx(80.0)
    assert any("jerk" in str(error) for error in kept.violations)


@pytest.mark.slow
def test_gains_grow_with_the_inertia_that_an_axis_moves(tmp_path):
    """The inertia is worked here from the kinetic energy: with one axis at 1 rad/s and the other at rest it is half."""
    task = SynthesisTask.from_curve(desired_curve(PAPER), terms=PAPER_TERMS)
    links = FiveBar(0.15, 0.25, 0.3, 0.15, (0.0, 0.0), (0.25, 0.0)).to_array()
    own = replace(task, machine=machine_model(PAPER))
    same = write_machine(tmp_path / "m.yaml", Candidate(own, links, np.zeros(4), 0.0), PAPER, "made for a test")
    assert same.notes == ()
    heavy = replace(own, machine=replace(own.machine, linear_density_kg_per_m=(3.14, 1.0, 1.0, 1.0)))
    changed = write_machine(tmp_path / "m.yaml", Candidate(heavy, links, np.zeros(4), 0.0), PAPER, "made for a test")

    def inertia(machine, motion):
        dynamics = Dynamics(dynamics_parameters(machine), same.prepared.cam.closure)
        return np.mean([2.0 * dynamics.energy(angles, motion)[0] for angles in zip(theta2, theta5, strict=True)])

    theta2 = np.linspace(0.0, 2 * np.pi, 144, endpoint=False)
    theta5 = same.prepared.cam.profile.at_many(theta2)[:, 0]
    for axis, motion in (("cv", (1.0, 0.0)), ("servo", (0.0, 1.0))):
        factor = inertia(changed.config, motion) / inertia(PAPER, motion)
        gains, before = (machine.axes[axis].emulation.gains for machine in (changed.config, PAPER))
        assert factor > 1.2
        ratios = [gains.K_P / before.K_P, gains.K_V / before.K_V, gains.K_F / before.K_F]
        assert ratios == pytest.approx([factor] * 3, rel=0.01)


@pytest.mark.slow
def test_the_machine_found_runs_in_virtual_time_and_is_reported(run):
    status, _, err = run("synthesize", CURVE, "-o", "m.yaml", "--budget", "20000", "--starts", "2")
    assert status == 0
    assert "report: m-report/report.html" in err
    names = {path.name for path in Path("m-report").iterdir()}
    plots = {f"{stem}.png" for stem in ("positions", "servo", "path", "torque", "convergence")}
    assert names == {"report.html", "report.json"} | plots
    page = Path("m-report/report.html").read_text()
    assert not re.search(r"(src|href)=\"(?!#)", page)
    assert page.count("<svg") == 5
    document = json.loads(Path("m-report/report.json").read_text())
    for value in (f"{document['variables']['p_mm']:.2f}", f"{document['figures']['displacement_deg']:.2f}°"):
        assert value in page
    status, _, err = run("run", "m.yaml", "--virtual-time", "--cycles", "2", "-r", "m.mcap")
    # Heartbeats may still tell of the nodes' last state.
    assert status == 0
    assert "done" in err.splitlines()[-3:]


@pytest.mark.slow
def test_a_front_is_reported_and_a_mechanism_taken_from_it_by_its_number(run):
    quick = ("--method", "pareto", "--budget", "6000", "--population", "60")
    status, out, err = run("synthesize", CURVE, "-o", "m.yaml", *quick, "--json", "--pareto", "2")
    document = json.loads(out)
    assert len(document["front"]) >= 2
    assert document["variables"] == document["front"][1]["variables"]
    terms = [tuple(found["terms"].values()) for found in document["front"]]
    for one in terms:
        assert not any(all(a <= b for a, b in zip(other, one, strict=True)) and other != one for other in terms)
    assert "2 (chosen)" in Path("m-report/report.html").read_text()
    status, _, err = run("synthesize", CURVE, "-o", "n.yaml", *quick, "--no-report", "--pareto", "100000")
    assert status == 2
    assert "--pareto 100000: the front has" in err
