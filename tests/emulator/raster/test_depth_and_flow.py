"""Depth, flow and labels of scenes: against closed forms, and against points that are moved and projected here."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from emulator.geometry.camera import Pinhole, Rays, Seen
from emulator.optics.lens import LensParameters
from emulator.optics.through import Through
from emulator.raster.surfaces import NearestSurface
from emulator.rig.kinds import CAMERA_MODELS
from emulator.scene.bodies.mesh import find_shape, load_mesh
from emulator.scene.bodies.raster_bodies import RasterBodies
from emulator.scene.bodies.table import BodiesParameters, BodyTable
from emulator.scene.checkerboard.checkerboard import Checkerboard
from emulator.scene.checkerboard.table import CheckerboardParameters
from emulator.scene.stars.stars import StarField
from emulator.scene.stars.table import MovingPoint, StarsParameters
from emulator.scene.terrain.raster_terrain import RasterTerrain
from emulator.scene.terrain.table import Ridge, TerrainParameters
from emulator.trajectory.laws import Gate
from emulator.trajectory.parameters import DescentPath, FixedPath, Keyframe, KeyframePath, SpinPath

SIZE = (96, 72)
CAMERA = Pinhole.of_field(SIZE, 40.0)
LENS = LensParameters(field_of_view_deg=40.0)
BENT = dataclasses.replace(LENS, k1=-0.2, k2=0.05, p1=0.004, p2=-0.003)
MS = 1_000_000

PASSING = KeyframePath(
    (Keyframe(0.0, (3.0, -1.0, -12.0)), Keyframe(4.0, (-2.0, 1.0, -9.0))),
    look_at_m=(0.0, 0.0, 0.0),
    up=(0.0, -1.0, 0.0),
)
BODIES = BodiesParameters(
    camera=PASSING,
    bodies=(
        BodyTable(
            "bus", "target_bus", path=SpinPath((0.0, 0.0, 0.0), (0.2, 0.3, -1.0), spin_deg_s=40.0, tilt_deg=12.0)
        ),
        BodyTable(shape="target_panel", fixed_to="bus", path=FixedPath((0.8, 0.0, 0.0))),
        BodyTable("far", "globe", units_m=3.0, path=SpinPath((1.0, 2.0, 9.0), (0.0, 1.0, 0.0), spin_deg_s=-25.0)),
    ),
)


def seen_by(scene, t_ns):
    out = Seen.of(*scene.size)
    geometry = scene.geometry()
    geometry.look(t_ns, out)
    return geometry, out


def turned(q):
    return Rotation.from_quat(np.roll(q, -1, axis=-1))


def bent(x, y, lens):
    """OpenCV's model, as its manual has it."""
    rr = x * x + y * y
    radial = 1 + lens.k1 * rr + lens.k2 * rr**2 + lens.k3 * rr**3
    return (
        x * radial + 2 * lens.p1 * x * y + lens.p2 * (rr + 2 * x * x),
        y * radial + lens.p1 * (rr + 2 * y * y) + 2 * lens.p2 * x * y,
    )


def directions(lens):
    """(height, width, 3), z = 1, of the pixels' middles, found by turning the model around step by step."""
    x1, y1 = np.meshgrid(
        (np.arange(SIZE[0]) + 0.5 - SIZE[0] / 2) / CAMERA.focal_px,
        (np.arange(SIZE[1]) + 0.5 - SIZE[1] / 2) / CAMERA.focal_px,
    )
    x, y = x1.copy(), y1.copy()
    for _ in range(200):
        at_x, at_y = bent(x, y, lens)
        x, y = x + (x1 - at_x), y + (y1 - at_y)
    return np.stack([x, y, np.ones_like(x)], axis=-1)


