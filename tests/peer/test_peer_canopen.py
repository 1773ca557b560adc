"""The package ``canopen`` as the master of the emulated machine: a user's program, as it would be written.

The machine is a process of its own that serves socketcand on the loopback; python-can's client connects to it.
"""

import itertools
import queue
import struct
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import canopen
import pytest
from canopen.objectdictionary import ODVariable
from canopen.profiles.p402 import BaseNode402
from canopen.sdo import SdoAbortedError, SdoCommunicationError

from config.loading import load_config

ROOT = Path(__file__).resolve().parent.parent.parent
EDS = str(ROOT / "config" / "eds" / "sim_drive.eds")
PATIENCE_S = 30.0
GATEWAY_NODE = 127
NO_DATA_AVAILABLE = 0x08000024
DROOP_COUNTS = 12
"""A controller without integral part gives way to the weight of the links, by as much as 10 counts on the crank."""

GAINS = [axis.emulation.gains for axis in load_config("paper").ordered_axes]

# Where the value after a reset is not the EDS': (index, subindex) -> what it is, for node n.
NOT_THE_DEFAULT: dict[tuple[int, int], Callable[[int], int]] = {
    (0x1018, 4): lambda node_id: node_id,
    # The machine's configuration leaves the watchdog to commissioning.
    (0x3050, 0): lambda _: 0,
    # Switch on disabled, voltage enabled, remote
    (0x6041, 0): lambda _: 0x0250,
    **{
        (0x3020, number): lambda node_id, gain=gain: getattr(GAINS[node_id - 1], gain)
        for number, gain in enumerate(("K_P", "K_I", "K_D", "K_V", "K_F"), start=1)
    },
}
READINGS = {(0x3040, 1)}
"""Meters that run on from power-on, idle draw included: no less than the EDS says."""
WITHOUT_DATA = {(0x1003, n) for n in range(1, 9)} | {(0x3000 + slot, 1) for slot in range(4)}


@pytest.fixture(scope="module")
def network(start_sim_drive: Callable[..., dict[str, Any]]) -> Iterator[canopen.Network]:
    place = start_sim_drive("--interface", "socketcand", "--port", "0")
    network = canopen.Network()
    network.connect(
        interface="socketcand", host=place["host"], port=place["port"], channel=place["channel"], tcp_tune=True
    )
    yield network
    network.disconnect()


class Heard:
    """What a node has told by heartbeats and EMCY, in order."""

    def __init__(self, node: canopen.RemoteNode) -> None:
        self.states: queue.Queue[int] = queue.Queue()
        self.emergencies: queue.Queue[Any] = queue.Queue()
        node.nmt.add_heartbeat_callback(self.states.put)
        node.emcy.add_callback(self.emergencies.put)

    def wait_for_state(self, state: int) -> None:
        for _ in range(1000):
            if self.states.get(timeout=PATIENCE_S) == state:
                return
        raise AssertionError(f"the state {state} never came")


@pytest.fixture(params=[1, 2])
def node(request: pytest.FixtureRequest, network: canopen.Network) -> Iterator[BaseNode402]:
    """A node that has just booted."""
    node = BaseNode402(request.param, EDS)
    node.sdo.RESPONSE_TIMEOUT = PATIENCE_S
    for name in ("SWITCH_OP_MODE", "SWITCH_STATE_FINAL", "SWITCH_STATE_SINGLE", "CHECK_TPDO"):
        setattr(node, f"TIMEOUT_{name}", PATIENCE_S)
    network.add_node(node)
    node.heard = Heard(node)
    node.nmt.state = "RESET"
    node.heard.wait_for_state(0)
    yield node
    node.nmt.state = "RESET"
    node.heard.wait_for_state(0)
    del network[node.id]


def variables(node: canopen.RemoteNode) -> list[ODVariable]:
    objects = node.object_dictionary.values()
    return [v for entry in objects for v in ([entry] if isinstance(entry, ODVariable) else entry.values())]


def test_the_scanner_finds_the_two_drives(network: canopen.Network, node: BaseNode402) -> None:
    network.scanner.reset()
    network.scanner.search()
    # Frames keep their order, so the answer to this comes after all the others.
    assert node.sdo.upload(0x1000, 0) == struct.pack("<I", 0x00020192)
    assert sorted(network.scanner.nodes) == [1, 2]


