"""SDO client, sans-IO: each transfer is a generator that yields requests and is sent the responses' payloads.

Expedited, segmented and block transfers of CiA 301, 7.2.4. The master puts node ids, COB-IDs and time-outs around them.

A request is a payload of 8 bytes that is answered with one response, or, in block transfer, a ``Request``: any number
of payloads, and what to wait for after them. A time-out is thrown into the generator as ``SdoTimeoutError``; only a
block upload can go on after one.
"""

import struct
from collections.abc import Generator
from enum import Enum, unique
from typing import Final, NamedTuple, TypeVar

from drivers.sdo import AbortCode, ClientCommand, ServerCommand, abort_text
from drivers.sdo_block import (
    ABORT_COMMAND,
    BLOCK_SIZE_INDICATED,
    CRC_SUPPORTED,
    LAST_SEGMENT,
    MAX_BLOCK_SIZE,
    SEGMENT_BYTES,
    BlockSubcommand,
    SubBlockReader,
    SubBlockStep,
    crc16,
    is_block_size,
    make_sub_block,
    unused_bytes,
)

MAX_UPLOAD_BYTES: Final = 1 << 20
"""A server that announces or sends more than this is refused: nothing on the bus is larger."""

MAX_RESUMES: Final = 8
"""How often in a row a block transfer is resumed without a single segment coming through, before it is given up."""

_INITIATE: Final = struct.Struct("<BHBI")
_INITIATE_BLOCK_UPLOAD: Final = struct.Struct("<BHBBB2x")
_BLOCK_END: Final = struct.Struct("<BH5x")
_EXPEDITED: Final = 0x02
_SIZE_INDICATED: Final = 0x01
_TOGGLE: Final = 0x10
_LAST_SEGMENT: Final = 0x01

T = TypeVar("T")


@unique
class Wait(Enum):
    """What a client waits for after its request."""

    RESPONSE = "response"
    MORE = "more"
    """The next of several responses, which follows the one before at once."""
    NOTHING = "nothing"


class Request(NamedTuple):
    """Payloads to send, oldest first, and what to wait for then."""

    payloads: tuple[bytes, ...]
    wait: Wait = Wait.RESPONSE


Transfer = Generator[bytes | Request, bytes, T]


class SdoTimeoutError(Exception):
    """Thrown into a transfer that has waited for too long."""


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
    return (yield from _upload_after(response, index, subindex))


def _upload_after(response: bytes, index: int, subindex: int) -> Generator[bytes, bytes, bytes]:
    """The upload from the response to its initiate on."""
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


# -- block transfer ----------------------------------------------------------------------------------------------------


def _is_block_refused(response: bytes) -> bool:
    """Whether the server does not know block transfer, so that segments have to do."""
    refusal = AbortCode.COMMAND_SPECIFIER_UNKNOWN.to_bytes(4, "little")
    return len(response) == 8 and response[0] >> 5 == ServerCommand.ABORT and response[4:8] == refusal


def _check_block(response: bytes, expected: ServerCommand, subcommand: BlockSubcommand, mask: int = 3) -> int:
    command = _check(response, expected)
    if command & mask != subcommand:
        raise SdoTransferError(AbortCode.COMMAND_SPECIFIER_UNKNOWN, is_by_server=False)
    return command


def download_block(index: int, subindex: int, data: bytes) -> Transfer[None]:
    """Write ``data`` in blocks, with CRC where the server has it; in segments if it knows no blocks.

    Segments that the server has not acknowledged are sent again. Raises SdoTransferError.
    """
    size = len(data)
    command = ClientCommand.BLOCK_DOWNLOAD << 5 | CRC_SUPPORTED | BLOCK_SIZE_INDICATED
    response = yield _INITIATE.pack(command, index, subindex, size)
    if _is_block_refused(response):
        yield from download(index, subindex, data)
        return
    command = _check_block(response, ServerCommand.BLOCK_DOWNLOAD, BlockSubcommand.INITIATE)
    _check_multiplexer(response, index, subindex)
    has_crc = bool(command & CRC_SUPPORTED)
    block_size = _checked_block_size(response[4])
    position = 0
    resumes = 0
    while True:
        segments = make_sub_block(data, position, block_size)
        response = yield Request(segments)
        _check_block(response, ServerCommand.BLOCK_DOWNLOAD, BlockSubcommand.RESPONSE)
        acknowledged = response[1]
        if acknowledged > len(segments):
            raise SdoTransferError(AbortCode.INVALID_SEQUENCE_NUMBER, is_by_server=False)
        block_size = _checked_block_size(response[2])
        if acknowledged == len(segments) and segments[-1][0] & LAST_SEGMENT:
            break
        position += acknowledged * SEGMENT_BYTES
        resumes = 0 if acknowledged else resumes + 1
        if resumes > MAX_RESUMES:
            raise SdoTransferError(AbortCode.PROTOCOL_TIMED_OUT, is_by_server=False)
    command = ClientCommand.BLOCK_DOWNLOAD << 5 | unused_bytes(size) << 2 | BlockSubcommand.END
    response = yield _BLOCK_END.pack(command, crc16(data) if has_crc else 0)
    _check_block(response, ServerCommand.BLOCK_DOWNLOAD, BlockSubcommand.END)


