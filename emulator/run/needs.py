"""What a rig needs of the machine, beyond evstim and its base dependencies."""

from __future__ import annotations

from emulator.gl.painter import selected_painter
from emulator.rig.link_kinds import LINKS
from emulator.rig.loading import Rig
from emulator.rig.scene_kinds import SCENES
from emulator.run.machine import egl
from transports.needs import Need

__all__ = ["GL", "needs_of"]

GL = Need("OpenGL 4.3 by EGL", egl)
"""What the GL painter, and pixels as a compute shader, draw with."""


def needs_of(rig: Rig) -> tuple[Need, ...]:
    """Return what the scene, the links and the painter of a rig need, each once."""
    scene = SCENES[rig.scene.kind]
    found = [*scene.needs(rig.scene), *(need for link in rig.links for need in LINKS[link.kind].needs(link))]
    if rig.run.pixels == "gpu" or (scene.gl and selected_painter(rig.run.painter) == "gl"):
        found.append(GL)
    return tuple({need.name: need for need in found}.values())
