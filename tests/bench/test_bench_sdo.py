"""SDO between our master and the emulated drive, at 1 Mbit/s in virtual time: printed, never asserted. -m bench -s."""

import random
import time
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any

import pytest

from drivers.eds import load_eds
from drivers.errors import SdoAbortedError
from drivers.master import Master
from drivers.virtual_time import VirtualBus
from gateway.running.procedure_core import ProcedureCore
from sim_drive.device.drive import Drive
from sim_drive.settings import DriveSettings

pytestmark = pytest.mark.bench

NODE = 5
DESCRIPTION = load_eds(Path(__file__).resolve().parents[2] / "config" / "eds" / "sim_drive.eds", NODE)
IMAGE = random.Random(0).randbytes(32 * 1024)
SLOT, DATA = 0x3000, 1
LIMIT_NS = 3600 * 1_000_000_000

Make = Callable[[Master], Generator[int, None, Any]]


def carry_out(title: str, make: Make) -> Any:
    drive = Drive(NODE, DESCRIPTION, DriveSettings(), lambda image: pytest.fail("no cam here"))
    drive.dictionary.entry(SLOT, DATA).value = IMAGE
    core = ProcedureCore(Master([NODE], 127, 0), make)
    bus = VirtualBus([core, drive], 1_000_000)
    began = time.perf_counter()
    assert bus.run_while(lambda: not core.is_done, LIMIT_NS)
    wall_s = time.perf_counter() - began
    assert core.failure is None, core.failure
    print(
        f"{title:44} {bus.frame_count:6} frames  {bus.now_ns * 1e-9:7.3f} s at 1 Mbit/s  {wall_s:6.3f} s of wall time"
        f"  {wall_s / bus.frame_count * 1e6:5.1f} us a frame"
    )
    return core.result


def test_full_dictionary_upload() -> None:
    places = [(v.index, v.subindex) for v in DESCRIPTION if v.index >= 0x1000 and v.access.is_readable]

    def by(upload: Callable[[Master, int, int], Generator[int, None, bytes]]) -> Make:
        def procedure(master: Master) -> Generator[int, None, int]:
            read = 0
            for index, subindex in places:
                if (index, subindex) == (SLOT, DATA):
                    continue
                try:
                    yield from upload(master, index, subindex)
                except SdoAbortedError:
                    continue  # an error history without errors, an empty slot
                read += 1
            return read

        return procedure

    print()
    segmented = carry_out("full dictionary, as it comes", by(lambda master, i, s: master.upload(NODE, i, s)))
    blocks = carry_out("full dictionary, all in blocks", by(lambda master, i, s: master.upload_block(NODE, i, s)))
    switched = carry_out(
        "full dictionary, in blocks above 21 bytes",
        by(lambda master, i, s: master.upload_block(NODE, i, s, protocol_switch_threshold=21)),
    )
    print(f"{segmented} of {len(places)} entries have data")
    assert segmented == blocks == switched > 200


def test_transfers_of_32_kibibytes() -> None:
    print()
    carry_out("32 KiB download, segmented", lambda master: master.download(NODE, SLOT, DATA, IMAGE))
    carry_out("32 KiB download, in blocks", lambda master: master.download_block(NODE, SLOT, DATA, IMAGE))
    assert carry_out("32 KiB upload, segmented", lambda master: master.upload(NODE, SLOT, DATA)) == IMAGE
    assert carry_out("32 KiB upload, in blocks", lambda master: master.upload_block(NODE, SLOT, DATA)) == IMAGE
