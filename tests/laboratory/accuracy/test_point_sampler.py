"""Point samples against closed forms."""

import numpy as np
import pytest

from laboratory.accuracy.sampled_scenes import PointSampler, clipped

SIZE = (8, 6)


def rectangle(left, top, right, bottom, depth, focal=10.0):
    """Return two facets that cover a rectangle of the picture, px from its middle, at `depth`."""
    a, b, c, d = (
        np.array([x, y, focal]) * depth / focal for x, y in ((left, top), (right, top), (right, bottom), (left, bottom))
    )
    return np.array([[a, b, c], [a, c, d]])


def test_a_rectangle_covers_the_share_of_pixels_that_it_covers():
    light = PointSampler(SIZE, 10.0, 64).draw([(rectangle(-0.5, -0.75, 2.25, 1.0, 3.0), np.full((2, 3), 2.0))])
    assert light.sum() == pytest.approx(2.0 * 2.75 * 1.75, rel=0.01)
    assert light[3, 4] == 2.0
    assert light[3, 3] == pytest.approx(1.0)
    assert light[0, 0] == 0.0


def test_the_nearer_surface_is_seen_whichever_comes_first():
    near, far = rectangle(-2, -2, 2, 2, 1.0), rectangle(-3, -3, 3, 3, 5.0)
    for order in ([near, far], [far, near]):
        lights = [np.full((2, 3), 7.0 if part is near else 1.0) for part in order]
        for parts in (list(zip(order, lights, strict=True)), [(np.concatenate(order), np.concatenate(lights))]):
            picture = PointSampler(SIZE, 10.0, 4).draw(parts)
            assert picture[3, 4] == 7.0
            assert picture[0, 4] == 1.0


def test_light_is_linear_in_space_and_not_on_the_picture():
    a, b = np.array([-2.0, 0.0, 2.0]), np.array([4.0, 0.0, 10.0])  # at -10 px and 4 px of the middle
    up = np.array([0.0, -50.0, 0.0])
    corners = np.array([[a + up, b + up, b - up], [a + up, b - up, a - up]])
    picture = PointSampler(SIZE, 10.0, 16).draw([(corners, np.array([[0.0, 1.0, 1.0], [0.0, 1.0, 0.0]]))])
    x_px = np.arange(8 * 100).reshape(8, 100) / 100 + 0.005 - 4
    share = (10 * a[0] - x_px * a[2]) / (x_px * (b[2] - a[2]) - 10 * (b[0] - a[0]))  # where the ray of x meets the line
    assert picture[3] == pytest.approx(share.mean(axis=1), abs=2e-3)


def test_a_facet_across_the_camera_plane_is_cut():
    facet = np.array([[[-1.0, -0.2, 2.0], [1.0, -0.2, 2.0], [0.0, -0.2, -2.0]]])
    corners, light = clipped(facet, np.array([[1.0, 1.0, 3.0]]), 0.5)
    assert (corners[:, :, 2] >= 0.5 - 1e-12).all()
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2
    assert area == pytest.approx(4.0 * (1 - (2.5 / 4) ** 2))
    assert light.max() == pytest.approx(1.0 + 2.0 * 1.5 / 4)
    assert PointSampler(SIZE, 10.0, 4).draw([(facet, np.ones((1, 3)))]).any()
