"""Light and rate of scenes whose pixels have closed forms."""

import numpy as np
import pytest

from emulator.raster.layout import Screen, View
from emulator.raster.lines import LINES
from emulator.raster.renderer import Renderer
from emulator.raster.topology import join, prepare

SCREEN = Screen(24, 18, 100.0, (12.0, 9.0))


def at_depth(pixels, velocities, depth_m):
    """Return positions and velocities of screen places (n, 2), px and px/s, at one depth."""
    pixels, velocities = np.asarray(pixels, float), np.asarray(velocities, float)
    scale = depth_m / SCREEN.focal_px
    positions = np.column_stack([(pixels - SCREEN.centre_px) * scale, np.full(len(pixels), depth_m)])
    return positions, np.column_stack([velocities * scale, np.zeros(len(pixels))])


def quad(x, y, wide, high, velocity, depth_m, radiance):
    corners = [(x, y), (x, y + high), (x + wide, y + high), (x + wide, y)]
    positions, velocities = at_depth(corners, [velocity] * 4, depth_m)
    return prepare([[0, 1, 2], [0, 2, 3]]), View(positions, velocities, np.full(4, radiance), np.zeros(4))


def stack(*parts):
    topologies, views = zip(*parts, strict=True)
    fields = ("positions_m", "velocities_m_s", "radiance", "radiance_rate")
    return join(topologies), View(*(np.concatenate([getattr(v, f) for v in views]) for f in fields))


def covered(low, high, n):
    """Return the share of each of n unit intervals that [low, high] covers."""
    k = np.arange(n)
    return np.clip(np.minimum(high, k + 1) - np.maximum(low, k), 0, 1)


def covered_rate(low, high, speed, n):
    """Return its rate when both ends move at `speed`."""
    k = np.arange(n)
    return speed * (((high > k) & (high < k + 1)).astype(float) - ((low > k) & (low < k + 1)))


def test_the_area_of_a_moving_triangle_and_its_rate(picture):
    places = np.array([[2.3, 1.2], [5.1, 10.4], [17.2, 3.9]])
    speeds = np.array([[3.0, 1.0], [-2.0, 0.5], [1.0, -4.0]])
    positions, velocities = at_depth(places, speeds, 10.0)
    radiance, rates = np.array([1.0, 2.0, 3.0]), np.array([0.1, 0.2, -0.3])
    light, rate, _ = picture(Renderer(prepare([[0, 1, 2]]), SCREEN), View(positions, velocities, radiance, rates))

    def cross(a, b):
        return a[0] * b[1] - a[1] * b[0]

    e, f, de, df = places[1] - places[0], places[2] - places[0], speeds[1] - speeds[0], speeds[2] - speeds[0]
    area, growth = -cross(e, f) / 2, -(cross(de, f) + cross(e, df)) / 2
    assert light.sum() == pytest.approx(area * radiance.mean(), rel=1e-6)
    assert rate.sum() == pytest.approx(growth * radiance.mean() + area * rates.mean(), rel=1e-5)


@pytest.mark.parametrize(("front", "behind"), [(3.0, 1.0), (0.0, 1.0), (3.0, 0.0), (0.0, 0.0)])
def test_a_square_in_front_of_a_square(picture, front, behind):
    """Black squares hide what is behind them and add no light, as others do."""
    near, far, v_near, v_far = (4.3, 3.6, 7.5, 6.2), (6.1, 1.7, 12.4, 11.9), (2.0, -3.0), (-1.5, 0.5)
    topology, view = stack(quad(*near, v_near, 5.0, front), quad(*far, v_far, 50.0, behind))
    light, rate, _ = picture(Renderer(topology, SCREEN), view)

    def sides(box, velocity):
        x, y, wide, high = box
        return (
            covered(x, x + wide, 24),
            covered(y, y + high, 18),
            covered_rate(x, x + wide, velocity[0], 24),
            covered_rate(y, y + high, velocity[1], 18),
        )

    nx, ny, dnx, dny = sides(near, v_near)
    fx, fy, dfx, dfy = sides(far, v_far)
    left, right = max(near[0], far[0]), near[0] + near[2]  # what the near one hides of the far one
    both_x, both_y = covered(left, right, 24), covered(near[1], near[1] + near[3], 18)
    k = np.arange(24)
    d_both_x = v_near[0] * ((right > k) & (right < k + 1)) - v_far[0] * ((left > k) & (left < k + 1))
    d_both_y = dny
    truth = front * np.outer(ny, nx) + behind * (np.outer(fy, fx) - np.outer(both_y, both_x))
    d_both = np.outer(d_both_y, both_x) + np.outer(both_y, d_both_x)
    d_truth = front * (np.outer(dny, nx) + np.outer(ny, dnx)) + behind * (
        np.outer(dfy, fx) + np.outer(fy, dfx) - d_both
    )
    exact = np.isclose(light, truth, atol=2e-6)
    np.testing.assert_allclose(light, truth, atol=3 / (2 * LINES))  # half a line's share of the brightest
    assert exact[3, 6] == (front == behind == 0), "the test means to meet pixels with corners"
    assert (~exact).sum() <= 4  # only those with a corner of one before or behind the other
    np.testing.assert_allclose(rate[exact], d_truth[exact], atol=2e-5)


