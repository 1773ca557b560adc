"""Block transfer against other people's stacks: ``canopen``'s client at our server, ``durand``'s server at our client.

``canopen`` waits in threads for what it is answered before it waits, so that no thread or time takes part here either.
"""

import random
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import canopen
import durand
import pytest
from canopen.sdo import SdoClient
from durand.datatypes import DatatypeEnum
from durand.network import NetworkABC
from durand.scheduler import AbstractScheduler, get_scheduler, set_scheduler
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.eds import load_eds
from drivers.errors import SdoAbortedError
from drivers.frame import Frame
from drivers.master import Master, Procedure
from drivers.node import Event
from drivers.virtual_time import VirtualBus
from gateway.running.procedure_core import ProcedureCore
from sim_drive.device.drive import Drive
from sim_drive.settings import DriveSettings

NODE = 5
SLOT, DATA = 0x3000, 1
TEXT = 0x2001
DESCRIPTION = load_eds(Path(__file__).resolve().parents[2] / "config" / "eds" / "sim_drive.eds", NODE)
IMAGE = random.Random(1).randbytes(32 * 1024)


def new_drive(block_size: int = 127) -> Drive:
    drive = Drive(NODE, DESCRIPTION, DriveSettings(sdo_block_size=block_size), lambda image: pytest.fail("no cam here"))
    drive.wake(0)
    drive.take_frames()
    return drive


# -- canopen as the client ---------------------------------------------------------------------------------------------


class Wire:
    """Stands for canopen's network. ``loses(direction, data)`` decides which frames get lost."""

    def __init__(self, drive: Drive, loses: Callable[[str, bytes], bool]) -> None:
        self._drive = drive
        self._loses = loses
        self.client = SdoClient(0x600 + NODE, 0x580 + NODE, canopen.ObjectDictionary())
        self.client.network = self
        self.client.RESPONSE_TIMEOUT = 0.01

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        assert not remote
        if self._loses("request", bytes(data)):
            return
        self._drive.receive(Frame(can_id, bytes(data)), 0)
        for frame in self._drive.take_frames():
            if frame.cob_id == 0x580 + NODE and not self._loses("response", frame.data):
                self.client.on_response(frame.cob_id, bytearray(frame.data), 0.0)


def lossless(direction: str, data: bytes) -> bool:
    return False


def write(client: SdoClient, data: bytes, crc: bool = True) -> None:
    options = {"size": len(data), "block_transfer": True, "request_crc_support": crc}
    with client.open(SLOT, DATA, "wb", **options) as stream:
        stream.write(data)


def read(client: SdoClient, crc: bool = True) -> bytes:
    with client.open(SLOT, DATA, "rb", block_transfer=True, request_crc_support=crc) as stream:
        return stream.read()


@pytest.mark.parametrize("crc", [True, False])
@pytest.mark.parametrize("block_size", [1, 2, 126, 127])
def test_canopen_writes_and_reads_32_kibibytes(block_size: int, crc: bool) -> None:
    drive = new_drive(block_size)
    client = Wire(drive, lossless).client
    write(client, IMAGE, crc)
    assert drive.dictionary.entry(SLOT, DATA).value == IMAGE
    assert read(client, crc) == IMAGE
    # The server is free again: nothing is due.
    assert client.upload(0x1000, 0) == bytes.fromhex("92010200")
    assert drive.next_wake_ns() is None


@given(data=st.binary(min_size=1, max_size=2000), block_size=st.integers(1, 127))
@settings(max_examples=60, deadline=None)
def test_canopen_reads_back_any_length(data: bytes, block_size: int) -> None:
    client = Wire(new_drive(block_size), lossless).client
    write(client, data)
    assert read(client) == data


@pytest.mark.parametrize("lost", [1, 2, 60, 126])
def test_canopen_is_helped_over_a_lost_segment_of_its_download(lost: int) -> None:
    drive = new_drive()
    remaining = [lost]

    def loses(direction: str, data: bytes) -> bool:
        if (
            direction == "request"
            and remaining
            and data[0] == remaining[0]
            and data[1:] == IMAGE[lost * 7 - 7 : lost * 7]
        ):
            remaining.clear()
            return True
        return False

    write(Wire(drive, loses).client, IMAGE[:3000])
    assert remaining == []
    assert drive.dictionary.entry(SLOT, DATA).value == IMAGE[:3000]


def test_canopen_asks_again_for_a_lost_segment_of_its_upload() -> None:
    drive = new_drive()
    write(Wire(drive, lossless).client, IMAGE[:3000])
    lost: list[bytes] = []

    def loses(direction: str, data: bytes) -> bool:
        if direction == "response" and not lost and data[0] == 50:
            lost.append(data)
            return True
        return False

    assert read(Wire(drive, loses).client) == IMAGE[:3000]
    assert len(lost) == 1


# -- durand as the server ----------------------------------------------------------------------------------------------


class NoTimers(AbstractScheduler[int]):
    """durand's block transfer has no time-outs, and its heartbeat is off."""

    def add(self, delay: float, callback: Callable[..., None], args: Any = (), kwargs: Any = None) -> int:
        return 0

    def cancel(self, entry: int) -> None:
        pass

    @property
    def lock(self) -> Any:
        raise NotImplementedError


