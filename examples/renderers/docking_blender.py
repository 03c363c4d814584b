"""Blender as the renderer of an emulated camera: the animation of a .blend file, or of a station built here.

    pip install bpy                             Blender as a module: one Python fits each version; GPL
    evstim run docking.toml                     in one terminal
    python docking_blender.py                   in another one; or with --blend FILE

Cycles draws the scene of the file through its active camera, which gets the field of view of the rig. Light is the
luminance of the combined pass, before any view transform: the strength of a Sun is its irradiance, so a file in W/m2
gives W/(m2 sr). The vector pass has two differences for each visible point, in px to the right and up: the place one
frame before less the present one, and the present one less that one frame after. Motion is the mean of both.
Stream time 0 is the first frame.
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from evstim.renderer import Camera, Image, Images, Renderer

# Blender's own packages stand in a folder of their own.
sys.path.append(f"{bpy.utils.resource_path('LOCAL')}/python/lib/python3.{sys.version_info.minor}/site-packages")
import OpenImageIO as oiio

SAMPLES = 16
WHITE_W_M2_SR = 300.0  # as scene.white_w_m2_sr in docking.toml
LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)  # of linear Rec. 709 (ITU-R BT.709-6)
SUN_W_M2 = 1361.0
FRAMES_PER_S = 100
APPROACH_M_S, ROLL_RAD_S, SECONDS = 0.25, 0.12, 20


class Animation:
    """The open scene of Blender, drawn for a camera of evstim's."""

    def __init__(self, camera: Camera) -> None:
        self.scene = bpy.context.scene
        if self.scene.camera is None:
            raise ValueError("the scene of the file has no active camera: set one in Blender, and save the file")
        self.shape = camera.height, camera.width
        self.frames_per_s = self.scene.render.fps / self.scene.render.fps_base
        self.folder = tempfile.TemporaryDirectory(prefix="evstim-blender-")
        self.file = Path(self.folder.name) / "image.exr"
        self._look_through(camera)
        self._draw_linear_light()

    def draw(self, image: Image) -> None:
        """Fill an image of its time."""
        frame = self.scene.frame_start + image.t_ns * 1e-9 * self.frames_per_s
        self.scene.frame_set(math.floor(frame), subframe=frame % 1)
        bpy.ops.render.render(write_still=True)
        passes = self._passes()
        image.light[:] = np.maximum(passes["Combined"][..., :3] @ LUMINANCE, 0) / WHITE_W_M2_SR
        image.motion[:] = self.motion_px_s(passes["Vector"])

    def motion_px_s(self, vector: np.ndarray) -> np.ndarray:
        """Return the motion to the right and down of the vector pass, (height, width, 4)."""
        up = -(vector[..., :2] + vector[..., 2:]) / 2 * self.frames_per_s
        return up * [1, -1]

    def _look_through(self, camera: Camera) -> None:
        render, lens = self.scene.render, self.scene.camera.data
        render.resolution_x, render.resolution_y, render.resolution_percentage = camera.width, camera.height, 100
        render.pixel_aspect_x = render.pixel_aspect_y = 1.0
        lens.type, lens.sensor_fit, lens.shift_x, lens.shift_y = "PERSP", "VERTICAL", 0.0, 0.0
        lens.angle = math.radians(camera.vertical_field_deg)

    def _draw_linear_light(self) -> None:
        """Set Cycles: equal samples in each image, the mean over each pixel, and motion instead of its blur."""
        render, cycles = self.scene.render, self.scene.cycles
        render.engine, render.use_motion_blur, render.use_persistent_data = "CYCLES", False, True
        render.use_compositing = render.use_sequencer = False
        cycles.samples, cycles.seed, cycles.pixel_filter_type = SAMPLES, 0, "BOX"
        cycles.use_denoising = cycles.use_adaptive_sampling = cycles.use_animated_seed = False
        for layer in self.scene.view_layers:
            layer.use = layer == self.scene.view_layers[0]
            layer.use_pass_vector = True
        picture = render.image_settings
        if hasattr(picture, "media_type"):  # since Blender 5.0
            picture.media_type = "MULTI_LAYER_IMAGE"
        picture.file_format, picture.color_depth, picture.exr_codec = "OPEN_EXR_MULTILAYER", "32", "NONE"
        render.filepath, render.use_file_extension = str(self.file), False

    def _passes(self) -> dict[str, np.ndarray]:
        """Return the passes of the drawn image by name, (height, width, channels) float32."""
        file = oiio.ImageInput.open(str(self.file))
        passes: dict[str, Any] = {}
        part = 0
        while file.seek_subimage(part, 0):
            values = np.asarray(file.read_image("float")).reshape(*self.shape, -1)
            for channel, name in enumerate(file.spec().channelnames):
                passes.setdefault(name.split(".")[-2], []).append(values[..., channel])
            part += 1
        file.close()
        return {name: np.stack(channels, axis=2) for name, channels in passes.items()}


