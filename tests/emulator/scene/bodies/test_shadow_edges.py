"""Shadow edges on smooth surfaces: areas, velocities and penumbras in closed form, rays beside embree, no history."""

import math

import numpy as np
import pytest
import trimesh
from scipy import ndimage

from emulator.geometry.camera import Pinhole
from emulator.photometry.reflectance import Sun
from emulator.scene.bodies.cast_shadow import build_tree
from emulator.scene.bodies.lit_surface import mean_side_m, subdivide
from emulator.scene.bodies.mesh import build_mesh, find_shape, load_mesh
from emulator.scene.bodies.raster_bodies import RasterBodies
from emulator.scene.bodies.shadow_edges import FrameFacets, Lights, ShadowEdges, Suns
from emulator.scene.bodies.sun_rays import SUNLIT, Window, first_met, look_to_sun
from emulator.scene.bodies.table import BodiesParameters, BodyTable
from emulator.threads import ThreadPool
from emulator.trajectory.parameters import FixedPath, SpinPath

RADIUS = Sun().radius_rad
ABOVE = Window(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 500.0]), 10.0, 10.0, 1e5)
CAMERA = Pinhole.of_field((120, 90), 14.0)


def unit(v):
    return np.asarray(v, float) / np.linalg.norm(v)


class Plate:
    """The plate z = 0 of facets of about 0.4 m, 20 m wide, below a caster of shadows."""

    def __init__(self, caster, threads=1, focal_px=2000.0):  # facets of a pixel, penumbras far below
        flat = trimesh.creation.box((20.0, 20.0, 0.2))
        flat.apply_translation((0.013, 0.007, -0.1))  # no vertex lies on an edge by its round numbers
        plate = subdivide(build_mesh(flat.vertices, flat.faces), 0.4)
        top = (plate.vertices[plate.faces][:, :, 2] > -1e-9).all(axis=1)
        self.faces, self.vertices = np.ascontiguousarray(plate.faces[top]), plate.vertices
        caster = build_mesh(caster.vertices, caster.faces)
        self.tree = build_tree(np.concatenate([m.vertices[m.faces] for m in (plate, caster)]))
        normals = np.zeros_like(self.vertices)
        normals[:, 2] = 1.0
        self.window = ABOVE._replace(focal_px=focal_px)
        side_m = mean_side_m(self.vertices, self.faces)
        self.edges = ShadowEdges(0, self.tree, self.vertices, normals, side_m, 0, ThreadPool(threads))
        self.drawn = FrameFacets(self.faces, (0, len(self.faces)), (0, 0))

    def cast(self, sun, turning=(0.0, 0.0, 0.0), radius=RADIUS):
        """Return what is hidden at vertices, and the parts of facets, lit by 1 + x / 100 and dark at 0."""
        chosen, step_s = np.arange(len(self.vertices), dtype=np.int32), 1e-7
        self.edges.begin(sun, radius)
        hidden = self.edges.hidden_from_sun(chosen, len(chosen), self.window).copy()
        none, lit = np.zeros(len(chosen)), 1 + self.vertices[:, 0] / 100
        suns = Suns(tuple(sun), tuple(unit(sun + step_s * np.asarray(turning))), step_s, radius)
        return hidden, self.edges.cut(
            Lights(np.stack([lit, none]), np.stack([none, none])), suns, self.window, self.drawn
        )


def dark_part(plate, hidden, parts, at_s=0.0):
    """Return area and middle of dark facets and dark parts, when the corners of parts have moved on."""
    whole = plate.vertices[plate.faces[(hidden[plate.faces] == 1).all(axis=1)]]
    places = (parts.corners[:, :3] + at_s * parts.corners[:, 3:])[parts.faces]
    dark = places[(parts.radiance[parts.faces] == 0).all(axis=1)]
    triangles = np.concatenate([whole, dark])
    sides = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    areas = np.cross(*sides)[:, 2] / 2
    return areas.sum(), (areas[:, None] * triangles.mean(axis=1)).sum(axis=0) / areas.sum()


def bar():
    """A bar of 2 x 3 x 0.5 m above the plate."""
    made = trimesh.creation.box((2.0, 3.0, 0.5))
    made.apply_translation((0.3, -0.2, 2.0))
    return made


