"""Choice of what draws bodies: a graphics card where there is one, else the CPU (see `gl.card`)."""

from __future__ import annotations

from emulator.geometry.pinhole import Pinhole
from emulator.gl.card import draws_on_a_card
from emulator.light import Scene
from emulator.scene.bodies.raster_bodies import RasterBodies
from emulator.scene.bodies.table import BodiesParameters
from emulator.threads import available_threads

__all__ = ["build_bodies"]

_THREADS_FROM_PX = 50_000  # smaller pictures are drawn sooner than a second thread is awake


def build_bodies(parameters: BodiesParameters, pinhole: Pinhole) -> Scene:
    """Return the bodies of `parameters` before `pinhole`; raises SceneError."""
    if draws_on_a_card():
        from emulator.scene.bodies.gl_bodies import GlBodies

        return GlBodies(parameters, pinhole)
    large = pinhole.width * pinhole.height >= _THREADS_FROM_PX
    return RasterBodies(parameters, pinhole, threads=available_threads() if large else 1)
