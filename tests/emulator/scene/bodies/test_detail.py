"""What is made up on bodies: size laws, seeds, places, fading with distance, and albedo."""

import dataclasses
import functools
import math

import numpy as np
import pytest
import trimesh
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from emulator.geometry.camera import Pinhole
from emulator.photometry.reflectance import Sun
from emulator.scene.bodies.albedo import clouded
from emulator.scene.bodies.mesh import build_mesh, facet_vectors, find_shape, load_mesh
from emulator.scene.bodies.raster_bodies import RasterBodies
from emulator.scene.bodies.regolith import Law, coarser, detailed, features, smallest_feature_m, weathered
from emulator.scene.bodies.smooth_ground import potential, smooth_ground
from emulator.scene.bodies.table import BodiesParameters, BodyTable, Clouds, Regolith
from emulator.trajectory.parameters import Keyframe, KeyframePath
from tests.emulator.scene.bodies.volume import volume_m3

PLAIN = Regolith(seed=5, craters=0.02, boulders_km2=2000.0, slope_deg=0.0, albedo_rms=0.1)


def ball(radius_m, subdivisions=4):
    solid = trimesh.creation.icosphere(subdivisions, radius_m)
    return build_mesh(solid.vertices, solid.faces)


def mean_over_area(mesh):
    areas = np.linalg.norm(facet_vectors(mesh.vertices, mesh.faces), axis=1)
    return float((areas[:, None] * mesh.albedo).sum() / (3 * areas.sum()))


@pytest.mark.parametrize("law", [Law(0, 949e-6 * 5**3.1, 3.1), Law(1, 0.046, 2.0)], ids=["boulders", "craters"])
def test_features_are_as_many_of_each_size_as_their_law_says(law):
    mesh = ball(1500.0)
    found = features(mesh, law, 3, 7.0, 200.0)
    for d in (7.0, 9.0, 16.0, 30.0):
        expected = law.number * (d**-law.power - 200.0**-law.power) * mesh.area_m2
        assert abs((found.diameters_m > d).sum() - expected) < 4 * math.sqrt(expected)


def test_the_body_changes_little_when_the_camera_comes_a_little_nearer():
    mesh, only = ball(300.0), dataclasses.replace(PLAIN, craters=0.0)
    bodies = [weathered(mesh, only, pixel_m) for pixel_m in (0.7, 0.707, 1.4)]
    risen = [volume_m3(body) - volume_m3(mesh) for body in bodies]
    assert abs(risen[1] / risen[0] - 1) < 0.01
    assert len(bodies[0].faces) > 1.5 * len(bodies[2].faces)


def test_two_cameras_see_a_boulder_at_the_same_place_and_as_high():
    mesh = ball(300.0)
    only = dataclasses.replace(PLAIN, craters=0.0)
    heights = []
    for pixel_m in (0.5, 0.8):
        body = weathered(mesh, only, pixel_m)
        law = Law(0, only.boulders_km2 * 1e-6 * 5**3.1, 3.1)
        largest = features(mesh, law, only.seed, 5.0, 6 * math.sqrt(mesh.area_m2 / len(mesh.faces)))
        near = np.linalg.norm(body.vertices - largest.places[0], axis=1) < largest.diameters_m[0] / 2
        heights.append((np.linalg.norm(body.vertices[near], axis=1) - 300.0).max() / largest.diameters_m[0])
    assert heights[0] == pytest.approx(heights[1], rel=0.15)
    assert 0.1 < heights[0] < 0.6


def test_the_same_seed_makes_the_same_body_and_another_one_another():
    mesh = ball(300.0)
    one, same, other = (weathered(mesh, dataclasses.replace(PLAIN, seed=s), 0.8) for s in (5, 5, 6))
    np.testing.assert_array_equal(one.vertices, same.vertices)
    np.testing.assert_array_equal(one.albedo, same.albedo)
    assert one.vertices.shape != other.vertices.shape or not np.allclose(one.vertices, other.vertices)


