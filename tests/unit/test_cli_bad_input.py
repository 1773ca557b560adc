"""Bad input gets one sentence that says what, where and which bound, the right exit status, and no traceback."""

import json
import socket
import sys

import pytest

from config.loading import load_config
from gateway.cli import main

PAPER = load_config("paper").text
CURVE = load_config("paper").relative("desired_path.csv").read_text()


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


@pytest.fixture
def config(tmp_path):
    """Write a changed configuration beside its curve."""

    def write(*replacements, curve=CURVE):
        text = PAPER
        for old, new in replacements:
            assert old in text
            text = text.replace(old, new, 1)
        path = tmp_path / "machine.yaml"
        path.write_text(text)
        (tmp_path / "desired_path.csv").write_text(curve)
        return path

    return write


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("p_mm: 150", "p_mm: 150\n    weight_kg: 3", "machine.five_bar.weight_kg: unknown key"),
        ("p_mm: 150", "p_m: 0.15", "machine.five_bar.p_m: unknown key, did you mean p_mm?"),
        ("p_mm: 150", "p_mm: 0.15", "machine.five_bar.p_mm: 0.15 should be greater than or equal to 1"),
        ("node_id: 2", "node_id: 1", "axes.servo.node_id: 1 is taken by axes.cv, every node id must be unique"),
        ("node_id: 2", "node_id: 128", "axes.servo.node_id: 128 should be less than or equal to 127"),
        ("cycle_us: 1000", "cycle_us: 1001", "bus.cycle_us: 1001 cannot be said in 60C2h"),
        ("cycle_us: 1000", "cycle_us: 500", "bus.cycle_us: 500 us is too short for 2 axes at 1000000 bit/s"),
        ("speed_rpm: 60", "speed_rpm: 200", "motion.speed_rpm: 200 is 20.944 rad/s, above"),
        (
            "      velocity_rad_per_s: 14.0",
            "      position_deg: [-10, 10]\n      velocity_rad_per_s: 14.0",
            "axes.cv.limits.position_deg: the master turns without end",
        ),
        (
            "      velocity_rad_per_s: 14.0",
            "      jerk_rad_per_s3: 29.0\n      velocity_rad_per_s: 14.0",
            "motion.ramp_jerk_rad_per_s3: 30 is above axes.cv.limits.jerk_rad_per_s3 29",
        ),
        ("role: slave", "role: master", "there must be one axis with role master and one with role slave"),
        ("name: paper", "name: paper\nname: twice", "line 5: key 'name' is given twice"),
        ("name: paper", "name: [", "not valid YAML"),
        ("K_P: 6800", "K_P: many", "axes.cv.emulation.gains.K_P: 'many' should be a valid integer"),
    ],
)
def test_configuration(run, config, old, new, sentence):
    path = config((old, new))
    status, out, err = run("check", path)
    assert status == 2
    assert out == ""
    assert f"drive-gateway: {path}: " in err
    assert sentence in err


def test_two_things_wrong_are_both_told(run, config):
    _, _, err = run("check", config(("node_id: 2", "node_id: 900"), ("speed_rpm: 60", "speed_rpm: -1")))
    assert len(err.splitlines()) == 2


def test_yaml_aliases_are_refused(run, tmp_path):
    path = tmp_path / "bomb.yaml"
    path.write_text("a: &a [1, 2]\nb: [*a, *a]\n")
    status, _, err = run("check", path)
    assert status == 2
    assert "aliases are not accepted" in err


def test_a_curve_that_the_mechanism_cannot_reach(run, config):
    far = CURVE.replace("180,0.1694,199.8728", "180,-60.0,320.0")
    assert far != CURVE
    status, _, err = run("compile", config(curve=far), "-o", "cam.json")
    assert status == 1
    assert "180" in err
    assert "mm" in err


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("position_deg: [-10, 110]", "position_deg: [-10, 90]", ["position", "99.78", "90"]),
        ("velocity_rad_per_s: 25.0", "velocity_rad_per_s: 15.0", ["velocity", "18.96", "15"]),
        ("acceleration_rad_per_s2: 400.0", "acceleration_rad_per_s2: 300.0", ["acceleration", "-317", "300"]),
        ("jerk_rad_per_s3: 20000.0", "jerk_rad_per_s3: 10000.0", ["jerk", "12", "10000"]),
        ("minimum_transmission_sine: 0.1", "minimum_transmission_sine: 0.85", ["0.8", "0.85"]),
    ],
)
def test_a_cam_past_a_limit(run, config, tmp_path, old, new, words):
    path = config((old, new))
    for arguments in (("compile", path, "-o", "cam.json"), ("check", path), ("run", path, "--virtual-time")):
        status, _, err = run(*arguments)
        assert status == 1
        for word in words:
            assert word in err
    assert not (tmp_path / "cam.json").exists()
    assert not list(tmp_path.glob("*.mcap"))