@pytest.mark.parametrize("azimuth", [0.1, 0.8, 2.0, 4.4])
def test_the_shadow_of_a_bar_has_its_area(azimuth):
    """The edges are straight, so only the facets at the six corners of the shadow differ from the closed form."""
    sun = unit([0.7 * math.cos(azimuth), 0.7 * math.sin(azimuth), 1.0])
    plate = Plate(bar())
    hidden, parts = plate.cast(sun)
    area, middle = dark_part(plate, hidden, parts)
    assert area == pytest.approx(6.0 + 0.5 * (3.0 * abs(sun[0]) + 2.0 * abs(sun[1])) / sun[2], rel=0.01)
    np.testing.assert_allclose(middle[:2], np.array([0.3, -0.2]) - 2.0 * sun[:2] / sun[2], atol=0.01)
    assert np.abs(parts.corners[:, 2]).max() < 1e-9
    a, b, c = (parts.corners[parts.faces[:, k], :3] for k in range(3))
    assert (np.cross(b - a, c - a)[:, 2] > -1e-12).all()  # counter-clockwise


def test_edges_move_as_the_shadow_does():
    """The middle of a bar 2 m above the plate moves by 2 m times the change of the Sun's tangent."""
    sun, later_s = unit([0.5, 0.3, 1.0]), 1e-3
    turning = np.array([0.3, -0.2, 0.0])
    turning -= sun * (turning @ sun)
    plate = Plate(bar())
    hidden, parts = plate.cast(sun, turning)
    moved = dark_part(plate, hidden, parts, later_s)[1] - dark_part(plate, hidden, parts)[1]
    after = unit(sun + later_s * turning)
    expected = 2.0 * (sun[:2] / sun[2] - after[:2] / after[2])
    np.testing.assert_allclose(moved[:2], expected, rtol=0.03)


def test_a_penumbra_is_as_wide_as_the_disc():
    """A straight edge 10 m above, and the Sun at the zenith: 0.866 of its diameter times the height."""
    wall = trimesh.creation.box((30.0, 30.0, 0.002))
    wall.apply_translation((-15.1, 0.0, 10.0))  # its edge is at x = -0.1
    plate = Plate(wall, focal_px=1e5)
    _, parts = plate.cast(np.array([0.0, 0.0, 1.0]))
    x, lit = parts.corners[:, 0], parts.radiance > 0
    on_side = np.isin(np.arange(len(x)) % 7, (1, 2, 3, 4))  # a facet has seven corners, three of them its own
    edge = on_side & (np.abs(parts.corners[:, 1]) < 8)
    half = math.sqrt(3) / 2 * RADIUS * 10.0
    np.testing.assert_allclose(x[edge & lit], -0.1 + half, atol=0.01 * half)
    np.testing.assert_allclose(x[edge & ~lit], -0.1 - half, atol=0.01 * half)
    narrow = Plate(wall).cast(np.array([0.0, 0.0, 1.0]))[1]
    assert len(narrow.faces) < len(parts.faces)  # no penumbra below half a pixel


def edges_of(tree, vertices, normals):
    return ShadowEdges(0, tree, vertices, normals, 0.4, 0, ThreadPool(1))


def test_light_ends_at_the_terminator_and_moves_with_it():
    """One facet in the open with cosines of incidence 0.2, 0.1 and -0.2; 0.3 is the light without the Sun."""
    above = build_tree(np.array([[[0.0, 0.0, 90.0], [1.0, 0.0, 90.0], [0.0, 1.0, 90.0]]]))
    vertices, cosines = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 2.0, 0.0]]), np.array([0.2, 0.1, -0.2])
    normals = np.stack([cosines, np.zeros(3), np.sqrt(1 - cosines**2)], axis=1)
    edges, step_s = edges_of(above, vertices, normals), 1e-7
    sun, later = np.array([1.0, 0.0, 0.0]), np.array([1.0, 0.0, step_s])
    edges.begin(sun, RADIUS)
    window = ABOVE._replace(focal_px=2e3)
    assert edges.hidden_from_sun(np.arange(3, dtype=np.int32), 3, window).tolist() == [0, 0, 1]
    dark = np.stack([np.full(3, 0.3), np.zeros(3)])
    lit = dark + [np.maximum(cosines, 0.0), normals[:, 2]]
    drawn = FrameFacets(np.array([[0, 1, 2]], np.int32), (0, 1), (0, 0))
    parts = edges.cut(Lights(lit, dark), Suns(tuple(sun), tuple(later), step_s, RADIUS), window, drawn)
    # Rows 1 and 2 are dark, 3 and 4 lit, on the sides from corner 2, which alone is dark, to corners 0 and 1.
    shares = np.array([0.2 / 0.4, 0.1 / 0.3])
    sides = vertices[2] - vertices[:2]
    rates = ((1 - shares) * normals[:2, 2] + shares * normals[2, 2]) / (cosines[:2] - cosines[2])
    for rows in ([1, 2], [3, 4]):
        np.testing.assert_allclose(parts.corners[rows, :3], vertices[:2] + shares[:, None] * sides, atol=1e-12)
        np.testing.assert_allclose(parts.corners[rows, 3:], rates[:, None] * sides, rtol=1e-6, atol=1e-12)
        np.testing.assert_allclose(parts.radiance[rows], 0.3, rtol=1e-12)
        np.testing.assert_allclose(parts.rate[rows], 0.0, atol=1e-6)


