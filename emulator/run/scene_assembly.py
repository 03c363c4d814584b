"""From a rig to its scene.

Scenes in units of radiance are seen through the camera's lens; the others bring their own light, relative to the
sensor's reference. What needs a GL library is imported only for a scene that draws with it.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from emulator.geometry.pinhole import Pinhole
from emulator.light import Scene
from emulator.optics.lens import CHIPS
from emulator.optics.through import Through
from emulator.playback.recording import RecordingParameters
from emulator.rig.loading import Rig
from emulator.scene.blank import Blank
from emulator.scene.bodies.table import BodiesParameters
from emulator.scene.checkerboard.checkerboard import Checkerboard
from emulator.scene.checkerboard.table import CheckerboardParameters
from emulator.scene.stars.stars import StarField
from emulator.scene.stars.table import StarsParameters
from emulator.scene.terrain.table import TerrainParameters
from emulator.scene.video.video import Video, VideoParameters

__all__ = ["build_scene"]


def build_scene(rig: Rig, size: tuple[int, int] | None = None) -> Scene:
    """Return the rig's scene at `size` = (width, height) pixels, by default its camera's; raises SceneError."""
    size = size or rig.camera.size
    match rig.scene:
        case CheckerboardParameters() as p:
            return Checkerboard(p, size)
        case RecordingParameters():
            return Blank(size)
        case VideoParameters() as p:
            return Video(p, size)
        case BodiesParameters() as p:
            from emulator.scene.bodies.build import build_bodies

            return _through_lens(rig, size, partial(build_bodies, p))
        case TerrainParameters() as p:
            from emulator.scene.terrain.terrain import Terrain

            return _through_lens(rig, size, partial(Terrain, p))
        case StarsParameters() as p:
            return StarField(p, size, rig.camera.lens, CHIPS[rig.camera.model])


def _through_lens(rig: Rig, size: tuple[int, int], build: Callable[[Pinhole], Scene]) -> Scene:
    """Return the scene that `build` makes for a pinhole, through the rig's lens."""
    return Through(rig.camera.lens, CHIPS[rig.camera.model], size, build)
