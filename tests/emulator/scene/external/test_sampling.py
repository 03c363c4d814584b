"""Light between pixels: exact at pixels, straight edges in closed form, bounds, and derivatives."""

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from emulator.scene.external.joining import sampled

_Floats = npt.NDArray[np.float32]
_IMAGES = arrays(np.float32, (6, 7), elements=st.sampled_from([0.0, 0.01, 0.3, 0.7, 1.0, 1.2]))
_SHARES = st.floats(0.02, 0.98)


@given(_IMAGES, st.integers(0, 5), st.integers(0, 6))
def test_light_at_a_pixel_is_that_of_the_pixel(image, row, column):
    assert sampled(image, float(row), float(column))[0] == pytest.approx(float(image[row, column]), abs=1e-4)


@given(_IMAGES, st.integers(0, 4), st.integers(0, 5), _SHARES, _SHARES)
def test_light_stays_within_that_of_the_pixels_around(image, row, column, y, x):
    value = sampled(image, row + y, column + x)[0]
    around = image[max(row - 1, 0) : row + 3, max(column - 1, 0) : column + 3]
    assert around.min() - 1e-6 <= value <= around.max() + 1e-6


@given(st.floats(0.05, 0.95), st.floats(-1.0, 1.0))
def test_an_upright_edge_before_black_is_sharp(place, shift):
    """Light is the share of the pixel around the place that is beyond the edge; the cubic has 0.06 of it as well."""
    image = np.zeros((7, 12), np.float32)
    image[:, 6:] = 1.0
    image[:, 5] = 1.0 - place
    assert sampled(image, 3.0, 5.0 + shift)[0] == pytest.approx(min(max(1.0 - place + shift, 0.0), 1.0), abs=1e-3)


@given(st.floats(-0.4, 0.4), st.floats(2.1, 2.9), st.floats(5.1, 5.9))
def test_derivatives_of_a_slanted_edge_are_those_of_its_light(place, y, x):
    points = (np.arange(32) + 0.5) / 32
    columns, rows = (np.arange(12)[:, None] + points).reshape(-1), (np.arange(6)[:, None] + points).reshape(-1, 1)
    inside = columns + 0.4 * rows > 7.0 + place
    image = inside.reshape(6, 32, 12, 32).mean((1, 3)).astype(np.float32)
    step = 1e-6
    _, down, across = sampled(image, y, x)
    differences = [
        (sampled(image, y + v, x + u)[0] - sampled(image, y - v, x - u)[0]) / (2 * step)
        for v, u in ((step, 0.0), (0.0, step))
    ]
    if not 1e-3 < sampled(image, y, x)[0] < 0.999:  # held to the brightest or darkest pixel
        return
    assert [down, across] == pytest.approx(differences, abs=0.02)


def test_an_edge_between_two_lit_surfaces_is_the_cubic():
    image = np.full((7, 12), 0.5, np.float32)
    image[:, 6:] = 1.0
    assert sampled(image, 3.0, 5.5)[0] == pytest.approx(0.75)
    assert sampled(image, 3.0, 5.25)[0] == pytest.approx(0.5 + 0.5 * 0.203125)


@pytest.mark.parametrize("shape", [(1, 1), (1, 5), (5, 1), (2, 2)])
def test_small_images_have_light_everywhere(shape):
    image = np.zeros(shape, np.float32)
    image[0, 0] = 1.0
    for y, x in ((0.0, 0.0), (0.5, 0.5), (9.0, -3.0), (-7.0, 4.0)):
        assert 0.0 <= sampled(image, y, x)[0] <= 1.0
