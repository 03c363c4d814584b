"""Facets with sides cut in the middle: surfaces stay closed, neighbours are right, and flat ones look as before."""

import numpy as np
import pytest
import trimesh

from emulator.raster import Facets, Renderer, Screen, View, prepare
from emulator.raster.topology import PARTS

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
MIDDLES = (len(VERTICES) + NUMBER).astype(np.int32)


def surfaces():
    topology = prepare(FACES)
    object.__setattr__(topology, "entries", len(VERTICES) + len(SIDES))
    return topology


def marked(share, seed):
    out = np.ones(len(VERTICES) + len(SIDES), np.uint8)
    out[len(VERTICES) :] = np.random.default_rng(seed).random(len(SIDES)) < share
    return out


NO_PATCHES = np.zeros((0, 3), np.int32), np.zeros(0, np.int32)


def test_parts_cover_each_facet_once():
    """In plane coordinates: the areas add up, all are counter-clockwise, and sides that are cut are never whole."""
    at = np.array([(0, 0), (1, 0), (0, 1), (0.5, 0), (0.5, 0.5), (0, 0.5)])
    for cut, parts in PARTS.items():
        areas = [np.linalg.det([at[q] - at[p], at[r] - at[p]]) for p, q, r in parts]
        assert min(areas) > 0
        assert sum(areas) == pytest.approx(1.0)
        used = {point for part in parts for point in part}
        assert used == {0, 1, 2} | {3 + k for k in range(3) if cut >> k & 1}


@pytest.mark.parametrize("share", [0.02, 0.3, 0.7, 1.0])
def test_neighbours_are_those_of_the_same_facets_prepared_anew(share):
    facets = Facets(surfaces(), MIDDLES)
    for seed in range(5):
        facets.cut(marked(share, seed))
        found = facets.on(*NO_PATCHES)
        fresh = prepare(found.faces)
        np.testing.assert_array_equal(found.across, fresh.across)
        np.testing.assert_array_equal(found.smooth, fresh.smooth)
        assert (found.across >= 0).all()
        assert found.vertices == fresh.vertices == len(VERTICES) + marked(share, seed)[len(VERTICES) :].sum()


def test_vertices_and_radiances_are_of_the_same_points():
    facets, marks = Facets(surfaces(), MIDDLES), marked(0.4, 9)
    facets.cut(marks)
    found = facets.on(*NO_PATCHES)
    number = np.flatnonzero(marks)  # the whole vertices come first in both
    np.testing.assert_array_equal(number[found.faces], found.shades)


def test_a_surface_without_cuts_and_its_patches_are_as_before():
    facets, plain = Facets(surfaces(), MIDDLES), Facets(surfaces())
    facets.cut(marked(0.6, 1))
    facets.on(np.array([[0, 1, 2]], np.int32), np.array([3], np.int32))
    facets.cut(marked(0.0, 1))
    patch = np.array([[0, 1, 2], [2, 1, 3]], np.int32), np.array([5, 6], np.int32)
    found, wanted = facets.on(*patch), plain.on(*patch)
    for name in ("faces", "shades", "across", "smooth", "two_sided", "over", "vertices", "entries"):
        np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name))


def test_rows_of_parts_belong_to_their_facets():
    facets = Facets(surfaces(), MIDDLES)
    facets.cut(marked(0.5, 2))
    half = len(FACES) // 2
    first, second = facets.parts_of(0, half), facets.parts_of(half, len(FACES))
    assert first[0] == len(FACES)
    assert first[1] == second[0]
    assert second[1] == len(facets.shades)
    wholes = set(range(half)), set(range(half, len(FACES)))
    owner = {tuple(sorted(p)): f for f in range(len(FACES)) for p in [FACES[f].tolist(), MIDDLES[f].tolist()]}
    for rows, own in zip((first, second), wholes, strict=True):
        for row in range(*rows):
            corners = set(facets.shades[row].tolist())
            assert any(corners <= set(key) | set(MIDDLES[f]) | set(FACES[f]) for key, f in owner.items() if f in own)


def test_cuts_of_flat_sides_change_no_light():
    """The middle of each side on the chord, with the mean light of its ends, so far away that perspective is none."""
    light, places = VERTICES[:, 2] ** 2, VERTICES + [0.1, 0.05, 1e5]
    light_of_all = np.concatenate([light, light[SIDES].mean(axis=1)])
    pictures = []
    for share in (0.0, 0.5, 1.0):
        facets, marks = Facets(surfaces(), MIDDLES), marked(share, 4)
        facets.cut(marks)
        middles = places[SIDES].mean(axis=1)[marks[len(VERTICES) :] != 0]
        at = np.concatenate([places, middles])
        renderer = Renderer(facets.on(*NO_PATCHES), SCREEN)
        out = np.zeros((2, 48, 64), np.float32)
        renderer.draw(View(at, 0.1 * (at - [0.0, 0.0, 1e5]), light_of_all, 0.2 * light_of_all), *out)
        pictures.append(out)
    assert pictures[0].max() > 0.5
    for other in pictures[1:]:
        np.testing.assert_allclose(other, pictures[0], atol=2e-6)