def test_every_object_of_the_eds_is_there_with_its_type_and_default(node: BaseNode402) -> None:
    wrong: list[str] = []
    read = 0
    for variable in variables(node):
        if variable.index < 0x1000:
            continue
        place = (variable.index, variable.subindex)
        name = f"{variable.index:04X}h:{variable.subindex:02X} {variable.name}"
        try:
            data = node.sdo.upload(*place)
        except SdoAbortedError as abort:
            if variable.access_type == "wo" and abort.code == 0x06010001:
                continue
            if not (place in WITHOUT_DATA and abort.code == NO_DATA_AVAILABLE):
                wrong.append(f"{name}: {abort}")
            continue
        read += 1
        if variable.data_type in variable.STRUCT_TYPES and len(data) * 8 != len(variable):
            wrong.append(f"{name}: {len(data)} bytes for {len(variable)} bits")
            continue
        value = variable.decode_raw(data)
        expected = NOT_THE_DEFAULT[place](node.id) if place in NOT_THE_DEFAULT else variable.default
        if not (value >= expected if place in READINGS else value == expected):
            wrong.append(f"{name}: {value!r}, the EDS says {expected!r}")
    assert wrong == []
    write_only = [variable for variable in variables(node) if variable.access_type == "wo"]
    assert read == len(variables(node)) - 7 - len(WITHOUT_DATA) - len(write_only)


def test_dummy_entries_are_no_objects(node: BaseNode402) -> None:
    for index in range(1, 8):
        with pytest.raises(SdoAbortedError) as refused:
            node.sdo.upload(index, 0)
        assert refused.value.code == 0x06020000


@pytest.mark.parametrize(
    ("index", "subindex", "value"),
    [
        (0x1017, 0, 1000),
        (0x6040, 0, 0),
        (0x605A, 0, 6),
        (0x6065, 0, 0xFFFFFFFF),
        (0x607C, 0, -2147483648),
        (0x607D, 1, -1),
        (0x6085, 0, 1),
        (0x6098, 0, 35),
        (0x60B2, 0, -1000),
        (0x60C2, 1, 255),
        (0x60C2, 2, -4),
        (0x3020, 3, -77),
    ],
)
def test_what_is_written_is_read_back(node: BaseNode402, index: int, subindex: int, value: int) -> None:
    entry = node.sdo[index] if subindex == 0 else node.sdo[index][subindex]
    entry.raw = value
    assert entry.raw == value


@pytest.mark.parametrize(
    ("index", "subindex", "data", "code"),
    [
        (0x1000, 0, b"\0\0\0\0", 0x06010002),
        (0x1018, 1, b"\0\0\0\0", 0x06010002),
        (0x2000, 0, b"\0", 0x06020000),
        (0x6041, 1, b"\0\0", 0x06090011),
        (0x1018, 5, b"\0\0\0\0", 0x06090011),
        (0x605A, 0, b"\x09\0", 0x06090031),
        (0x60C2, 2, b"\xf9", 0x06090032),
        (0x6065, 0, b"\0\0", 0x06070013),
        (0x6040, 0, b"\0\0\0\0", 0x06070012),
        (0x6098, 0, b"\x0f", 0x06090030),
        (0x6060, 0, b"\x05", 0x06090030),  # no mode has this number
        (0x1A01, 0, b"\x09", 0x06090031),
    ],
)
def test_a_wrong_download_is_aborted_with_its_code(
    node: BaseNode402, index: int, subindex: int, data: bytes, code: int
) -> None:
    with pytest.raises(SdoAbortedError) as refused:
        node.sdo.download(index, subindex, data)
    assert f"{refused.value.code:08X}" == f"{code:08X}"


def test_a_mapping_that_cannot_be_is_aborted(node: BaseNode402) -> None:
    mapping = node.sdo[0x1A01]
    mapping[0].raw = 0
    with pytest.raises(SdoAbortedError) as refused:
        mapping[1].raw = 0x10000020
    assert refused.value.code == 0x06040041
    for place, word in enumerate((0x60640020, 0x60620020, 0x606C0020), start=1):
        mapping[place].raw = word
    with pytest.raises(SdoAbortedError) as refused:
        mapping[0].raw = 3
    assert refused.value.code == 0x06040042
    mapping[0].raw = 2


@pytest.mark.parametrize("size", [1, 4, 5, 7, 8, 889, 4116])
def test_a_profile_slot_takes_bytes_of_any_length(node: BaseNode402, size: int) -> None:
    image = bytes((7 * n + size) % 251 for n in range(size))
    node.sdo.download(0x3001, 1, image)
    assert node.sdo.upload(0x3001, 1) == image
    assert node.sdo[0x3001][5].raw == zlib.crc32(image)
    assert node.sdo[0x3001][3].raw == 1
    # Nobody's table: parsing it is refused, and the slot says so.
    node.sdo[0x3001][2].raw = 1
    assert node.sdo[0x3001][3].raw == 3
    assert node.sdo[0x3001][4].raw != 0


