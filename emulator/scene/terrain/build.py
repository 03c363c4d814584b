"""Choice of what draws terrain: a graphics card where there is one, else the CPU (see `gl.card`)."""

from __future__ import annotations

from emulator.geometry.pinhole import Pinhole
from emulator.gl.card import draws_on_a_card
from emulator.light import Scene
from emulator.scene.terrain.raster_terrain import RasterTerrain
from emulator.scene.terrain.table import TerrainParameters
from emulator.threads import available_threads

__all__ = ["build_terrain"]


def build_terrain(parameters: TerrainParameters, pinhole: Pinhole) -> Scene:
    """Return the terrain of `parameters` before `pinhole`; raises SceneError."""
    if draws_on_a_card():
        from emulator.scene.terrain.gl_terrain import GlTerrain

        return GlTerrain(parameters, pinhole)
    return RasterTerrain(parameters, pinhole, threads=available_threads())
