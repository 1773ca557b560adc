"""A run whose controller goes bus-off, as error frames on a real vcan0 have it, and comes back or does not."""

import json
import socket
import struct
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from drivers.controller import BusErrorClass
from drivers.ports import interface_is_up
from gateway.record.recording import read_recording

pytestmark = [
    pytest.mark.vcan,
    pytest.mark.timeout(400),
    pytest.mark.skipif(not interface_is_up("vcan0"), reason="there is no CAN interface vcan0 that is up"),
]

RAW = struct.Struct("=IB3x8s")
CAN_ERR_FLAG = 0x20000000
PATIENCE_S = 240.0
LOOK_S = 2.0
"""How often a gateway that is not heard is looked for."""
OUTAGE_S = 1.5
HEARTBEAT_TIMEOUT_MS = 5000
SETTLE_S = 0.5
MOVED_COUNTS = 400


@pytest.fixture
def raw() -> Iterator[socket.socket]:
    with socket.socket(29, socket.SOCK_RAW, 1) as opened:
        opened.settimeout(LOOK_S)
        opened.bind(("vcan0",))
        yield opened


def error_frame(raw: socket.socket, what: int) -> None:
    raw.send(RAW.pack(CAN_ERR_FLAG | what, 8, bytes(8)))


def heard(raw: socket.socket, span_s: float) -> list[int]:
    """COB-IDs of all frames within a span."""
    cob_ids: list[int] = []
    end_s = time.monotonic() + span_s
    while (left_s := end_s - time.monotonic()) > 0.0:
        raw.settimeout(left_s)
        try:
            cob_ids.append(RAW.unpack(raw.recv(16))[0])
        except TimeoutError:
            break
    return cob_ids


def wait_for_motion(raw: socket.socket, process: "subprocess.Popen[str]", folder: Path) -> None:
    end_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < end_s:
        assert process.poll() is None, (folder / "stderr").read_text()
        try:
            cob_id, _, data = RAW.unpack(raw.recv(16))
        except TimeoutError:
            continue
        if cob_id == 0x201 and abs(int.from_bytes(data[2:6], "little", signed=True)) > MOVED_COUNTS:
            return
    raise AssertionError("the machine has not moved")


@pytest.mark.parametrize("is_coming_back", [True, False])
def test_a_run_ends_in_order_whether_the_controller_comes_back_or_not(
    is_coming_back: bool,
    start_own_sim_drive: Callable[..., dict[str, Any]],
    unhurried: Path,
    drive_gateway: Callable[..., "subprocess.Popen[str]"],
    tmp_path: Path,
    raw: socket.socket,
) -> None:
    config = yaml.safe_load(unhurried.read_text())
    config["recovery"] = {"bus_off_timeout_s": 10.0 if is_coming_back else 2.0}
    # Drives that a slow computer leaves unheard are none of this test's business: the controller's word counts at once.
    config["guard"]["bus_off"]["persistence_cycles"] = 500
    config["bus"]["heartbeat_timeout_ms"] = HEARTBEAT_TIMEOUT_MS
    path = tmp_path / "machine.yaml"
    path.write_text(yaml.safe_dump(config))
    start_own_sim_drive("--interface", "socketcan", "--channel", "vcan0", "--realtime", config=str(path))
    options = ("-i", "socketcan", "-c", "vcan0", "--cycles", "20", "--record", "run.mcap", "--json")
    process = drive_gateway("run", path, *options, folder=tmp_path)
    try:
        wait_for_motion(raw, process, tmp_path)
        error_frame(raw, BusErrorClass.BUS_OFF)
        time.sleep(SETTLE_S)
        with socket.socket(29, socket.SOCK_RAW, 1) as meanwhile:
            # A socket of its own has nothing left over from before.
            meanwhile.bind(("vcan0",))
            during = heard(meanwhile, OUTAGE_S - SETTLE_S)
        assert not {0x080, 0x201, 0x202, 0x77F} & set(during), "neither loop nor kernel sends anything"
        if is_coming_back:
            error_frame(raw, BusErrorClass.RESTARTED)
        output, _ = process.communicate(timeout=PATIENCE_S)
    finally:
        process.kill()
        process.wait(PATIENCE_S)
    said = (tmp_path / "stderr").read_text()
    assert process.returncode == 1, said
    recording = read_recording(tmp_path / "run.mcap")
    texts = [str(event.data["text"]) for event in recording.events]
    assert "the gateway's CAN controller is bus-off" in texts
    told = [text for text in texts if text.startswith("the gateway's CAN controller: ")]
    assert told[0] == "the gateway's CAN controller: it is restarted after 100 ms"
    assert told[1].endswith("it has no controller that could be restarted")
    if is_coming_back:
        assert json.loads(output)["stopped_by"] == "bus_off"
        assert "the gateway's CAN controller is error-active, 0 transmit errors, 0 receive errors" in texts
        axes = [text for text in texts if text.startswith("axis ") and "ready for a new run" in text]
        assert len(axes) == 2, texts
    else:
        assert "the gateway's CAN controller has been bus-off for 2 s and is not back" in said
        assert recording.stopped_by == "bus_lost"
    with socket.socket(29, socket.SOCK_RAW, 1) as afterwards:
        afterwards.bind(("vcan0",))
        assert 0x080 not in heard(afterwards, 0.1), "SYNC has ended with the run"
