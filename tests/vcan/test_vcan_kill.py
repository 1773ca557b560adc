"""A gateway killed in motion stops the machine: by the drives' own guard, or by what is left of the gateway."""

import os
import select
import signal
import subprocess
from collections.abc import Callable, Iterator
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
ANSWER_S = 10.0
MOVING_COUNTS = 1000
OPERATION_ENABLED = 0x27
HEARTBEAT_TIMEOUT_S = 1.0
"""Of ``unhurried``, whose drives have no watchdog over SYNC: their watch over the heartbeat alone stops them."""
STATED_S = HEARTBEAT_TIMEOUT_S + 0.2
"""After its last set-point, by the drive's own clock, an axis is without torque: the time-out, and a ramp. A heartbeat
that was sent after the last set-point counts from then."""
Start = Callable[..., "subprocess.Popen[str]"]


@pytest.fixture
def bus(start_own_sim_drive: Callable[..., dict[str, Any]], unhurried: Path) -> Iterator[can.BusABC]:
    """The bus of an emulated machine at its home position; the first TPDOs pass."""
    start_own_sim_drive("--interface", "socketcan", "--channel", "vcan0", "--realtime", config=str(unhurried))
    with can.Bus(interface="socketcan", channel="vcan0", can_filters=[{"can_id": 0x180, "can_mask": 0x780}]) as bus:
        yield bus


@pytest.fixture
def emergency_bus(bus: can.BusABC) -> Iterator[can.BusABC]:
    """EMCY of both drives alone: a queue that TPDOs filled would have lost them."""
    filters: list[Any] = [{"can_id": 0x080 + node, "can_mask": 0x7FF} for node in (1, 2)]
    with can.Bus(interface="socketcan", channel="vcan0", can_filters=filters) as emergencies:
        yield emergencies


@pytest.fixture
def drives() -> Iterator[list[canopen.RemoteNode]]:
    network = canopen.Network()
    network.connect(interface="socketcan", channel="vcan0")
    nodes = [network.add_node(node_id, EDS) for node_id in (1, 2)]
    for node in nodes:
        node.sdo.RESPONSE_TIMEOUT = ANSWER_S
    yield nodes
    network.disconnect()


def child_of(process: "subprocess.Popen[str]", module: str) -> int:
    """Process id of the child that runs ``module``."""
    for folder in Path("/proc").iterdir():
        if not folder.name.isdigit():
            continue
        try:
            parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
            command = (folder / "cmdline").read_bytes().decode().split("\0")
        except OSError:
            continue
        if parent == process.pid and module in command:
            return int(folder.name)
    raise AssertionError(f"no child of {process.pid} runs {module}")


def wait_for_motion(bus: can.BusABC, process: "subprocess.Popen[str]", folder: Path) -> None:
    """Return when the CV axis is enabled and has turned by MOVING_COUNTS."""
    for _ in range(200_000):
        message = bus.recv(1.0)
        assert process.poll() is None, f"the run is over already: {(folder / 'stderr').read_text()}"
        if message is None or message.arbitration_id != 0x181:
            continue
        statusword = int.from_bytes(message.data[:2], "little")
        position = int.from_bytes(message.data[2:6], "little", signed=True)
        if statusword & 0x6F == OPERATION_ENABLED and abs(position) > MOVING_COUNTS:
            return
    raise AssertionError("the machine never moved")


def wait_until_disabled(node: canopen.RemoteNode) -> int:
    """The statusword's state once the drive has left Operation enabled, and has come to its rest."""
    for _ in range(100_000):
        try:
            state = node.sdo[0x6041].raw & 0x6F
        except canopen.sdo.SdoCommunicationError:
            # An answer to the gateway's own last request, which canopen's listener has only now come to.
            continue
        if state & 0x4F in {0x08, 0x40}:
            return state & 0x4F
    raise AssertionError(f"node {node.id} is still in state {state:02X}")


