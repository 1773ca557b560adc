"""The SocketCAN port over sockets that every system has: batches, time stamps, what is skipped."""

import socket
import struct
import time

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.broadcast_manager import PeriodicFrame
from drivers.controller import BusErrorClass, ErrorState
from drivers.errors import BusError
from drivers.frame import Frame
from drivers.message_batch import MessageBatch
from drivers.socketcan_port import CAN_FRAME, SocketcanPort

SO_TIMESTAMPNS = 35
CONTROL_LENGTH_OFFSET = 40
"""Of ``struct msghdr`` on a machine of 64 bits."""


@pytest.fixture
def pair():
    far, near = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    near.setblocking(False)
    near.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
    with far, near:
        yield far, near


def received(port):
    """The next frame; the first None may be about the moment at which the queue was last read."""
    one = port.receive() or port.receive()
    return None if one is None else one[0]


def raw(identifier, data=b""):
    return CAN_FRAME.pack(identifier, len(data), data)


def test_frames_come_in_order_with_the_instant_at_which_the_kernel_took_them(pair):
    far, near = pair
    port = SocketcanPort("pair", carrier=near)
    assert port.receive() is None
    before = time.monotonic_ns()
    for number in range(40):  # more than two batches
        far.send(raw(0x181 + number % 3, bytes((number,) * (number % 9))))
    after = time.monotonic_ns()
    heard = []
    while (one := port.receive()) is not None:
        heard.append(one)
    assert [frame for frame, _ in heard] == [Frame(0x181 + n % 3, bytes((n,) * (n % 9))) for n in range(40)]
    instants = [at_ns for _, at_ns in heard]
    # The stamp is of another clock, read one after the other: a few microseconds.
    assert all(before - 200_000 <= at_ns <= after + 200_000 for at_ns in instants)
    assert port.receive() is None


def test_what_waits_behind_an_exactly_full_batch_is_not_left_there(pair):
    far, near = pair
    port = SocketcanPort("pair", carrier=near)
    for count in (16, 17, 32, 1):
        for number in range(count):
            far.send(raw(0x200 + number))
        assert [received(port).cob_id for _ in range(count)] == [0x200 + number for number in range(count)]
        assert port.receive() is None


def test_a_frame_that_came_after_the_queue_was_empty_is_found(pair):
    far, near = pair
    port = SocketcanPort("pair", carrier=near)
    far.send(raw(0x181))
    assert port.receive() is not None
    assert port.receive() is None
    far.send(raw(0x182))
    assert received(port).cob_id == 0x182


def test_error_and_remote_frames_are_told_apart(pair):
    far, near = pair
    port = SocketcanPort("pair", carrier=near)
    far.send(raw(0x20000000 | BusErrorClass.NO_ACKNOWLEDGE | BusErrorClass.BUS_ERROR, bytes(8)))
    far.send(raw(0x40000000 | 0x701))
    assert received(port) == Frame(0x701, b"", True)
    assert port.controller.frame_count == 1
    assert port.controller.counts[BusErrorClass.NO_ACKNOWLEDGE] == 1


def test_a_port_that_is_bus_off_stays_open_and_sends_nothing_until_it_is_back(pair):
    far, near = pair
    port = SocketcanPort("pair", carrier=near)
    port.outlives_bus_off = True
    assert port.send(Frame(0x201, b"before"))
    far.send(raw(0x20000000 | BusErrorClass.BUS_OFF, bytes(8)))
    far.send(raw(0x181))
    assert received(port) == Frame(0x181)
    assert port.controller.state is ErrorState.OFF
    assert not port.send(Frame(0x202, b"lost"))
    far.send(raw(0x20000000 | BusErrorClass.RESTARTED, bytes(8)))
    assert received(port) is None
    assert port.controller.state is ErrorState.ACTIVE
    assert port.send(Frame(0x203, b"after"))
    far.setblocking(False)
    assert [far.recv(16)[:2] for _ in range(2)] == [b"\x01\x02", b"\x03\x02"]
    with pytest.raises(BlockingIOError):
        far.recv(16)


def test_bus_off_is_a_lost_bus_where_nobody_brings_the_controller_back(pair):
    far, near = pair
    port = SocketcanPort("pair", carrier=near)
    far.send(raw(0x20000000 | BusErrorClass.BUS_OFF, bytes(8)))
    with pytest.raises(BusError, match="bus-off"):
        received(port)


def test_a_socket_without_stamps_says_so_with_zero():
    far, near = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    with far, near:
        near.setblocking(False)
        batch = MessageBatch(near, 4)
        assert batch.receive() == 0
        far.send(b"abc")
        assert batch.receive() == 1
        assert (batch.stamp_ns(0), batch.length(0), bytes(batch.data[:3])) == (0, 3, b"abc")