def eros():
    return load_mesh(find_shape("eros007790"), 1.0)


def test_verdicts_are_those_of_embree():
    pytest.importorskip("embreex", reason="the ray caster of the test group")
    mesh = eros()
    tree = build_tree(mesh.vertices[mesh.faces])
    points = mesh.vertices + 0.02 * 100.0 * mesh.normals
    other = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    for sun in (unit([1.0, 0.2, 0.1]), unit([-0.1, 0.9, -0.5]), unit([0.3, 0.3, 1.0])):
        hidden = look(tree, points, sun)
        truth = other.ray.intersects_any(points, np.tile(sun, (len(points), 1)))
        assert 0.2 < truth.mean() < 0.8
        assert (hidden != truth).sum() <= 2  # embree's rays are float32


def look(tree, points, sun, hiding=None, normals=None, radius_rad=0.0):
    hiding = np.full(len(points), SUNLIT) if hiding is None else hiding
    chosen, hidden = np.arange(len(points), dtype=np.int32), np.full(len(points), -1, np.int8)
    all_around = Window(np.eye(3), np.array([0.0, 0.0, -1e9]), 10.0, 10.0, 1.0)
    normals = np.tile(sun, (len(points), 1)) if normals is None else normals  # turned to the Sun: each gets a ray
    look_to_sun(tree, points, normals, chosen, (0, len(points)), all_around, sun, radius_rad, hiding, hidden)
    return hidden


def test_earlier_results_change_nothing():
    """A Sun that wanders for a while by small and large steps: each result equals that of a fresh search."""
    mesh = eros()
    tree, points = build_tree(mesh.vertices[mesh.faces]), mesh.vertices + 2.0 * mesh.normals
    hiding, random, sun = np.full(len(points), SUNLIT), np.random.default_rng(5), unit([1.0, 0.1, 0.2])
    left = 0
    for step in (0.0, 1e-4, 1e-4, 1e-3, 1e-3, 0.02, 1e-4, 0.5, 1e-3, 1e-3):
        sun = unit(sun + step * random.normal(size=3))
        before = hiding.copy()
        found = look(tree, points, sun, hiding)
        np.testing.assert_array_equal(found, look(tree, points, sun))
        np.testing.assert_array_equal(found, hiding >= 0)
        left += int(((before >= 0) & (hiding == SUNLIT)).sum())
    assert left > len(points) / 10  # the triangle of the step before hides the Sun no more


@pytest.mark.parametrize("count", [1, 3, 5, 9, 17, 40, 100, 300, 600, 1100])
def test_trees_of_all_depths_have_the_triangles_that_rays_meet(count):
    """Beside the solution of point + t sun = first + a u + b v for each ray and triangle."""
    random, spread = np.random.default_rng(count), count ** (1 / 3)
    triangles = random.normal(size=(count, 1, 3)) * spread + random.normal(size=(count, 3, 3))
    tree, middles = build_tree(triangles), triangles[random.integers(count, size=200)].mean(axis=1)
    for axis in (unit([0.3, -0.5, 0.8]), np.array([0.0, 0.0, 1.0])):
        points = middles + random.normal(size=(200, 3)) * 0.5 - random.normal(size=(200, 1)) * spread * axis
        found = np.array([first_met(tree, tuple(point), tuple(axis)) for point in points])
        ordered = tree.corners.transpose(0, 2, 1).reshape(-1, 3, 3)
        first, u, v = ordered[:, 0], ordered[:, 1] - ordered[:, 0], ordered[:, 2] - ordered[:, 0]
        is_one = np.linalg.norm(np.cross(u, v), axis=1) > 0
        system = np.stack([np.broadcast_to(-axis, u.shape), u, v], axis=2)[is_one]
        t, a, b = np.linalg.solve(system[None], (points[:, None] - first[is_one])[..., None])[..., 0].transpose(2, 0, 1)
        met = (t > 0) & (a >= 0) & (b >= 0) & (a + b <= 1)
        numbers = np.flatnonzero(is_one)[met.argmax(axis=1)]
        np.testing.assert_array_equal(found, np.where(met.any(axis=1), numbers, SUNLIT))
        assert met.any()


