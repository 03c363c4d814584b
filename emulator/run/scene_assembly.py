"""From a rig to its scene.

Scenes in units of radiance are seen through the camera's lens; the others bring their own light, relative to the
sensor's reference. What builds a scene is imported only for a rig that has one of its kind.
"""

from __future__ import annotations

from functools import partial

from emulator.gl.painter import selected_painter
from emulator.light import Scene
from emulator.optics.through import Through
from emulator.rig.camera_models import CAMERA_MODELS
from emulator.rig.loading import Rig
from emulator.rig.scene_kinds import SCENES
from emulator.tables.registry import imported

__all__ = ["build_scene"]


def build_scene(rig: Rig, size: tuple[int, int] | None = None) -> Scene:
    """Return the rig's scene at `size` = (width, height) pixels, by default its camera's; raises SceneError."""
    size = size or rig.camera.size
    kind, lens, chip = SCENES[rig.scene.kind], rig.camera.lens, CAMERA_MODELS[rig.camera.model].chip
    drawn_by_gl = kind.gl and selected_painter(rig.run.painter) == "gl"
    build = partial(imported(kind.gl if drawn_by_gl else kind.build), rig.scene)
    if kind.lens == "applied":
        return Through(lens, chip, size, build)
    scene: Scene = build(size, lens, chip) if kind.lens == "own" else build(size)
    return scene
