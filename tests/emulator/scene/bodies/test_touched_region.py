"""The part of a light frame that bodies can touch."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from emulator.geometry.camera import Pinhole
from emulator.light import Region
from emulator.scene.bodies.gl_bodies import touched_region

CAMERA = Pinhole.of_field((64, 48), 60.0)
CUBE = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
number = st.floats(-30, 30)


def test_a_cube_before_the_camera_is_seen_as_wide_as_its_front():
    half_px = CAMERA.focal_px / 9
    top, left, side = int(24 - half_px) - 1, int(32 - half_px) - 1, 2 * int(half_px) + 4
    assert touched_region(CUBE + [0, 0, 10], CAMERA) == Region(top, top + side, left, left + side)


def test_what_is_behind_the_camera_is_not_seen_and_what_is_around_it_may_be_anywhere():
    assert touched_region(np.zeros((0, 3)), CAMERA) == touched_region(CUBE - [0, 0, 10], CAMERA) == Region(0, 1, 0, 1)
    assert touched_region(CUBE + [5, 0, 0.5], CAMERA) == Region(0, 48, 0, 64)


@given(st.lists(st.tuples(number, number, st.floats(-5, 30)), min_size=1, max_size=4), st.integers(0, 2**32 - 1))
def test_every_point_that_is_seen_lies_within(places, seed):
    seen = touched_region(np.concatenate([CUBE + place for place in places]), CAMERA)
    assert 0 <= seen.first_column < seen.last_column <= 64
    assert 0 <= seen.first_row < seen.last_row <= 48
    points = np.concatenate([np.random.default_rng(seed).uniform(-1, 1, (100, 3)) + place for place in places])
    points = points[points[:, 2] > 1e-3]
    pixels = np.floor(CAMERA.focal_px * points[:, :2] / points[:, 2:] + [32, 24])
    inside = pixels[((pixels >= 0) & (pixels < [64, 48])).all(axis=1)]
    first, last = [seen.first_column, seen.first_row], [seen.last_column, seen.last_row]
    assert np.all((inside >= first) & (inside < last))