def wait_for_rest(drives: list[canopen.RemoteNode]) -> None:
    for _ in range(2000):
        before = [node.sdo[0x6064].raw for node in drives]
        at_rest = all(node.sdo[0x606C].raw == 0 for node in drives)
        if at_rest and [node.sdo[0x6064].raw for node in drives] == before:
            return
    raise AssertionError("the machine never came to rest")


def emergencies(bus: can.BusABC) -> dict[int, list[int]]:
    """The emergency error codes that wait in the bus' queue, by node."""
    codes: dict[int, list[int]] = {}
    while (message := bus.recv(0)) is not None:
        code = int.from_bytes(message.data[:2], "little")
        codes.setdefault(message.arbitration_id - 0x080, []).append(code)
    return codes


def start_run(drive_gateway: Start, unhurried: Path, folder: Path) -> "subprocess.Popen[str]":
    options = ("-i", "socketcan", "-c", "vcan0", "--cycles", "500", "--record", "run.mcap", "--json")
    return drive_gateway("run", unhurried, *options, folder=folder)


def test_a_killed_cyclic_process_is_a_fault_of_every_drive(
    unhurried: Path,
    drive_gateway: Start,
    drives: list[canopen.RemoteNode],
    bus: can.BusABC,
    emergency_bus: can.BusABC,
    tmp_path: Path,
) -> None:
    process = start_run(drive_gateway, unhurried, tmp_path)
    wait_for_motion(bus, process, tmp_path)
    os.kill(child_of(process, "gateway.running.cyclic_process"), signal.SIGKILL)

    # Heartbeat lost, fault reaction, fault: with nobody left to tell them.
    assert [wait_until_disabled(node) for node in drives] == [0x08, 0x08]
    assert [node.sdo[0x603F].raw for node in drives] == [0x8130, 0x8130]
    wait_for_rest(drives)
    assert emergencies(emergency_bus) == {1: [0x8130], 2: [0x8130]}
    ages_s = [node.sdo[0x3051].raw * 1e-6 for node in drives]
    print(f"\ntorque off {', '.join(f'{age_s:.3f}' for age_s in ages_s)} s after the last set-point")
    assert all(0.5 * HEARTBEAT_TIMEOUT_S < age_s < STATED_S for age_s in ages_s)

    output, _ = process.communicate(timeout=PATIENCE_S)
    complaints = (tmp_path / "stderr").read_text()
    assert process.returncode == 1, complaints
    assert "the cyclic process was ended by SIGKILL" in complaints
    assert "Traceback" not in complaints
    assert output == ""
    assert len(read_recording(tmp_path / "run.mcap").samples) > 100


@pytest.mark.slow
def test_a_cyclic_process_that_has_lost_its_parent_stops_the_machine_on_the_cam(
    unhurried: Path,
    drive_gateway: Start,
    drives: list[canopen.RemoteNode],
    bus: can.BusABC,
    emergency_bus: can.BusABC,
    tmp_path: Path,
) -> None:
    process = start_run(drive_gateway, unhurried, tmp_path)
    wait_for_motion(bus, process, tmp_path)
    recorder = os.pidfd_open(child_of(process, "gateway.running.recorder"))
    cyclic = os.pidfd_open(child_of(process, "gateway.running.cyclic_process"))
    process.kill()
    process.communicate(timeout=PATIENCE_S)
    # Until it has ended, the SDO channels of the drives are its own.
    assert select.select([cyclic], [], [], PATIENCE_S)[0]
    os.close(cyclic)

    # Ramped down and disabled in good order: no fault.
    assert [wait_until_disabled(node) for node in drives] == [0x40, 0x40]
    wait_for_rest(drives)
    codes = emergencies(emergency_bus)
    # It has released the drives' watch over its heartbeat before it went.
    assert codes == {}
    assert [node.sdo[0x6041].raw & 0x4F for node in drives] == [0x40, 0x40]
    # The recorder has outlived its parent too, until it had everything.
    assert select.select([recorder], [], [], PATIENCE_S)[0]
    os.close(recorder)
    recording = read_recording(tmp_path / "run.mcap")
    assert recording.is_complete
    assert recording.stopped_by == "operator"
