"""The product's programs against each other on a real vcan0, and candump, tshark and canopen listening."""

import itertools
import json
import shutil
import signal
import subprocess
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import can
import canopen
import pytest

from drivers.ports import interface_is_up
from gateway.record.recording import read_recording

pytestmark = [
    pytest.mark.vcan,
    pytest.mark.timeout(400),
    pytest.mark.skipif(not interface_is_up("vcan0"), reason="there is no CAN interface vcan0 that is up"),
]

ROOT = Path(__file__).resolve().parent.parent.parent
EDS = str(ROOT / "config" / "eds" / "sim_drive.eds")
PATIENCE_S = 240.0
CYCLE = [0x080, 0x181, 0x182, 0x201, 0x202]
Start = Callable[..., "subprocess.Popen[str]"]


@pytest.fixture(scope="module")
def emulator(start_sim_drive: Callable[..., dict[str, Any]], unhurried: Path) -> dict[str, Any]:
    options = ("--interface", "socketcan", "--channel", "vcan0", "--realtime")
    return start_sim_drive(*options, config=str(unhurried))


@contextmanager
def candump(log: Path) -> Iterator[None]:
    program = shutil.which("candump")
    assert program is not None, "can-utils are not installed"
    with log.open("wb") as output:
        process = subprocess.Popen([program, "-L", "-r", "8000000", "vcan0"], stdout=output, stderr=subprocess.PIPE)
    try:
        yield
    finally:
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=PATIENCE_S)


def test_a_users_canopen_program_reaches_the_emulator(emulator: dict[str, Any]) -> None:
    """The README's recipe for a CI of one's own."""
    assert (emulator["interface"], emulator["channel"]) == ("socketcan", "vcan0")
    network = canopen.Network(can.Bus(interface="socketcan", channel="vcan0"))
    network.connect()
    try:
        for node_id in (1, 2):
            node = network.add_node(node_id, EDS)
            node.sdo.RESPONSE_TIMEOUT = PATIENCE_S
            assert node.sdo[0x1000].raw == 0x00020192
            assert node.sdo[0x1018][4].raw == node_id
            assert node.sdo[0x1008].raw == "sim-drive"
            assert node.sdo[0x6041].raw & 0x4F == 0x40
            node.sdo[0x607D][1].raw = -5
            assert node.sdo[0x607D][1].raw == -5
            node.nmt.state = "RESET"
            assert node.sdo[0x607D][1].raw == -0x80000000
    finally:
        network.disconnect()


def test_a_cam_is_downloaded_and_verified(
    emulator: dict[str, Any], unhurried: Path, drive_gateway: Start, tmp_path: Path
) -> None:
    compiled = drive_gateway("compile", unhurried, "-o", "cam.json", "--json", folder=tmp_path)
    figures = json.loads(compiled.communicate(timeout=PATIENCE_S)[0])["figures"]
    assert compiled.returncode == 0
    assert abs(figures["displacement_deg"] - 99.8) <= 0.2
    options = ("-i", "socketcan", "-c", "vcan0", "--slot", "3", "--json")
    download = drive_gateway("download", unhurried, "cam.json", *options, folder=tmp_path)
    answer = json.loads(download.communicate(timeout=PATIENCE_S)[0])
    assert download.returncode == 0, (tmp_path / "stderr").read_text()
    assert (answer["node_id"], answer["slot"], answer["points"], answer["is_selected"]) == (2, 3, 1024, True)

    network = canopen.Network()
    network.connect(interface="socketcan", channel="vcan0")
    try:
        node = network.add_node(2, EDS)
        node.sdo.RESPONSE_TIMEOUT = PATIENCE_S
        image = node.sdo.upload(0x3002, 1)
        assert len(image) == answer["bytes"]
        assert zlib.crc32(image) == answer["crc"] == node.sdo[0x3002][5].raw
        assert node.sdo[0x3002][3].raw == 2, "valid"
        assert node.sdo[0x3010].raw == 3
    finally:
        network.disconnect()


@pytest.fixture(scope="module")
def run(
    emulator: dict[str, Any], unhurried: Path, drive_gateway: Start, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, dict[str, Any]]:
    """Folder and JSON of a run of one machine cycle; the folder has run.mcap and candump.log."""
    folder = tmp_path_factory.mktemp("run")
    with candump(folder / "candump.log"):
        options = ("-i", "socketcan", "-c", "vcan0", "--cycles", "1", "--record", "run.mcap", "--json")
        process = drive_gateway("run", unhurried, *options, folder=folder)
        output, _ = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, (folder / "stderr").read_text()
    return folder, json.loads(output)