class DurandNode(NetworkABC):
    """A node of durand as a core."""

    def __init__(self) -> None:
        self._callbacks: dict[int, Callable[[int, bytes], None]] = {}
        self._frames: list[Frame] = []
        set_scheduler(NoTimers())
        self.node = durand.MinimalNode(self, NODE)
        self.node.object_dictionary[TEXT] = durand.Variable(DatatypeEnum.DOMAIN, "rw", b"")

    def add_subscription(self, cob_id: int, callback: Callable[[int, bytes], None]) -> None:
        self._callbacks[cob_id] = callback

    def remove_subscription(self, cob_id: int) -> None:
        self._callbacks.pop(cob_id)

    def send(self, cob_id: int, msg: bytes) -> None:
        self._frames.append(Frame(cob_id, bytes(msg)))

    def receive(self, frame: Frame, now_ns: int) -> None:
        callback = self._callbacks.get(frame.cob_id)
        if callback is not None:
            callback(frame.cob_id, frame.data)

    def next_wake_ns(self) -> int | None:
        return None

    def wake(self, now_ns: int) -> None:
        pass

    def take_frames(self) -> list[Frame]:
        frames, self._frames = self._frames, []
        return frames

    def take_events(self) -> list[Event]:
        return []


@pytest.fixture(autouse=True)
def _durand_scheduler() -> Iterator[None]:
    before = get_scheduler()
    yield
    set_scheduler(before)


def carry_out(peer: Any, make: Callable[[Master], Procedure[Any]], trace: list[Frame] | None = None) -> Any:
    core = ProcedureCore(Master([NODE], 127, 0), make)
    bus = VirtualBus([core, peer], 1_000_000, trace=None if trace is None else lambda _, frame: trace.append(frame))
    assert bus.run_while(lambda: not core.is_done, 3600 * 1_000_000_000), "the procedure never ended"
    bus.run_until(bus.now_ns + 1_000_000)
    if core.failure is not None:
        raise core.failure
    return core.result


def there_and_back(index: int, subindex: int, data: bytes) -> Callable[[Master], Procedure[bytes]]:
    def procedure(master: Master) -> Procedure[bytes]:
        yield from master.download_block(NODE, index, subindex, data)
        return (yield from master.upload_block(NODE, index, subindex))

    return procedure


# durand tells 7 unused bytes instead of none when it sends whole segments alone, which loses the last one.
@given(size=st.integers(1, 2000).filter(lambda size: size % 7))
@settings(max_examples=60, deadline=None)
def test_durand_gives_back_what_our_client_wrote(size: int) -> None:
    data = IMAGE[:size]
    assert carry_out(DurandNode(), there_and_back(TEXT, 0, data)) == data


def test_durand_takes_32_kibibytes_in_blocks() -> None:
    trace: list[Frame] = []
    assert carry_out(DurandNode(), there_and_back(TEXT, 0, IMAGE), trace) == IMAGE
    # 32768 bytes are 4682 segments, 36 sub-blocks of 127 and one of 110; each way some frames to open and close it.
    assert len([frame for frame in trace if frame.cob_id == 0x605]) == 1 + 4682 + 1 + 1 + 1 + 37 + 1


def test_durands_abort_comes_through_and_the_next_transfer_goes_well() -> None:
    def procedure(master: Master) -> Procedure[bytes]:
        with pytest.raises(SdoAbortedError) as caught:
            yield from master.download_block(NODE, 0x5000, 0, b"123456789")
        assert caught.value.code == 0x06020000
        with pytest.raises(SdoAbortedError) as caught:
            yield from master.upload_block(NODE, 0x1018, 99)
        assert caught.value.code == 0x06090011
        yield from master.download_block(NODE, TEXT, 0, b"123456789")
        return (yield from master.upload_block(NODE, TEXT, 0))

    assert carry_out(DurandNode(), procedure) == b"123456789"


# -- our client at our server, over a bus that loses frames ------------------------------------------------------------


class LossyDrive:
    """The drive as a core whose line is bad: it loses every n-th frame of a sub-block, in both directions."""

    def __init__(self, every: int, seed: int) -> None:
        self.drive = new_drive()
        self._random = random.Random(seed)
        self._every = every
        self.lost = 0

    def _loses(self, frame: Frame) -> bool:
        # What opens and closes a transfer has no protection but its time-out.
        is_segment = 1 <= frame.data[0] & 0x7F <= 127 and frame.data[0] & 0xE3 not in {
            0xA0,
            0xA1,
            0xA2,
            0xA3,
            0xC1,
            0xC2,
        }
        is_lost = is_segment and self._random.randrange(self._every) == 0
        self.lost += is_lost
        return is_lost

    def receive(self, frame: Frame, now_ns: int) -> None:
        if not self._loses(frame):
            self.drive.receive(frame, now_ns)

    def next_wake_ns(self) -> int | None:
        return self.drive.next_wake_ns()

    def wake(self, now_ns: int) -> None:
        self.drive.wake(now_ns)

    def take_frames(self) -> list[Frame]:
        return [frame for frame in self.drive.take_frames() if not self._loses(frame)]

    def take_events(self) -> list[Event]:
        return self.drive.take_events()


@pytest.mark.parametrize("seed", range(4))
def test_a_whole_slot_comes_through_a_line_that_loses_segments(seed: int) -> None:
    image = IMAGE + IMAGE[::-1]
    line = LossyDrive(every=100, seed=seed)

    def procedure(master: Master) -> Procedure[bytes]:
        yield from master.download_block(NODE, SLOT, DATA, image, timeout_s=1.0)
        return (yield from master.upload_block(NODE, SLOT, DATA, timeout_s=0.5))

    assert carry_out(line, procedure) == image
    assert line.lost > 50
