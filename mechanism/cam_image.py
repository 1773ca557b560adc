"""The binary cam image that a drive takes into a profile slot.

Little-endian: magic "CAM1"; u16 version; u16 fraction bits (one slave unit is 2^-fraction_bits counts); u32 number of
points; i32 master counts a cycle; i32 slave counts gained in a cycle; then one i32 slave position a point, in slave
units, at equal steps of the master's cycle from master position 0 on; then u32 CRC-32 (that of zlib) of everything
before it. The number of points is a power of two. Nothing of it depends on the mechanism: any master and slave axis
will do.
"""

import struct
from dataclasses import dataclass, field
from math import tau
from typing import Final
from zlib import crc32

import numpy as np

from mechanism.cam_profile import CamProfile
from mechanism.errors import CamImageError, CamImageFault

MAGIC: Final = b"CAM1"
VERSION: Final = 1
MINIMUM_POINTS: Final = 8
MAXIMUM_POINTS: Final = 65536
MAXIMUM_FRACTION_BITS: Final = 16
DEFAULT_FRACTION_BITS: Final = 8

_HEADER: Final = struct.Struct("<4sHHIii")
_CRC: Final = struct.Struct("<I")
_I32_MAXIMUM: Final = 2**31 - 1
_I32_MINIMUM: Final = -(2**31)


@dataclass(frozen=True, slots=True)
class CamImage:
    """A cam table as a drive holds it.

    master_counts_per_cycle > 0; slave_counts_per_cycle: what the slave gains in a cycle (counts); positions: slave
    units of 2^-fraction_bits counts at equal steps of the cycle. Raises CamImageError.
    """

    fraction_bits: int
    master_counts_per_cycle: int
    slave_counts_per_cycle: int
    positions: tuple[int, ...]
    _counts: tuple[float, ...] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        count = len(self.positions)
        _check_points(count)
        _check_numbers(self.fraction_bits, self.master_counts_per_cycle, self.slave_counts_per_cycle)
        for i, position in enumerate(self.positions):
            if not _I32_MINIMUM <= position <= _I32_MAXIMUM:
                raise CamImageError(CamImageFault.VALUE_OUT_OF_RANGE, f"slave position {i} is {position} units")
        unit = 2.0**-self.fraction_bits
        middle = [position * unit for position in self.positions]
        gain = float(self.slave_counts_per_cycle)
        # One neighbour before and two after spare the lookup every wrap-around.
        around = (middle[-1] - gain, *middle, middle[0] + gain, middle[1] + gain)
        object.__setattr__(self, "_counts", around)

    @property
    def points(self) -> int:
        """How many points the table has; a power of two."""
        return len(self.positions)

    def slave_position(self, master_counts: int) -> float:
        """The slave's position in counts for a master position of any size and sign, in constant time.

        Cubic between the points (Catmull-Rom: velocity is continuous), periodic but for the slave's gain in a cycle.
        """
        cycle, phase = divmod(master_counts, self.master_counts_per_cycle)
        at = phase * len(self.positions) / self.master_counts_per_cycle
        i = int(at)
        u = at - i
        counts = self._counts
        before = counts[i]
        here = counts[i + 1]
        after = counts[i + 2]
        beyond = counts[i + 3]
        return (
            cycle * self.slave_counts_per_cycle
            + here
            + 0.5
            * u
            * (
                after
                - before
                + u * (2.0 * before - 5.0 * here + 4.0 * after - beyond + u * (3.0 * (here - after) + beyond - before))
            )
        )


def _check_points(points: int) -> None:
    if points < MINIMUM_POINTS:
        raise CamImageError(CamImageFault.TOO_FEW_POINTS, f"{points} points, bound at least {MINIMUM_POINTS}")
    if points & (points - 1):
        raise CamImageError(CamImageFault.NOT_A_POWER_OF_TWO, f"{points} points are not a power of two")
    if points > MAXIMUM_POINTS:
        raise CamImageError(CamImageFault.VALUE_OUT_OF_RANGE, f"{points} points, bound at most {MAXIMUM_POINTS}")