def test_a_run_reports_all_that_scripts_rely_on(run: tuple[Path, dict[str, Any]]) -> None:
    folder, answer = run
    assert set(answer["axes"]) == {"cv", "servo"}
    for axis in answer["axes"].values():
        assert {"max", "min", "rms", "max_abs_at_master_deg"} <= set(axis["following_error_counts"])
        for key in ("position_actual_counts", "velocity_actual_counts_per_s", "demand_velocity_rad_per_s"):
            assert axis[key]["max"] > axis[key]["min"] or key.startswith("demand")
    assert {"max", "rms"} <= set(answer["end_effector_error_mm"])
    cycle = answer["cycle"]
    assert cycle["period_s"] == 0.004
    assert cycle["count"] > 0
    assert {"p50", "p99", "max"} <= set(cycle["sync_period_deviation_us"])
    assert cycle["missed_tpdo"] >= 0
    assert cycle["missed_rpdo_deadline"] >= 0
    assert cycle["loop_cpu_us_per_cycle"]
    assert answer["machine_cycles"] >= 1
    assert answer["stopped_by"] == "completed"
    assert read_recording(folder / "run.mcap").is_complete
    servo = answer["axes"]["servo"]
    demand = servo["demand_velocity_rad_per_s"]
    assert demand["max"] == pytest.approx(4.48, rel=0.01)
    assert demand["min"] == pytest.approx(-18.96, rel=0.01)
    position = servo["position_actual_counts"]
    assert (position["max"] - position["min"]) * 360 / 4096 == pytest.approx(99.8, abs=3.0)


def logged(log: Path) -> list[can.Message]:
    with can.LogReader(log) as reader:
        return list(reader)


def test_candump_saw_every_cycle_in_order(run: tuple[Path, dict[str, Any]]) -> None:
    folder, answer = run
    messages = logged(folder / "candump.log")
    identifiers = [message.arbitration_id for message in messages]
    cyclic = [identifier for identifier in identifiers if identifier in CYCLE]
    starts = [place for place, identifier in enumerate(cyclic) if identifier == 0x080]
    cycles = [cyclic[a:b] for a, b in itertools.pairwise(starts)]
    assert len(starts) >= answer["cycle"]["count"]
    # Every SYNC is answered with both demands, in order; by a processor that was away, several at once.
    counts = Counter(cyclic)
    assert [c for c in cyclic if c >= 0x200] == [0x201, 0x202] * counts[0x201]
    assert abs(counts[0x201] - len(starts)) <= 1
    assert abs(counts[0x181] - len(starts)) <= 1
    assert counts[0x181] == counts[0x182]
    tpdos = [identifier for identifier in cyclic if identifier in {0x181, 0x182}]
    assert tpdos == [0x181, 0x182] * counts[0x181]
    # A TPDO that is late counts as missed, and comes after the demands.
    assert sum(cycle == CYCLE for cycle in cycles) > len(cycles) // 4


def test_candump_saw_the_services_around_the_cycle(run: tuple[Path, dict[str, Any]]) -> None:
    folder, _ = run
    messages = logged(folder / "candump.log")
    for node in (1, 2):
        states = [m.data[0] for m in messages if m.arbitration_id == 0x700 + node]
        assert 0x00 in states, "boot-up"
        assert 0x05 in states, "operational"
        assert states[-1] == 0x7F, "left in pre-operational"
        commands = [bytes(m.data) for m in messages if m.arbitration_id == 0x000 and m.data[1] == node]
        assert commands == [bytes((0x82, node)), bytes((0x01, node)), bytes((0x80, node))]
    assert {bytes(m.data) for m in messages if m.arbitration_id == 0x77F} == {b"\x05"}
    assert not any(m.is_error_frame or m.is_remote_frame or m.is_extended_id for m in messages)
    assert {m.arbitration_id for m in messages} <= {
        0x000, *CYCLE, 0x081, 0x082, 0x581, 0x582, 0x601, 0x602, 0x701, 0x702, 0x77F
    }  # fmt: skip


def test_tshark_decodes_the_live_log(run: tuple[Path, dict[str, Any]], dissect: Callable[..., list[list[str]]]) -> None:
    log = run[0] / "candump.log"
    rows = dissect(log, "can.id", "frame.protocols", "_ws.col.Info", "_ws.expert.message", "canopen.sdo.abort_code")
    assert len(rows) == len(logged(log))
    assert {int(row[0], 0) for row in rows if not row[1].endswith(":can:canopen")} == {0x080}
    assert {(row[3], row[4]) for row in rows} == {("", "")}
    said = {row[2].split(" [")[0] for row in rows}
    assert {"SYNC", "PDO1 (tx)", "PDO1 (rx)", "NMT Error Control: Boot-up", "NMT: Start remote node"} <= said


def test_the_recording_has_the_frames_that_candump_saw(run: tuple[Path, dict[str, Any]]) -> None:
    folder, _ = run
    frames = read_recording(folder / "run.mcap").frames()
    recorded = [(int(f["cob_id"]), f["data"][: f["length"]].tobytes()) for f in frames]
    seen = [(m.arbitration_id, bytes(m.data)) for m in logged(folder / "candump.log")]
    # The recorder comes to the bus a little later than candump, and leaves it a little sooner.
    assert len(recorded) > 0.9 * len(seen)
    start = next(n for n in range(len(seen)) if seen[n : n + 50] == recorded[:50])
    assert seen[start : start + len(recorded)] == recorded
