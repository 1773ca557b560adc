"""The CAN frame as it travels between cores, and its length on the wire."""

from collections.abc import Callable
from typing import Final, NamedTuple

MAX_DATA_LENGTH: Final = 8


class Frame(NamedTuple):
    """One classic CAN 2.0A data or remote frame.

    A named tuple rather than a dataclass: it is frozen and slotted all the same, and costs a third to make, which is
    what the cycle and virtual time spend most of their time on.
    """

    cob_id: int
    """11-bit identifier; CANopen calls it the COB-ID."""
    data: bytes = b""
    """0 to 8 bytes; empty for a remote frame."""
    is_remote: bool = False

    def __str__(self) -> str:
        return f"{self.cob_id:03X}#{'R' if self.is_remote else self.data.hex().upper()}"


new_frame: Final[Callable[[type[Frame], tuple[int, bytes, bool]], Frame]] = tuple.__new__  # pyright: ignore[reportUnknownMemberType, reportUnknownVariableType]
"""``new_frame(Frame, (cob_id, data, False))`` is a frame at half the cost, for what sends in every cycle."""


def worst_case_bits(data_length: int) -> int:
    """Bits that a base frame of ``data_length`` bytes takes on the wire with worst-case bit stuffing.

    47 + 8n bits including the interframe space, of which 34 + 8n are subject to stuffing (ISO 11898-1).
    """
    return 47 + 8 * data_length + (34 + 8 * data_length - 1) // 4


WORST_CASE_BITS: Final = tuple(worst_case_bits(n) for n in range(MAX_DATA_LENGTH + 1))
