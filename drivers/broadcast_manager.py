"""A frame that the kernel sends by itself at a fixed period: SocketCAN's broadcast manager (linux/can/bcm.h).

The frame leaves from the kernel's own timer, whatever the process does in the meantime; it ends with the socket, so
also with a process that is killed.
"""

import errno
import os
import socket
import struct
from typing import Final

from drivers.errors import BusError
from drivers.frame import Frame
from drivers.socketcan_port import CAN_FRAME

_AF_CAN: Final = 29
_CAN_BCM: Final = 2
_TX_SETUP: Final = 1
_TX_DELETE: Final = 2
_SETTIMER: Final = 0x1
_STARTTIMER: Final = 0x2
# opcode, flags, count; ival1 and ival2 as seconds and microseconds; identifier, number of frames
_HEAD: Final = struct.Struct("@IIIllllII0q")


class PeriodicFrame:
    """One frame, sent by the kernel every period from ``start`` to ``stop``."""

    def __init__(self, channel: str, frame: Frame, period_us: int) -> None:
        """Connect to the broadcast manager of the interface ``channel``; nothing is sent yet.

        Raises:
            BusError: this kernel has no broadcast manager, or there is no such interface.
        """
        self.channel: Final = channel
        self._frame = frame
        self._period_us = period_us
        try:
            self._socket = socket.socket(_AF_CAN, socket.SOCK_DGRAM, _CAN_BCM)
        except OSError as error:
            raise self._error(f"this system offers no CAN broadcast manager ({error.strerror})") from None
        try:
            self._socket.connect((channel,))
        except OSError as error:
            self._socket.close()
            reason = "no such interface" if error.errno == errno.ENODEV else os.strerror(error.errno or 0)
            raise self._error(f"the broadcast manager cannot use it ({reason})") from None

    def start(self) -> None:
        """Send the frame now and every period from now on. Raises BusError."""
        self._set_up(_SETTIMER | _STARTTIMER)

    def retime(self, period_us: int) -> None:
        """Another period, from the frame after next on; nothing is sent for it. Raises BusError."""
        self._period_us = period_us
        self._set_up(_SETTIMER)

    def _set_up(self, flags: int) -> None:
        cob_id, data, _ = self._frame
        period = divmod(self._period_us, 1_000_000)
        head = _HEAD.pack(_TX_SETUP, flags, 0, 0, 0, *period, cob_id, 1)
        self._write(head + CAN_FRAME.pack(cob_id, len(data), data))

    def stop(self) -> None:
        """Send it no more. Raises BusError."""
        self._write(_HEAD.pack(_TX_DELETE, 0, 0, 0, 0, 0, 0, self._frame.cob_id, 0))

    def close(self) -> None:
        """Stop, and leave the interface; may be called twice."""
        self._socket.close()

    def _write(self, message: bytes) -> None:
        try:
            self._socket.send(message)
        except OSError as error:
            raise self._error(f"the broadcast manager refuses the frame ({error.strerror})") from None

    def _error(self, reason: str) -> BusError:
        return BusError("socketcan", self.channel, reason)