def projected(points, placed, lens):
    """Where points of the world, (..., 3), appear, px."""
    own = (
        turned(placed.q_world_from_camera).inv().apply((points - placed.camera_m).reshape(-1, 3)).reshape(points.shape)
    )
    x, y = bent(own[..., 0] / own[..., 2], own[..., 1] / own[..., 2], lens)
    return CAMERA.focal_px * np.stack([x, y], axis=-1)


def flow_by_moving_points(geometry, out, t_ns, lens=LENS, side_ns=2 * MS):
    """Take each pixel's point from its depth, fix it to its body, and see where it is before and after."""
    now, before, after = (geometry.places(t) for t in (t_ns, t_ns - side_ns, t_ns + side_ns))
    rays = turned(now.q_world_from_camera).apply(directions(lens).reshape(-1, 3)).reshape(*out.depth.shape, 3)
    flow = np.full(out.flow.shape, np.nan)
    for label in np.unique(out.labels):
        mask = out.labels == label
        if label == 0:
            ends = [projected(placed.camera_m + rays[mask], placed, lens) for placed in (before, after)]
        else:
            k = label - 1
            points = now.camera_m + rays[mask] * out.depth[mask][:, None].astype(float)
            fixed = turned(now.q_world_from_bodies[k]).inv().apply(points - now.bodies_m[k])
            ends = [
                projected(turned(p.q_world_from_bodies[k]).apply(fixed) + p.bodies_m[k], p, lens)
                for p in (before, after)
            ]
        flow[mask] = (ends[1] - ends[0]) / (2e-9 * side_ns)
    return flow


def assert_flow(flow, expected):
    assert np.abs(flow).max() > 5
    assert np.abs(flow - expected).max() < 2e-4 * np.abs(expected).max()


def test_a_plane_is_as_far_as_its_equation_says():
    normal, away = np.array([0.3, -0.2, -1.0]), 7.0  # n . P = -away
    columns, rows = np.meshgrid((-9.0, 9.0), (-9.0, 9.0))
    corners = np.stack([columns.ravel(), rows.ravel(), np.zeros(4)], axis=-1)
    corners[:, 2] = away + 0.3 * corners[:, 0] - 0.2 * corners[:, 1]
    surface = NearestSurface([(np.array([[0, 1, 2], [2, 1, 3]], np.int32), 4, True)], CAMERA, 1e-3)
    labels, inverse_depth = np.zeros(SIZE[::-1], np.uint16), np.zeros(SIZE[::-1])
    surface.look(corners, Rays.straight(CAMERA), labels, inverse_depth)
    expected = -away / (directions(LENS) @ normal)
    assert (labels == 1).all()
    assert np.abs(inverse_depth * expected - 1).max() < 1e-12


def test_a_nearer_surface_hides_and_one_that_reaches_behind_the_camera_is_cut():
    floor = np.array([[-50.0, 1.0, -5.0], [50.0, 1.0, -5.0], [0.0, 1.0, 400.0]])  # y = 1, below the boresight
    wall = np.array([[-50.0, -50.0, 20.0], [50.0, -50.0, 20.0], [0.0, 70.0, 20.0]])
    one = np.array([[0, 1, 2]], np.int32)
    surface = NearestSurface([(one, 3, True), (one, 3, True)], CAMERA, 1e-3)
    labels, inverse_depth = np.zeros(SIZE[::-1], np.uint16), np.zeros(SIZE[::-1])
    surface.look(np.concatenate([wall, floor]), Rays.straight(CAMERA), labels, inverse_depth)
    down = directions(LENS)[..., 1]
    is_floor = down > 1 / 20
    assert (labels == np.where(is_floor, 2, 1)).all()
    assert np.abs(inverse_depth - np.where(is_floor, down, 1 / 20)).max() < 1e-12


