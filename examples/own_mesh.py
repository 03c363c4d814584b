"""Point the camera at your own mesh: `python own_mesh.py [MESH] [SECONDS]`.

MESH is a file in metres that trimesh reads: .obj, .stl, .ply, .off, .glb, ... A rig may also name .tab, .bds and USD
files. Without MESH, a box with two panels is made here. The script writes a rig file beside the mesh, runs it and
counts the events; the same file works with `evstim run`, `evstim plan` and `evstim picture`. To serve the camera on
USB/IP, replace "loopback" by "usbip".
"""

from __future__ import annotations

import sys
from pathlib import Path

import trimesh

import evstim

__all__ = ["main"]

RIG = """\
title = "My mesh, turning in sunlight"

[scene]
kind = "bodies"

[scene.sun]
direction = [-0.5, -0.4, -0.75]  # towards the Sun

[scene.camera]
kind = "fixed"
position_m = [0.0, 0.0, {distance_m}]  # looks along +z of the world

[[scene.bodies]]
shape = "{mesh}"
smooth = false  # flat facets
[scene.bodies.path]
kind = "spin"
pole = [0.0, -1.0, 0.0]
spin_deg_s = 30.0
[scene.bodies.reflectance]
kind = "lambert"

[camera]
model = "davis346"
[camera.lens]
field_of_view_deg = 20.0

[run]
step_us = 2000
seed = 1

[[links]]
kind = "loopback"
"""


def spacecraft(path: Path) -> None:
    """Write a box of 2 m with two panels of 3 m."""
    box = trimesh.creation.box((2.0, 1.5, 1.5))
    panels = [trimesh.creation.box((3.0, 1.0, 0.05)).apply_translation((side * 2.6, 0.0, 0.0)) for side in (-1, 1)]
    trimesh.util.concatenate([box, *panels]).export(path)  # type: ignore[no-untyped-call]


def main(mesh: str | None = None, seconds: str = "0.5") -> int:
    """Write the rig and run it; return the number of events that the sensor read out."""
    path = Path(mesh or "spacecraft.obj")
    if mesh is None:
        spacecraft(path)
    size_m = float(trimesh.load_mesh(path).scale) / 2  # half the diagonal of its box
    rig = path.with_suffix(".toml")
    rig.write_text(RIG.format(mesh=path.name, distance_m=-7.0 * size_m))
    with evstim.run(rig, seconds=float(seconds), pace="free") as run:
        count = sum(len(events) for events in run)
    assert run.result.good
    print(f"{count} events of {rig}; look at it with: evstim picture {rig} look.png")
    return count


if __name__ == "__main__":
    main(*sys.argv[1:])
