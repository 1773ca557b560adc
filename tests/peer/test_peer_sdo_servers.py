"""The master's side against other people's nodes in virtual time: ``durand`` and the ``LocalNode`` of ``canopen``.

Both are wrapped as cores without I/O, so that no thread, socket or clock takes part.
"""

import heapq
import itertools
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from threading import Lock
from typing import Any, TypeVar

import canopen
import durand
import pytest
from durand.datatypes import DatatypeEnum
from durand.network import NetworkABC
from durand.scheduler import AbstractScheduler, get_scheduler, set_scheduler
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.errors import NoAnswerError, SdoAbortedError
from drivers.frame import Frame
from drivers.master import (
    BootUpReceived,
    EmergencyReceived,
    HeartbeatLost,
    Master,
    NodeStateChanged,
    Procedure,
)
from drivers.nmt import NmtCommand, NmtState
from drivers.node import Event, Node
from drivers.object_dictionary import DataType
from drivers.pdo import MappingEntry
from drivers.virtual_time import VirtualBus
from gateway.running.commissioning import map_pdo
from gateway.running.procedure_core import ProcedureCore

T = TypeVar("T")
NODE = 5
BIT_RATE = 1_000_000
LIMIT_NS = 3600 * 1_000_000_000
NUMBERS = 0x2000
"""One entry for each integer type, at the sub-index of its place in INTEGERS."""
TEXT, SECRET, FIXED, LIMITED = 0x2001, 0x2002, 0x2003, 0x2004
INTEGERS = (
    DataType.INTEGER8,
    DataType.INTEGER16,
    DataType.INTEGER32,
    DataType.INTEGER64,
    DataType.UNSIGNED8,
    DataType.UNSIGNED16,
    DataType.UNSIGNED32,
    DataType.UNSIGNED64,
)