def test_a_ball_is_as_far_as_a_sphere():
    ball = BodyTable(shape="globe", path=FixedPath((0.1, 0.2, 5.0)))
    with RasterBodies(BodiesParameters(bodies=(ball,), detail_px=0.0), CAMERA) as scene:
        _, out = seen_by(scene, 0)
    rays, centre = directions(LENS), np.array([0.1, 0.2, 5.0])
    along, square = rays @ centre, (rays**2).sum(axis=-1)
    under = along**2 - square * (centre @ centre - 1)
    hit = under > 0.02  # beside the outline a facet's place is another than the sphere's
    mesh = load_mesh(find_shape("globe"), 1.0)
    middles = mesh.vertices[mesh.faces].mean(axis=1)
    deepest = 1 - np.linalg.norm(middles, axis=1).min()  # how far facets lie within the sphere
    off = out.depth[hit] - ((along - np.sqrt(np.maximum(under, 0))) / square)[hit]
    assert (out.labels[hit] == 1).all()
    assert (out.labels[under < -0.02] == 0).all()
    assert np.isinf(out.depth[out.labels == 0]).all()
    assert 0 < off.max() < 1.5 * deepest / np.sqrt(under[hit]).min()
    assert off.min() > -1e-6


@pytest.mark.parametrize("lens", [LENS, BENT], ids=["straight", "bent"])
@pytest.mark.parametrize("t_ns", [3 * MS, 1_700 * MS])
def test_flow_of_bodies_and_sky_is_that_of_their_points(lens, t_ns):
    with Through(lens, CAMERA_MODELS["davis346"].chip, SIZE, lambda pinhole: RasterBodies(BODIES, pinhole)) as scene:
        geometry, out = seen_by(scene, t_ns)
        assert geometry.names == ("bus", "target_panel", "far")
        assert set(np.unique(out.labels)) == {0, 1, 2, 3}
        assert_flow(out.flow, flow_by_moving_points(geometry, out, t_ns, lens))


def test_time_that_runs_faster_moves_points_faster():
    fast = dataclasses.replace(BODIES, time_scale=3.0)
    with RasterBodies(BODIES, CAMERA) as slow_scene, RasterBodies(fast, CAMERA) as fast_scene:
        _, slow = seen_by(slow_scene, 600 * MS)
        _, out = seen_by(fast_scene, 200 * MS)
    assert (slow.depth == out.depth).all()
    assert np.abs(out.flow - 3 * slow.flow).max() < 1e-4


def test_depth_behind_a_lens_is_that_of_the_bent_rays():
    """The plate is flat and large: its points must lie on its plane, wherever the lens shows them."""
    plate = BodyTable(shape="target_plate", units_m=20.0, path=FixedPath((0.0, 0.0, 30.0)))
    scene_of = BodiesParameters(bodies=(plate,))
    with Through(BENT, CAMERA_MODELS["davis346"].chip, SIZE, lambda pinhole: RasterBodies(scene_of, pinhole)) as scene:
        geometry, out = seen_by(scene, 0)
    mesh = load_mesh(find_shape("target_plate"), 20.0)
    facing = mesh.vertices[:, 2].min() + 30.0
    assert (out.labels == 1).sum() > 300
    on_face = np.isclose(out.depth, facing, rtol=1e-5)
    assert on_face[out.labels == 1].mean() > 0.98  # the others are its sides
    assert geometry.places(0).bodies_m.tolist() == [[0.0, 0.0, 30.0]]


RIDGE = Ridge(size_m=1024.0, finest_m=2.0, posts=128, ridge_m=100.0, seed=4)
GATES = (Gate(0.0, 400.0, 0.0, 10.0, 50.0), Gate(60.0, 30.0, 0.0, 3.0, 80.0), Gate(70.0, 8.0))


