"""Renderers of others feed an unmodified driver: MuJoCo, Mitsuba and Blender draw, dv-processing reads every event.

Each renderer has an environment of its own, as a user would have, and of evstim only the file evstim/renderer.py.
"""

import functools
import os
import subprocess
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from tests.firmware_protocol.ground.own_environments import python_with
from tests.free_ports import free_port
from tests.guest.attachment import Attachment
from tests.guest.environments import DRIVERS
from tests.guest.running_rig import RunningRig
from tests.guest.streaming import read
from tests.guest.test_drivers import assert_sees

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples" / "renderers"
EVENTS = 15_000
TIMEOUT_S = 600.0  # a light frame of Mitsuba takes seconds on a busy machine

pytestmark = [pytest.mark.guest, pytest.mark.socket, pytest.mark.timeout(1800)]
BLENDER = "bpy>=4.4,<6"
SQUARE = """
import math, sys
from types import SimpleNamespace
import bpy, numpy as np
import docking_blender as example
bpy.ops.wm.read_factory_settings(use_empty=True)
scene = bpy.context.scene
scene.render.fps = 50
bpy.ops.mesh.primitive_plane_add(size=1, rotation=(math.pi / 2, 0, 0))
square = bpy.context.object
example._finish(None, (0.5, 0.5, 0.5))
values = square.data.materials[0].node_tree.nodes["Principled BSDF"].inputs
values["Roughness"].default_value, values["Specular IOR Level"].default_value = 1.0, 0.0
example.FRAMES_PER_S = 50
for axis, speed_m_s in ((0, 1.0), (2, 0.5)):
    example._animate(square, "location", axis, (-speed_m_s, speed_m_s * (example.SECONDS - 1)))
camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
camera.location, camera.rotation_euler = (0, -6, 0), (math.pi / 2, 0, 0)
sun = bpy.data.objects.new("Sun", bpy.data.lights.new("Sun", "SUN"))
sun.data.energy, sun.data.angle, sun.rotation_euler = 1361.0, 0.0, (math.radians(50), 0, 0)
for thing in (camera, sun):
    scene.collection.objects.link(thing)
scene.camera = camera
animation = example.Animation(SimpleNamespace(width=160, height=120, vertical_field_deg=30.0))
image = SimpleNamespace(t_ns=1_107_000_000, light=np.zeros((120, 160)), motion=np.zeros((120, 160, 2)))
animation.draw(image)
np.savez(sys.argv[1], light=image.light, motion=image.motion)
"""


@pytest.fixture(scope="module")
def renderer_python(tmp_path_factory):
    """Python with a renderer's package, made once for the tests of this module."""

    @functools.cache
    def python_of(package):
        variable = f"EVSTIM_{package.split('>')[0].upper()}_PYTHON"
        return python_with(package, variable, tmp_path_factory.mktemp("renderer") / "venv")

    return python_of


@contextmanager
def drawing(python, program, port):
    """Run an example beside the block; it connects as soon as evstim listens."""
    environment = os.environ | {"PYTHONPATH": str(ROOT), "PYTHONDONTWRITEBYTECODE": "1"}
    with subprocess.Popen([python, EXAMPLES / program, f"127.0.0.1:{port}"], env=environment) as process:
        try:
            yield
        finally:
            process.kill()


@pytest.mark.long
@pytest.mark.parametrize(
    ("rig", "program", "package"),
    [
        ("tumbling.toml", "tumbling_mujoco.py", "mujoco>=3.2,<4 numpy"),
        ("orbit.toml", "orbit_mitsuba.py", "mitsuba>=3.5,<4 numpy"),
        ("docking.toml", "docking_blender.py", BLENDER),
    ],
)
def test_a_driver_reads_every_event_of_a_renderer(
    guest, driver_pythons, renderer_python, tmp_path, rig, program, package
):
    python = renderer_python(package)
    driver, scene_port = DRIVERS[0], free_port()
    text = (EXAMPLES / rig).read_text().replace("port = 5560", f"port = {scene_port}") + "port = {port}\n"
    with drawing(python, program, scene_port), RunningRig(tmp_path, text=text) as run, Attachment(guest, run.port):
        seen = read(guest, driver, driver_pythons[driver.name], EVENTS, timeout_s=TIMEOUT_S)
    assert_sees(driver, seen.events, run.delivered.last)
    assert run.summary["scene"]["images"] > 1, run.summary


@pytest.mark.long
def test_light_and_motion_of_blender_are_those_of_the_closed_form(renderer_python, tmp_path):
    """A diffuse square of 1 m, 6 m away, moves at 1 m/s to the right and 0.5 m/s up, between two frames."""
    environment = os.environ | {"PYTHONPATH": f"{ROOT}:{EXAMPLES}", "PYTHONDONTWRITEBYTECODE": "1"}
    command = [renderer_python(BLENDER), "-c", SQUARE, tmp_path / "drawn.npz"]
    subprocess.run(command, env=environment, check=True, timeout=TIMEOUT_S)
    drawn = np.load(tmp_path / "drawn.npz")
    focal_px = 60 / np.tan(np.radians(15))
    inside = drawn["light"] > 0.9 * drawn["light"].max()
    rows, columns = np.mgrid[:120, :160] + 0.5
    place = [np.average(at[drawn["light"] > 0], weights=drawn["light"][drawn["light"] > 0]) for at in (columns, rows)]
    np.testing.assert_allclose(place, [80 + focal_px * 0.107 / 6, 60 - focal_px * 0.0535 / 6], atol=0.05)
    np.testing.assert_allclose(
        drawn["motion"][inside], np.tile([focal_px / 6, -focal_px / 12], (inside.sum(), 1)), rtol=2e-3
    )
    radiance = 0.5 * 1361 / np.pi * np.sin(np.radians(50))
    np.testing.assert_allclose(drawn["light"][inside], radiance / 300, rtol=1e-3)
    assert not drawn["motion"][drawn["light"] == 0].any()
