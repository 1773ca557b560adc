"""Whatever is sent to the emulated drive, it neither raises nor falls silent; another stack's client agrees with it."""

import struct
from pathlib import Path

import canopen
import pytest
from canopen.sdo import SdoClient
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.eds import load_eds
from drivers.frame import Frame
from drivers.object_dictionary import ObjectDictionary
from mechanism.errors import CamFileError
from sim_drive.device.cam_slots import CamTable
from sim_drive.device.cia402 import PowerState
from sim_drive.device.drive import Drive, DriveSettings

NODE = 5
EDS = Path(__file__).parents[2] / "config" / "eds" / "sim_drive.eds"
DESCRIPTION: ObjectDictionary = load_eds(EDS, NODE)
PLACES = [(variable.index, variable.subindex) for variable in DESCRIPTION]
WRITABLE = [
    (variable.index, variable.subindex, variable.size)
    for variable in DESCRIPTION
    if variable.access.is_writable and variable.size and variable.index >= 0x1000
]
READ_BACK = [
    (index, subindex, size)
    for index, subindex, size in WRITABLE
    if (variable := DESCRIPTION.get(index, subindex)) is not None and variable.access.is_readable
]


class Ramp:
    points = 2

    def slave_position(self, master_counts: int) -> float:
        return master_counts * 0.37


def decode(image: bytes) -> CamTable:
    if len(image) % 2:
        raise CamFileError("image", "odd")
    return Ramp()


def new_drive() -> Drive:
    drive = Drive(NODE, DESCRIPTION, DriveSettings(), decode)
    drive.wake(0)
    drive.on_servo_tick(0, 0)
    drive.take_frames()
    return drive


def request(command: int, index: int, subindex: int, payload: bytes) -> Frame:
    return Frame(0x600 + NODE, struct.pack("<BHB4s", command, index, subindex, payload))


def write(drive: Drive, index: int, subindex: int, value: int, size: int) -> None:
    payload = (value & ((1 << 8 * size) - 1)).to_bytes(4, "little")
    drive.receive(request(0x23 | (4 - size) << 2, index, subindex, payload), 0)
    assert [frame.data[0] for frame in drive.take_frames() if frame.cob_id == 0x585] == [0x60]


def moving_drive(mode: int) -> Drive:
    """Operation enabled in ``mode``, with cyclic PDOs that carry what the mode needs, and a cam in slot 1."""
    drive = new_drive()
    write(drive, 0x3000, 1, 0, 4)
    write(drive, 0x3000, 2, 1, 1)
    write(drive, 0x3010, 0, 1, 1)
    write(drive, 0x1400, 1, 0x80000205, 4)
    write(drive, 0x1600, 0, 0, 1)
    for number, word in enumerate((0x60400010, 0x607A0020 if mode == 8 else 0x30110020, 0x60B20010), start=1):
        write(drive, 0x1600, number, word, 4)
    write(drive, 0x1600, 0, 3, 1)
    write(drive, 0x1400, 2, 1, 1)
    write(drive, 0x1400, 1, 0x205, 4)
    write(drive, 0x6060, 0, mode, 1)
    drive.on_servo_tick(0, 0)
    drive.receive(Frame(0x000, bytes((0x01, NODE))), 0)
    for word in (0x06, 0x07, 0x0F):
        write(drive, 0x6040, 0, word, 2)
    assert drive.power_state is PowerState.OPERATION_ENABLED
    return drive


STARTS = {"off": new_drive, "csp": lambda: moving_drive(8), "cam": lambda: moving_drive(-2)}

any_data = st.binary(max_size=8)
any_frames = st.builds(
    Frame,
    st.sampled_from([0x000, 0x080, 0x100, 0x185, 0x205, 0x305, 0x605, 0x701, 0x705, 0x77F, 0x7E5, 0x123]),
    any_data,
    st.booleans(),
)
sdo_frames = st.builds(
    lambda command, place, payload: request(command, *place, payload),
    st.integers(0, 255),
    st.sampled_from(PLACES),
    st.binary(min_size=4, max_size=4),
)
writes = st.builds(
    lambda place, payload: request(0x23 | (4 - place[2]) << 2, place[0], place[1], payload),
    st.sampled_from(WRITABLE),
    st.binary(min_size=4, max_size=4) | st.integers(0, 20).map(lambda n: struct.pack("<I", n)),
)
commands = st.builds(
    lambda command: Frame(0x000, bytes((command, NODE))), st.sampled_from([0x01, 0x01, 0x01, 0x02, 0x80, 0x81, 0x82])
)
controls = st.builds(
    lambda word: request(0x2B, 0x6040, 0, struct.pack("<I", word)),
    st.sampled_from([0x06, 0x07, 0x0F, 0x1F, 0x02, 0x00, 0x80]),
)
modes = st.builds(lambda mode: request(0x2F, 0x6060, 0, bytes((mode, 0, 0, 0))), st.sampled_from([6, 8, 0xFE, 0]))
set_points = st.builds(lambda data: Frame(0x205, data), st.binary(min_size=2, max_size=8)) | st.builds(
    lambda target: Frame(0x205, struct.pack("<Hih", 0x0F, target, 10)), st.integers(-60, 60)
)
syncs = st.just(Frame(0x080, b""))
steps = st.tuples(
    st.one_of(any_frames, sdo_frames, writes, commands, controls, modes, set_points, syncs),
    st.integers(0, 2_000_000) | st.integers(0, 300_000_000),
    st.integers(-60, 60) | st.integers(-(1 << 40), 1 << 40),
)


