"""Whether a network interface stamps frames by a clock of its own (linux/ethtool.h, linux/net_tstamp.h)."""

import ctypes
import fcntl
import os
import socket
import struct
from typing import Final

SO_TIMESTAMPING: Final = 37
_SIOCETHTOOL: Final = 0x8946
_ETHTOOL_GET_TS_INFO: Final = 0x41
_TS_INFO: Final = struct.Struct("=IIiI3II3I")
_INTERFACE_REQUEST: Final = struct.Struct("@16sP16x")
_RX_HARDWARE: Final = 0x04
_RX_SOFTWARE: Final = 0x08
_SOFTWARE: Final = 0x10
_RAW_HARDWARE: Final = 0x40
_MAX_NAME_BYTES: Final = 15

BOTH_STAMPS: Final = _RX_HARDWARE | _RAW_HARDWARE | _RX_SOFTWARE | _SOFTWARE
"""Value of SO_TIMESTAMPING for a socket that wants the controller's stamp and the kernel's with every frame."""


def why_no_hardware_stamps(channel: str) -> str:
    """Empty if the interface stamps received frames by its own clock; else why not, in a few words."""
    name = channel.encode()
    if len(name) > _MAX_NAME_BYTES:
        return "no such interface"
    answer = ctypes.create_string_buffer(_TS_INFO.size)
    struct.pack_into("=I", answer, 0, _ETHTOOL_GET_TS_INFO)
    request = _INTERFACE_REQUEST.pack(name, ctypes.addressof(answer))
    try:
        # Any socket does for a question about an interface.
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as asking:
            fcntl.ioctl(asking.fileno(), _SIOCETHTOOL, request)
    except OSError as error:
        return f"{channel} does not tell of its timestamps ({os.strerror(error.errno or 0).lower()})"
    return "" if offers_both(answer.raw) else f"{channel} has none"


def offers_both(info: bytes) -> bool:
    """Whether ``struct ethtool_ts_info`` offers hardware stamps of received frames, and hands them out as they are."""
    capabilities = _TS_INFO.unpack(info)[1]
    return capabilities & _RX_HARDWARE != 0 and capabilities & _RAW_HARDWARE != 0
