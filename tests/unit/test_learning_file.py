"""The memory of learning between runs: what comes back, what is kept when, and one sentence for every bad file."""

import json
import math
from dataclasses import dataclass

import numpy as np
import pytest

from config.loading import load_config, parse_config
from gateway.cli.app import app
from gateway.cyclic.guard import StopReason
from gateway.errors import UsageError
from gateway.learning.law import LearnedTorque
from gateway.learning.memory_file import LearningMemory, cam_crc32, memory_file, read_memory, write_memory
from gateway.running.learning_store import LearningStore, open_store
from mechanism.cam_profile import CamProfile

PAPER = load_config("paper")
NAMES = ("cv", "servo")
THETA2 = np.arange(64) * math.tau / 64
CAM = CamProfile.through(THETA2, 0.5 * (1.0 - np.cos(THETA2)))
OTHER = CamProfile.through(THETA2, 0.5001 * (1.0 - np.cos(THETA2)))


def learned(speed, bins=32, scale=0.1):
    return LearnedTorque(speed, scale * np.random.default_rng(5).normal(size=(2, bins)))


def test_a_memory_comes_back_bit_by_bit(tmp_path):
    memory = LearningMemory(cam_crc32(CAM), NAMES).with_learned(learned(6.28)).with_learned(learned(3.14, 16))
    path = tmp_path / "memory.json"
    write_memory(path, memory)
    back = read_memory(path, cam_crc32(CAM), NAMES)
    assert [known.speed for known in back.learned] == [3.14, 6.28]
    for before, after in zip(memory.learned, back.learned, strict=True):
        assert np.array_equal(before.torque, after.torque)
    assert [file.name for file in tmp_path.iterdir()] == ["memory.json"]


def test_each_speed_has_its_own_and_the_nearest_is_begun_with():
    memory = LearningMemory(1, NAMES)
    assert memory.nearest(6.0) is None
    memory = memory.with_learned(learned(6.0)).with_learned(learned(12.0)).with_learned(learned(6.0000001, scale=0.5))
    assert len(memory.learned) == 2
    assert np.abs(memory.learned[0].torque).max() > 0.5
    # In ratio 8.4 is nearer to 6 than to 12, 8.5 is not.
    assert [memory.nearest(speed).speed for speed in (1.0, 8.4, 8.5, 99.0)] == [6.0000001, 6.0000001, 12.0, 12.0]


def test_the_memory_of_another_profile_is_refused_with_one_sentence(tmp_path):
    path = tmp_path / "memory.json"
    write_memory(path, LearningMemory(cam_crc32(CAM), NAMES).with_learned(learned(6.28)))
    with pytest.raises(UsageError) as refused:
        read_memory(path, cam_crc32(OTHER), NAMES)
    sentence = str(refused.value)
    assert sentence.startswith(f"{path}: the learning memory of another profile (its cam has CRC-32 ")
    assert f"{cam_crc32(CAM):08X}h" in sentence
    assert f"{cam_crc32(OTHER):08X}h" in sentence
    assert "\n" not in sentence
    with pytest.raises(UsageError, match=r"of axes cv, servo, not cv, other$"):
        read_memory(path, cam_crc32(CAM), ("cv", "other"))


def damaged(change):
    document = {
        "format": "drive-gateway learning",
        "version": 1,
        "cam_crc32": f"{cam_crc32(CAM):08X}",
        "axes": ["cv", "servo"],
        "learned": [{"speed_rad_per_s": 6.28, "torque_Nm": {"cv": [0.1, 0.2], "servo": [0.1, 0.3]}}],
    }
    change(document)
    return json.dumps(document).encode()


