"""SDO client, sans-IO: each transfer is a generator that yields request payloads and is sent the responses' payloads.

Expedited and segmented transfers of CiA 301, 7.2.4. The master puts node ids, COB-IDs and time-outs around them.
"""

import struct
from collections.abc import Generator
from typing import Final

from drivers.sdo import AbortCode, ClientCommand, ServerCommand, abort_text

MAX_UPLOAD_BYTES: Final = 1 << 20
"""A server that announces or sends more than this is refused: nothing on the bus is larger."""

_INITIATE: Final = struct.Struct("<BHBI")
_EXPEDITED: Final = 0x02
_SIZE_INDICATED: Final = 0x01
_TOGGLE: Final = 0x10
_LAST_SEGMENT: Final = 0x01


class SdoTransferError(Exception):
    """A transfer ended with an abort; ``is_by_server`` tells by whom."""

    def __init__(self, code: int, is_by_server: bool) -> None:
        super().__init__(abort_text(code))
        self.code = code
        self.is_by_server = is_by_server


def abort_payload(index: int, subindex: int, code: int) -> bytes:
    """The 8 bytes that abort a transfer of this object."""
    return _INITIATE.pack(ClientCommand.ABORT << 5, index, subindex, code)


def _check(response: bytes, expected: ServerCommand) -> int:
    """The command byte of ``response``; raises SdoTransferError if it aborts, or is not ``expected``."""
    if len(response) != 8:
        raise SdoTransferError(AbortCode.COMMAND_SPECIFIER_UNKNOWN, is_by_server=False)
    command = response[0]
    if command >> 5 == ServerCommand.ABORT:
        raise SdoTransferError(int.from_bytes(response[4:8], "little"), is_by_server=True)
    if command >> 5 != expected:
        raise SdoTransferError(AbortCode.COMMAND_SPECIFIER_UNKNOWN, is_by_server=False)
    return command


def _check_multiplexer(response: bytes, index: int, subindex: int) -> None:
    if int.from_bytes(response[1:3], "little") != index or response[3] != subindex:
        raise SdoTransferError(AbortCode.PARAMETER_INCOMPATIBLE, is_by_server=False)


def upload(index: int, subindex: int) -> Generator[bytes, bytes, bytes]:
    """Read an object: the generator returns its bytes. Raises SdoTransferError."""
    response = yield _INITIATE.pack(ClientCommand.INITIATE_UPLOAD << 5, index, subindex, 0)
    command = _check(response, ServerCommand.INITIATE_UPLOAD)
    _check_multiplexer(response, index, subindex)
    if command & _EXPEDITED:
        unused = command >> 2 & 3 if command & _SIZE_INDICATED else 0
        return response[4 : 8 - unused]
    announced = int.from_bytes(response[4:8], "little") if command & _SIZE_INDICATED else None
    if announced is not None and announced > MAX_UPLOAD_BYTES:
        raise SdoTransferError(AbortCode.OUT_OF_MEMORY, is_by_server=False)
    data = bytearray()
    toggle = 0
    while True:
        response = yield bytes((ClientCommand.UPLOAD_SEGMENT << 5 | toggle, 0, 0, 0, 0, 0, 0, 0))
        command = _check(response, ServerCommand.UPLOAD_SEGMENT)
        if command & _TOGGLE != toggle:
            raise SdoTransferError(AbortCode.TOGGLE_BIT_NOT_ALTERNATED, is_by_server=False)
        data += response[1 : 8 - (command >> 1 & 7)]
        if len(data) > MAX_UPLOAD_BYTES:
            raise SdoTransferError(AbortCode.OUT_OF_MEMORY, is_by_server=False)
        if command & _LAST_SEGMENT:
            break
        toggle ^= _TOGGLE
    if announced is not None and announced != len(data):
        raise SdoTransferError(AbortCode.LENGTH_MISMATCH, is_by_server=False)
    return bytes(data)


def download(index: int, subindex: int, data: bytes) -> Generator[bytes, bytes, None]:
    """Write ``data`` to an object, expedited up to 4 bytes, segmented above. Raises SdoTransferError."""
    size = len(data)
    if 1 <= size <= 4:
        command = ClientCommand.INITIATE_DOWNLOAD << 5 | (4 - size) << 2 | _EXPEDITED | _SIZE_INDICATED
        response = yield _INITIATE.pack(command, index, subindex, int.from_bytes(data, "little"))
        _check(response, ServerCommand.INITIATE_DOWNLOAD)
        _check_multiplexer(response, index, subindex)
        return
    response = yield _INITIATE.pack(ClientCommand.INITIATE_DOWNLOAD << 5 | _SIZE_INDICATED, index, subindex, size)
    _check(response, ServerCommand.INITIATE_DOWNLOAD)
    _check_multiplexer(response, index, subindex)
    toggle = 0
    for start in range(0, max(size, 1), 7):
        segment = data[start : start + 7]
        is_last = start + 7 >= size
        command = ClientCommand.DOWNLOAD_SEGMENT << 5 | toggle | (7 - len(segment)) << 1 | is_last
        response = yield bytes((command,)) + segment.ljust(7, b"\0")
        answer = _check(response, ServerCommand.DOWNLOAD_SEGMENT)
        if answer & _TOGGLE != toggle:
            raise SdoTransferError(AbortCode.TOGGLE_BIT_NOT_ALTERNATED, is_by_server=False)
        toggle ^= _TOGGLE
