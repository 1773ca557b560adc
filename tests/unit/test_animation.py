"""The linkage over its cycle: what is shown is the mechanism's motion, and the page needs nothing from elsewhere."""

import base64
import hashlib
import io
import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from config.loading import load_config, parse_config
from gateway.cli import main
from gateway.errors import UsageError
from gateway.running.preparation import compile_config
from gateway.synthesis.animation_gif import gif_of
from gateway.synthesis.animation_html import html_of
from gateway.synthesis.linkage_motion import linkage_motion
from mechanism.cam_file import write_cam_file

PAPER = load_config("paper")


@pytest.fixture(scope="module")
def motion():
    return linkage_motion(PAPER, 36)


@pytest.fixture
def run(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["drive-gateway", *map(str, arguments)])
        with pytest.raises(SystemExit) as end:
            main()
        captured = capsys.readouterr()
        assert "Traceback" not in captured.err
        return end.value.code, captured.out, captured.err

    return call


def test_the_joints_keep_the_links_lengths_and_stand_where_the_paper_has_them(motion):
    for one, other, length in (
        (motion.joint_a, np.array([0.0, 0.0]), 0.150),
        (motion.joint_a, motion.end_effector, 0.250),
        (motion.end_effector, motion.joint_d, 0.300),
        (motion.joint_d, np.array([0.250, 0.0]), 0.150),
    ):
        assert np.hypot(*(one - other).T) == pytest.approx(np.full(36, length), abs=1e-12)
    # At theta2 = 0 both cranks lie along x, and the curve's first row is (220, 240) mm.
    assert motion.joint_a[0] == pytest.approx([0.150, 0.0])
    assert motion.joint_d[0] == pytest.approx([0.400, 0.0], abs=1e-6)
    assert motion.end_effector[0] == pytest.approx([0.220, 0.240], abs=2e-6)
    assert np.degrees(motion.displacement_rad) == pytest.approx(99.78, abs=0.01)


def test_velocity_and_acceleration_are_the_derivatives_of_the_angle(motion):
    fine = linkage_motion(PAPER, 3600)
    step = 1.0 / 3600.0  # 60 rpm: one revolution a second
    slope = (np.roll(fine.theta5, -1) - np.roll(fine.theta5, 1)) / (2 * step)
    assert fine.velocity == pytest.approx(slope, abs=2e-3)
    bend = (np.roll(fine.velocity, -1) - np.roll(fine.velocity, 1)) / (2 * step)
    assert fine.acceleration == pytest.approx(bend, abs=0.1)
    assert fine.velocity.min() == pytest.approx(-18.96, abs=0.01)


def test_the_motors_work_covers_friction_alone_over_a_closed_cycle():
    """Kinetic and potential energy come back to where they were, so the mean power is what friction takes."""
    fine = linkage_motion(PAPER, 3600)
    omega = np.stack((np.full(3600, fine.speed_rad_per_s), fine.velocity), axis=1)
    power = float((fine.torque * omega).sum(axis=1).mean())
    coulomb, viscous = np.array([0.04, 0.05]), np.array([0.005, 0.005])
    friction = float(((coulomb * np.tanh(omega / 0.05) + viscous * omega) * omega).sum(axis=1).mean())
    assert power == pytest.approx(friction, rel=1e-6)


def test_the_page_runs_its_own_script_alone_and_shows_the_motion(motion):
    page = html_of(motion)
    script = re.search(r"<script>(.*)</script>", page, re.DOTALL)[1]
    allowed = re.search(r"script-src 'sha256-([^']+)'", page)[1]
    assert base64.b64decode(allowed) == hashlib.sha256(script.encode()).digest()
    assert not re.search(r"(src|href|url)\s*[=(]", page)
    assert "http" not in page.replace('http-equiv="Content-Security-Policy"', "")
    data = json.loads(re.match(r"const data = (\{.*?\});", script)[1])
    assert data["c"][:2] == pytest.approx([220.0, -240.0], abs=0.002)
    assert data["theta5"][24] == pytest.approx(np.degrees(motion.theta5[24]), abs=1e-3)
    assert data["period"] == pytest.approx(1.0)


def test_the_gif_has_a_picture_for_every_sample_and_runs_without_end():
    motion = linkage_motion(PAPER, 12)
    content = gif_of(motion, 0.6)
    assert content == gif_of(motion, 0.6)
    image = Image.open(io.BytesIO(content))
    assert image.n_frames == 12
    assert image.info["loop"] == 0
    seen = set()
    for i in range(12):
        image.seek(i)
        assert image.info["duration"] == 50
        seen.add(image.convert("RGB").tobytes())
    assert len(seen) == 12


def test_a_name_in_a_page_is_text_not_markup(tmp_path):
    changed = parse_config(PAPER.text, PAPER.path)
    motion = linkage_motion(changed, 12)
    object.__setattr__(motion, "name", "<script>alert(1)</script>")
    assert html_of(motion).count("<script>") == 1


def test_the_command_takes_a_compiled_cam(run, tmp_path):
    write_cam_file(tmp_path / "cam.json", compile_config(PAPER))
    status, out, _ = run("animate", "paper", "--cam", "cam.json", "-o", "a.html", "--frames", 24, "--json")
    assert status == 0
    assert json.loads(out) == {"animation": "a.html", "samples": 24, "bytes": Path("a.html").stat().st_size}


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("paper", "-o", "a.mp4"), "a.mp4: the name must end in .gif or .html"),
        (("paper", "-o", "no/a.gif"), "no/a.gif: there is no folder no"),
        (("paper", "-o", "a.gif", "--frames", "721"), "721 frames in a GIF, bound 720"),
        (("paper", "-o", "a.gif", "--frames", "90", "--seconds", "1"), "90 frames in 1 s are 11 ms each, bound 20 ms"),
        (("paper", "-o", "a.gif", "--cam", "none.json"), "none.json: cannot be read"),
    ],
)
def test_bad_use(run, arguments, sentence):
    status, out, err = run("animate", *arguments)
    assert status == 2
    assert out == ""
    assert sentence in err


def test_a_cam_of_another_linkage_is_refused(run, tmp_path):
    write_cam_file(tmp_path / "cam.json", compile_config(PAPER))
    (tmp_path / "machine.yaml").write_text(PAPER.text.replace("r_mm: 300", "r_mm: 301"))
    status, _, err = run("animate", "machine.yaml", "--cam", "cam.json", "-o", "a.gif")
    assert status == 2
    assert "made for r = 300 mm, the machine has 301 mm" in err


def test_a_linkage_that_cannot_reach_its_curve(run, tmp_path):
    (tmp_path / "machine.yaml").write_text(PAPER.text.replace("r_mm: 300", "r_mm: 100"))
    status, _, err = run("animate", "machine.yaml", "-o", "a.gif")
    assert status == 1
    assert "is out of reach" in err


def test_too_few_samples():
    with pytest.raises(UsageError, match="11 samples a cycle, bound 12 to 7200"):
        linkage_motion(PAPER, 11)