def test_a_short_download_is_segmented_too_if_the_client_wants(node: BaseNode402) -> None:
    node.sdo.download(0x6065, 0, b"\x39\x30\0\0", force_segment=True)
    assert node.sdo[0x6065].raw == 12345


def test_nmt_states_are_those_that_the_heartbeat_tells(node: BaseNode402) -> None:
    node.sdo[0x1017].raw = 20
    node.heard.wait_for_state(127)
    for state, number in (("OPERATIONAL", 5), ("PRE-OPERATIONAL", 127), ("OPERATIONAL", 5), ("STOPPED", 4)):
        node.nmt.state = state
        node.heard.wait_for_state(number)
        assert node.nmt.state == state
    node.sdo.RESPONSE_TIMEOUT = 0.3
    with pytest.raises(SdoCommunicationError):
        node.sdo.upload(0x1000, 0)
    node.nmt.state = "RESET COMMUNICATION"
    node.heard.wait_for_state(0)
    node.sdo.RESPONSE_TIMEOUT = PATIENCE_S
    assert node.sdo[0x1017].raw == 0


def set_up_pdos(node: BaseNode402) -> "queue.Queue[tuple[int, int]]":
    """RPDO 1 and TPDO 1 for BaseNode402, event-driven; TPDO 2 on SYNC, whose values the queue gets."""
    node.nmt.state = "PRE-OPERATIONAL"
    node.tpdo.read()
    node.rpdo.read()
    status, actual, command, target = node.tpdo[1], node.tpdo[2], node.rpdo[1], node.rpdo[3]
    for pdo, entries, kind in (
        (status, (0x6041, 0x6061), 255),
        (actual, (0x6041, 0x6064), 1),
        (command, (0x6040, 0x6060), 255),
        (target, (0x607A,), 1),
    ):
        pdo.clear()
        for index in entries:
            pdo.add_variable(index)
        pdo.trans_type = kind
        pdo.enabled = True
    status.event_timer = 10
    values: queue.Queue[tuple[int, int]] = queue.Queue()
    actual.add_callback(lambda pdo: values.put((pdo[0x6041].raw, pdo[0x6064].raw)))
    node.tpdo.save()
    node.rpdo.save()
    node.setup_402_state_machine()
    statuswords: queue.Queue[int] = queue.Queue()
    status.add_callback(lambda pdo: statuswords.put(pdo[0x6041].raw))
    node.nmt.state = "OPERATIONAL"
    statuswords.get(timeout=PATIENCE_S)
    return values


def test_pdo_settings_that_canopen_saves_are_those_it_reads(node: BaseNode402) -> None:
    set_up_pdos(node)
    fresh = canopen.RemoteNode(node.id, EDS)
    fresh.associate_network(node.network)
    fresh.sdo.RESPONSE_TIMEOUT = PATIENCE_S
    try:
        fresh.tpdo.read()
        fresh.rpdo.read()
        found = {
            name: (pdo.cob_id, pdo.enabled, pdo.trans_type, [variable.index for variable in pdo])
            for name, pdo in (
                ("T1", fresh.tpdo[1]),
                ("T2", fresh.tpdo[2]),
                ("R1", fresh.rpdo[1]),
                ("R3", fresh.rpdo[3]),
            )
        }
        is_enabled = [pdo.enabled for pdo in (*fresh.tpdo.values(), *fresh.rpdo.values())]
    finally:
        fresh.remove_network()
    n = node.id
    assert found == {
        "T1": (0x180 + n, True, 255, [0x6041, 0x6061]),
        "T2": (0x280 + n, True, 1, [0x6041, 0x6064]),
        "R1": (0x200 + n, True, 255, [0x6040, 0x6060]),
        "R3": (0x400 + n, True, 1, [0x607A]),
    }
    assert is_enabled == [True, True, False, False, True, False, True, False]


def test_base_node_402_goes_through_the_states(node: BaseNode402) -> None:
    set_up_pdos(node)
    assert node.state == "SWITCH ON DISABLED"
    for state in ("READY TO SWITCH ON", "SWITCHED ON", "OPERATION ENABLED", "SWITCHED ON", "OPERATION ENABLED"):
        node.state = state
        assert node.state == state
    assert node.sdo[0x6041].raw & 0x6F == 0x27
    # Stays in Quick stop active, from where transition 16 leads back.
    node.sdo[0x605A].raw = 6
    node.state = "QUICK STOP ACTIVE"
    assert node.state == "QUICK STOP ACTIVE"
    node.state = "OPERATION ENABLED"
    node.state = "SWITCH ON DISABLED"
    assert node.sdo[0x6041].raw & 0x4F == 0x40


