"""Stored parameters on disk: written whole, checked when read, and one sentence about what is wrong."""

import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest
from drive_bench import decode_bench_image, described
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.frame import Frame
from sim_drive.communication.parameter_file import FileParameterStore, make_parameter_store
from sim_drive.communication.parameters import (
    MemoryParameterStore,
    ParametersLost,
    ParameterStoreError,
    StoredParameters,
)
from sim_drive.device.drive import Drive
from sim_drive.settings import DriveSettings

SOME = StoredParameters({(0x1017, 0): b"\x64\0", (0x3020, 1): b"\xff\xff\xff\xff"}, node_id=7, bit_timing=2)


def test_what_was_saved_is_loaded(tmp_path: Path):
    store = FileParameterStore(tmp_path / "drive.json")
    assert store.load() is None
    store.save(SOME)
    assert FileParameterStore(tmp_path / "drive.json").load() == SOME
    store.save(StoredParameters())
    assert store.load() == StoredParameters()
    assert [path.name for path in tmp_path.iterdir()] == ["drive.json"]


def test_file_is_readable_by_people(tmp_path: Path):
    FileParameterStore(tmp_path / "drive.json").save(SOME)
    body = json.loads((tmp_path / "drive.json").read_text())["parameters"]
    assert body["values"] == {"1017:00": "6400", "3020:01": "FFFFFFFF"}
    assert (body["node_id"], body["bit_timing"]) == (7, 2)


@settings(max_examples=50)
@given(
    st.dictionaries(
        st.tuples(st.integers(0, 0xFFFF), st.integers(0, 0xFF)), st.binary(min_size=1, max_size=8), max_size=20
    ),
    st.none() | st.integers(1, 127),
    st.none() | st.integers(0, 9),
)
def test_anything_comes_back(values: dict[tuple[int, int], bytes], node_id: int | None, bit_timing: int | None):
    path = Path(os.environ.get("TMPDIR", "/tmp")) / f"test_parameter_file.{os.getpid()}.json"
    try:
        parameters = StoredParameters(values, node_id, bit_timing)
        FileParameterStore(path).save(parameters)
        assert FileParameterStore(path).load() == parameters
    finally:
        path.unlink(missing_ok=True)


def change(key: str, value: object) -> Callable[[str], str]:
    def damage(text: str) -> str:
        content = json.loads(text)
        content["parameters"][key] = value
        return json.dumps(content)

    return damage


@pytest.mark.parametrize(
    ("damage", "sentence"),
    [
        (lambda text: "", "not a parameter file"),
        (lambda text: text[: len(text) // 2], "not a parameter file"),
        (lambda text: "[]", "not a parameter file"),
        (lambda text: "\0" * 100, "not a parameter file"),
        (lambda text: text.replace("6400", "6500"), "damaged: its CRC-32 is"),
        (lambda text: text.replace("6400", "640"), "not a parameter file: parameters.values"),
        (lambda text: text.replace("1017:00", "1017h"), "not a parameter file: parameters.values"),
        (change("version", 2), "not a parameter file: parameters.version"),
        (change("format", "something else"), "not a parameter file: parameters.format"),
        (change("node_id", 128), "not a parameter file: parameters.node_id"),
        (change("node_id", True), "not a parameter file: parameters.node_id"),
        (change("extra", 1), "not a parameter file: parameters.extra"),
        (change("node_id", 8), "damaged: its CRC-32 is"),
        (lambda text: text + " " * (1 << 20), "larger than 1048576 bytes"),
    ],
)
def test_damage_is_found_and_told_in_one_sentence(tmp_path: Path, damage: Callable[[str], str], sentence: str):
    path = tmp_path / "drive.json"
    FileParameterStore(path).save(SOME)
    path.write_text(damage(path.read_text()))
    with pytest.raises(ParameterStoreError) as caught:
        FileParameterStore(path).load()
    assert str(caught.value).startswith(f"{path}: {sentence}")
    assert "\n" not in str(caught.value)


def test_folder_is_no_file(tmp_path: Path):
    with pytest.raises(ParameterStoreError, match="cannot be read: Is a directory"):
        FileParameterStore(tmp_path).load()


def test_folder_that_is_not_there_cannot_be_written(tmp_path: Path):
    with pytest.raises(ParameterStoreError, match="cannot be written: No such file or directory"):
        FileParameterStore(tmp_path / "nowhere" / "drive.json").save(SOME)


def test_failed_replacement_leaves_the_old_file_and_no_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    store = FileParameterStore(tmp_path / "drive.json")
    store.save(SOME)

    def refuse(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", refuse)
    with pytest.raises(ParameterStoreError, match="No space left on device"):
        store.save(StoredParameters())
    monkeypatch.undo()
    assert store.load() == SOME
    assert [path.name for path in tmp_path.iterdir()] == ["drive.json"]


def test_settings_name_the_file(tmp_path: Path):
    assert isinstance(make_parameter_store(DriveSettings()), MemoryParameterStore)
    store = make_parameter_store(DriveSettings(parameter_file=tmp_path / "drive.json"))
    assert isinstance(store, FileParameterStore)
    assert store.path == tmp_path / "drive.json"


def test_drive_keeps_its_parameters_on_disk_and_notices_damage(tmp_path: Path):
    settings = DriveSettings(parameter_file=tmp_path / "drive.json")

    def new_drive() -> Drive:
        drive = Drive(5, described(5), settings, decode_bench_image, make_parameter_store(settings))
        drive.wake(0)
        return drive

    drive = new_drive()
    for request in ("2B171000FA000000", "2310100173617665"):
        drive.receive(Frame(0x605, bytes.fromhex(request)), 0)
    assert [str(frame) for frame in drive.take_frames()] == [
        "705#00",
        "585#6017100000000000",
        "585#6010100100000000",
    ]
    assert new_drive().dictionary.entry(0x1017).value == 250

    path = tmp_path / "drive.json"
    path.write_text(path.read_text().replace("FA00", "FB00"))
    drive = new_drive()
    assert drive.dictionary.entry(0x1017).value == 0
    assert [str(frame) for frame in drive.take_frames()] == ["705#00", "085#1063210000000000"]
    (lost,) = [event for event in drive.take_events() if isinstance(event, ParametersLost)]
    assert lost.reason.startswith(f"{path}: damaged: its CRC-32 is")
