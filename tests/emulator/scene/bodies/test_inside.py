"""A camera inside a body: where that is, and that it is reported once, whatever gives the poses."""

import logging

import numpy as np
import pytest

import evstim
from emulator.scene.bodies.mesh import build_mesh, find_shape, load_mesh
from emulator.scene.bodies.world import enclosure

ATTITUDE = (1.0, 0.0, 0.0, 0.0)

RIG = """
[scene]
kind = "bodies"
camera = {kind = "PATH", position_m = [0.0, 0.0, -4.0] EXTRA}
[[scene.bodies]]
name = "ball"
shape = "globe"
path = {kind = "fixed", position_m = [0.0, 0.0, 1.0], q_world_from_body = [0.0, 1.0, 0.0, 0.0]}
[[scene.bodies]]
name = "moon"
shape = "globe"
units_m = 0.3
fixed_to = "ball"
path = {kind = "fixed", position_m = [1.4, 0.5, 0.0], q_world_from_body = [0.0, 0.0, 1.0, 0.0]}
[camera]
sensor = {width = 32, height = 24}
[camera.lens]
field_of_view_deg = 40.0
"""


def rig_of(path="fixed", extra=""):
    return evstim.parse_rig(RIG.replace("PATH", path).replace("EXTRA", extra), "a.toml", "a")


@pytest.mark.parametrize("shape", ["eros022540", "itokawa_49152", "target_bus", "globe"])
def test_places_inside_and_outside(shape):
    """Along rays from the middle: inside up to the surface, which is no nearer than the distance that is returned."""
    mesh = load_mesh(find_shape(shape), 1.0)
    step = len(mesh.vertices) // 4
    for vertex in mesh.vertices[::step]:
        for share, expected in ((0.0, True), (0.6, True), (0.97, True), (1.03, False), (1.6, False)):
            is_inside, way_m = enclosure(mesh, share * vertex)
            if shape in ("globe", "target_bus"):  # star-shaped: each ray leaves once
                assert is_inside is expected
            if share > 1.5:
                assert not is_inside
            assert way_m <= np.linalg.norm(mesh.vertices - share * vertex, axis=1).min()


def test_an_open_box_encloses_the_places_below_its_rim():
    points = [[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
    sides = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6]]
    cup = build_mesh(points, [*sides, [0, 2, 6], [0, 6, 4]])
    assert cup.open_edges == 4
    assert enclosure(cup, np.array([0.0, 0.0, -0.5]))[0]
    assert not enclosure(cup, np.array([0.0, 0.0, 2.0]))[0]


def flown(rig, caplog, places):
    with caplog.at_level(logging.WARNING), evstim.Simulation(rig) as sim:
        for place in places:
            sim.step(10_000, camera=evstim.Pose(np.array(place), np.array(ATTITUDE)))
    return sim.result.scene_counts


def test_a_program_that_flies_into_a_body_is_warned_once(caplog):
    """The moon turns with the ball: in the world it is at (1.4, -0.5, 1)."""
    counts = flown(rig_of(), caplog, [(0, 0, -1.9), (0, 0, 0.5), (0, 0, 1.0), (0, 0, 3), (1.4, -0.5, 1.0), (0, 0, 1.0)])
    ball, moon = (record.getMessage() for record in caplog.records)
    assert ball.startswith("at 0.018 s the camera is inside the body ball: it is at (0, 0, 0.02) m, 0.98 m from its")
    assert "inside the body moon" in moon
    assert set(counts) == {"light frames from inside ball", "light frames from inside moon"}
    assert counts["light frames from inside ball"] > 20


def test_outside_nothing_is_said(caplog):
    assert flown(rig_of(), caplog, [(0, 0, -2), (0.99, 0.99, 1.0), (1.4, 0.5, 1.0), (3, 0, 1)]) == {}
    assert caplog.records == []


def test_poses_from_the_network(caplog):
    """As they come; until the first one, those of the rig."""
    rig = rig_of("live", ", port = 0")
    with caplog.at_level(logging.WARNING), evstim.build_scene(rig) as scene:
        light = np.zeros((24, 32), np.float32)
        scene.light(0, light)
        world = scene.scene._world
        world.camera._first = evstim.Pose([0.0, 0.0, 1.2], ATTITUDE)
        for t_ns in (1_000_000, 1_000_000, 2_000_000):
            scene.light(t_ns, light)
        assert scene.counts["light frames from inside ball"] == 2
    assert len(caplog.records) == 1