def _check_numbers(fraction_bits: int, master_counts: int, slave_counts: int) -> None:
    if not 0 <= fraction_bits <= MAXIMUM_FRACTION_BITS:
        why = f"{fraction_bits} fraction bits, bound 0 to {MAXIMUM_FRACTION_BITS}"
        raise CamImageError(CamImageFault.VALUE_OUT_OF_RANGE, why)
    if not 0 < master_counts <= _I32_MAXIMUM:
        why = f"{master_counts} master counts a cycle, bound 1 to {_I32_MAXIMUM}"
        raise CamImageError(CamImageFault.VALUE_OUT_OF_RANGE, why)
    if not _I32_MINIMUM <= slave_counts <= _I32_MAXIMUM:
        raise CamImageError(CamImageFault.VALUE_OUT_OF_RANGE, f"{slave_counts} slave counts gained in a cycle")


def make_cam_image(
    profile: CamProfile,
    points: int = 1024,
    master_counts_per_revolution: int = 4096,
    slave_counts_per_revolution: int = 4096,
    slave_zero_rad: float = 0.0,
    fraction_bits: int = DEFAULT_FRACTION_BITS,
) -> CamImage:
    """The table of a profile: master position 0 is theta2 = 0, slave position 0 is theta5 = slave_zero_rad.

    Raises CamImageError (too few points, not a power of two, value out of range).
    """
    _check_points(points)
    gain = profile.net_turns * slave_counts_per_revolution
    _check_numbers(fraction_bits, master_counts_per_revolution, gain)
    theta5 = profile.at_many(np.arange(points) * (tau / points))[:, 0]
    scale = slave_counts_per_revolution * 2.0**fraction_bits / tau
    positions = tuple(round(value) for value in ((theta5 - slave_zero_rad) * scale).tolist())
    return CamImage(fraction_bits, master_counts_per_revolution, gain, positions)


def encode(image: CamImage) -> bytes:
    """The bytes of an image."""
    head = _HEADER.pack(
        MAGIC,
        VERSION,
        image.fraction_bits,
        image.points,
        image.master_counts_per_cycle,
        image.slave_counts_per_cycle,
    )
    body = head + struct.pack(f"<{image.points}i", *image.positions)
    return body + _CRC.pack(crc32(body))


def encode_cam_image(
    profile: CamProfile,
    points: int = 1024,
    master_counts_per_revolution: int = 4096,
    slave_counts_per_revolution: int = 4096,
    slave_zero_rad: float = 0.0,
    fraction_bits: int = DEFAULT_FRACTION_BITS,
) -> bytes:
    """The bytes of `make_cam_image`: 24 + 4 a point. Raises CamImageError."""
    return encode(
        make_cam_image(
            profile,
            points,
            master_counts_per_revolution,
            slave_counts_per_revolution,
            slave_zero_rad,
            fraction_bits,
        )
    )


def decode_cam_image(data: bytes) -> CamImage:
    """Read and check an image. Raises CamImageError with its ``reason``; no value is read before the CRC is right."""
    if data[: len(MAGIC)] != MAGIC:
        raise CamImageError(CamImageFault.BAD_MAGIC, f"it starts with {data[:4].hex(' ') or 'nothing'}, not with CAM1")
    if len(data) < _HEADER.size + _CRC.size:
        why = f"{len(data)} bytes, bound at least {_HEADER.size + _CRC.size}"
        raise CamImageError(CamImageFault.WRONG_LENGTH, why)
    _, version, fraction_bits, points, master_counts, slave_counts = _HEADER.unpack_from(data)
    if version != VERSION:
        raise CamImageError(CamImageFault.BAD_VERSION, f"version {version}, only {VERSION} is known")
    _check_points(points)
    expected = _HEADER.size + 4 * points + _CRC.size
    if len(data) != expected:
        raise CamImageError(CamImageFault.WRONG_LENGTH, f"{len(data)} bytes, but {points} points take {expected}")
    computed = crc32(memoryview(data)[: -_CRC.size])
    (stored,) = _CRC.unpack_from(data, len(data) - _CRC.size)
    if computed != stored:
        raise CamImageError(CamImageFault.WRONG_CRC, f"CRC-32 is {computed:08X}h, the image says {stored:08X}h")
    positions = struct.unpack_from(f"<{points}i", data, _HEADER.size)
    return CamImage(fraction_bits, master_counts, slave_counts, positions)