@pytest.mark.parametrize(
    ("data", "sentence"),
    [
        (b"", "not a learning memory"),
        (b"\xff\xfe", "not a learning memory"),
        (b"[1]", "not a learning memory"),
        (b'{"format": "drive-gateway learning", "x": NaN}', "not a learning memory"),
        (damaged(lambda d: d.update(format="other")), "not a learning memory"),
        (damaged(lambda d: d.update(version=2)), "version 2, only 1 is known"),
        (damaged(lambda d: d.update(cam_crc32="xyz")), "a damaged learning memory"),
        (damaged(lambda d: d.pop("learned")), "a damaged learning memory"),
        (damaged(lambda d: d["learned"][0]["torque_Nm"].pop("cv")), "a damaged learning memory"),
        (damaged(lambda d: d["learned"][0]["torque_Nm"].update(cv=[0.1])), "a damaged learning memory"),
        (damaged(lambda d: d["learned"][0]["torque_Nm"].update(cv=[0.1, "a"])), "a damaged learning memory"),
        (damaged(lambda d: d["learned"][0]["torque_Nm"].update(cv=[0.1, 1e99])), "a damaged learning memory"),
        (damaged(lambda d: d["learned"][0].update(speed_rad_per_s=-1)), "a damaged learning memory"),
        (damaged(lambda d: d["learned"][0].update(speed_rad_per_s=0)), "a damaged learning memory"),
        (damaged(lambda d: d.update(learned=[3])), "a damaged learning memory"),
    ],
)
def test_a_damaged_file_is_refused_with_one_sentence(tmp_path, data, sentence):
    path = tmp_path / "memory.json"
    path.write_bytes(data)
    with pytest.raises(UsageError) as refused:
        read_memory(path, cam_crc32(CAM), NAMES)
    assert str(refused.value).startswith(f"{path}: ")
    assert sentence in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_folder_has_one_file_for_each_profile(tmp_path):
    crc = cam_crc32(CAM)
    assert memory_file(tmp_path, "paper", crc) == tmp_path / f"paper-{crc:08X}.learning.json"
    assert memory_file(tmp_path / "mine.json", "paper", crc) == tmp_path / "mine.json"
    assert cam_crc32(OTHER) != crc


@dataclass
class Core:
    """What a store looks at when a run is over."""

    learned: LearnedTorque | None
    stopped_by: StopReason = StopReason.COMPLETED
    failure: Exception | None = None


def test_what_a_guard_has_stopped_is_not_kept(tmp_path):
    path = tmp_path / "memory.json"
    store = LearningStore(PAPER, CAM, path)
    assert not store.keep(Core(None))
    assert not store.keep(Core(learned(6.28), StopReason.FOLLOWING_ERROR))
    assert not store.keep(Core(learned(6.28), failure=UsageError("x")))
    assert not path.exists()
    assert store.keep(Core(learned(6.28), StopReason.OPERATOR))
    assert LearningStore(PAPER, CAM, path).learning().learned.speed == 6.28


def test_the_configuration_names_a_memory_beside_itself_and_the_command_line_another(tmp_path):
    text = f"{PAPER.text}\nlearning: {{enabled: true, memory: folder}}\n"
    config = parse_config(text, tmp_path / "machine.yaml")
    (tmp_path / "folder").mkdir()
    assert open_store(config, CAM, None).path == tmp_path / "folder" / f"paper-{cam_crc32(CAM):08X}.learning.json"
    assert open_store(config, CAM, tmp_path / "other.json").path == tmp_path / "other.json"
    assert open_store(PAPER, CAM, None) is None
    with pytest.raises(UsageError, match="there is no folder"):
        open_store(PAPER, CAM, tmp_path / "nowhere" / "memory.json")


def test_the_command_line_refuses_the_memory_of_another_profile(tmp_path, monkeypatch, capsys):
    path = tmp_path / "memory.json"
    write_memory(path, LearningMemory(cam_crc32(CAM), NAMES).with_learned(learned(6.28)))
    from gateway.cli.terminal import errors_answered

    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended, errors_answered():
        app(["run", "paper", "--virtual-time", "--learn", str(path)], standalone_mode=False)
    assert ended.value.code == 2
    assert "another profile" in " ".join(capsys.readouterr().err.split())
    assert [file.name for file in tmp_path.iterdir()] == ["memory.json"]
