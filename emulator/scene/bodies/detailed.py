"""A shape model with what its rig makes up on it, as fine as the camera sees it at its closest."""

from __future__ import annotations

from emulator.scene.bodies.clouds import clouded
from emulator.scene.bodies.detail_table import Clouds, Detail, Regolith
from emulator.scene.bodies.mesh import Mesh
from emulator.scene.bodies.regolith import weathered

__all__ = ["detailed"]


def detailed(mesh: Mesh, detail: Detail, pixel_m: float) -> Mesh:
    """Return the mesh with `detail`, for a camera whose pixel spans `pixel_m` on the body at its closest."""
    match detail:
        case Regolith():
            return weathered(mesh, detail, pixel_m)
        case Clouds():
            return clouded(mesh, detail, detail.facet_px * pixel_m)
    return mesh