def test_a_socket_that_is_gone_is_an_error():
    far, near = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    near.setblocking(False)
    port = SocketcanPort("pair", carrier=near)
    near.close()
    far.close()
    with pytest.raises(BusError, match="the interface has failed"):
        port.receive()


@settings(max_examples=30)
@given(st.lists(st.integers(1, 40), min_size=1, max_size=10))
def test_whatever_the_bursts_nothing_is_lost_or_told_twice(bursts):
    far, near = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    with far, near:
        near.setblocking(False)
        port = SocketcanPort("pair", carrier=near)
        count = heard = 0
        for burst in bursts:
            for _ in range(burst):
                far.send(raw(count & 0x7FF))
                count += 1
            # Not always to the end: what is left must come next time.
            for _ in range(burst - burst // 3):
                assert received(port).cob_id == heard & 0x7FF
                heard += 1
        while (one := received(port)) is not None:
            assert one.cob_id == heard & 0x7FF
            heard += 1
        assert heard == count


def test_no_broadcast_manager_is_one_sentence():
    with pytest.raises(BusError, match=r"nosuchcan9: (this system offers no CAN broadcast manager|the broadcast)"):
        PeriodicFrame("nosuchcan9", Frame(0x080), 1000)


def test_stamps_of_kernel_and_controller_are_told_apart():
    """The control message as the kernel writes it; the controller's stamp is no time of day, and need not be there."""
    far, near = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    with far, near:
        batch = MessageBatch(near, 2)
        both = struct.pack("@Nii6l", 64, socket.SOL_SOCKET, 37, 1_700_000_000, 5, 0, 0, 12, 345_678_000)
        drops = struct.pack("@NiiI4x", 20, socket.SOL_SOCKET, 40, 7)
        for number, control in ((0, both), (1, drops + both[:48] + bytes(16))):
            batch._ancillary[128 * number : 128 * number + len(control)] = control
            struct.pack_into("@N", batch._raw, len(batch._raw) // 2 * number + CONTROL_LENGTH_OFFSET, len(control))
        assert batch.stamp_ns(0) == 1_700_000_000_000_000_005
        assert batch.hardware_ns == 12_345_678_000
        assert batch.stamp_ns(1) == 1_700_000_000_000_000_005
        assert (batch.hardware_ns, batch.drop_count) == (0, 7)


class Stamped:
    """A batch whose datagrams carry stamps of the test's own."""

    capacity = 16
    drop_count = 0

    def __init__(self, stamps):
        self.stamps = stamps
        self.data = memoryview(b"".join(raw(0x181) for _ in stamps))
        self.hardware_ns = 0
        self.is_read = False

    def receive(self):
        count, self.is_read = 0 if self.is_read else len(self.stamps), True
        return count

    def stamp_ns(self, number):
        software_ns, self.hardware_ns = self.stamps[number]
        return software_ns


def test_the_controllers_stamps_take_the_jitter_out_of_arrivals_and_frames_without_one_keep_the_kernels(pair):
    _, near = pair
    port = SocketcanPort("pair", carrier=near)
    port.use_hardware_stamps()
    now_ns = time.time_ns()
    # Every 100 us; late by 0, 50, 30 us and 10 us, the third one not stamped by the controller.
    lateness_us = (0, 50, 30, 10)
    port._batch = Stamped(
        [
            (now_ns - 500_000 + 100_000 * n + 1000 * late, 0 if n == 2 else 7_000_000 + 100_000 * n)
            for n, late in enumerate(lateness_us)
        ]
    )
    arrivals = [port.receive()[1] for _ in lateness_us]
    assert [at_ns - arrivals[0] for at_ns in arrivals] == [0, 100_000, 230_000, 300_000]


def test_a_socket_that_is_asked_for_both_stamps_still_has_the_kernels():
    """As a real interface without a clock of its own has it: the loopback's."""
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as near,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as far,
    ):
        near.bind(("127.0.0.1", 0))
        near.setblocking(False)
        port = SocketcanPort("loopback", carrier=near)
        port.use_hardware_stamps()
        end_s = time.monotonic() + 20.0
        stamp_ns = 0
        # The kernel begins to stamp some time after it has been asked to.
        while not stamp_ns and time.monotonic() < end_s:
            far.sendto(raw(0x181), near.getsockname())
            sent_ns = time.time_ns()
            assert port.wait(5.0)
            assert port._batch.receive() == 1
            stamp_ns = port._batch.stamp_ns(0)
        assert abs(stamp_ns - sent_ns) < 1_000_000_000
        assert port._batch.hardware_ns == 0