def test_a_square_that_fills_the_picture_is_even_and_still(picture):
    topology, view = stack(quad(-9, -7, 60, 50, (4.0, -3.0), 8.0, 2.5))
    light, rate, box = picture(Renderer(topology, SCREEN), view)
    np.testing.assert_allclose(light, 2.5, rtol=1e-6)
    np.testing.assert_allclose(rate, 0.0, atol=1e-6)
    assert (box.first_row, box.last_row, box.first_column, box.last_column) == (0, 18, 0, 24)


@pytest.mark.parametrize("shift", [(-5.3, 2.2), (19.7, 4.4), (5.2, -4.9), (8.1, 14.6), (-60.0, 1.0)])
def test_a_square_that_hangs_over_the_border(picture, shift):
    x, y = shift
    topology, view = stack(quad(x, y, 9.4, 7.7, (3.0, 2.0), 8.0, 1.0))
    light, rate, box = picture(Renderer(topology, SCREEN), view)
    nx, ny = covered(x, x + 9.4, 24), covered(y, y + 7.7, 18)
    np.testing.assert_allclose(light, np.outer(ny, nx), atol=1e-6)
    d_truth = np.outer(covered_rate(y, y + 7.7, 2.0, 18), nx) + np.outer(ny, covered_rate(x, x + 9.4, 3.0, 24))
    np.testing.assert_allclose(rate, d_truth, atol=1e-5)
    assert box.empty == (light.sum() == 0)


def cube(angle):
    """Return points of a cube of 2 m that has turned by `angle` about a skew axis, and their speeds at 1 rad/s."""
    from scipy.spatial.transform import Rotation

    axis = np.array([0.36, 0.48, 0.8])
    corners = np.array([[x, y, z] for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)], float)
    points = Rotation.from_rotvec(axis * angle).apply(corners)
    return points + [0, 0, 20.0], np.cross(axis, points)


CUBE = [
    [0, 2, 3], [0, 3, 1], [4, 5, 7], [4, 7, 6], [0, 1, 5], [0, 5, 4],
    [2, 6, 7], [2, 7, 3], [0, 4, 6], [0, 6, 2], [1, 3, 7], [1, 7, 5],
]  # fmt: skip
SHADES = np.repeat(np.arange(6), 2)[:, None].repeat(3, axis=1)


@pytest.mark.sampled
@pytest.mark.system
@pytest.mark.parametrize("angle", [0.3, 0.9, 2.2])
def test_a_turning_cube_with_faces_of_different_light(picture, sample, angle):
    radiance = np.array([1.0, 2.0, 0.5, 1.5, 0.7, 1.2])
    renderer = Renderer(prepare(CUBE, shades=SHADES), SCREEN)
    points, speeds = cube(angle)
    light, rate, _ = picture(renderer, View(points, speeds, radiance, np.zeros(6)))
    of_facets = radiance[SHADES[:, 0]]

    def truth(at):
        return sample(SCREEN, cube(at)[0], np.array(CUBE), of_facets, 96)

    np.testing.assert_allclose(light, truth(angle), atol=0.012)
    step = 0.01  # 0.1 px at the corners
    slope = (truth(angle + step) - truth(angle - step)) / (2 * step)
    error = np.abs(rate - slope)[np.abs(slope) > 0]
    assert np.median(error) < 0.01 * np.abs(slope).max()
    assert np.percentile(error, 99) < 0.06 * np.abs(slope).max()
    assert rate.sum() == pytest.approx(slope.sum(), abs=0.02 * np.abs(slope).sum())
