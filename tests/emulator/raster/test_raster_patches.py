"""Patches: parts of a facet with other light, against closed forms and against rays."""

import numpy as np
import pytest

from emulator.raster.layout import Screen, View
from emulator.raster.renderer import Renderer
from emulator.raster.topology import Facets, join, prepare

SCREEN = Screen(24, 18, 100.0, (12.0, 9.0))
LIFT = 1e-6
GROUND = [(-30, -30), (-30, 60), (60, 60), (60, -30)]


def world(pixels, depth_m=10.0):
    scale = depth_m / SCREEN.focal_px
    return np.column_stack([(np.asarray(pixels, float) - SCREEN.centre_px) * scale, np.full(len(pixels), depth_m)])


def still(positions):
    return np.zeros_like(positions)


def ground(radiance=2.0):
    places = world(GROUND)
    return prepare([[0, 1, 2], [0, 2, 3]]), View(places, still(places), np.full(4, radiance), np.zeros(4))


def patched(topology, view, corners, faces, over, radiance, velocities=None):
    """Return a scene with patches at camera places `corners`, m, a little lifted."""
    speeds = still(corners) if velocities is None else velocities
    values = np.full(len(corners), radiance)
    return Facets(topology).on(np.asarray(faces, np.int32), np.asarray(over, np.int32)), View(
        np.concatenate([view.positions_m, (1 - LIFT) * corners]),
        np.concatenate([view.velocities_m_s, (1 - LIFT) * speeds]),
        np.concatenate([view.radiance, values]),
        np.concatenate([view.radiance_rate, still(values)]),
    )


def square(x, y, side):
    return [(x, y), (x, y + side), (x + side, y + side), (x + side, y)]


def shares(low, high, n):
    k = np.arange(n)
    return np.clip(np.minimum(high, k + 1) - np.maximum(low, k), 0, 1)


def dark_square(x, y, side):
    """Return a dark square that goes 3 px/s to the right, on the lower of the ground's facets alone."""
    corners = world(square(x, y, side))
    speeds = np.zeros_like(corners)
    speeds[:, 0] = 3.0 * 10.0 / SCREEN.focal_px
    return patched(*ground(), corners, [[0, 1, 2], [0, 2, 3]], [0, 0], 0.5, speeds)


def test_a_dark_square_takes_its_area_and_its_edges_move(picture):
    x, y, side = 3.3, 9.4, 4.0
    topology, view = dark_square(x, y, side)
    light, rate, _ = picture(Renderer(topology, SCREEN), view)
    covered = np.outer(shares(y, y + side, 18), shares(x, x + side, 24))
    assert light == pytest.approx(2.0 - 1.5 * covered, abs=1e-5)
    edges = np.zeros(24)
    edges[int(x)], edges[int(x + side)] = -3.0, 3.0
    assert rate == pytest.approx(-1.5 * np.outer(shares(y, y + side, 18), edges), abs=1e-4)


def test_a_nearer_surface_hides_a_patch_and_its_outline_over_it_is_right(picture, sample):
    """A part of the patch holds no sample and is farther than all samples around: it must not be lost."""
    topology, view = dark_square(3.3, 9.4, 4.0)
    front = world([(5.2, 2.0), (4.4, 16.5), (16.0, 12.0)], 5.0)
    cover = prepare([[0, 1, 2]]), View(front, still(front), np.full(3, 7.0), np.zeros(3))
    first = ground()
    both, (bare, over) = join([first[0], cover[0]]), (first[1], cover[1])
    seen = View(
        np.concatenate([bare.positions_m, over.positions_m]),
        np.zeros((7, 3)),
        np.concatenate([bare.radiance, over.radiance]),
        np.zeros(7),
    )
    corners = world(square(3.3, 9.4, 4.0))
    topology, view = patched(both, seen, corners, [[0, 1, 2], [0, 2, 3]], [0, 0], 0.5)
    light, _, _ = picture(Renderer(topology, SCREEN), view)
    radiance = np.array([2.0, 2.0, 7.0, 0.5, 0.5])
    truth = sample(SCREEN, view.positions_m, topology.faces, radiance, 40)
    assert light == pytest.approx(truth, abs=0.12)
    assert np.abs(light - truth).mean() < 0.006


def test_small_patches_on_a_steep_facet_are_all_drawn(picture):
    """Patches far smaller than a pixel, on a facet whose depth changes much: the light that is lost is their area."""
    places = np.array([[-4.0, -3.0, 6.0], [-4.0, 3.0, 6.0], [4.0, 3.0, 16.0], [4.0, -3.0, 16.0]])
    topology = prepare([[0, 1, 2], [0, 2, 3]])
    view = View(places, still(places), np.full(4, 2.0), np.zeros(4))
    rng = np.random.default_rng(3)
    along = (rng.uniform((4, 6), (20, 14), (200, 2)) - SCREEN.centre_px) / SCREEN.focal_px
    depth = 11.0 / (1 - 1.25 * along[:, 0])  # on the facets' plane z = 11 + 1.25 x
    middles = np.column_stack([along * depth[:, None], depth])
    middles = middles[middles[:, 1] > 0.75 * middles[:, 0] + 0.2]  # in the first facet
    a, b, c = places[0], places[1], places[2]
    size = 0.002
    corners = np.concatenate([np.stack([m, m + size * (b - a), m + size * (c - a)]) for m in middles])
    faces = np.arange(len(corners)).reshape(-1, 3)
    lit, _, _ = picture(Renderer(topology, SCREEN), view)
    topology, view = patched(topology, view, corners, faces, [0] * len(faces), 0.0)
    light, _, _ = picture(Renderer(topology, SCREEN), view)
    px = corners[:, :2] / corners[:, 2:] * SCREEN.focal_px + SCREEN.centre_px
    e, f = px[1::3] - px[::3], px[2::3] - px[::3]
    area = np.abs(e[:, 0] * f[:, 1] - e[:, 1] * f[:, 0]).sum() / 2
    assert (lit - light).sum() == pytest.approx(2.0 * area, rel=1e-4)


def test_a_patch_on_a_facet_that_the_camera_cuts_is_drawn_on_what_is_left(picture):
    places = np.array([[-4.0, 1.0, -2.0], [4.0, 1.0, 20.0], [-4.0, 1.0, 20.0]])
    topology, view = prepare([[0, 1, 2]]), View(places, still(places), np.full(3, 2.0), np.zeros(3))
    corners = np.array([[-1.0, 1.0, 13.0], [0.2, 1.0, 18.0], [-1.5, 1.0, 18.0]])
    whole, _, _ = picture(Renderer(topology, SCREEN), view)
    topology, view = patched(topology, view, corners, [[0, 1, 2]], [0], 0.5)
    light, _, _ = picture(Renderer(topology, SCREEN), view)
    px = corners[:, :2] / corners[:, 2:] * SCREEN.focal_px + SCREEN.centre_px
    e, f = px[1] - px[0], px[2] - px[0]
    assert (whole - light).sum() == pytest.approx(1.5 * abs(e[0] * f[1] - e[1] * f[0]) / 2, rel=1e-3)
