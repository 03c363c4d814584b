"""Facets with sides cut in thirds: surfaces stay closed, neighbours are right, and flat ones look as before."""

import numpy as np
import pytest
import trimesh

from emulator.raster.layout import Screen, View
from emulator.raster.renderer import Renderer
from emulator.raster.topology import PARTS, Facets, prepare

BALL = trimesh.creation.icosphere(subdivisions=2)
FACES = np.asarray(BALL.faces, np.int32)
VERTICES = np.asarray(BALL.vertices, float)
SCREEN = Screen(64, 48, 20e5, (32.0, 24.0), 1e-3)


def sides_of(faces):
    """Return the sides, (n, 2), and the number of each facet's, (m, 3)."""
    ends = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
    sides, number = np.unique(ends, axis=0, return_inverse=True)
    return sides, number.reshape(faces.shape)


SIDES, NUMBER = sides_of(FACES)
FALLS = np.roll(FACES, -1, axis=1) < FACES
ON_SIDES = (len(VERTICES) + 2 * NUMBER[:, :, None] + (FALLS[:, :, None] != [False, True])).reshape(-1, 6)
WITHIN = len(VERTICES) + 2 * len(SIDES) + np.arange(len(FACES))
POINTS = np.column_stack([ON_SIDES, WITHIN]).astype(np.int32)
ENTRIES = int(WITHIN[-1]) + 1


def surfaces():
    topology = prepare(FACES)
    object.__setattr__(topology, "entries", ENTRIES)
    return topology


def marked(share, seed):
    is_cut = np.random.default_rng(seed).random(len(SIDES)) < share
    return np.concatenate([np.ones(len(VERTICES)), np.repeat(is_cut, 2), is_cut[NUMBER].all(axis=1)]).astype(np.uint8)


NO_PATCHES = np.zeros((0, 3), np.int32), np.zeros(0, np.int32)


def test_parts_cover_each_facet_once():
    """In plane coordinates: the areas add up, all are counter-clockwise, and sides that are cut are never whole."""
    at = np.array([(0, 0), (3, 0), (0, 3), (1, 0), (2, 0), (2, 1), (1, 2), (0, 2), (0, 1), (1, 1)]) / 3
    for cut, parts in PARTS.items():
        areas = [np.linalg.det([at[q] - at[p], at[r] - at[p]]) for p, q, r in parts]
        assert min(areas) > 0
        assert sum(areas) == pytest.approx(1.0)
        used = {point for part in parts for point in part}
        assert used == {0, 1, 2} | {p for p in range(3, 9) if cut >> (p - 3) // 2 & 1} | ({9} if cut == 7 else set())


def test_cuts_of_flat_sides_change_no_light():
    """The points in the planes of facets, with the light between their corners, too far away for perspective."""
    light, places = VERTICES[:, 2] ** 2, VERTICES + [0.1, 0.05, 1e5]

    def of_all(values):
        a, b = values[SIDES[:, 0]], values[SIDES[:, 1]]
        on_sides = np.stack([2 * a + b, a + 2 * b], axis=1).reshape(-1, *values.shape[1:]) / 3
        return np.concatenate([values, on_sides, values[FACES].mean(axis=1)])

    light_of_all = of_all(light)
    pictures = []
    for share in (0.0, 0.5, 1.0):
        facets, marks = Facets(surfaces(), POINTS), marked(share, 4)
        facets.cut(marks)
        at = of_all(places)[marks != 0]
        renderer = Renderer(facets.on(*NO_PATCHES), SCREEN)
        out = np.zeros((2, 48, 64), np.float32)
        renderer.draw(View(at, 0.1 * (at - [0.0, 0.0, 1e5]), light_of_all, 0.2 * light_of_all), *out)
        pictures.append(out)
    assert pictures[0].max() > 0.5
    for other in pictures[1:]:
        np.testing.assert_allclose(other, pictures[0], atol=2e-6)
