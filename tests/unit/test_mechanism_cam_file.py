"""The cam file: comes back bit by bit, and one sentence for every damaged one."""

import json
from math import tau
from pathlib import Path

import numpy as np
import pytest

from mechanism.cam import CamLimits, CompiledCam, compile_cam
from mechanism.cam_file import MAXIMUM_FILE_BYTES, cam_document, parse_cam_file, read_cam_file, write_cam_file
from mechanism.curve import load_curve_csv
from mechanism.errors import CamFileError, CamLimitError
from mechanism.five_bar import FiveBar

PATH = Path(__file__).parents[2] / "config" / "desired_path.csv"
PAPER = FiveBar(0.15, 0.25, 0.3, 0.15, (0.0, 0.0), (0.25, 0.0))


@pytest.fixture(scope="module")
def compiled() -> CompiledCam:
    return compile_cam(load_curve_csv(PATH), PAPER, CamLimits(25.0, 400.0), tau)


@pytest.fixture(scope="module")
def document(compiled: CompiledCam) -> dict[str, object]:
    return cam_document(compiled)


def test_what_is_read_evaluates_bit_by_bit_as_what_was_written(compiled: CompiledCam, tmp_path: Path) -> None:
    path = tmp_path / "paper.cam.json"
    write_cam_file(path, compiled)
    read = read_cam_file(path)
    theta2 = np.random.default_rng(1).uniform(-50.0, 50.0, 5000)
    assert read.cam.profile.coefficients.tobytes() == compiled.profile.coefficients.tobytes()
    assert read.cam.profile.at_many(theta2).tobytes() == compiled.profile.at_many(theta2).tobytes()
    assert read.cam.five_bar == PAPER
    assert read.cam.closure is compiled.closure
    assert read.cam.desired_point(1.0) == compiled.desired_point(1.0)
    assert read.counts_per_revolution == 4096
    assert read.master_speed_rad_per_s == tau
    assert read.figures == compiled.report.figures()
    assert read.require_for(PAPER, 4096) is read.cam
    assert [file.name for file in tmp_path.iterdir()] == ["paper.cam.json"]


def test_the_table_is_in_degrees(document: dict[str, object]) -> None:
    theta2, theta5 = document["theta2_deg"], document["theta5_deg"]
    assert isinstance(theta2, list)
    assert isinstance(theta5, list)
    assert len(theta2) == len(theta5) == document["knots"] == 1024
    assert theta2[256] == 90.0
    assert max(theta5) == pytest.approx(99.78, abs=0.01)


def test_a_second_write_replaces_the_first(compiled: CompiledCam, tmp_path: Path) -> None:
    path = tmp_path / "cam"
    path.write_text("old")
    write_cam_file(path, compiled)
    first = path.read_bytes()
    write_cam_file(path, compiled)
    assert path.read_bytes() == first


def test_a_cam_that_breaks_a_limit_is_not_written(tmp_path: Path) -> None:
    bad = compile_cam(load_curve_csv(PATH), PAPER, CamLimits(5.0, 400.0), tau)
    with pytest.raises(CamLimitError):
        write_cam_file(tmp_path / "cam", bad)
    assert list(tmp_path.iterdir()) == []


def test_a_file_cut_anywhere_is_refused(document: dict[str, object]) -> None:
    text = json.dumps(document)
    for length in (0, 1, 30, len(text) // 2, len(text) - 1):
        with pytest.raises(CamFileError, match=r"^some\.cam: truncated or not a cam file"):
            parse_cam_file(text[:length], "some.cam")


@pytest.mark.parametrize(
    ("key", "value"), [("net_turns", 1), ("closure", -1), ("theta5_deg", []), ("more", 1), ("sha256", "0" * 64)]
)
def test_an_edited_file_is_refused(document: dict[str, object], key: str, value: object) -> None:
    with pytest.raises(CamFileError, match="checksum"):
        parse_cam_file(json.dumps({**document, key: value}), "some.cam")


def test_one_changed_digit_is_refused(document: dict[str, object]) -> None:
    text = json.dumps(document)
    at = text.index("coefficients_rad") + 500
    while not text[at].isdigit():
        at += 1
    changed = text[:at] + str((int(text[at]) + 1) % 10) + text[at + 1 :]
    with pytest.raises(CamFileError, match=r"checksum|truncated"):
        parse_cam_file(changed, "some.cam")


@pytest.mark.parametrize("text", ["[]", "{}", "3", '"cam"', "null", '{"format": "other"}', "[" * 100_000])
def test_other_json_is_not_a_cam_file(text: str) -> None:
    with pytest.raises(CamFileError, match="not a cam file"):
        parse_cam_file(text, "some.cam")


def sealed(document: dict[str, object]) -> str:
    from mechanism import cam_file

    return json.dumps({**document, "sha256": cam_file._seal(document)})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"version": 2}, "version 2, only 1 is known"),
        ({"knots": 1000}, "malformed"),
        ({"knots": "many"}, "malformed"),
        ({"coefficients_rad": [1.0]}, "malformed"),
        ({"five_bar": {}}, "malformed"),
        ({"closure": 0}, "malformed"),
        ({"spline_degree": 3}, "degree 3"),
        ({"figures": [1]}, "malformed"),
        ({"knots": 10**400}, "malformed"),
    ],
)
def test_a_well_sealed_but_impossible_file_is_refused(
    document: dict[str, object], changes: dict[str, object], message: str
) -> None:
    with pytest.raises(CamFileError, match=message) as caught:
        parse_cam_file(sealed({**document, **changes}), "some.cam")
    assert "\n" not in str(caught.value)


def test_a_cam_for_another_machine_is_refused(document: dict[str, object]) -> None:
    read = parse_cam_file(json.dumps(document), "some.cam")
    other = FiveBar(0.15, 0.25, 0.31, 0.15, (0.0, 0.0), (0.25, 0.0))
    with pytest.raises(CamFileError, match=r"some\.cam: made for r = 300 mm, the machine has 310 mm"):
        read.require_for(other, 4096)
    with pytest.raises(CamFileError, match="made for 4096 counts a revolution, the machine has 8192"):
        read.require_for(PAPER, 8192)


def test_files_that_cannot_be_read_or_written(compiled: CompiledCam, tmp_path: Path) -> None:
    with pytest.raises(CamFileError, match="cannot be read"):
        read_cam_file(tmp_path / "none")
    with pytest.raises(CamFileError, match="cannot be written"):
        write_cam_file(tmp_path / "none" / "cam", compiled)
    folder = tmp_path / "folder"
    folder.mkdir()
    with pytest.raises(CamFileError, match="cannot be written"):
        write_cam_file(folder, compiled)
    assert [path.name for path in tmp_path.iterdir()] == ["folder"]
    binary = tmp_path / "binary"
    binary.write_bytes(b"\xff\xfe")
    with pytest.raises(CamFileError, match="not a text file"):
        read_cam_file(binary)
    binary.write_bytes(b" " * (MAXIMUM_FILE_BYTES + 1))
    with pytest.raises(CamFileError, match="larger than"):
        read_cam_file(binary)
