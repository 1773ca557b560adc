"""COB-ID entries of the communication profile: their bits, and the identifiers that may not be configured."""

from typing import Final

COB_ID_MASK: Final = 0x7FF
EXTENDED_FRAME: Final = 1 << 29
"""Bit 29: a 29-bit identifier, which the drive has none of."""


def is_restricted(cob_id: int) -> bool:
    """Whether CiA 301 (table 76) keeps this COB-ID from any object that can be configured."""
    return (
        cob_id < 0x080
        or 0x101 <= cob_id <= 0x180
        or 0x581 <= cob_id <= 0x5FF
        or 0x601 <= cob_id <= 0x67F
        or cob_id >= 0x6E0
    )


def is_refused(value: int, current: int, exists: int) -> bool:
    """Whether an entry must not change from ``current`` to ``value``.

    The identifier is restricted or of 29 bits, or it would change while the object exists, before and after;
    ``exists`` are the bits of which any one says that it does.
    """
    is_moved = bool((value ^ current) & COB_ID_MASK)
    is_kept = bool(current & exists and value & exists)
    return bool(value & EXTENDED_FRAME) or is_restricted(value & COB_ID_MASK) or (is_moved and is_kept)