def test_a_ramp_that_would_exceed_the_servos_acceleration(run, config):
    path = config(
        ("ramp_acceleration_rad_per_s2: 6.0", "ramp_acceleration_rad_per_s2: 50.0"),
    )
    status, _, err = run("check", path)
    assert status == 1
    assert "acceleration while the master ramps at 50 rad/s^2" in err


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("theta2_deg,x_mm,y_mm", "theta2_deg,x_m,y_m", ["x_mm"]),
        ("180,0.1694,199.8728", "180,nan,199.8728", ["desired_path.csv"]),
        ("180,0.1694,199.8728", "179,0.1694,199.8728", ["179"]),
        ("180,0.1694,199.8728", "180,0.1694", ["desired_path.csv"]),
    ],
)
def test_a_curve_file_that_is_none(run, config, old, new, words):
    assert old in CURVE
    status, _, err = run("check", config(curve=CURVE.replace(old, new)))
    assert status == 2
    assert len(err.splitlines()) == 1
    for word in words:
        assert word in err


def test_a_truncated_or_edited_cam_file(run, tmp_path):
    status, _, _ = run("compile", "paper", "-o", "cam.json")
    assert status == 0
    whole = (tmp_path / "cam.json").read_text()
    (tmp_path / "short.json").write_text(whole[: len(whole) // 2])
    (tmp_path / "edited.json").write_text(whole.replace("0.15", "0.16", 1))
    for name in ("short.json", "edited.json", "absent.json"):
        status, _, err = run("download", "paper", name)
        assert status == 2
        assert name in err
        assert len(err.splitlines()) == 1


def test_a_cam_of_another_machine_is_not_downloaded(run, config):
    status, _, _ = run("compile", "paper", "-o", "cam.json")
    assert status == 0
    status, _, err = run("download", config(("r_mm: 300", "r_mm: 310")), "cam.json")
    assert status == 2
    assert "made for r = 300 mm, the machine has 310 mm" in err


def test_an_existing_file_is_not_overwritten(run, tmp_path):
    (tmp_path / "cam.json").write_text("mine")
    status, _, err = run("compile", "paper", "-o", "cam.json")
    assert status == 2
    assert "exists already" in err
    assert (tmp_path / "cam.json").read_text() == "mine"


@pytest.mark.parametrize("interface", ["socketcan", "nonsense"])
def test_a_bus_that_does_not_exist(run, tmp_path, interface):
    status, _, err = run("run", "paper", "-i", interface, "-c", "nocan7")
    assert status == 1
    assert f"bus {interface}:nocan7:" in err
    assert not list(tmp_path.glob("*.mcap"))


def test_a_server_that_is_not_there(run):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        status, _, err = run("run", "paper", "-i", "socketcand", "--port", port)
    assert status == 1
    assert f"nothing listens at 127.0.0.1:{port}" in err


def test_a_recording_that_is_none(run, tmp_path):
    (tmp_path / "text.mcap").write_text("not a recording")
    for name in ("text.mcap", "absent.mcap"):
        status, _, err = run("report", name, "-o", "out")
        assert status == 2
        assert name in err
        assert len(err.splitlines()) == 1


def test_nothing_to_monitor(run, config):
    status, _, err = run("monitor", config(("name: paper", "name: nobody-runs-this")), "--once")
    assert status == 1
    assert "no run of nobody-runs-this" in err


@pytest.mark.parametrize("arguments", [("run",), ("compile", "paper"), ("run", "paper", "--cycles", "0"), ("fly",)])
def test_wrong_use(run, arguments):
    status, _, err = run(*arguments)
    assert status == 2
    assert "Error" in err or "Usage" in err


@pytest.mark.parametrize("command", ["demo", "check", "compile", "run", "report", "download", "monitor"])
def test_every_command_has_help_with_examples(run, command):
    status, out, _ = run(command, "--help")
    assert status == 0
    assert "Examples" in out
    assert f"drive-gateway {command} " in out or command == "download"


def test_compile_json_gives_the_table_in_degrees(run, tmp_path):
    status, out, _ = run("compile", "paper", "-o", "cam.json", "--json")
    assert status == 0
    document = json.loads(out)
    assert document["theta2_deg"][0] == 0.0
    assert document["theta5_deg"][0] == pytest.approx(0.0, abs=1e-4)
    assert max(document["theta5_deg"]) == pytest.approx(99.78, abs=0.01)
    assert json.loads((tmp_path / "cam.json").read_text())["theta5_deg"] == document["theta5_deg"]