@pytest.mark.parametrize("method", [35, 37])
@pytest.mark.parametrize("offset", [-1234, 70000])
def test_base_node_402_homes_on_the_current_position(node: BaseNode402, method: int, offset: int) -> None:
    values = set_up_pdos(node)
    assert node.is_op_mode_supported("HOMING")
    assert node.is_op_mode_supported("CYCLIC SYNCHRONOUS POSITION")
    assert node.is_op_mode_supported("PROFILED POSITION")
    assert not node.is_op_mode_supported("VELOCITY")
    assert not node.is_homed()
    node.sdo[0x6098].raw = method
    node.sdo[0x607C].raw = offset
    assert node.homing(timeout=PATIENCE_S)
    assert node.is_homed()
    assert node.op_mode == "HOMING"
    node.network.sync.transmit()
    statusword, position = values.get(timeout=PATIENCE_S)
    # Homing attained, target reached, Operation enabled
    assert statusword & 0x346F == 0x1427
    assert abs(position - offset) <= DROOP_COUNTS
    assert abs(node.sdo[0x6064].raw - offset) <= DROOP_COUNTS
    assert abs(node.sdo[0x6062].raw - offset) <= DROOP_COUNTS


def test_an_axis_follows_targets_of_synchronous_pdos(node: BaseNode402) -> None:
    values = set_up_pdos(node)
    assert node.homing(timeout=PATIENCE_S)
    # 100 ms a set-point, and so 2 s until the drive misses one.
    node.sdo[0x60C2][1].raw = 10
    node.sdo[0x60C2][2].raw = -2
    node.op_mode = "CYCLIC SYNCHRONOUS POSITION"
    assert node.state == "OPERATION ENABLED"
    target = node.rpdo[3]
    positions: list[int] = []
    node.network.sync.start(0.1)
    try:
        for step in range(60):
            target[0x607A].raw = min(15 * step, 120)
            target.transmit()
            statusword, position = values.get(timeout=PATIENCE_S)
            assert statusword & 0x6F == 0x27
            positions.append(position)
            if node.sdo[0x6062].raw == 120 and abs(position - 120) <= DROOP_COUNTS:
                break
        else:
            raise AssertionError(f"the target was never reached: {positions}")
    finally:
        node.network.sync.stop()
    assert abs(positions[0]) <= DROOP_COUNTS, "latched before the first demand acts"
    steps = [after - before for before, after in itertools.pairwise(positions)]
    assert max(steps) <= 15 + DROOP_COUNTS, "a line from set-point to set-point, no jump"
    node.state = "SWITCH ON DISABLED"


def test_a_silent_master_is_a_fault_with_its_emcy(node: BaseNode402) -> None:
    set_up_pdos(node)
    node.sdo[0x1016][1].raw = GATEWAY_NODE << 16 | 200
    node.state = "OPERATION ENABLED"
    node.network.send_message(0x700 + GATEWAY_NODE, b"\x05")
    emergency = node.heard.emergencies.get(timeout=PATIENCE_S)
    assert (emergency.code, emergency.register, emergency.data) == (0x8130, 0x11, bytes(5))
    assert node.emcy.active == [emergency]
    assert emergency.get_desc() == "Monitoring"
    for _ in range(1000):
        if node.sdo[0x6041].raw & 0x4F == 0x08:
            break
    else:
        raise AssertionError("the fault reaction never ended")
    assert node.sdo[0x1001].raw == 0x11
    assert node.sdo[0x603F].raw == 0x8130
    assert [node.sdo[0x1003][n].raw for n in (0, 1)] == [1, 0x8130]
    # CiA 301 asks for pre-operational where 1029h:01 is 0.
    node.sdo[0x1017].raw = 20
    node.heard.wait_for_state(127)

    # As long as the cause is there, a fault reset is in vain.
    node.sdo[0x6040].raw = 0x00
    node.sdo[0x6040].raw = 0x80
    assert node.sdo[0x6041].raw & 0x4F == 0x08

    master = node.network.send_periodic(0x700 + GATEWAY_NODE, b"\x05", 0.05)
    try:
        node.nmt.state = "OPERATIONAL"
        node.heard.wait_for_state(5)
        node.reset_from_fault()
        assert node.state == "OPERATION ENABLED"
        over = node.heard.emergencies.get(timeout=PATIENCE_S)
        assert (over.code, over.register) == (0, 0)
        assert node.emcy.active == []
        node.state = "SWITCH ON DISABLED"
    finally:
        master.stop()


def test_an_rpdo_that_is_too_short_is_told_by_emcy(node: BaseNode402) -> None:
    set_up_pdos(node)
    node.network.send_message(0x200 + node.id, b"\x06")
    emergency = node.heard.emergencies.get(timeout=PATIENCE_S)
    assert (emergency.code, emergency.register & 0x11) == (0x8210, 0x11)
    assert node.state == "SWITCH ON DISABLED"
