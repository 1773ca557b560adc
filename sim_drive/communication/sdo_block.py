"""The server's side of SDO block transfers (CiA 301, 7.2.4.3.9 to 7.2.4.3.16): one object for each transfer."""

from enum import Enum, unique
from typing import Final

from drivers.sdo import AbortCode, ClientCommand, ServerCommand
from drivers.sdo_block import (
    SEGMENT_BYTES,
    BlockSubcommand,
    SubBlockReader,
    SubBlockStep,
    crc16,
    is_block_size,
    make_sub_block,
    unused_bytes,
)
from sim_drive.communication.dictionary import Entry, check_size

_DOWNLOAD: Final = ServerCommand.BLOCK_DOWNLOAD << 5
_UPLOAD: Final = ServerCommand.BLOCK_UPLOAD << 5


class BlockDownload:
    """A download: sub-blocks come in until the last segment is there, then the end command with the CRC."""

    __slots__ = ("_block_size", "_expected_size", "_has_crc", "_limit", "_reader", "entry", "is_ending")

    def __init__(self, entry: Entry, expected_size: int | None, has_crc: bool, block_size: int) -> None:
        self.entry: Final = entry
        self.is_ending = False
        """All segments are there; the end command is awaited."""
        self._expected_size = expected_size
        self._has_crc = has_crc
        self._block_size = block_size
        self._limit = entry.capacity if expected_size is None else expected_size
        self._reader = SubBlockReader(block_size)

    def take_segment(self, segment: bytes) -> bytes | AbortCode | None:
        """Take a segment; gives the response when the sub-block is over, an abort code, or nothing yet."""
        step = self._reader.take(segment)
        if step is SubBlockStep.INVALID:
            return AbortCode.INVALID_SEQUENCE_NUMBER
        # The last segment is padded, by how much the end command tells.
        if len(self._reader.buffer) - SEGMENT_BYTES > self._limit:
            return self._too_long()
        return self._respond() if step is SubBlockStep.ENDED else None

    def resume(self) -> bytes | None:
        """The client has fallen silent: the response, if it can only be that the sub-block's end has been lost."""
        return self._respond() if self._reader.has_heard and not self.is_ending else None

    def is_repetition(self, frame: bytes) -> bool:
        """Whether this is the last segment once more."""
        return self._reader.is_repetition(frame)

    def finish(self, command: bytes) -> bytes | AbortCode:
        """Take the end command; gives all the data, or the abort code."""
        buffer = self._reader.buffer
        data = bytes(buffer[: len(buffer) - (command[0] >> 2 & 7)])
        if self._expected_size is not None and len(data) != self._expected_size:
            too_long = len(data) > self._expected_size
            return AbortCode.LENGTH_TOO_HIGH if too_long else AbortCode.LENGTH_TOO_LOW
        if self._has_crc and int.from_bytes(command[1:3], "little") != crc16(data):
            return AbortCode.CRC_ERROR
        return data

    def _respond(self) -> bytes:
        reader = self._reader
        response = bytes((_DOWNLOAD | BlockSubcommand.RESPONSE, reader.last_good, self._block_size, 0, 0, 0, 0, 0))
        self.is_ending = reader.is_complete
        reader.begin()
        return response

    def _too_long(self) -> AbortCode:
        refusal = None if self._expected_size is not None else check_size(self.entry, len(self._reader.buffer))
        return AbortCode.LENGTH_TOO_HIGH if refusal is None else refusal


@unique
class UploadPhase(Enum):
    """What a block upload waits for."""

    START = "start"
    ACKNOWLEDGEMENT = "acknowledgement"
    END = "end"


class BlockUpload:
    """An upload: a sub-block goes out whole, and again from where the client says it has lost the sequence."""

    __slots__ = ("_block_size", "_data", "_has_crc", "_is_last", "_position", "_sent", "phase")

    def __init__(self, data: bytes, has_crc: bool, block_size: int) -> None:
        self._data = data
        self._has_crc = has_crc
        self._block_size = block_size
        self._position = 0
        self._sent = 0
        self._is_last = False
        self.phase = UploadPhase.START

    def take(self, command: bytes) -> tuple[bytes, ...] | AbortCode:
        """Take a command of the client; gives what to send (nothing once the transfer is over), or the abort code."""
        subcommand = command[0] & 3
        if self.phase is UploadPhase.START and subcommand == BlockSubcommand.START:
            return self._send()
        if self.phase is UploadPhase.ACKNOWLEDGEMENT and subcommand == BlockSubcommand.RESPONSE:
            return self._acknowledge(command[1], command[2])
        if self.phase is UploadPhase.END and subcommand == BlockSubcommand.END:
            return ()
        return AbortCode.COMMAND_SPECIFIER_UNKNOWN

    def _send(self) -> tuple[bytes, ...]:
        segments = make_sub_block(self._data, self._position, self._block_size)
        self._sent = len(segments)
        self._is_last = self._position + SEGMENT_BYTES * self._sent >= len(self._data)
        self.phase = UploadPhase.ACKNOWLEDGEMENT
        return segments

    def _acknowledge(self, last_good: int, block_size: int) -> tuple[bytes, ...] | AbortCode:
        if last_good > self._sent:
            return AbortCode.INVALID_SEQUENCE_NUMBER
        if not is_block_size(block_size):
            return AbortCode.INVALID_BLOCK_SIZE
        self._block_size = block_size
        if last_good < self._sent or not self._is_last:
            self._position += SEGMENT_BYTES * last_good
            return self._send()
        self.phase = UploadPhase.END
        size = len(self._data)
        command = _UPLOAD | unused_bytes(size) << 2 | BlockSubcommand.END
        crc = crc16(self._data) if self._has_crc else 0
        return (bytes((command, crc & 0xFF, crc >> 8, 0, 0, 0, 0, 0)),)


def is_initiate(command: int) -> bool:
    """Whether a block command opens a transfer, which may happen at any time, rather than going on with one."""
    mask = 1 if command >> 5 == ClientCommand.BLOCK_DOWNLOAD else 3
    return command & mask == BlockSubcommand.INITIATE
