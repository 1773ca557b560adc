"""Many datagrams in one system call: recvmmsg(2) into buffers that are made once.

The socket module asks the kernel for the interface's name with every CAN frame that it receives together with its time
stamp, a second system call each. A batch costs one call for all frames that wait.
"""

import ctypes
import os
import socket
import struct
from typing import Any, Final

from drivers.hardware_stamps import SO_TIMESTAMPING

DATAGRAM_BYTES: Final = 16
_CONTROL_BYTES: Final = 128
_SO_TIMESTAMPNS: Final = 35
_SO_RXQ_OVFL: Final = 40


class _Vector(ctypes.Structure):
    _fields_ = (("base", ctypes.c_void_p), ("length", ctypes.c_size_t))


class _Header(ctypes.Structure):
    _fields_ = (
        ("name", ctypes.c_void_p),
        ("name_length", ctypes.c_uint),
        ("vectors", ctypes.c_void_p),
        ("vector_count", ctypes.c_size_t),
        ("control", ctypes.c_void_p),
        ("control_length", ctypes.c_size_t),
        ("flags", ctypes.c_int),
    )


class _Message(ctypes.Structure):
    _fields_ = (("header", _Header), ("length", ctypes.c_uint))


_MESSAGE_SIZE: Final = ctypes.sizeof(_Message)
_CONTROL_LENGTH_OFFSET: Final = int(_Header.control_length.offset)
_LENGTH_OFFSET: Final = int(_Message.length.offset)
_unpack_size: Final = struct.Struct("@N").unpack_from
_UNSIGNED: Final = struct.Struct("@I")
_ANCILLARY: Final = struct.Struct("@Nii")
_TIMESPEC: Final = struct.Struct("@ll")
_TIMESTAMPING: Final = struct.Struct("@llllll")
"""``struct scm_timestamping``: the kernel's stamp, a legacy one that stays empty, the hardware's."""
_STAMP: Final = struct.Struct("@Niill")
_ALIGNMENT: Final = ctypes.sizeof(ctypes.c_size_t)


class MessageBatch:
    """Receives datagrams of up to 16 bytes from a socket that does not block, with kernel time stamps if it has them.

    After ``receive`` the datagrams lie in ``data``, ``DATAGRAM_BYTES`` each.
    """

    def __init__(self, receiver: socket.socket, capacity: int = 16) -> None:
        """``capacity``: datagrams at most in a call."""
        self.drop_count = 0
        """Datagrams that the kernel had no room for, where the socket tells (SO_RXQ_OVFL)."""
        self.hardware_ns = 0
        """Stamp by the controller's clock of the datagram that ``stamp_ns`` was asked for last; 0 where it has none."""
        self.capacity: Final = capacity
        self._descriptor = receiver.fileno()
        self._data = ctypes.create_string_buffer(DATAGRAM_BYTES * capacity)
        self._control = ctypes.create_string_buffer(_CONTROL_BYTES * capacity)
        self._vectors = (_Vector * capacity)()
        self._messages = (_Message * capacity)()
        data, control, vectors = map(ctypes.addressof, (self._data, self._control, self._vectors))
        for number in range(capacity):
            self._vectors[number] = _Vector(data + DATAGRAM_BYTES * number, DATAGRAM_BYTES)
            header = self._messages[number].header
            header.vectors = vectors + ctypes.sizeof(_Vector) * number
            header.vector_count = 1
            header.control = control + _CONTROL_BYTES * number
            header.control_length = _CONTROL_BYTES
        self.data: Final = memoryview(self._data).cast("B")
        self._ancillary = memoryview(self._control).cast("B")
        self._raw = memoryview(self._messages).cast("B")
        # The kernel writes lengths into the headers: they are put back after every call.
        fresh = bytes(self._raw)
        self._fresh = tuple(fresh[: _MESSAGE_SIZE * count] for count in range(capacity + 1))
        self._used = 0
        self._function: Any = ctypes.CDLL(None, use_errno=True).recvmmsg
        self._function.argtypes = (ctypes.c_int, ctypes.c_void_p, ctypes.c_uint, ctypes.c_int, ctypes.c_void_p)
        self._function.restype = ctypes.c_int
        self._address = ctypes.addressof(self._messages)

    def receive(self) -> int:
        """How many datagrams have been received, 0 for none. Raises OSError."""
        used = self._used
        if used:
            self._raw[: _MESSAGE_SIZE * used] = self._fresh[used]
            self._used = 0
        count = self._function(self._descriptor, self._address, self.capacity, socket.MSG_DONTWAIT, None)
        if count < 0:
            code = ctypes.get_errno()
            if code in (11, 4):  # EAGAIN, EINTR
                return 0
            raise OSError(code, os.strerror(code))
        self._used = count
        return count

    def length(self, number: int) -> int:
        """Bytes of datagram ``number``."""
        return _UNSIGNED.unpack_from(self._raw, _MESSAGE_SIZE * number + _LENGTH_OFFSET)[0]

    def stamp_ns(self, number: int) -> int:
        """Time of day at which the kernel received datagram ``number``; 0 where it does not tell."""
        (left,) = _unpack_size(self._raw, _MESSAGE_SIZE * number + _CONTROL_LENGTH_OFFSET)
        offset = _CONTROL_BYTES * number
        if left == _STAMP.size:
            _, _, kind, seconds, nanoseconds = _STAMP.unpack_from(self._ancillary, offset)
            if kind == _SO_TIMESTAMPNS:
                return seconds * 1_000_000_000 + nanoseconds
        stamp_ns = self.hardware_ns = 0
        while left >= _ANCILLARY.size:
            length, _, kind = _ANCILLARY.unpack_from(self._ancillary, offset)
            if kind == _SO_TIMESTAMPNS:
                seconds, nanoseconds = _TIMESPEC.unpack_from(self._ancillary, offset + _ANCILLARY.size)
                stamp_ns = seconds * 1_000_000_000 + nanoseconds
            elif kind == SO_TIMESTAMPING:
                stamps = _TIMESTAMPING.unpack_from(self._ancillary, offset + _ANCILLARY.size)
                seconds, nanoseconds, _, _, hardware_s, hardware_ns = stamps
                stamp_ns = seconds * 1_000_000_000 + nanoseconds
                self.hardware_ns = hardware_s * 1_000_000_000 + hardware_ns
            elif kind == _SO_RXQ_OVFL:
                (self.drop_count,) = _UNSIGNED.unpack_from(self._ancillary, offset + _ANCILLARY.size)
            step = -(-max(length, _ANCILLARY.size) // _ALIGNMENT) * _ALIGNMENT
            offset += step
            left -= step
        return stamp_ns