class VirtualScheduler(AbstractScheduler[int]):
    """Timers of durand, fired by whoever tells it the time."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self._heap: list[tuple[float, int, Callable[[], None]]] = []
        self._cancelled: set[int] = set()
        self._numbers = itertools.count(1)
        self._lock = Lock()

    def add(self, delay: float, callback: Callable[..., None], args: Any = (), kwargs: Any = None) -> int:
        number = next(self._numbers)
        heapq.heappush(self._heap, (self.now_s + delay, number, lambda: callback(*args, **(kwargs or {}))))
        return number

    def cancel(self, entry: int) -> None:
        self._cancelled.add(entry)

    @property
    def lock(self) -> Any:
        return self._lock

    def next_s(self) -> float | None:
        while self._heap and self._heap[0][1] in self._cancelled:
            heapq.heappop(self._heap)
        return self._heap[0][0] if self._heap else None

    def run(self, now_s: float) -> None:
        while (due_s := self.next_s()) is not None and due_s <= now_s:
            self.now_s, _, callback = heapq.heappop(self._heap)
            callback()
        self.now_s = now_s


class DurandNode(NetworkABC):
    """A node of durand as a core."""

    def __init__(self) -> None:
        self._callbacks: dict[int, Callable[[int, bytes], None]] = {}
        self._frames: list[Frame] = []
        self._scheduler = VirtualScheduler()
        set_scheduler(self._scheduler)
        self.node = durand.MinimalNode(self, NODE)
        dictionary = self.node.object_dictionary
        numbers = durand.Record(name="Numbers")
        for place, data_type in enumerate(INTEGERS, start=1):
            numbers[place] = durand.Variable(DatatypeEnum(data_type), "rw", 0)
        dictionary[NUMBERS] = numbers
        dictionary[TEXT] = durand.Variable(DatatypeEnum.DOMAIN, "rw", b"")
        dictionary[SECRET] = durand.Variable(DatatypeEnum.UNSIGNED8, "wo", 0)
        dictionary[FIXED] = durand.Variable(DatatypeEnum.UNSIGNED32, "const", 0x12345678)
        dictionary[LIMITED] = durand.Variable(DatatypeEnum.INTEGER16, "rw", 0, minimum=-5, maximum=100)
        for index, data_type in ((0x6041, DatatypeEnum.UNSIGNED16), (0x6064, DatatypeEnum.INTEGER32)):
            dictionary[index] = durand.Variable(data_type, "ro", 0)
        for index, data_type in ((0x6040, DatatypeEnum.UNSIGNED16), (0x607A, DatatypeEnum.INTEGER32)):
            dictionary[index] = durand.Variable(data_type, "rw", 0)

    # what durand wants of a network
    def add_subscription(self, cob_id: int, callback: Callable[[int, bytes], None]) -> None:
        self._callbacks[cob_id] = callback

    def remove_subscription(self, cob_id: int) -> None:
        self._callbacks.pop(cob_id)

    def send(self, cob_id: int, msg: bytes) -> None:
        self._frames.append(Frame(cob_id, bytes(msg)))

    # the seam
    def receive(self, frame: Frame, now_ns: int) -> None:
        self._scheduler.run(now_ns * 1e-9)
        callback = self._callbacks.get(frame.cob_id)
        if callback is not None:
            callback(frame.cob_id, frame.data)

    def next_wake_ns(self) -> int | None:
        due_s = self._scheduler.next_s()
        return None if due_s is None else -int(-due_s * 1e9 // 1)

    def wake(self, now_ns: int) -> None:
        self._scheduler.run(now_ns * 1e-9)

    def take_frames(self) -> list[Frame]:
        frames, self._frames = self._frames, []
        return frames

    def take_events(self) -> list[Event]:
        return []


class CanopenNode(canopen.Network):
    """A LocalNode of canopen as a core."""

    def __init__(self) -> None:
        super().__init__()
        self._frames: list[Frame] = []
        dictionary = canopen.ObjectDictionary()
        numbers = canopen.objectdictionary.ODRecord("Numbers", NUMBERS)
        for place, data_type in enumerate(INTEGERS, start=1):
            numbers.add_member(self._variable(NUMBERS, place, data_type))
        dictionary.add_object(numbers)
        dictionary.add_object(self._variable(TEXT, 0, DataType.DOMAIN))
        dictionary.add_object(self._variable(SECRET, 0, DataType.UNSIGNED8, "wo"))
        fixed = self._variable(FIXED, 0, DataType.UNSIGNED32, "const")
        fixed.default = 0x12345678
        dictionary.add_object(fixed)
        self.create_node(NODE, dictionary)

    @staticmethod
    def _variable(index: int, subindex: int, data_type: DataType, access: str = "rw") -> Any:
        variable = canopen.objectdictionary.ODVariable(f"{index:X}sub{subindex}", index, subindex)
        variable.data_type = int(data_type)
        variable.access_type = access
        return variable

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        assert not remote
        self._frames.append(Frame(can_id, bytes(data)))

    def receive(self, frame: Frame, now_ns: int) -> None:
        self.notify(frame.cob_id, bytearray(frame.data), now_ns * 1e-9)

    def next_wake_ns(self) -> int | None:
        return None

    def wake(self, now_ns: int) -> None:
        pass

    def take_frames(self) -> list[Frame]:
        frames, self._frames = self._frames, []
        return frames

    def take_events(self) -> list[Event]:
        return []


PEERS: dict[str, Callable[[], Node]] = {"durand": DurandNode, "canopen": CanopenNode}


@pytest.fixture(autouse=True)
def _durand_scheduler() -> Iterator[None]:
    before = get_scheduler()
    yield
    set_scheduler(before)


def carry_out(peer: Node, make: Callable[[Master], Procedure[T]], trace: list[Frame] | None = None) -> T:
    """Let a master carry out a procedure with ``peer`` on a virtual bus; what it raises is raised here."""
    core = ProcedureCore(Master([NODE], 127, 0), make)
    bus = VirtualBus([core, peer], BIT_RATE, trace=None if trace is None else lambda _, frame: trace.append(frame))
    assert bus.run_while(lambda: not core.is_done, LIMIT_NS), "the procedure never ended"
    bus.run_until(bus.now_ns + 1_000_000)
    if core.failure is not None:
        raise core.failure
    return core.result  # pyright: ignore[reportReturnType]


@pytest.mark.parametrize("peer", PEERS)
@given(data=st.data())
@settings(max_examples=60, deadline=None)
def test_integers_of_all_types_come_back(peer: str, data: st.DataObject) -> None:
    place = data.draw(st.integers(0, len(INTEGERS) - 1))
    data_type = INTEGERS[place]
    bits = int("".join(c for c in data_type.name if c.isdigit()))
    low, high = (-(1 << bits - 1), (1 << bits - 1) - 1) if data_type.name.startswith("I") else (0, (1 << bits) - 1)
    value = data.draw(st.integers(low, high) | st.sampled_from([low, high, 0]))

    def procedure(master: Master) -> Procedure[int]:
        yield from master.write(NODE, NUMBERS, place + 1, data_type, value)
        return (yield from master.read_int(NODE, NUMBERS, place + 1, data_type))

    assert carry_out(PEERS[peer](), procedure) == value


@pytest.mark.parametrize("peer", PEERS)
@given(image=st.binary(min_size=1, max_size=300))
@settings(max_examples=60, deadline=None)
def test_bytes_of_any_length_come_back(peer: str, image: bytes) -> None:
    def procedure(master: Master) -> Procedure[bytes]:
        yield from master.download(NODE, TEXT, 0, image)
        return (yield from master.upload(NODE, TEXT, 0))

    assert carry_out(PEERS[peer](), procedure) == image


@pytest.mark.parametrize("peer", PEERS)
def test_a_segmented_transfer_is_the_standards(peer: str) -> None:
    trace: list[Frame] = []

    def procedure(master: Master) -> Procedure[bytes]:
        yield from master.download(NODE, TEXT, 0, b"CANopen 301")
        return (yield from master.upload(NODE, TEXT, 0))

    assert carry_out(PEERS[peer](), procedure, trace) == b"CANopen 301"
    requests = [frame.data.hex() for frame in trace if frame.cob_id == 0x605]
    assert requests == [
        "210120000b000000",
        "0043414e6f70656e",
        "1720333031000000",
        "4001200000000000",
        "6000000000000000",
        "7000000000000000",
    ]
    responses = [frame.data.hex() for frame in trace if frame.cob_id == 0x585]
    assert responses[3:] == ["410120000b000000", "0043414e6f70656e", "1720333031000000"]


def test_no_bytes_at_all_come_back_from_durand() -> None:
    assert carry_out(DurandNode(), lambda master: master.upload(NODE, TEXT, 0)) == b""


@pytest.mark.parametrize("peer", PEERS)
def test_a_large_image_comes_back(peer: str) -> None:
    image = bytes(n * n % 257 & 0xFF for n in range(8192))

    def procedure(master: Master) -> Procedure[bytes]:
        yield from master.download(NODE, TEXT, 0, image)
        return (yield from master.upload(NODE, TEXT, 0))

    assert carry_out(PEERS[peer](), procedure) == image


def read(index: int, subindex: int) -> Callable[[Master], Procedure[Any]]:
    return lambda master: master.upload(NODE, index, subindex)


def write(index: int, subindex: int, data: bytes) -> Callable[[Master], Procedure[Any]]:
    return lambda master: master.download(NODE, index, subindex, data)


@pytest.mark.parametrize(
    ("peer", "procedure", "place", "code"),
    [
        ("durand", read(0x5000, 0), (0x5000, 0), 0x06020000),
        ("durand", read(NUMBERS, 99), (NUMBERS, 99), 0x06090011),
        ("durand", read(SECRET, 0), (SECRET, 0), 0x06010001),
        ("durand", write(FIXED, 0, b"\1\2\3\4"), (FIXED, 0), 0x06010002),
        ("durand", write(FIXED, 0, b"12345678"), (FIXED, 0), 0x06010002),
        ("durand", write(NUMBERS, 3, b"12345678"), (NUMBERS, 3), 0x06070010),
        ("durand", write(LIMITED, 0, struct.pack("<h", 101)), (LIMITED, 0), 0x06090031),
        ("durand", write(LIMITED, 0, struct.pack("<h", -6)), (LIMITED, 0), 0x06090032),
        ("canopen", read(0x5000, 0), (0x5000, 0), 0x06020000),
        ("canopen", read(NUMBERS, 99), (NUMBERS, 99), 0x06090011),
        ("canopen", read(SECRET, 0), (SECRET, 0), 0x06010001),
        ("canopen", write(FIXED, 0, b"\1\2\3\4"), (FIXED, 0), 0x06010002),
        ("canopen", read(TEXT, 0), (TEXT, 0), 0x060A0023),
    ],
)
def test_an_abort_comes_through_with_code_and_place(
    peer: str, procedure: Callable[[Master], Procedure[Any]], place: tuple[int, int], code: int
) -> None:
    with pytest.raises(SdoAbortedError) as refused:
        carry_out(PEERS[peer](), procedure)
    error = refused.value
    assert (error.node_id, error.index, error.subindex) == (NODE, *place)
    assert f"{error.code:08X}" == f"{code:08X}"


def test_after_an_abort_the_next_transfer_goes_well() -> None:
    def procedure(master: Master) -> Procedure[bytes]:
        with pytest.raises(SdoAbortedError):
            yield from master.download(NODE, NUMBERS, 3, b"12345678")
        yield from master.download(NODE, TEXT, 0, b"12345678")
        return (yield from master.upload(NODE, TEXT, 0))

    assert carry_out(DurandNode(), procedure) == b"12345678"


def test_a_stopped_node_does_not_answer() -> None:
    def procedure(master: Master) -> Procedure[bytes]:
        master.command(NmtCommand.STOP, NODE)
        return (yield from master.upload(NODE, FIXED, 0))

    with pytest.raises(NoAnswerError):
        carry_out(DurandNode(), procedure)


def test_boot_up_heartbeat_and_emcy_of_durand() -> None:
    peer = DurandNode()
    events: list[Event] = []

    def procedure(master: Master) -> Procedure[None]:
        yield from master.pause(0.01)
        yield from master.reset_communication(NODE, 0.5)
        yield from master.write(NODE, 0x1017, 0, DataType.UNSIGNED16, 20)
        master.watch_heartbeat(NODE, 0.05)
        yield from master.pause(0.1)
        master.command(NmtCommand.START, NODE)
        remote = master.nodes[NODE]
        assert (yield from master.wait_for(lambda: remote.state is NmtState.OPERATIONAL, 0.1))
        peer.node.emcy.set(0x8611, 0x21, b"\1\2")
        yield from master.pause(0.01)
        yield from master.write(NODE, 0x1017, 0, DataType.UNSIGNED16, 0)
        assert (yield from master.wait_for(lambda: remote.is_lost, 0.1))

    core = ProcedureCore(Master([NODE], 127, 0), procedure)
    bus = VirtualBus([core, peer], BIT_RATE, on_event=lambda _, event: events.append(event))
    assert bus.run_while(lambda: not core.is_done, LIMIT_NS)
    bus.run_until(bus.now_ns + 1000)
    assert core.failure is None
    kinds = [type(event) for event in events]
    # durand boots once by itself, and once because it is told to
    assert kinds == [BootUpReceived, BootUpReceived, NodeStateChanged, EmergencyReceived, HeartbeatLost]
    emergency = events[3]
    assert isinstance(emergency, EmergencyReceived)
    assert (emergency.code, emergency.register, emergency.vendor) == (0x8611, 0x21, b"\1\2\0\0\0")


def test_durand_is_mapped_by_our_commissioning_and_exchanges_pdos() -> None:
    peer = DurandNode()
    trace: list[Frame] = []

    def procedure(master: Master) -> Procedure[None]:
        statusword, actual = MappingEntry(0x6041, 0, 16), MappingEntry(0x6064, 0, 32)
        controlword, target = MappingEntry(0x6040, 0, 16), MappingEntry(0x607A, 0, 32)
        yield from map_pdo(master, NODE, 0x1800, 0x1A00, 0x40000185, (statusword, actual))
        yield from map_pdo(master, NODE, 0x1400, 0x1600, 0x205, (controlword, target))
        master.command(NmtCommand.START, NODE)
        yield from master.pause(0.01)
        peer.node.object_dictionary.write(0x6041, 0, 0x1637)
        peer.node.object_dictionary.write(0x6064, 0, -2)
        master.outbox.append(Frame(0x205, bytes.fromhex("0f00fdffffff")))
        yield from master.pause(0.01)
        master.outbox.append(Frame(0x080))
        yield from master.pause(0.01)

    carry_out(peer, procedure, trace)
    assert [frame.data.hex() for frame in trace if frame.cob_id == 0x185] == ["3716feffffff"]
    assert peer.node.object_dictionary.read(0x6040, 0) == 0x0F
    assert peer.node.object_dictionary.read(0x607A, 0) == -3


def test_the_emulated_drives_dictionary_makes_a_canopen_local_node() -> None:
    """Someone else's node built from our EDS, and our master reading its defaults."""
    network = CanopenNode()
    eds = Path(__file__).resolve().parent.parent.parent / "config" / "eds" / "sim_drive.eds"
    del network[NODE]
    network.create_node(NODE, str(eds))

    def procedure(master: Master) -> Procedure[list[int]]:
        values: list[int] = []
        for index, subindex, data_type in (
            (0x1000, 0, DataType.UNSIGNED32),
            (0x1018, 1, DataType.UNSIGNED32),
            (0x1014, 0, DataType.UNSIGNED32),
            (0x1801, 1, DataType.UNSIGNED32),
            (0x607D, 1, DataType.INTEGER32),
            (0x60C2, 2, DataType.INTEGER8),
        ):
            values.append((yield from master.read_int(NODE, index, subindex, data_type)))
        return values

    expected = [0x00020192, 0x4D2, 0x85, 0xC0000285, -0x80000000, -3]
    assert carry_out(network, procedure) == expected
