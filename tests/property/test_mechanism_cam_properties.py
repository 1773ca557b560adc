"""Cam profiles, images and plans over random data."""

from math import comb, tau

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mechanism.cam_image import CamImage, decode_cam_image, encode
from mechanism.cam_profile import CamProfile
from mechanism.errors import CamImageError

bits = st.integers(0, 16)
i32 = st.integers(-(2**31), 2**31 - 1)
images = st.sampled_from((8, 16, 64)).flatmap(
    lambda points: st.builds(
        CamImage,
        bits,
        st.integers(1, 2**31 - 1),
        i32,
        st.lists(i32, min_size=points, max_size=points).map(tuple),
    )
)


@settings(deadline=None, derandomize=True)
@given(images)
def test_every_image_comes_back(image: CamImage) -> None:
    assert decode_cam_image(encode(image)) == image


@settings(deadline=None, derandomize=True, max_examples=20)
@given(images)
def test_any_single_bit_flip_is_refused(image: CamImage) -> None:
    data = encode(image)
    for at in range(len(data) * 8):
        flipped = bytearray(data)
        flipped[at // 8] ^= 1 << (at % 8)
        with pytest.raises(CamImageError):
            decode_cam_image(bytes(flipped))


@settings(deadline=None, derandomize=True)
@given(images, st.integers(0, 400))
def test_any_other_length_is_refused(image: CamImage, length: int) -> None:
    data = encode(image)
    if length != len(data):
        with pytest.raises(CamImageError):
            decode_cam_image((data * 2)[:length])


@settings(deadline=None, derandomize=True)
@given(st.binary(max_size=200))
def test_random_bytes_never_raise_anything_else(data: bytes) -> None:
    for start in (b"", b"CAM1", b"CAM1\x01\x00"):
        with pytest.raises(CamImageError):
            decode_cam_image(start + data)


@settings(deadline=None, derandomize=True)
@given(images, st.integers(-(2**40), 2**40))
def test_an_image_repeats_but_for_its_gain(image: CamImage, master: int) -> None:
    here = image.slave_position(master)
    next_cycle = image.slave_position(master + image.master_counts_per_cycle)
    assert next_cycle - here == pytest.approx(image.slave_counts_per_cycle, abs=1e-6 * (1.0 + abs(here)))


points = st.integers(5, 60).flatmap(
    lambda count: st.tuples(
        st.lists(st.floats(0.2, 1.0), min_size=count, max_size=count),
        st.lists(st.floats(-3.0, 3.0), min_size=count, max_size=count),
        st.integers(-2, 2),
        st.floats(-5.0, 5.0),
    )
)


@settings(deadline=None, derandomize=True)
@given(points, st.floats(-100.0, 100.0))
def test_a_profile_is_periodic_and_four_times_continuous(
    data: tuple[list[float], list[float], int, float], theta2: float
) -> None:
    widths, values, net_turns, start = data
    steps = np.array(widths) * (tau / sum(widths))
    angles = start + np.cumsum(steps) - steps[0]
    profile = CamProfile.through(angles, np.array(values) + net_turns * (angles - start), net_turns, knots=256)
    size = 1.0 + float(np.abs(profile.coefficients).max())

    here, further = profile.at(theta2), profile.at(theta2 + 3 * tau)
    assert further[0] - here[0] == pytest.approx(3 * tau * net_turns, abs=1e-9 * size)
    assert further[1:] == pytest.approx(here[1:], rel=1e-6, abs=1e-6 * size)

    # At every knot the pieces on both sides agree in the value and four derivatives.
    c = profile.coefficients
    following = np.roll(c, -1, axis=0).copy()
    following[-1, 0] += tau * net_turns
    binomial = np.array([[comb(power, order) for power in range(6)] for order in range(5)])
    assert np.abs(c @ binomial.T - following[:, :5]).max() < 1e-10 * size


@settings(deadline=None, derandomize=True)
@given(points)
def test_derivatives_are_those_of_the_function(data: tuple[list[float], list[float], int, float]) -> None:
    widths, values, net_turns, start = data
    steps = np.array(widths) * (tau / sum(widths))
    angles = start + np.cumsum(steps) - steps[0]
    profile = CamProfile.through(angles, np.array(values) + net_turns * (angles - start), net_turns, knots=256)
    h = 1e-5
    theta2 = np.linspace(-7.0, 7.0, 50)
    above, below, middle = profile.at_many(theta2 + h), profile.at_many(theta2 - h), profile.at_many(theta2)
    for order in range(3):
        size = 1.0 + float(np.abs(profile.at_many(np.linspace(0, tau, 2048))).max())
        assert (above[:, order] - below[:, order]) / (2 * h) == pytest.approx(middle[:, order + 1], abs=1e-5 * size)