@settings(max_examples=300, deadline=None)
@given(st.sampled_from(sorted(STARTS)), st.lists(steps, max_size=60))
def test_no_frame_breaks_the_drive(start: str, script: list[tuple[Frame, int, int]]):
    drive = STARTS[start]()
    now_ns = 0
    shaft = 0
    drive.axis.latch = lambda now_ns: (shaft, shaft * 1.5, shaft)
    for frame, wait_ns, shaft_counts in script:
        now_ns += wait_ns
        shaft = shaft_counts
        for _ in range(8):
            due_ns = drive.next_wake_ns()
            if due_ns is None or due_ns > now_ns:
                break
            drive.wake(now_ns)
        else:
            raise AssertionError("the drive does not let the time go on")
        drive.receive(frame, now_ns)
        drive.on_servo_tick(now_ns, shaft)
        for sent in drive.take_frames():
            assert 0 < sent.cob_id < 0x800
            assert len(sent.data) <= 8
        assert not drive.is_powered or drive.power_state in {
            PowerState.OPERATION_ENABLED,
            PowerState.QUICK_STOP_ACTIVE,
            PowerState.FAULT_REACTION_ACTIVE,
        }
        assert drive.is_powered or drive.position_demand_counts == shaft
        assert drive.is_powered or drive.axis.torque_offset_Nm == 0.0
    drive.receive(Frame(0x000, bytes((0x80, NODE))), now_ns)
    # Within a block download everything but an abort is a segment.
    drive.receive(Frame(0x605, bytes.fromhex("8000000000000008")), now_ns)
    drive.take_frames()
    drive.receive(Frame(0x605, bytes.fromhex("4000100000000000")), now_ns)
    assert drive.take_frames() == [Frame(0x585, bytes.fromhex("4300100092010200"))]


@settings(max_examples=200, deadline=None)
@given(st.lists(st.one_of(any_data, st.binary(min_size=8, max_size=8)), max_size=40))
def test_sdo_server_answers_after_any_requests(requests: list[bytes]):
    drive = new_drive()
    may_take_segments = False
    for data in requests:
        drive.receive(Frame(0x605, data), 0)
        answers = [frame.data for frame in drive.take_frames() if frame.cob_id == 0x585]
        if may_take_segments or (data and data[0] & 0xE3 in {0xA2, 0xA3}):
            assert len(answers) <= 127
        elif len(data) != 8 or data[0] >> 5 == 4 or data[0] & 0xE3 == 0xA1:
            assert len(answers) <= 1
        else:
            assert len(answers) == 1
        # Segments of a block download are answered at the end of their sub-block alone.
        if any(answer[0] & 0xE3 == 0xA0 for answer in answers):
            may_take_segments = True
        elif any(answer[0] == 0x80 for answer in answers) or (len(data) == 8 and data[0] == 0x80):
            may_take_segments = False
    drive.receive(Frame(0x605, bytes.fromhex("8000000000000008")), 0)
    drive.receive(Frame(0x605, bytes.fromhex("4000100000000000")), 0)
    assert drive.take_frames() == [Frame(0x585, bytes.fromhex("4300100092010200"))]


class Wire:
    """Stands for the ``canopen`` package's network: what its client sends is answered before it waits."""

    def __init__(self, drive: Drive) -> None:
        self.drive = drive
        self.client: SdoClient | None = None

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        self.drive.receive(Frame(can_id, bytes(data)), 0)
        for frame in self.drive.take_frames():
            if frame.cob_id == 0x580 + NODE and self.client is not None:
                self.client.on_response(frame.cob_id, bytearray(frame.data), 0.0)


def peer(drive: Drive) -> SdoClient:
    wire = Wire(drive)
    client = SdoClient(0x600 + NODE, 0x580 + NODE, canopen.ObjectDictionary())
    client.network = wire
    client.RESPONSE_TIMEOUT = 0.01
    wire.client = client
    return client


@settings(max_examples=60, deadline=None)
@given(st.binary(min_size=1, max_size=3000), st.booleans())
def test_another_stacks_client_reads_back_what_it_wrote(image: bytes, force_segment: bool):
    client = peer(new_drive())
    client.download(0x3001, 1, image, force_segment=force_segment)
    assert client.upload(0x3001, 1) == image
    assert client.upload(0x1008, 0) == b"sim-drive"


@settings(max_examples=100, deadline=None)
@given(st.sampled_from(READ_BACK), st.binary(min_size=1, max_size=9))
def test_a_wrong_length_is_refused_and_changes_nothing(place: tuple[int, int, int], data: bytes):
    index, subindex, size = place
    client = peer(new_drive())
    before = client.upload(index, subindex)
    assert len(before) == size
    if len(data) == size:
        return
    with pytest.raises(canopen.SdoAbortedError) as caught:
        client.download(index, subindex, data)
    assert caught.value.code == (0x06070012 if len(data) > size else 0x06070013)
    assert client.upload(index, subindex) == before
