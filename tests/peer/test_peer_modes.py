"""The package ``canopen`` runs the modes of the emulated drive as a user's program would: BaseNode402, SDO and PDO."""

import queue
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import canopen
import pytest
from canopen.profiles.p402 import BaseNode402

EDS = str(Path(__file__).resolve().parents[2] / "config" / "eds" / "sim_drive.eds")
PATIENCE_S = 10.0
POLLS = 50_000
NODE = 3


@pytest.fixture(scope="module")
def place(start_sim_drive: Callable[..., dict[str, Any]]) -> dict[str, Any]:
    return start_sim_drive("--interface", "socketcand", "--port", "0", config="--nodes=3")


@pytest.fixture
def node(place: dict[str, Any]) -> Iterator[BaseNode402]:
    """A drive with an axis of its own, just booted, referenced and operational."""
    network = canopen.Network()
    network.connect(
        interface="socketcand", host=place["host"], port=place["port"], channel=place["channel"], tcp_tune=True
    )
    node = BaseNode402(NODE, EDS)
    node.sdo.RESPONSE_TIMEOUT = PATIENCE_S
    for name in ("SWITCH_OP_MODE", "SWITCH_STATE_FINAL", "SWITCH_STATE_SINGLE", "CHECK_TPDO"):
        setattr(node, f"TIMEOUT_{name}", PATIENCE_S)
    network.add_node(node)
    states: queue.Queue[int] = queue.Queue()
    node.nmt.add_heartbeat_callback(states.put)
    node.nmt.state = "RESET"
    while states.get(timeout=PATIENCE_S) != 0:
        pass
    node.setup_402_state_machine()
    node.nmt.state = "OPERATIONAL"
    yield node
    node.nmt.state = "RESET"
    network.disconnect()


def enable(node: BaseNode402, mode: str) -> None:
    assert node.is_op_mode_supported(mode)
    node.op_mode = mode
    node.state = "OPERATION ENABLED"
    assert node.op_mode == mode


def wait_for(node: BaseNode402, mask: int, value: int) -> int:
    for _ in range(POLLS):
        statusword: int = node.sdo[0x6041].raw
        if statusword & mask == value:
            return statusword
    raise AssertionError(f"the statusword stays at {node.sdo[0x6041].raw:04X}h")


def test_profile_position(node: BaseNode402) -> None:
    enable(node, "PROFILED POSITION")
    start = node.sdo[0x6064].raw
    for distance in (2000, -500):
        node.sdo[0x607A].raw = start + distance
        node.sdo[0x6040].raw = 0x3F
        wait_for(node, 0x1000, 0x1000)  # the set-point is acknowledged
        node.sdo[0x6040].raw = 0x0F
        wait_for(node, 0x1400, 0x0400)  # and reached
        assert abs(node.sdo[0x6064].raw - start - distance) <= node.sdo[0x6067].raw
        assert node.sdo[0x6062].raw == start + distance


def test_profile_velocity(node: BaseNode402) -> None:
    enable(node, "PROFILED VELOCITY")
    wait_for(node, 0x1000, 0x1000)
    before = node.sdo[0x6064].raw
    node.sdo[0x60FF].raw = 8000
    wait_for(node, 0x1400, 0x0400)
    assert node.sdo[0x6064].raw > before
    assert abs(node.sdo[0x606C].raw - 8000) <= 2048
    node.sdo[0x6040].raw = 0x010F  # halt
    wait_for(node, 0x1400, 0x1400)
    assert node.state == "OPERATION ENABLED"


def test_profile_torque(node: BaseNode402) -> None:
    node.sdo[0x6087].raw = 100_000
    enable(node, "PROFILED TORQUE")
    before = node.sdo[0x6064].raw
    node.sdo[0x6071].raw = 100
    wait_for(node, 0x0400, 0x0400)
    for _ in range(POLLS):
        if abs(node.sdo[0x6077].raw - 100) <= 1 and node.sdo[0x6064].raw > before:
            break
    else:
        raise AssertionError("the torque does not move the axis")
    node.state = "SWITCH ON DISABLED"


def test_homing_on_the_index_pulse(node: BaseNode402) -> None:
    node.sdo[0x6098].raw = 34
    node.sdo[0x607C].raw = 5000
    node.sdo[0x6099][2].raw = 4096
    enable(node, "HOMING")
    assert node.homing(timeout=PATIENCE_S)
    wait_for(node, 0x3400, 0x1400)
    # It rests beyond the pulse by no more than the braking takes: 4096^2 / 200000, and a little lag.
    assert 5000 <= node.sdo[0x6064].raw <= 5000 + 84 + 24


def test_homing_without_the_switch_is_an_error(node: BaseNode402) -> None:
    node.sdo[0x6098].raw = 7
    enable(node, "HOMING")
    node.sdo[0x6040].raw = 0x1F
    assert wait_for(node, 0x2000, 0x2000) & 0x1000 == 0


def test_interpolated_position(node: BaseNode402) -> None:
    node.sdo[0x60C2][1].raw = 20
    enable(node, "INTERPOLATED POSITION")
    start = node.sdo[0x6064].raw
    for step in (50, 100, 150, 150):
        node.sdo[0x60C1][1].raw = start + step
    node.sdo[0x6040].raw = 0x1F
    wait_for(node, 0x1400, 0x1400)
    assert node.sdo[0x6062].raw == start + 150
