"""SDO block transfer, what client and server share (CiA 301, 7.2.4.3.9 to 7.2.4.3.16): sub-blocks, sequence, CRC."""

from binascii import crc_hqx
from enum import Enum, IntEnum, unique
from typing import Final

MAX_BLOCK_SIZE: Final = 127
"""Segments in a sub-block, at most."""
SEGMENT_BYTES: Final = 7
CRC_SUPPORTED: Final = 0x04
"""Bit of both sides' initiate commands."""
BLOCK_SIZE_INDICATED: Final = 0x02
"""Bit of the initiate command of whoever has the data: their size is in the last four bytes."""
LAST_SEGMENT: Final = 0x80
"""Bit of a segment's first byte: no more segments follow in this transfer."""
ABORT_COMMAND: Final = 0x80
"""First byte of an abort; no segment has it, because sequence numbers begin with 1."""


class BlockSubcommand(IntEnum):
    """Sub-commands, in bits 1 and 0 of a command byte; the initiate of the data's side uses bit 0 alone."""

    INITIATE = 0
    END = 1
    RESPONSE = 2
    START = 3


def crc16(data: bytes) -> int:
    """CRC-16-CCITT as block transfer uses it: polynomial 1021h, initial value 0, no reflection; "123456789": 31C3h."""
    return crc_hqx(data, 0)


def unused_bytes(size: int) -> int:
    """Bytes of the last segment that carry nothing, when ``size`` bytes are sent; 7 if there are no data at all."""
    return SEGMENT_BYTES - size % SEGMENT_BYTES if size % SEGMENT_BYTES or not size else 0


def is_block_size(value: int) -> bool:
    """Whether ``value`` may be the number of segments in a sub-block."""
    return 1 <= value <= MAX_BLOCK_SIZE


def make_sub_block(data: bytes, position: int, block_size: int) -> tuple[bytes, ...]:
    """The segments of 8 bytes for ``data`` from ``position`` on, ``block_size`` of them at most."""
    end = max(len(data), 1)
    starts = range(position, min(end, position + SEGMENT_BYTES * block_size), SEGMENT_BYTES)
    return tuple(
        bytes((number | (LAST_SEGMENT if start + SEGMENT_BYTES >= end else 0),))
        + data[start : start + SEGMENT_BYTES].ljust(SEGMENT_BYTES, b"\0")
        for number, start in enumerate(starts, start=1)
    )


@unique
class SubBlockStep(Enum):
    """What a segment has led to."""

    GOES_ON = "goes on"
    ENDED = "ended"
    """The sub-block is over and wants its response; segments of it may be missing."""
    INVALID = "invalid"
    """The sequence number is 0 or beyond the sub-block."""


class SubBlockReader:
    """Puts sub-blocks together. What follows a gap is dropped, until the other side sends it again."""

    __slots__ = ("_previous", "block_size", "buffer", "has_heard", "is_complete", "last_good")

    def __init__(self, block_size: int) -> None:
        self.block_size = block_size
        self.buffer = bytearray()
        """The data of all segments in sequence, the last one's padding included."""
        self.last_good = 0
        """Sequence number of the last segment of this sub-block that came in sequence."""
        self.has_heard = False
        """Some segment of this sub-block has come, in sequence or not."""
        self.is_complete = False
        """The transfer's last segment has come in sequence."""
        self._previous = b""

    def take(self, segment: bytes) -> SubBlockStep:
        """Take a segment of 8 bytes."""
        if self.is_repetition(segment):
            return SubBlockStep.GOES_ON
        number = segment[0] & ~LAST_SEGMENT
        if not 1 <= number <= self.block_size:
            return SubBlockStep.INVALID
        self._previous = segment
        self.has_heard = True
        if number == self.last_good + 1:
            self.last_good = number
            self.buffer += segment[1:]
            self.is_complete = bool(segment[0] & LAST_SEGMENT)
        is_over = segment[0] & LAST_SEGMENT or number == self.block_size
        return SubBlockStep.ENDED if is_over else SubBlockStep.GOES_ON

    def is_repetition(self, segment: bytes) -> bool:
        """Whether the frame before has come twice; in sub-blocks of one segment that cannot be told."""
        return self.block_size > 1 and segment == self._previous

    def begin(self) -> None:
        """The response has been sent: the next sub-block counts from 1."""
        self.last_good = 0
        self.has_heard = False