def test_albedo_has_the_stated_mean_and_spread():
    body = weathered(ball(300.0, 5), dataclasses.replace(PLAIN, boulders_km2=0.0, craters=0.0), 1.0)
    assert mean_over_area(body) == pytest.approx(1, abs=1e-12)
    assert body.at_vertices(body.albedo).std() == pytest.approx(0.1, rel=0.25)


def test_roughness_has_the_stated_slope():
    mesh = ball(300.0, 5)
    body = weathered(mesh, dataclasses.replace(PLAIN, boulders_km2=0.0, craters=0.0, slope_deg=5.0), 10.0)
    before, after = (facet_vectors(v, mesh.faces) for v in (mesh.vertices, body.vertices))
    cosine = (before * after).sum(axis=1) / np.linalg.norm(before, axis=1) / np.linalg.norm(after, axis=1)
    slopes = np.tan(np.arccos(np.clip(cosine, -1, 1)))
    assert math.degrees(math.atan(math.sqrt((slopes**2).mean()))) == pytest.approx(5.0, rel=0.1)


def test_a_crater_has_its_closed_form_with_a_rim_all_round():
    """Depth and rim of the parabola that `Regolith` states, on a ball of known radius; sectors of 45 degrees."""
    mesh, p = ball(300.0), dataclasses.replace(PLAIN, seed=29, craters=0.004, boulders_km2=0.0)
    body = weathered(mesh, p, 2.5)
    some = features(mesh, Law(1, p.craters, 2.0), p.seed, 15.0, 6 * math.sqrt(mesh.area_m2 / len(mesh.faces)))
    apart = np.linalg.norm(some.places - some.places[0], axis=1)[1:] - 0.85 * some.diameters_m[1:]
    assert apart.min() > some.diameters_m[0], "another crater is in the way: take another seed"
    normal, radius_m = some.places[0] / np.linalg.norm(some.places[0]), some.diameters_m[0] / 2
    offsets = body.vertices - some.places[0]
    flat = offsets - np.outer(offsets @ normal, normal)
    r = np.linalg.norm(flat, axis=1) / radius_m
    near = np.linalg.norm(offsets, axis=1) < 1.7 * radius_m
    raised = (np.linalg.norm(body.vertices, axis=1) - 300.0) / radius_m
    age = 0.25 + 0.75 * some.lots[0, 0] ** 2
    depth = 2 * p.crater_depth * age
    rim = near & (np.abs(r - 1) < 0.08)
    across = np.cross(normal, [0.0, 0.0, 1.0])
    sectors = np.floor(np.arctan2(flat[rim] @ np.cross(normal, across), flat[rim] @ across) / (math.pi / 4))
    assert len(np.unique(sectors)) == 8
    height = 0.25 * age * depth
    inside = depth * (r[near] ** 2 - 1) + height * r[near] ** 2
    apron = height * np.clip((1.7 - r[near]) / 0.7, 0, 1) ** 2
    np.testing.assert_allclose(raised[near], np.where(r[near] < 1, inside, apron), atol=0.05 * depth)


def test_craters_and_roughness_leave_the_volume():
    mesh = ball(300.0, 5)
    body = weathered(mesh, dataclasses.replace(PLAIN, craters=0.046, boulders_km2=0.0, slope_deg=4.0), 1.0)
    assert volume_m3(body) == pytest.approx(volume_m3(mesh), rel=0.001)


def test_no_more_facets_are_made_than_allowed_and_none_where_nothing_is_seen():
    mesh = ball(300.0)
    many = dataclasses.replace(PLAIN, most_facets=20_000, smallest_m=0.1)
    assert len(weathered(mesh, many, 0.01).faces) < 1.5 * 20_000
    assert smallest_feature_m(mesh, many, 0.01) > smallest_feature_m(mesh, PLAIN, 0.01)
    assert len(weathered(mesh, PLAIN, 100.0).faces) == len(mesh.faces)


