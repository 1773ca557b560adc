"""A SocketCAN raw socket with kernel or hardware time stamps, kernel filters and error frames."""

import errno
import os
import select
import socket
import struct
import time
from collections.abc import Sequence
from typing import Final

from drivers.arrival_clock import ArrivalClock
from drivers.bus_off import Link
from drivers.can_link import NetworkLink
from drivers.controller import Controller
from drivers.errors import BusError
from drivers.frame import MAX_DATA_LENGTH, Frame
from drivers.hardware_clock import HardwareClock
from drivers.hardware_stamps import BOTH_STAMPS, SO_TIMESTAMPING
from drivers.message_batch import MessageBatch

# linux/can.h, linux/can/raw.h and asm-generic/socket.h; written out so that the module can be imported anywhere.
_AF_CAN: Final = 29
_CAN_RAW: Final = 1
_SOL_CAN_RAW: Final = 101
_CAN_RAW_FILTER: Final = 1
_CAN_RAW_ERR_FILTER: Final = 2
_CAN_RAW_RECV_OWN_MSGS: Final = 4
_CAN_EFF_FLAG: Final = 0x80000000
_CAN_RTR_FLAG: Final = 0x40000000
_CAN_ERR_FLAG: Final = 0x20000000
_CAN_SFF_MASK: Final = 0x7FF
_CAN_ERR_MASK: Final = 0x1FFFFFFF
_SO_RCVBUFFORCE: Final = 33
_SO_TIMESTAMPNS: Final = 35
_SO_RXQ_OVFL: Final = 40

CAN_FRAME: Final = struct.Struct("=IB3x8s")
"""``struct can_frame``: identifier and flags, length, data."""
_pack_frame: Final = CAN_FRAME.pack
_unpack_frame: Final = CAN_FRAME.unpack_from
_FILTER: Final = struct.Struct("=II")
_RECEIVE_BUFFER_BYTES: Final = 4 << 20
_MAX_SKIPPED_FRAMES: Final = 64
_QUEUE_FULL: Final = (errno.ENOBUFS, errno.EAGAIN)