@pytest.mark.parametrize("t_ns", [2_000 * MS, 40_000 * MS])
def test_points_of_terrain_lie_on_the_ground_and_move_with_it(t_ns, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    parameters = TerrainParameters(ground=RIDGE, camera=DescentPath(GATES), sun_elevation_deg=20.0)
    with RasterTerrain(parameters, CAMERA) as scene:
        light = np.zeros(SIZE[::-1], np.float32)
        scene.light(t_ns, light)
        geometry, out = seen_by(scene, t_ns)
        ground = scene._world.ground
    placed, hit = geometry.places(t_ns), out.labels == 1
    assert hit.mean() > 0.4
    rays = turned(placed.q_world_from_camera).apply(directions(LENS)[hit])
    points = placed.camera_m + rays * out.depth[hit][:, None]
    above = np.array([z - ground.height_m(x, y) for x, y, z in points])
    footprint_m = out.depth[hit] / CAMERA.focal_px
    assert np.abs(np.median(above)) < 0.1 * np.median(footprint_m)
    assert np.quantile(np.abs(above) / footprint_m, 0.95) < 1.0  # facets are some pixels wide
    assert np.abs(out.flow - flow_by_moving_points(geometry, out, t_ns)).max() < 2e-4 * np.abs(out.flow).max()


def test_terrain_that_was_not_drawn_at_that_time_is_drawn_for_it(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    parameters = TerrainParameters(ground=RIDGE, camera=DescentPath(GATES), sun_elevation_deg=20.0)
    light = np.zeros(SIZE[::-1], np.float32)
    with RasterTerrain(parameters, CAMERA) as scene:
        scene.light(30_000 * MS, light)
        _, first = seen_by(scene, 40_000 * MS)
        scene.light(40_000 * MS, light)
        _, second = seen_by(scene, 40_000 * MS)
    assert (first.depth == second.depth).all()


SKY = StarsParameters(
    camera=SpinPath((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), tilt_deg=-90.0, precession_deg_s=-3.0),
    points=(MovingPoint(KeyframePath((Keyframe(0.0, (-200.0, 1900.0, -50.0)), Keyframe(9.0, (300.0, 1800.0, 20.0))))),),
)


@pytest.mark.parametrize("lens", [LENS, BENT], ids=["straight", "bent"])
def test_the_sky_turns_and_a_point_in_it_moves(lens):
    with StarField(SKY, SIZE, lens, CAMERA_MODELS["davis346"].chip) as scene:
        geometry, out = seen_by(scene, 900 * MS)
        assert_flow(out.flow, flow_by_moving_points(geometry, out, 900 * MS, lens))
        light = np.zeros(SIZE[::-1], np.float32)
        bare = np.zeros_like(light)
        scene.light(900 * MS, light)
    with StarField(dataclasses.replace(SKY, points=()), SIZE, lens, CAMERA_MODELS["davis346"].chip) as empty:
        empty.light(900 * MS, bare)
    brightest = np.unravel_index(np.argmax(light - bare), light.shape)
    assert out.labels[brightest] == 1
    assert 1 < (out.labels == 1).sum() < 40
    distance = np.linalg.norm(geometry.places(900 * MS).bodies_m[0] - geometry.places(900 * MS).camera_m)
    assert abs(out.depth[brightest] / distance - 1) < 0.1
    assert np.isinf(out.depth[out.labels == 0]).all()


@pytest.mark.parametrize("direction_deg", [0.0, 90.0, 180.0])
def test_the_board_is_where_its_flow_takes_it(direction_deg):
    board = CheckerboardParameters(square_px=11.0, speed_px_s=100.0, direction_deg=direction_deg)
    first, later = np.zeros(SIZE[::-1], np.float32), np.zeros(SIZE[::-1], np.float32)
    with Checkerboard(board, SIZE) as scene:
        geometry, out = seen_by(scene, 0)
        scene.light(0, first)
        scene.light(50 * MS, later)
    assert geometry.gives == {"flow", "labels"}
    right, down = (round(float(v) * 0.05) for v in out.flow[3, 4])
    assert abs(right) + abs(down) == 5
    assert np.allclose(np.roll(first, (down, right), axis=(0, 1))[8:-8, 8:-8], later[8:-8, 8:-8], atol=1e-5)
