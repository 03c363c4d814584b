"""Threads, single pixels, regions, sheets, the camera among facets, and hostile surfaces."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from emulator.light import NOTHING
from emulator.raster.layout import Screen, View
from emulator.raster.renderer import Renderer
from emulator.raster.topology import join, prepare

SCREEN = Screen(40, 30, 60.0, (20.0, 15.0))


def grid(n, two_sided=False):
    """Return the topology of n x n squares, seen from the side of the camera, and its corners in [-1, 1]^2."""
    k = np.arange(n * (n + 1)).reshape(n, n + 1)[:, :-1].ravel()
    faces = np.concatenate([np.column_stack([k, k + n + 1, k + n + 2]), np.column_stack([k, k + n + 2, k + 1])])
    x, y = np.meshgrid(np.linspace(-1, 1, n + 1), np.linspace(-1, 1, n + 1))
    return prepare(faces, two_sided=two_sided), np.column_stack([x.ravel(), y.ravel()])


def soup(seed, count=300):
    """Return the view and topology of triangles at random, some behind the camera."""
    rng = np.random.default_rng(seed)
    middle = rng.uniform([-3, -3, -1], [3, 3, 9], (count, 1, 3))
    points = (middle + rng.normal(0, 0.6, (count, 3, 3))).reshape(-1, 3)
    view = View(points, rng.normal(0, 1, points.shape), rng.uniform(0, 2, len(points)), rng.normal(0, 1, len(points)))
    return prepare(np.arange(3 * count).reshape(-1, 3), two_sided=True), view


def test_threads_change_no_bit(picture):
    topology, view = soup(3)
    with_one, with_two = Renderer(topology, SCREEN), Renderer(topology, SCREEN, threads=2)
    for a, b in zip(picture(with_one, view), picture(with_two, view), strict=True):
        np.testing.assert_equal(a, b)
    with_two.close()
    with_two.close()


def test_only_what_changes_is_written():
    topology, corners = grid(1)
    renderer = Renderer(topology, SCREEN)
    light, rate = np.zeros((30, 40), np.float32), np.zeros((30, 40), np.float32)

    def draw(shift, before):
        points = np.column_stack([0.2 * corners + shift, np.full(4, 2.0)])
        return renderer.draw(View(points, np.ones((4, 3)), np.ones(4), np.zeros(4)), light, rate, before)

    first = draw(-0.3, NOTHING)
    light[0, 0] = 7.0  # outside of both
    second = draw(0.2, first)
    assert light[0, 0] == 7.0
    assert light[first.first_row : first.last_row, first.first_column : second.first_column].max() == 0
    outside = np.ones((30, 40), bool)
    outside[second.first_row : second.last_row, second.first_column : second.last_column] = False
    outside[0, 0] = False
    assert light[outside].max() == 0
    assert np.abs(rate[outside]).max() == 0
    assert light.max() == 1 or light.max() == 7
    assert draw(100.0, second).empty
    assert light.sum() == 7
    assert draw(0.2, None) == second
    assert light[0, 0] == 0


@pytest.mark.parametrize("two_sided", [False, True])
def test_a_sheet_from_behind(picture, two_sided):
    topology, corners = grid(4, two_sided)
    for sign, seen in ((1, True), (-1, two_sided)):
        points = np.column_stack([sign * corners[:, 0], corners[:, 1], np.full(len(corners), 6.0)])
        view = View(points, np.zeros_like(points), np.ones(len(points)), np.zeros(len(points)))
        light = picture(Renderer(topology, SCREEN), view)[0]
        assert light.sum() == pytest.approx(400.0 if seen else 0.0, rel=1e-6)


@pytest.mark.parametrize("height_m", [0.05, 2.0])
def test_ground_that_reaches_behind_the_camera(picture, sample, height_m):
    topology, corners = grid(5, two_sided=True)
    points = np.column_stack([300 * corners[:, 0], np.full(len(corners), height_m), 300 * corners[:, 1] + 7.0])
    speeds = np.tile([0.02, 0.1 * height_m, -0.3], (len(points), 1))
    renderer = Renderer(topology, SCREEN)

    def at(t):
        return picture(renderer, View(points + t * speeds, speeds, np.ones(len(points)), np.zeros(len(points))))

    light, rate, _ = at(0)
    truth = sample(SCREEN, points, topology.faces, np.ones(len(topology.faces)), 16, two_sided=True)
    np.testing.assert_allclose(light, truth, atol=0.07)
    slope = (at(0.01)[0].astype(float) - at(-0.01)[0]) / 0.02
    np.testing.assert_allclose(rate, slope, atol=1e-4)
    assert 500 < light.sum() < 600


def test_light_of_one_layer_is_conserved_however_fine(picture):
    """Facets far below a pixel, in several sheets whose borders only touch."""
    left, corners = grid(60)
    flat = [np.column_stack([0.4 * corners + shift, np.full(len(corners), 3.0)]) for shift in ([-0.4, 0], [0.4, 0])]
    points = np.concatenate(flat)
    view = View(points, np.tile([0.5, 0, 0], (len(points), 1)), np.ones(len(points)), np.zeros(len(points)))
    light, rate, _ = picture(Renderer(join([left, left]), SCREEN), view)
    assert light.sum() == pytest.approx(1.6 * 0.8 * 20 * 20, rel=1e-6)
    assert abs(rate.sum()) < 1e-3
    np.testing.assert_allclose(light[9:21, 5:35], 1.0, atol=1e-6)


@given(st.integers(0, 2**32 - 1), st.sampled_from([1, 7, 60, 400]), st.booleans())
def test_triangles_at_random(seed, count, two_sided):
    topology, view = soup(seed, count)
    topology = prepare(topology.faces, two_sided=two_sided)
    light, rate = np.full((30, 40), np.nan, np.float32), np.full((30, 40), np.nan, np.float32)
    renderer = Renderer(topology, SCREEN)
    renderer.draw(view, light, rate)
    assert np.isfinite(light).all()
    assert np.isfinite(rate).all()
    assert light.min() >= 0
    assert light.max() <= 2.05


coordinates = st.sampled_from([0.0, 1.0, -1.0, 1e-12, 1e-3, 0.5, 1e9, -1e12, 1e300, np.inf, -np.inf, np.nan])


@given(st.lists(st.tuples(coordinates, coordinates, coordinates), min_size=6, max_size=6), st.booleans())
def test_absurd_corners(points, two_sided):
    faces = [[0, 1, 2], [2, 1, 3], [3, 4, 5], [0, 0, 1], [5, 4, 3], [1, 2, 0]]
    renderer = Renderer(prepare(faces, two_sided=two_sided), SCREEN)
    light, rate = np.zeros((30, 40), np.float32), np.zeros((30, 40), np.float32)
    with np.errstate(all="ignore"):
        renderer.draw(View(np.array(points), np.zeros((6, 3)), np.ones(6), np.zeros(6)), light, rate)
    assert np.isfinite(light).all()
    assert np.isfinite(rate).all()


def test_what_a_view_must_have():
    topology, _ = grid(2)
    renderer = Renderer(topology, SCREEN)
    out = np.zeros((30, 40), np.float32)
    with pytest.raises(ValueError, match="its facets need 9"):
        renderer.draw(View(np.zeros((4, 3)), np.zeros((4, 3)), np.zeros(9), np.zeros(9)), out, out.copy())
    with pytest.raises(ValueError, match="not \\(n, 3\\)"):
        View(np.zeros((4, 2)), np.zeros((4, 2)), np.zeros(4), np.zeros(4))
    with pytest.raises(ValueError, match="need the shapes"):
        View(np.zeros((4, 3)), np.zeros((3, 3)), np.zeros(4), np.zeros(4))
    with pytest.raises(ValueError, match="below 0"):
        prepare([[0, 1, -2]])