class SocketcanPort:
    """Port on a SocketCAN network interface.

    Frames of 29-bit identifiers are left in the kernel: CANopen has none. ``controller`` is what the error frames tell
    of the own controller; while it is bus-off nothing can be sent. ``lost_frame_count`` counts the frames that the
    kernel had no room for.
    """

    def __init__(
        self,
        channel: str,
        filters: Sequence[tuple[int, int]] | None = None,
        carrier: socket.socket | None = None,
        hears_own: bool = False,
    ) -> None:
        """Open the interface ``channel``; ``filters`` are pairs of COB-ID and mask, applied by the kernel.

        ``hears_own``: also receive what is sent here, when it has been on the bus, and in the bus' order.
        ``carrier``: a socket that does not block and carries ``CAN_FRAME`` datagrams, in place of the interface.

        Raises:
            BusError: this kernel has no SocketCAN, there is no such interface, or it is down.
        """
        self.channel: Final = channel
        self.controller: Final = Controller()
        self.link: Final[Link | None] = NetworkLink(channel) if carrier is None else None
        """See Port."""
        self.outlives_bus_off = False
        """See Port."""
        self._socket = self._open(channel, filters) if carrier is None else carrier
        if hears_own:
            self._socket.setsockopt(_SOL_CAN_RAW, _CAN_RAW_RECV_OWN_MSGS, 1)
        self._clock: Final = ArrivalClock()
        self._hardware_clock: HardwareClock | None = None
        self._batch: Final = MessageBatch(self._socket)
        self._batch_count = 0
        self._batch_next = 0
        self._may_hold_more = True
        self._empty_ns = 0

    def use_hardware_stamps(self) -> None:
        """Tell arrivals by the controller's own clock, of every frame that it has stamped; see ``hardware_stamps``.

        Raises BusError where the kernel knows no such thing.
        """
        try:
            self._socket.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 0)
            self._socket.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPING, BOTH_STAMPS)
        except OSError as error:
            raise self._error(f"it has no hardware timestamps ({error.strerror})") from None
        self._hardware_clock = HardwareClock()

    @property
    def lost_frame_count(self) -> int:
        """Frames that the kernel had no room for."""
        return self._batch.drop_count

    def _open(self, channel: str, filters: Sequence[tuple[int, int]] | None) -> socket.socket:
        try:
            can_socket = socket.socket(_AF_CAN, socket.SOCK_RAW, _CAN_RAW)
        except OSError as error:
            raise self._error(f"this system offers no SocketCAN ({error.strerror})") from None
        try:
            accepted = ((0, 0),) if filters is None else filters
            can_socket.setsockopt(
                _SOL_CAN_RAW,
                _CAN_RAW_FILTER,
                b"".join(
                    _FILTER.pack(cob_id & _CAN_SFF_MASK, mask & _CAN_SFF_MASK | _CAN_EFF_FLAG)
                    for cob_id, mask in accepted
                ),
            )
            can_socket.setsockopt(_SOL_CAN_RAW, _CAN_RAW_ERR_FILTER, _CAN_ERR_MASK)
            can_socket.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
            can_socket.setsockopt(socket.SOL_SOCKET, _SO_RXQ_OVFL, 1)
            try:
                can_socket.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, _RECEIVE_BUFFER_BYTES)
            except OSError:
                can_socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER_BYTES)
            can_socket.setblocking(False)
            can_socket.bind((channel,))
            state = can_socket.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
        except OSError as error:
            can_socket.close()
            if error.errno == errno.ENODEV or "interface name" in str(error):
                raise self._error("no such interface; 'ip -brief link' lists what there is") from None
            raise self._error(f"cannot be opened ({error.strerror or error})") from None
        if state:
            can_socket.close()
            reason = "down" if state == errno.ENETDOWN else f"unusable ({os.strerror(state)})"
            raise self._error(f"the interface is {reason}; 'ip link set {channel} up' brings it up")
        return can_socket

    def send(self, frame: Frame) -> bool:
        """See Port."""
        if self.controller.is_off:
            # The kernel would take it, and either drop it or keep it until the controller is back: too late for all.
            return False
        cob_id, data, is_remote = frame
        try:
            self._socket.send(_pack_frame(cob_id | _CAN_RTR_FLAG if is_remote else cob_id, len(data), data))
        except OSError as error:
            if error.errno in _QUEUE_FULL:
                return False
            raise self._lost(error) from None
        return True

    def receive(self) -> tuple[Frame, int] | None:
        """See Port."""
        for _ in range(_MAX_SKIPPED_FRAMES):
            number = self._batch_next
            if number == self._batch_count:
                number = 0
                if not self._fetch():
                    return None
            self._batch_next = number + 1
            identifier, length, data = _unpack_frame(self._batch.data, number << 4)
            if identifier <= _CAN_SFF_MASK:
                # Most frames by far are whole and plain.
                frame = Frame(identifier, data if length == MAX_DATA_LENGTH else data[:length])
            elif identifier & _CAN_ERR_FLAG:
                self._take_error(identifier, data[:length])
                continue
            else:
                frame = Frame(identifier & _CAN_SFF_MASK, b"", True)
            arrival_ns = self._clock.arrival_ns(self._batch.stamp_ns(number))
            if self._hardware_clock is not None and self._batch.hardware_ns:
                arrival_ns = self._hardware_clock.arrival_ns(self._batch.hardware_ns, arrival_ns)
            return frame, arrival_ns
        return None

    def _fetch(self) -> bool:
        """Fill the batch; False if nothing waits.

        A batch that was not full has emptied the queue: nothing more is asked for before the next ``wait``.
        """
        self._batch_next = self._batch_count = 0
        if self._may_hold_more:
            try:
                self._batch_count = self._batch.receive()
            except OSError as error:
                raise self._lost(error) from None
            if self._batch_count < self._batch.capacity:
                self._may_hold_more = False
                self._empty_ns = time.monotonic_ns()
            if self._batch_count:
                self._clock.look()
                return True
        self._clock.queue_is_empty(self._empty_ns)
        self._may_hold_more = True
        return False

    def wait(self, timeout_s: float) -> bool:
        """See Port."""
        try:
            return bool(select.select((self._socket,), (), (), timeout_s)[0])
        except (OSError, ValueError) as error:
            raise self._error(f"the socket is closed ({error})") from None

    def fileno(self) -> int:
        """See Port."""
        return self._socket.fileno()

    def close(self) -> None:
        """See Port."""
        self._socket.close()

    def _take_error(self, identifier: int, data: bytes) -> None:
        self.controller.take(identifier, data)
        if self.controller.is_off and not self.outlives_bus_off:
            raise self._error("the controller has gone bus-off; look at bit rate, wiring and termination")

    def _lost(self, error: OSError) -> BusError:
        if error.errno == errno.ENETDOWN:
            return self._error("the interface has gone down")
        if error.errno in (errno.ENODEV, errno.ENXIO):
            return self._error("the interface has been removed")
        return self._error(f"the interface has failed ({error.strerror or error})")

    def _error(self, reason: str) -> BusError:
        return BusError("socketcan", self.channel, reason)