def scene(threads=1, **more):
    path = SpinPath(spin_deg_s=0.01)
    table = BodyTable(shape="itokawa_49152", units_m=1000.0, path=path)
    camera = FixedPath((0.0, -3000.0, 0.0), look_at_m=(0.0, 0.0, 0.0))
    parameters = BodiesParameters(bodies=(table,), camera=camera, sun=Sun((1.0, -0.3, 0.1)), time_scale=300.0, **more)
    return RasterBodies(parameters, CAMERA, threads)


def frame(bodies, t_ns):
    light, rate = np.zeros((2, 90, 120), np.float32)
    bodies.light_and_rate(t_ns, light, rate)
    return light, rate


def test_light_does_not_depend_on_threads_or_on_frames_before():
    times = [0, 10_000_000, 20_000_000, 3_000_000_000, 15_000_000]
    one, three = scene(), scene(3)
    for t_ns in times:
        fresh = frame(scene(), t_ns)
        np.testing.assert_array_equal(frame(one, t_ns), fresh)
        np.testing.assert_array_equal(frame(three, t_ns), fresh)
    assert fresh[0].max() > 0


def test_pixels_are_dark_where_embree_hides_the_sun():
    """A ray through the middle of each pixel, and one from there to the Sun's middle, against the facets as drawn."""
    pytest.importorskip("embreex", reason="the ray caster of the test group")
    light, _ = frame(scene(), 0)
    without, _ = frame(scene(shadows=False), 0)
    mesh = load_mesh(find_shape("itokawa_49152"), 1000.0)
    other = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    columns, rows = np.meshgrid(np.arange(120) + 0.5 - 60, np.arange(90) + 0.5 - 45)
    # The camera looks along +y with z up: x is to the right, and rows go down.
    rays = np.stack([columns, np.full_like(columns, CAMERA.focal_px), -rows], axis=-1).reshape(-1, 3)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    eyes = np.tile([0.0, -3000.0, 0.0], (len(rays), 1))
    facets = other.ray.intersects_first(eyes, rays)
    hit = facets >= 0
    normals = other.face_normals[facets[hit]]
    along = ((other.triangles[facets[hit], 0] - eyes[hit]) * normals).sum(axis=1) / (rays[hit] * normals).sum(axis=1)
    places = eyes[hit] + along[:, None] * rays[hit] + 0.1 * normals
    sun = unit([1.0, -0.3, 0.1])
    hidden = other.ray.intersects_any(places, np.tile(sun, (hit.sum(), 1)))
    faces_sun = normals @ sun > 0.1
    bright = light.ravel()[hit] > 0.5 * without.ravel()[hit]
    assert hidden[faces_sun].mean() > 0.02  # the head's shadow on the body, and those of boulders
    assert (bright == ~hidden)[faces_sun].mean() > 0.98
    # No light comes from the horizon of a place in the shadow of others.
    dark = np.zeros(light.size, bool)
    dark[hit] = hidden
    around = ndimage.minimum_filter(dark.reshape(light.shape), 3)
    assert around.sum() > 100
    assert (light[around] > 1e-5 * light.max()).mean() < 0.03


@pytest.mark.parametrize("height", [-0.9, -0.5, 0.5, 0.9])
@pytest.mark.parametrize(("wall", "is_hidden"), [(0.0, False), (0.3, False), (0.9, True)])
def test_a_point_whose_horizon_cuts_the_sun_is_hidden_where_the_middle_of_the_rest_is(height, wall, is_hidden):
    """The Sun's middle `height` of its radius above level ground; a wall as high as `wall` of what is seen of it."""
    ground = [[-99.0, -99.0, 0.0], [99.0, -99.0, 0.0], [0.0, 99.0, 0.0]]
    across = [[10.0, -99.0, -99.0], [10.0, 99.0, -99.0], [10.0, 0.0, 10.0 * RADIUS * (1 + height) * wall]]
    tree = build_tree(np.array([ground, across]))
    sun = np.array([math.cos(RADIUS * height), 0.0, math.sin(RADIUS * height)])
    point, normal = np.array([[0.0, 0.0, 1e-6]]), np.array([[0.0, 0.0, 1.0]])
    assert look(tree, point, sun, normals=normal, radius_rad=RADIUS) == [is_hidden]
