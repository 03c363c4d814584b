"""The pinhole's geometry against plain trigonometry."""

import math

import pytest

from emulator.geometry.camera import Pinhole


def test_the_field_of_view_gives_the_focal_length():
    camera = Pinhole.of_field((346, 260), 21.0)
    assert camera.focal_px == pytest.approx(173 / math.tan(math.radians(10.5)))
    assert camera.zoom == pytest.approx((camera.focal_px / 173, camera.focal_px / 130))


def test_the_widest_ray_goes_to_a_corner():
    assert Pinhole(600, 800, 500.0).widest_rad == pytest.approx(math.pi / 4)
