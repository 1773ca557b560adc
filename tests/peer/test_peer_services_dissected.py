"""Services that a usual run does not show, as a candump log before tshark's CANopen dissector: none is malformed."""

import re
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from drivers.eds import describe_any_node
from drivers.frame import Frame
from drivers.master import Master, Procedure
from drivers.virtual_time import VirtualBus
from gateway.record.recording import write_candump_log
from gateway.record.ring import FRAME_DTYPE
from gateway.running.procedure_core import ProcedureCore
from sim_drive.device.drive import UNCONFIGURED_NODE_ID, Drive
from sim_drive.settings import DriveIdentity, DriveSettings

NODE = 5
MS = 1_000_000
DESCRIBE = describe_any_node(Path(__file__).resolve().parents[2] / "config" / "eds" / "sim_drive.eds")
Dissect = Callable[..., list[list[str]]]


def new_drive(node_id: int) -> Drive:
    settings = DriveSettings(identity=DriveIdentity(serial_number=77))
    return Drive(node_id, DESCRIBE(NODE), settings, lambda image: pytest.fail("no cam here"), None, DESCRIBE)


def talk(drive: Drive, make: Callable[[Master], Procedure[None]]) -> list[tuple[int, Frame]]:
    """Everything on a bus where a master carries out a procedure."""
    taken: list[tuple[int, Frame]] = []
    core = ProcedureCore(Master([NODE], 127, 0), make)
    bus = VirtualBus([core, drive], 1_000_000, trace=lambda at_ns, frame: taken.append((at_ns, frame)))
    assert bus.run_while(lambda: not core.is_done, 100_000 * MS)
    assert core.failure is None
    bus.run_until(bus.now_ns + MS)
    return taken


@pytest.fixture
def sentences(tmp_path: Path, dissect: Dissect) -> Callable[[list[tuple[int, Frame]]], Iterator[tuple[int, str]]]:
    """What tshark says of each frame; it is held against finding one malformed, or having something to remark."""

    def say(taken: list[tuple[int, Frame]]) -> Iterator[tuple[int, str]]:
        frames = np.zeros(len(taken), dtype=FRAME_DTYPE)
        for record, (at_ns, frame) in zip(frames, taken, strict=True):
            record["at_ns"], record["cob_id"], record["length"] = at_ns, frame.cob_id, len(frame.data)
            record["data"] = list(frame.data.ljust(8, b"\0"))
            record["is_remote"] = frame.is_remote
        log = tmp_path / "services.log"
        write_candump_log(frames, log)
        rows = dissect(log, "can.id", "_ws.col.Info", "_ws.expert.message", "_ws.malformed")
        assert len(rows) == len(taken)
        for row, (_, frame) in zip(rows, taken, strict=True):
            assert int(row[0], 0) == frame.cob_id
            assert row[2:] == ["", ""], f"{frame}: {row}"
            yield frame.cob_id, re.sub(r"\s*\[0x[0-9a-f]+\]$", "", row[1])

    return say


def test_block_transfers(sentences: Callable[..., Iterator[tuple[int, str]]]) -> None:
    image = bytes(range(256)) * 8

    def procedure(master: Master) -> Procedure[None]:
        yield from master.download_block(NODE, 0x3000, 1, image)
        assert (yield from master.upload_block(NODE, 0x3000, 1)) == image

    said = list(sentences(talk(new_drive(NODE), procedure)))
    requests = [sentence for cob_id, sentence in said if cob_id == 0x605]
    responses = [sentence for cob_id, sentence in said if cob_id == 0x585]
    # A sub-block's segments have no command that a dissector without memory could know: only the ends are compared.
    assert requests[0] == "Default-SDO (rx): Block download"
    assert responses[0] == "Default-SDO (tx): Block download"
    assert requests[-1] == "Default-SDO (rx): Block upload"
    assert responses[-1] == "Default-SDO (tx): Block upload"


def test_lss_services(sentences: Callable[..., Iterator[tuple[int, str]]]) -> None:
    drive = new_drive(UNCONFIGURED_NODE_ID)
    drive.wake(0)
    taken: list[tuple[int, Frame]] = []
    for request in (
        "4C00000000000000",  # identify unconfigured
        "5100000000800000",  # fast scan
        "0401000000000000",
        "5A00000000000000",
        "5E00000000000000",
        "1105000000000000",  # configure node id
        "1300020000000000",  # configure bit timing
        "1700000000000000",  # store
        "0400000000000000",
    ):
        frame = Frame(0x7E5, bytes.fromhex(request))
        drive.receive(frame, 0)
        taken += [(len(taken) * MS, frame), *((len(taken) * MS, answer) for answer in drive.take_frames())]
    said = list(sentences(taken))
    assert all(sentence.startswith("LSS") for cob_id, sentence in said if cob_id != 0x705), said
    assert said[-1] == (0x705, "NMT Error Control: Boot-up")
    assert len([cob_id for cob_id, _ in said if cob_id == 0x7E4]) == 7


def test_time_guarding_and_sync_with_counter(sentences: Callable[..., Iterator[tuple[int, str]]]) -> None:
    drive = new_drive(NODE)
    drive.wake(0)
    drive.take_frames()
    taken: list[tuple[int, Frame]] = []
    for frame in (
        Frame(0x605, bytes.fromhex("2F1910000A000000")),  # SYNC counter
        Frame(0x605, bytes.fromhex("2F00180201000000")),  # TPDO 1 at every SYNC
        Frame(0x000, b"\x01\x05"),
        Frame(0x080, b"\x01"),
        Frame(0x100, bytes.fromhex("0C5A26057F3A")),
        Frame(0x705, b"", is_remote=True),
        Frame(0x705, b"", is_remote=True),
    ):
        drive.receive(frame, 0)
        taken += [(len(taken) * MS, frame), *((len(taken) * MS, answer) for answer in drive.take_frames())]
    said = list(sentences(taken))
    assert [sentence for cob_id, sentence in said if cob_id not in (0x605, 0x585, 0x705)] == [
        "NMT: Start remote node",
        "SYNC [1]",
        "PDO1 (tx)",
        "TIME STAMP",
    ]
    answers = [sentence for cob_id, sentence in said if cob_id == 0x705][1::2]
    assert answers == ["NMT Error Control: Operational"] * 2