def test_gravity_of_a_ball_and_of_two_balls_is_that_of_points():
    """Newton's closed form, on the surface and outside; soft near the facets, so 2 % there."""
    mesh = ball(300.0, 3)
    outside = np.array([[0.0, 0.0, 450.0], [400.0, 300.0, 0.0]])
    np.testing.assert_allclose(potential(mesh, outside), [-1 / 450, -1 / 500], rtol=0.003)
    np.testing.assert_allclose(potential(mesh, mesh.vertices), -1 / 300, rtol=0.02)


# degrees of latitude and east longitude: IAU, Gazetteer of planetary nomenclature; touchdown: Yano et al. 2006, Science
# 312, 1350
_MUSES_C, _SAGAMIHARA, _TOUCHDOWN, _KAMISUNAGAWA = (-70, 60), (80, 15), (-6, 39), (-28, 45)
_KOMABA, _CATALINA, _LAUREL, _KAMOI, _HAMMAGUIRA = (-10, 102), (-17, 14), (1, 162), (6, 244), (-18, 205)


@functools.cache
def itokawa():
    return load_mesh(find_shape("itokawa_49152"), 1000.0)


def towards(mesh, place):
    """Number of the vertex that lies towards a latitude and longitude, (2,) degrees."""
    latitude, longitude = np.radians(place)
    flat = math.cos(latitude)
    direction = (flat * math.cos(longitude), flat * math.sin(longitude), math.sin(latitude))
    return (mesh.vertices / np.linalg.norm(mesh.vertices, axis=1)[:, None] @ direction).argmax()


def test_smooth_ground_of_itokawa_is_where_hayabusa_saw_it():
    mesh = itokawa()
    smooth = smooth_ground(mesh, coarser(mesh, 20.0), 0.2)(mesh.vertices)
    for place in (_MUSES_C, _SAGAMIHARA, _TOUCHDOWN, _KAMISUNAGAWA):
        assert smooth[towards(mesh, place)] > 0.9, place
    for place in (_KOMABA, _CATALINA, _LAUREL, _KAMOI, _HAMMAGUIRA):
        assert smooth[towards(mesh, place)] < 0.1, place
    areas = np.linalg.norm(facet_vectors(mesh.vertices, mesh.faces), axis=1)
    on_facets = smooth[mesh.faces].mean(axis=1)
    assert (areas * on_facets).sum() / areas.sum() == pytest.approx(0.2, abs=0.01)
    assert (areas * (np.abs(on_facets - 0.5) < 0.45)).sum() < 0.04 * areas.sum()  # a sharp border
    sides = np.sort(mesh.faces[on_facets > 0.5][:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2))
    shape = (len(mesh.vertices),) * 2
    _, sea = connected_components(coo_matrix((np.ones(len(sides)), sides.T), shape), directed=False)
    seas = np.sort(np.bincount(sea[np.unique(sides)]))[::-1]
    assert seas[1] > 0.3 * seas[0]
    assert seas[:2].sum() > 0.95 * seas.sum()  # two seas, and no spots