def _checked_block_size(value: int) -> int:
    if not is_block_size(value):
        raise SdoTransferError(AbortCode.INVALID_BLOCK_SIZE, is_by_server=False)
    return value


def upload_block(
    index: int, subindex: int, block_size: int = MAX_BLOCK_SIZE, protocol_switch_threshold: int = 0
) -> Transfer[bytes]:
    """Read an object in blocks of ``block_size`` segments (1 to 127); in segments if the server knows no blocks.

    ``protocol_switch_threshold``: the server may answer as to an ordinary upload where there are no more bytes than
    this, 0 to 255; 0 forbids it. Segments that get lost are asked for again. Raises SdoTransferError.
    """
    command = ClientCommand.BLOCK_UPLOAD << 5 | CRC_SUPPORTED
    response = yield _INITIATE_BLOCK_UPLOAD.pack(command, index, subindex, block_size, protocol_switch_threshold)
    if _is_block_refused(response):
        return (yield from upload(index, subindex))
    if protocol_switch_threshold and response[0] >> 5 == ServerCommand.INITIATE_UPLOAD:
        return (yield from _upload_after(response, index, subindex))
    command = _check_block(response, ServerCommand.BLOCK_UPLOAD, BlockSubcommand.INITIATE, mask=1)
    _check_multiplexer(response, index, subindex)
    announced = int.from_bytes(response[4:8], "little") if command & BLOCK_SIZE_INDICATED else None
    if announced is not None and announced > MAX_UPLOAD_BYTES:
        raise SdoTransferError(AbortCode.OUT_OF_MEMORY, is_by_server=False)
    reader = SubBlockReader(block_size)
    yield from _take_sub_blocks(reader)
    response = yield Request((_acknowledgement(reader),))
    while reader.is_repetition(response):
        response = yield Request((), Wait.MORE)
    end = _check_block(response, ServerCommand.BLOCK_UPLOAD, BlockSubcommand.END)
    data = bytes(reader.buffer[: len(reader.buffer) - (end >> 2 & 7)])
    if command & CRC_SUPPORTED and int.from_bytes(response[1:3], "little") != crc16(data):
        raise SdoTransferError(AbortCode.CRC_ERROR, is_by_server=False)
    if announced is not None and announced != len(data):
        raise SdoTransferError(AbortCode.LENGTH_MISMATCH, is_by_server=False)
    yield Request((_subcommand(BlockSubcommand.END),), Wait.NOTHING)
    return data


def _subcommand(subcommand: BlockSubcommand) -> bytes:
    return bytes((ClientCommand.BLOCK_UPLOAD << 5 | subcommand, 0, 0, 0, 0, 0, 0, 0))


def _acknowledgement(reader: SubBlockReader) -> bytes:
    command = ClientCommand.BLOCK_UPLOAD << 5 | BlockSubcommand.RESPONSE
    return bytes((command, reader.last_good, reader.block_size, 0, 0, 0, 0, 0))


def _take_sub_blocks(reader: SubBlockReader) -> Transfer[None]:
    """Start the server's sending and take sub-blocks until the last segment is there; it is not acknowledged yet."""
    request = Request((_subcommand(BlockSubcommand.START),))
    resumes = 0
    while True:
        try:
            response = yield request
        except SdoTimeoutError:
            # The sub-block's end was lost, or the acknowledgement: what is missing is asked for.
            step = SubBlockStep.ENDED
        else:
            if len(response) != 8 or response[0] == ABORT_COMMAND:
                _check(response, ServerCommand.BLOCK_UPLOAD)
            step = reader.take(response)
        if step is SubBlockStep.INVALID:
            raise SdoTransferError(AbortCode.INVALID_SEQUENCE_NUMBER, is_by_server=False)
        if len(reader.buffer) > MAX_UPLOAD_BYTES + SEGMENT_BYTES:
            raise SdoTransferError(AbortCode.OUT_OF_MEMORY, is_by_server=False)
        if reader.is_complete:
            return
        if step is SubBlockStep.GOES_ON:
            request = Request((), Wait.MORE)
            continue
        resumes = 0 if reader.last_good else resumes + 1
        if resumes > MAX_RESUMES:
            raise SdoTimeoutError
        request = Request((_acknowledgement(reader),))
        reader.begin()
