"""Light between two images: closed forms of moving smooth patterns, edges in front of a background, and agreement."""

import numpy as np
import numpy.typing as npt
import pytest

from emulator.scene.external.joining import Joined, TimedImage, front_motion

_SIZE = (48, 40)
_T_NS = 10_000_000
_Floats = npt.NDArray[np.float32]


def _places():
    rows, columns = np.mgrid[: _SIZE[1], : _SIZE[0]]
    return rows + 0.5, columns + 0.5


def _blob(row, column, sigma_px=4.0):
    rows, columns = _places()
    squared = (rows - row) ** 2 + (columns - column) ** 2
    return np.asarray(1 + np.exp(-squared / (2 * sigma_px**2)), np.float32)


def _flow(x_px_s, y_px_s):
    return np.tile(np.array([x_px_s, y_px_s], np.float32), (_SIZE[1], _SIZE[0], 1))


def _written(pair, t_ns, threads=1):
    joined = Joined(_SIZE, threads=threads)
    light, rate = np.zeros(_SIZE[::-1], np.float32), np.zeros(_SIZE[::-1], np.float32)
    joined.write(pair, t_ns, light, rate)
    joined.close()
    return light, rate


def test_images_alone_are_joined_by_a_line():
    a, b = np.full(_SIZE[::-1], 1, np.float32), np.full(_SIZE[::-1], 3, np.float32)
    light, rate = _written((TimedImage(0, a), TimedImage(_T_NS, b)), _T_NS // 4)
    np.testing.assert_allclose(light, 1.5, rtol=1e-6)
    np.testing.assert_allclose(rate, 200, rtol=1e-6)


def test_rates_give_the_cubic_of_hermite():
    """A cubic in time is its own interpolant."""
    ones = np.ones(_SIZE[::-1], np.float32)

    def cubic(s):
        return 5 + 2 * s - 3 * s**2 + 1.5 * s**3, (2 - 6 * s + 4.5 * s**2) / (_T_NS * 1e-9)

    images = [TimedImage(k * _T_NS, ones * cubic(k)[0], rate=ones * cubic(k)[1]) for k in (0, 1)]
    light, rate = _written((images[0], images[1]), int(0.3 * _T_NS))
    np.testing.assert_allclose(light, cubic(0.3)[0], rtol=1e-5)
    np.testing.assert_allclose(rate, cubic(0.3)[1], rtol=1e-4)


@pytest.mark.parametrize("share", [0.0, 0.2, 0.5, 0.9, 1.0])
def test_motion_moves_a_smooth_pattern(share):
    """A blob moves 6.7 px from one image to the next, and keeps its form.

    Only its top may be cut, to the brightest of the four pixels around it: at most 0.7 px away, 0.5 / (2 * 16) lower.
    """
    flow = _flow(600.0, -300.0)
    pair = TimedImage(0, _blob(22, 20), flow), TimedImage(_T_NS, _blob(19, 26), flow)
    light, rate = _written(pair, round(share * _T_NS))
    truth = _blob(22 - 3 * share, 20 + 6 * share)
    np.testing.assert_allclose(light, truth, atol=0.016)
    assert np.abs(light - truth).mean() < 2e-4
    rows, columns = _places()
    slope = (truth - 1) * (600 * (columns - 20 - 6 * share) - 300 * (rows - 22 + 3 * share)) / 16
    np.testing.assert_allclose(rate, slope, atol=0.04 * np.abs(slope).max())


def _covered(angle, place_px):
    """Return the share of each pixel that is on the bright side of a straight edge, by 32 x 32 points each."""
    points = (np.arange(32) + 0.5) / 32
    rows = (np.arange(_SIZE[1])[:, None] + points).reshape(-1, 1)
    columns = (np.arange(_SIZE[0])[:, None] + points).reshape(-1)
    inside = np.cos(angle) * (columns - 24) + np.sin(angle) * (rows - 20) < place_px
    return inside.reshape(_SIZE[1], 32, _SIZE[0], 32).mean((1, 3)).astype(np.float32)


@pytest.mark.parametrize("angle_deg", [0, 20, 45, 110, 200, 271])
def test_an_edge_before_black_arrives_in_each_pixel_at_its_own_time(angle_deg):
    """A straight edge moves 1.3 px between two images: light is its share of each pixel, and black stays black."""
    angle = np.radians(angle_deg)
    flow = _flow(130 * np.cos(angle), 130 * np.sin(angle))
    pair = TimedImage(0, _covered(angle, 0.2), flow), TimedImage(_T_NS, _covered(angle, 1.5), flow)
    middle = np.s_[6:-6, 6:-6]  # the edge of the image has no pixels beyond it
    for share in (0.1, 0.37, 0.8):
        light, rate = _written(pair, round(share * _T_NS))
        truth = _covered(angle, 0.2 + 1.3 * share)
        light, rate, truth = light[middle], rate[middle], truth[middle]
        np.testing.assert_allclose(light, truth, atol=1 / 32)
        assert light[truth == 0].max() < 0.01
        earlier, later = (_written(pair, round(share * _T_NS) + by_ns)[0] for by_ns in (-20_000, 20_000))
        difference = (later.astype(np.float64) - earlier)[middle] / 40e-6
        agree = np.abs(difference - rate)[truth < 0.9] < 5  # of 130 or more; beyond, the cubic is held
        assert agree.mean() > 0.995  # not where the edge passes a corner of a pixel within the 40 us


def test_a_point_that_accelerates_is_followed():
    """From 500 to 800 px/s it moves 6.5 px, and half way in time 2.875 px, not 3.25."""
    pair = TimedImage(0, _blob(20, 20), _flow(500, 0)), TimedImage(_T_NS, _blob(20, 26.5), _flow(800, 0))
    light, _ = _written(pair, _T_NS // 2)
    np.testing.assert_allclose(light, _blob(20, 22.875), atol=0.016)


def _disc(column, v_px_s, t_ns, *, with_depth):
    """Return a disc of light 5 and radius 8 px in front of a background of stripes that stands still."""
    rows, columns = _places()
    cover = np.clip(8.5 - np.hypot(rows - 20, columns - column), 0, 1)
    light = cover * 5 + (1 - cover) * (1 + 0.5 * np.sin(columns))
    inside = cover >= 0.5
    motion = np.where(inside[..., None], np.array([v_px_s, 0.0]), 0.0)
    depth = np.where(inside, 10.0, 100.0).astype(np.float32) if with_depth else None
    motion = motion.astype(np.float32)
    return TimedImage(t_ns, light.astype(np.float32), front_motion(motion, depth), depth)


@pytest.mark.parametrize("with_depth", [True, False])
def test_an_object_hides_and_uncovers_what_is_behind_it(with_depth):
    images = [_disc(18 + 10 * k, 1000.0, k * _T_NS, with_depth=with_depth) for k in (0, 1)]
    truth = _disc(23, 1000.0, 0, with_depth=False).light
    light, _ = _written((images[0], images[1]), _T_NS // 2)
    line, _ = _written((TimedImage(0, images[0].light), TimedImage(_T_NS, images[1].light)), _T_NS // 2)
    wrong, without = np.abs(light - truth), np.abs(line - truth)
    assert np.count_nonzero(without > 0.5) > 60
    rows, columns = _places()
    at_edge = np.abs(np.hypot(rows - 20, columns - 23) - 8) < 2.6  # pixels that have light of both surfaces
    assert np.count_nonzero(without[~at_edge] > 0.5) > 30
    np.testing.assert_allclose(light[~at_edge], truth[~at_edge], atol=0.05)
    assert wrong.mean() < 0.25 * without.mean()


def test_the_derivative_is_that_of_the_light():
    images = [_disc(20 + 5 * k, 500.0, k * _T_NS, with_depth=True) for k in (0, 1)]
    pair = images[0], images[1]
    light, rate = _written(pair, 3_000_000)
    later, _ = _written(pair, 3_010_000)
    difference = (later.astype(np.float64) - light) / 1e-5
    agree = np.abs(difference - rate) < 0.05 * np.abs(rate).max()
    assert agree.mean() > 0.97  # not where a surface appears within the 10 us


def test_threads_give_the_same_light():
    images = [_disc(20 + 5 * k, 500.0, k * _T_NS, with_depth=True) for k in (0, 1)]
    pair, t_ns = (images[0], images[1]), 3_333_333
    light, rate = _written(pair, t_ns)
    again = _written(pair, t_ns, threads=3)
    np.testing.assert_array_equal(light, again[0])
    np.testing.assert_array_equal(rate, again[1])


def test_motion_out_of_every_bound_stays_within_the_image():
    light = np.random.default_rng(1).random(_SIZE[::-1], np.float32)
    wild = np.random.default_rng(2).choice([-1e9, 1e9, 3e8, 0.0], (*_SIZE[::-1], 2)).astype(np.float32)
    out, _ = _written((TimedImage(0, light, wild), TimedImage(_T_NS, light, -wild)), _T_NS // 3)
    assert (out >= light.min()).all()
    assert (out <= light.max()).all()