def test_smooth_ground_of_itokawa_stays_even_and_rough_ground_becomes_rough():
    mesh = itokawa()
    p = dataclasses.replace(PLAIN, craters=0.0, boulders_km2=0.0, slope_deg=16.0, smooth_share=0.2)
    smooth = smooth_ground(mesh, coarser(mesh, 20.0), 0.2)(mesh.vertices)[mesh.faces].mean(axis=1)
    x, y, z = mesh.vertices[mesh.faces].mean(axis=1).T > 0
    before, squares = facet_vectors(mesh.vertices, mesh.faces), []
    for seed in range(1, 5):  # an octant has 75 waves of 23 m, of which few are boulders
        body = weathered(mesh, dataclasses.replace(p, seed=seed), 2.0)
        after = facet_vectors(body.vertices, body.faces)
        slopes = np.linalg.norm(np.cross(before, after), axis=1) / (before * after).sum(axis=1)
        assert ((slopes >= 0) & (slopes < 1.74)).all()  # no facet is turned over, or by more than 60 degrees
        squares.append(slopes**2)
        assert body.albedo[smooth > 0.99].std() < 0.2 * body.albedo[smooth < 0.01].std()
    mean_square = np.mean(squares, axis=0)

    def degrees(part):
        return np.degrees(np.arctan(np.sqrt(mean_square[part].mean())))

    assert degrees(smooth > 0.99) < 2.5
    for octant in range(8):  # as rough everywhere
        part = (4 * x + 2 * y + z == octant) & (smooth < 0.01)
        assert degrees(part) == pytest.approx(16.0, rel=0.1)


def test_a_clouded_planet_is_round_and_as_bright_as_its_reflectance_says():
    planet = clouded(ball(6.4e6, 3), Clouds(seed=2), 3e5)
    np.testing.assert_allclose(np.linalg.norm(planet.vertices, axis=1), 6.4e6, rtol=1e-9)
    assert mean_over_area(planet) == pytest.approx(1, abs=1e-12)
    ratio = planet.albedo.max() / planet.albedo.min()
    assert 8 < ratio < 15  # thick cloud over open ocean, 0.7 / 0.05


@pytest.mark.parametrize("albedo_rms", [0.0, 0.1])
def test_detail_is_made_once_for_the_same_body(monkeypatch, tmp_path, albedo_rms):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    mesh, detail = ball(500.0), dataclasses.replace(PLAIN, albedo_rms=albedo_rms)
    made = detailed(mesh, detail, 1.0)
    expected = weathered(mesh, detail, 1.0)

    def fail(*_):
        raise AssertionError("made again")

    monkeypatch.setattr("emulator.scene.bodies.regolith.weathered", fail)
    for one in (made, detailed(mesh, detail, 1.0)):
        for field in dataclasses.fields(expected):
            found, wanted = getattr(one, field.name), getattr(expected, field.name)
            assert type(found) is type(wanted)
            assert np.array_equal(found, wanted), field.name
        assert one.vertices.flags.c_contiguous
    for other in ((mesh, dataclasses.replace(detail, seed=6), 1.0), (mesh, detail, 2.0), (ball(501.0), detail, 1.0)):
        with pytest.raises(AssertionError, match="made again"):
            detailed(*other)


def approach(shape, seconds):
    """Return the light near the end of an approach of so many seconds, (48, 64), and the facets of the body."""
    far, near = (Keyframe(t_s, (0.0, 0.0, -range_m)) for t_s, range_m in ((0.0, 400.0), (seconds, 30.0)))
    body = BodyTable(shape=str(shape), detail=dataclasses.replace(PLAIN, most_facets=20_000))
    parameters = BodiesParameters(bodies=(body,), camera=KeyframePath((far, near)), sun=Sun((1.0, 0.0, -1.0)))
    light = np.zeros((48, 64), np.float32)
    with RasterBodies(parameters, Pinhole.of_field((64, 48), 30.0)) as scene:
        scene.light(round(0.9 * seconds * 1e9), light)
        return light, len(scene.geometry()._meshes[0].faces)


@pytest.mark.long
def test_an_approach_of_ten_minutes_shows_what_a_short_one_shows(tmp_path):
    shape = tmp_path / "ball.obj"
    trimesh.creation.icosphere(3, 10.0).export(shape)
    (slow, slow_facets), (fast, fast_facets) = approach(shape, 600.0), approach(shape, 50.0)
    assert slow_facets == fast_facets > 5000
    np.testing.assert_allclose(slow, fast, rtol=1e-4, atol=1e-4 * fast.max())
    assert fast.max() > 0
