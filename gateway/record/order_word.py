"""An operator's order as one word of 64 bits, so that the loop never sees half of one."""

from typing import Final

VALUE_SCALE: Final = 1000
"""Values travel in thousandths, as INTEGER32."""
_HALF: Final = 1 << 31
_MASK: Final = (1 << 32) - 1
_NUMBERS: Final = 1 << 24


def pack_order(number: int, order: int, value: float) -> int:
    """``number`` tells an order from the one before; ``order`` is 1 to 255. Raises ValueError for a value too large."""
    scaled = round(value * VALUE_SCALE)
    if not -_HALF <= scaled < _HALF:
        raise ValueError(f"{value:g} is not within {-_HALF // VALUE_SCALE} to {_HALF // VALUE_SCALE}")
    return (number % _NUMBERS) << 40 | order << 32 | scaled & _MASK


def unpack_order(word: int) -> tuple[int, int, float]:
    """Number, order and value of a word."""
    scaled = ((word & _MASK) + _HALF & _MASK) - _HALF
    return word >> 40, word >> 32 & 0xFF, scaled / VALUE_SCALE
