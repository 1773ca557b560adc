"""The LSS master of ``canopen`` before the emulated drive: selection, configuration, inquiry and fast scan.

``canopen`` waits in threads for what it is answered before it waits, so that no thread or time takes part here: what it
sends is answered at once, and where nobody answers it waits a millisecond instead of its half second.
"""

from collections.abc import Callable
from pathlib import Path

import canopen
import canopen.lss
import pytest

from drivers.eds import describe_any_node
from drivers.frame import Frame
from drivers.object_dictionary import ObjectDictionary
from sim_drive.communication.parameters import MemoryParameterStore
from sim_drive.device.drive import UNCONFIGURED_NODE_ID, Drive
from sim_drive.settings import DriveIdentity, DriveSettings

EDS = Path(__file__).resolve().parents[2] / "config" / "eds" / "sim_drive.eds"
DESCRIBE = describe_any_node(EDS)
DESCRIPTIONS: dict[int, ObjectDictionary] = {}
LSS_RESPONSE = 0x7E4


def describe(node_id: int) -> ObjectDictionary:
    if node_id not in DESCRIPTIONS:
        DESCRIPTIONS[node_id] = DESCRIBE(node_id)
    return DESCRIPTIONS[node_id]


def new_drive(node_id: int, serial_number: int, store: MemoryParameterStore | None = None) -> Drive:
    settings = DriveSettings(identity=DriveIdentity(serial_number=serial_number))
    drive = Drive(node_id, describe(1), settings, lambda image: pytest.fail("no cam here"), store, describe)
    drive.wake(0)
    return drive


class Wire(canopen.Network):
    """A network of canopen's whose bus is a list of drives."""

    def __init__(self, drives: list[Drive]) -> None:
        super().__init__()
        self.drives = drives
        self.heard: list[str] = []
        self.lss.RESPONSE_TIMEOUT = 0.001
        self._deliver()

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        for drive in self.drives:
            drive.receive(Frame(can_id, bytes(data), remote), 0)
        self._deliver()

    def _deliver(self) -> None:
        frames = [frame for drive in self.drives for frame in drive.take_frames()]
        self.heard += [str(frame) for frame in frames]
        if any(frame.cob_id == LSS_RESPONSE for frame in frames):
            # Equal frames of several slaves are one frame on a wire.
            frame = next(frame for frame in frames if frame.cob_id == LSS_RESPONSE)
            self.notify(frame.cob_id, bytearray(frame.data), 0.0)


@pytest.fixture(autouse=True)
def _no_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(canopen.lss.time, "sleep", lambda span_s: None)


@pytest.fixture
def wire() -> Callable[..., Wire]:
    return lambda *drives: Wire(list(drives))


def test_selection_and_inquiry(wire: Callable[..., Wire]) -> None:
    network = wire(new_drive(1, 11), new_drive(2, 22))
    lss = network.lss
    assert lss.send_switch_state_selective(0x4D2, 0x1024, 0x10000, 22)
    assert lss.inquire_node_id() == 2
    identity = [lss.inquire_lss_address(command) for command in (0x5A, 0x5B, 0x5C, 0x5D)]
    assert identity == [0x4D2, 0x1024, 0x10000, 22]
    lss.send_switch_state_global(lss.WAITING_STATE)
    with pytest.raises(canopen.lss.LssError):
        lss.send_switch_state_selective(0x4D2, 0x1024, 0x10000, 33)
    with pytest.raises(canopen.lss.LssError):
        lss.inquire_node_id()


def test_node_id_is_configured_stored_and_taken(wire: Callable[..., Wire]) -> None:
    store = MemoryParameterStore()
    network = wire(new_drive(1, 11, store))
    lss = network.lss
    lss.send_switch_state_global(lss.CONFIGURATION_STATE)
    lss.configure_node_id(42)
    lss.configure_bit_timing(2)
    lss.activate_bit_timing(10)
    lss.store_configuration()
    lss.send_switch_state_global(lss.WAITING_STATE)
    with pytest.raises(canopen.lss.LssError):
        lss.configure_node_id(43)
    network.nmt.send_command(0x82)
    assert network.heard[-1] == "72A#00"
    assert new_drive(1, 11, store).node_id == 42


@pytest.mark.parametrize("wrong", [0, 128, 254])
def test_impossible_node_ids_are_refused(wire: Callable[..., Wire], wrong: int) -> None:
    lss = wire(new_drive(1, 11)).lss
    lss.send_switch_state_global(lss.CONFIGURATION_STATE)
    with pytest.raises(canopen.lss.LssError, match="LSS Error: 1"):
        lss.configure_node_id(wrong)


@pytest.mark.parametrize("bit_timing", [5, 9, 255])
def test_unsupported_bit_timings_are_refused(wire: Callable[..., Wire], bit_timing: int) -> None:
    lss = wire(new_drive(1, 11)).lss
    lss.send_switch_state_global(lss.CONFIGURATION_STATE)
    with pytest.raises(canopen.lss.LssError, match="LSS Error: 1"):
        lss.configure_bit_timing(bit_timing)


def test_identification_of_slaves(wire: Callable[..., Wire]) -> None:
    network = wire(new_drive(1, 11), new_drive(UNCONFIGURED_NODE_ID, 22))
    network.heard.clear()
    network.lss.send_identify_remote_slave(0x4D2, 0x1024, 0, 0xFFFFFFFF, 10, 20)
    assert network.heard == ["7E4#4F00000000000000"]
    network.lss.send_identify_remote_slave(0x4D2, 0x1024, 0, 0xFFFF, 10, 20)
    assert len(network.heard) == 1
    network.lss.send_identify_non_configured_remote_slave()
    assert network.heard[1:] == ["7E4#5000000000000000"]


def test_fast_scan_gives_every_new_node_a_node_id(wire: Callable[..., Wire]) -> None:
    serials = [0x00000000, 0x00000001, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 0xA5A5A5A5]
    network = wire(new_drive(1, 11), *(new_drive(UNCONFIGURED_NODE_ID, serial) for serial in serials))
    lss = network.lss
    found: list[int] = []
    for node_id in range(10, 10 + len(serials)):
        is_found, identity = lss.fast_scan()
        assert is_found
        assert identity[:3] == [0x4D2, 0x1024, 0x10000]
        found.append(identity[3])
        assert lss.inquire_node_id() == UNCONFIGURED_NODE_ID
        lss.configure_node_id(node_id)
        lss.store_configuration()
        lss.send_switch_state_global(lss.WAITING_STATE)
        assert network.heard[-1] == f"{0x700 + node_id:03X}#00"
    # Of several nodes the scan finds that one first whose number has a 0 where they differ first.
    assert found == sorted(serials)
    assert lss.fast_scan() == (False, None)
    assert sorted(drive.node_id for drive in network.drives) == [1, 10, 11, 12, 13, 14, 15]


def test_new_node_is_a_remote_node_at_once(wire: Callable[..., Wire]) -> None:
    network = wire(new_drive(UNCONFIGURED_NODE_ID, 22))
    is_found, _ = network.lss.fast_scan()
    assert is_found
    network.lss.configure_node_id(9)
    network.lss.send_switch_state_global(network.lss.WAITING_STATE)
    drive = network.drives[0]
    drive.receive(Frame(0x609, bytes.fromhex("4018100400000000")), 0)
    assert [str(frame) for frame in drive.take_frames()] == ["589#4318100416000000"]
