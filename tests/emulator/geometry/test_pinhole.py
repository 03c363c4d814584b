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


@pytest.mark.parametrize(("size", "focal"), [((0, 5), 1.0), ((5, 5), 0.0), ((5, 5), math.inf), ((5, 5), math.nan)])
def test_nonsense_is_refused(size, focal):
    with pytest.raises(ValueError, match=r"must be|at least"):
        Pinhole(*size, focal)


@pytest.mark.parametrize("field", [0.0, 180.0, -1.0, math.nan])
def test_a_field_of_view_has_bounds(field):
    with pytest.raises(ValueError, match="between 0 and 180"):
        Pinhole.of_field((5, 5), field)
