"""A whole run in virtual time as a candump log, before tshark's CANopen dissector, python-can and its viewer."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import can
import numpy as np
import pytest
from can.viewer import CanViewer, _parse_viewer_args

from config.loading import load_config
from drivers.errors import SdoAbortedError
from drivers.frame import Frame
from drivers.master import Master, Procedure
from drivers.object_dictionary import DataType
from drivers.virtual_time import VirtualBus
from gateway.record.recording import read_recording, write_candump_log
from gateway.record.ring import FRAME_DTYPE, FrameArray
from gateway.running.download import download_image
from gateway.running.drive_settings import build_master, node_settings
from gateway.running.preparation import prepare
from gateway.running.procedure_core import ProcedureCore
from gateway.running.virtual_run import run_virtual
from mechanism.cam_image import encode_cam_image
from sim_drive.assembly import build_machine

Dissect = Callable[..., list[list[str]]]
SYNC = 0x080


@dataclass(frozen=True, slots=True)
class Run:
    frames: FrameArray
    log: Path
    cycles: int


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    folder = tmp_path_factory.mktemp("candump")
    config = load_config("paper")
    prepared = prepare(config, 1)
    core = run_virtual(prepared, build_machine(config, 0), folder / "run.mcap", "{}", 0)
    assert core.failure is None
    recording = read_recording(folder / "run.mcap")
    log = folder / "run.log"
    write_candump_log(recording.frames(), log)
    return Run(recording.frames(), log, len(recording.samples))


Row = tuple[int, str, str, str, str]
"""Identifier, protocols, the dissector's sentence, what the expert found, SDO abort code."""


def decode(dissect: Dissect, log: Path) -> list[Row]:
    fields = ("can.id", "frame.protocols", "_ws.col.Info", "_ws.expert.message", "canopen.sdo.abort_code")
    return [(int(row[0], 0), row[1], row[2], row[3], row[4]) for row in dissect(log, *fields)]


def sentences(rows: list[Row]) -> dict[int, set[str]]:
    """What tshark says of the frames of each identifier, without the node id that it ends with."""
    said: dict[int, set[str]] = {}
    for identifier, _, sentence, _, _ in rows:
        said.setdefault(identifier, set()).add(re.sub(r"\s*\[0x[0-9a-f]+\]$", "", sentence))
    return said


@pytest.fixture(scope="module")
def rows(run: Run, dissect: Dissect) -> list[Row]:
    return decode(dissect, run.log)


def test_tshark_takes_every_frame_for_sound_canopen(run: Run, rows: list[Row]) -> None:
    assert [row[0] for row in rows] == run.frames["cob_id"].tolist()
    # A SYNC has nothing that the dissector could show beneath the frame.
    assert {row[0] for row in rows if not row[1].endswith(":can:canopen")} == {SYNC}
    assert {row[3] for row in rows} == {""}, "the expert has found something"
    assert {row[4] for row in rows} == {""}, "an SDO transfer was aborted"


def test_tshark_sees_the_services_that_were_meant(rows: list[Row]) -> None:
    said = sentences(rows)
    for node in (1, 2):
        # Whether a heartbeat falls between the last command and the end of the run is a matter of its phase.
        said[0x700 + node].discard("NMT Error Control: Pre-operational")
    resets = {"NMT: Reset communication", "NMT: Start remote node", "NMT: Enter pre-operational state"}
    states = {"NMT Error Control: Boot-up", "NMT Error Control: Operational"}
    requests = {"Default-SDO (rx): Initiate upload request", "Default-SDO (rx): Initiate download request"}
    answers = {"Default-SDO (tx): Initiate upload response", "Default-SDO (tx): Initiate download response"}
    assert said == {
        0x000: resets,
        SYNC: {"SYNC"},
        0x181: {"PDO1 (tx)"},
        0x182: {"PDO1 (tx)"},
        0x201: {"PDO1 (rx)"},
        0x202: {"PDO1 (rx)"},
        0x581: answers,
        0x582: answers,
        0x601: requests,
        0x602: requests,
        0x701: states,
        0x702: states,
        0x77F: {"NMT Error Control: Operational"},
    }


def test_every_cycle_is_sync_then_tpdos_then_rpdos(run: Run) -> None:
    identifiers = [n for n in run.frames["cob_id"].tolist() if n in {SYNC, 0x181, 0x182, 0x201, 0x202}]
    first = identifiers.index(SYNC)
    # The first demands may go out before the first SYNC.
    cycle = [SYNC, 0x181, 0x182, 0x201, 0x202]
    whole = len(identifiers[first:]) // 5
    assert identifiers[first : first + 5 * whole] == cycle * whole
    assert abs(whole - run.cycles) <= 2


