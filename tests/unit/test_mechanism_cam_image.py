"""The drive's cam image against bytes written out by hand."""

from math import tau
from struct import pack
from zlib import crc32

import numpy as np
import pytest

from mechanism.cam_image import CamImage, decode_cam_image, encode, encode_cam_image, make_cam_image
from mechanism.cam_profile import CamProfile
from mechanism.errors import CamFileError, CamImageError, CamImageFault

POSITIONS = (0, 1, -1, 256, -256, 2**31 - 1, -(2**31), 7)
HEAD = bytes.fromhex("43414d31 0100 0800 08000000 00100000 00f0ffff")
BODY = bytes.fromhex("00000000 01000000 ffffffff 00010000 00ffffff ffffff7f 00000080 07000000")


def sealed(body: bytes) -> bytes:
    return body + pack("<I", crc32(body))


def test_bytes_written_out_by_hand() -> None:
    image = CamImage(8, 4096, -4096, POSITIONS)
    assert encode(image) == sealed(HEAD + BODY)
    assert decode_cam_image(sealed(HEAD + BODY)) == image


def test_crc_is_that_of_the_standard_check_word() -> None:
    # The catalogue's check value of CRC-32 (ISO-HDLC) over "123456789".
    assert crc32(b"123456789") == 0xCBF43926


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", CamImageFault.BAD_MAGIC),
        (b"CAM2" + sealed(HEAD + BODY)[4:], CamImageFault.BAD_MAGIC),
        (HEAD, CamImageFault.WRONG_LENGTH),
        (sealed(b"CAM1\x02\x00" + HEAD[6:] + BODY), CamImageFault.BAD_VERSION),
        (sealed(HEAD[:8] + pack("<I", 4) + HEAD[12:] + BODY[:16]), CamImageFault.TOO_FEW_POINTS),
        (sealed(HEAD[:8] + pack("<I", 0) + HEAD[12:]), CamImageFault.TOO_FEW_POINTS),
        (sealed(HEAD[:8] + pack("<I", 12) + HEAD[12:] + BODY + BODY[:16]), CamImageFault.NOT_A_POWER_OF_TWO),
        (sealed(HEAD[:8] + pack("<I", 2**31) + HEAD[12:] + BODY), CamImageFault.VALUE_OUT_OF_RANGE),
        (sealed(HEAD + BODY)[:-1], CamImageFault.WRONG_LENGTH),
        (sealed(HEAD + BODY) + b"\x00", CamImageFault.WRONG_LENGTH),
        (HEAD + BODY + b"\x00\x00\x00\x00", CamImageFault.WRONG_CRC),
        (sealed(HEAD[:6] + pack("<H", 17) + HEAD[8:] + BODY), CamImageFault.VALUE_OUT_OF_RANGE),
        (sealed(HEAD[:12] + pack("<i", 0) + HEAD[16:] + BODY), CamImageFault.VALUE_OUT_OF_RANGE),
        (sealed(HEAD[:12] + pack("<i", -4096) + HEAD[16:] + BODY), CamImageFault.VALUE_OUT_OF_RANGE),
    ],
)
def test_reasons(data: bytes, reason: CamImageFault) -> None:
    with pytest.raises(CamImageError, match=r"^cam image: ") as caught:
        decode_cam_image(data)
    assert caught.value.reason is reason
    assert isinstance(caught.value, CamFileError)


def test_points_are_hit_and_straight_lines_are_straight() -> None:
    # 16 units (one count of 4 fraction bits) a point, 8 points, 80 master counts: slave = master / 10.
    image = CamImage(4, 80, 8, tuple(16 * i for i in range(8)))
    for master in (0, 10, 15, 79, 80, 81, -1, -80, 8_000_003):
        assert image.slave_position(master) == pytest.approx(master / 10, abs=1e-9)


def test_a_cubic_between_the_points_worked_by_hand() -> None:
    # Catmull-Rom half way: (-before + 9 here + 9 after - beyond) / 16, here (-0 + 0 + 9 x 16 - 32) / 16 = 7.
    image = CamImage(0, 16, 0, (0, 0, 16, 32, 0, 0, 0, 0))
    assert image.slave_position(3) == 7.0
    # The last piece looks over the wrap-around at the points 0 and 1.
    wrapped = CamImage(0, 16, 0, (16, 32, 0, 0, 0, 0, 0, 0))
    assert wrapped.slave_position(15) == 7.0


def test_the_table_follows_the_profile() -> None:
    theta2 = np.arange(128) * (tau / 128)
    profile = CamProfile.through(theta2, 0.8 * np.sin(theta2) - theta2, -1)
    image = make_cam_image(profile, 1024, 4096, 2000, slave_zero_rad=0.25)
    assert image.slave_counts_per_cycle == -2000
    for master in range(-9000, 9000, 37):
        wanted = (profile.at(master * tau / 4096)[0] - 0.25) * 2000 / tau
        assert image.slave_position(master) == pytest.approx(wanted, abs=2.0**-8)


def test_encoding_is_decoded_again() -> None:
    theta2 = np.arange(64) * (tau / 64)
    profile = CamProfile.through(theta2, np.cos(theta2))
    data = encode_cam_image(profile, 256, fraction_bits=4)
    assert len(data) == 24 + 4 * 256
    assert decode_cam_image(data) == make_cam_image(profile, 256, fraction_bits=4)


def test_what_does_not_fit_is_not_encoded() -> None:
    theta2 = np.arange(64) * (tau / 64)
    profile = CamProfile.through(theta2, np.cos(theta2))
    for arguments, reason in (
        ({"points": 4}, CamImageFault.TOO_FEW_POINTS),
        ({"points": 1000}, CamImageFault.NOT_A_POWER_OF_TWO),
        ({"fraction_bits": 17}, CamImageFault.VALUE_OUT_OF_RANGE),
        ({"master_counts_per_revolution": 0}, CamImageFault.VALUE_OUT_OF_RANGE),
        ({"slave_counts_per_revolution": 2**28}, CamImageFault.VALUE_OUT_OF_RANGE),
    ):
        with pytest.raises(CamImageError) as caught:
            encode_cam_image(profile, **arguments)
        assert caught.value.reason is reason