def station() -> None:
    """Build a station that rolls, and a camera that comes nearer; Blender's units are m."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.fps, scene.frame_start, scene.frame_end = FRAMES_PER_S, 1, 1 + SECONDS * FRAMES_PER_S
    mesh = bpy.ops.mesh
    body = bpy.data.objects.new("station", None)
    scene.collection.objects.link(body)
    white, gold, blue, grey = (0.8, 0.8, 0.78), (0.7, 0.45, 0.12), (0.03, 0.04, 0.12), (0.25, 0.25, 0.25)
    mesh.primitive_cylinder_add(vertices=48, radius=1.0, depth=3.0, location=(0, 1.7, 0), rotation=(math.pi / 2, 0, 0))
    _finish(body, white)
    mesh.primitive_torus_add(major_radius=0.5, minor_radius=0.08, location=(0, 0.15, 0), rotation=(math.pi / 2, 0, 0))
    _finish(body, grey, metallic=1.0)
    for side in (-1, 1):
        for panel in range(3):
            mesh.primitive_cube_add(size=1, location=(side * (1.8 + 1.25 * panel), 1.6, 0))
            bpy.context.object.scale = 1.2, 0.05, 1.6
            _finish(body, blue)
        mesh.primitive_cube_add(size=0.4, location=(0.5 * side, 0.15, 0.7 * side))
        _finish(body, gold, metallic=0.6)
    _animate(body, "rotation_euler", 1, (0.0, ROLL_RAD_S * SECONDS))
    eye = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    eye.rotation_euler, eye.location = (math.pi / 2, 0, 0), (0.1, -12, 0.1)
    _animate(eye, "location", 1, (-12.0, -12.0 + APPROACH_M_S * SECONDS))
    sun = bpy.data.objects.new("Sun", bpy.data.lights.new("Sun", "SUN"))
    sun.data.energy, sun.data.angle = SUN_W_M2, 0.0  # soft shadows and bounces are noisy, and noise makes events
    scene.cycles.max_bounces = 0
    sun.rotation_euler = math.radians(60), 0, math.radians(35)
    for thing in (eye, sun):
        scene.collection.objects.link(thing)
    scene.camera = eye


def _finish(body: Any, colour: tuple[float, float, float], metallic: float = 0.0) -> None:
    """Give the object that was made last its material, and join it to the body."""
    material = bpy.data.materials.new("surface")
    material.use_nodes = True
    values = material.node_tree.nodes["Principled BSDF"].inputs
    values["Base Color"].default_value = (*colour, 1.0)
    values["Metallic"].default_value, values["Roughness"].default_value = metallic, 0.6
    bpy.context.object.data.materials.append(material)
    bpy.context.object.parent = body


def _animate(thing: Any, path: str, axis: int, ends: tuple[float, float]) -> None:
    """Move from one end to the other at a constant speed, and further at the same speed."""
    for second, value in zip((0, SECONDS), ends, strict=True):
        getattr(thing, path)[axis] = value
        thing.keyframe_insert(path, index=axis, frame=1 + second * FRAMES_PER_S)
    for layer in thing.animation_data.action.layers:
        for curve in layer.strips[0].channelbags[0].fcurves:
            curve.extrapolation = "LINEAR"
            for point in curve.keyframe_points:
                point.interpolation = "LINEAR"


def main() -> None:
    """Draw what evstim requests, until it ends."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("address", nargs="?", default="127.0.0.1:5560")
    parser.add_argument("--blend", type=Path, help="file to draw instead of the station")
    arguments = parser.parse_args()
    if arguments.blend:
        bpy.ops.wm.open_mainfile(filepath=str(arguments.blend), load_ui=False, use_scripts=False)
    else:
        station()
    with Renderer(arguments.address, Images(motion=True), name=f"Blender {bpy.app.version_string}", wait_s=600) as link:
        animation = Animation(link.camera)
        for image in link:
            animation.draw(image)
            image.send()


if __name__ == "__main__":
    main()