def test_python_can_reads_the_same_frames(run: Run) -> None:
    with can.LogReader(run.log) as reader:
        messages = list(reader)
    assert len(messages) == len(run.frames)
    for message, frame in zip(messages, run.frames, strict=True):
        length = int(frame["length"])
        assert message.arbitration_id == frame["cob_id"]
        assert bytes(message.data) == frame["data"][:length].tobytes()
        assert (message.dlc, message.is_extended_id, message.is_remote_frame) == (
            length,
            False,
            bool(frame["is_remote"]),
        )
        assert message.channel == "vcan0"
        assert abs(message.timestamp - int(frame["at_ns"]) * 1e-9) < 1.1e-6


def test_segments_aborts_and_emcys_are_sound_too(tmp_path: Path, dissect: Dissect) -> None:
    """A cam download, a refused request and a lost master: what a good run does not show."""
    config = load_config("paper")
    image = encode_cam_image(prepare(config, 1).cam.profile, 64, 4096, 4096, 0.0)
    taken: list[tuple[int, Frame]] = []

    def procedure(master: Master) -> Procedure[None]:
        yield from download_image(master, node_settings(config)[1], 1, image, True)
        with pytest.raises(SdoAbortedError):
            yield from master.upload(2, 0x2000, 0)
        yield from master.write(2, 0x1016, 1, DataType.UNSIGNED32, 127 << 16 | 100)
        yield from master.wait_for(lambda: master.nodes[2].emergencies > 0, 1.0)

    core = ProcedureCore(build_master(config), procedure)
    bus = VirtualBus(
        [core, build_machine(config, 0)],
        config.bus.bit_rate,
        trace=lambda at_ns, frame: taken.append((at_ns, frame)),
    )
    for _ in range(3):
        core_is_done = bus.run_while(lambda: not core.is_done, bus.now_ns + 2_000_000_000)
        if core_is_done:
            break
    assert core.is_done
    assert core.failure is None
    # The core, and with it the master's heartbeat, is silent from here on.
    bus.run_until(bus.now_ns + 300_000_000)
    frames = np.zeros(len(taken), dtype=FRAME_DTYPE)
    for record, (at_ns, frame) in zip(frames, taken, strict=True):
        data = list(frame.data.ljust(8, b"\0"))
        record["at_ns"], record["cob_id"], record["length"] = at_ns, frame.cob_id, len(frame.data)
        record["data"] = data
    log = tmp_path / "other.log"
    write_candump_log(frames, log)
    rows = decode(dissect, log)
    said = sentences(rows)
    assert {row[3] for row in rows} == {""}
    assert {"Default-SDO (rx): Download segment request", "Default-SDO (rx): Upload segment request"} <= said[0x602]
    assert {"Default-SDO (tx): Download segment response", "Default-SDO (tx): Abort transfer"} <= said[0x582]
    assert [int(row[4], 0) for row in rows if row[4]] == [0x06020000]
    assert said[0x082] == {"EMCY"}
    emergencies = dissect(log, "can.id", "canopen.em.err_code", "canopen.em.err_reg")
    assert [(int(row[1], 0), int(row[2], 0)) for row in emergencies if row[1]] == [(0x8130, 0x11)]


def test_the_viewers_format_of_a_tpdo_gives_the_recorded_values(run: Run) -> None:
    """``python -m can.viewer -d "181:<Hih"``: statusword, position actual value, torque actual value."""
    recording = read_recording(run.log.with_suffix(".mcap"))
    _, structs = _parse_viewer_args(["-i", "virtual", "-c", "x", "-d", "181:<Hih"])
    tpdos = run.frames[run.frames["cob_id"] == 0x181]
    shown = [CanViewer.unpack_data(0x181, structs, bytes(data.tolist())) for data in tpdos["data"]]
    statuswords, positions, torques = zip(*shown, strict=True)
    samples = recording.samples
    count = len(samples)
    assert count <= len(shown) <= count + 1
    assert list(statuswords[:count]) == samples["statusword"][:, 0].tolist()
    assert list(positions[:count]) == samples["position_actual"][:, 0].tolist()
    assert list(torques[:count]) == samples["torque_actual"][:, 0].tolist()
