"""Makes the parts of the rendezvous target in emulator/scene/bodies/shapes/, from simple solids.

    python docs/make_target_spacecraft.py

Axes of every part: +z out of the docking face, metres. The parts are shapes of their own because each has its own
surface: multilayer insulation, solar cells, bare metal, black and white paint.

    target_bus.obj       a box of 1.6 x 1.6 x 2.2 m wrapped in crinkled foil, an engine's nozzle at its back
    target_panel.obj     a solar panel, 3.6 x 1.4 m, its hinge at the origin, reaching along +x
    target_ring.obj      the docking ring, 1.2 m across
    target_plate.obj     the marker's black plate, 0.5 m
    target_marks.obj     its white cross, standing 0.12 m before the plate, and four dots
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh

SHAPES = Path(__file__).parent.parent / "emulator/scene/bodies/shapes"
CRINKLE_M = 0.012


def crinkled(box: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return a box whose faces are foil: subdivided, each vertex pushed in or out, the edges left where they are."""
    foil = box.subdivide().subdivide().subdivide()
    half = np.abs(foil.vertices).max(axis=0)
    on = np.isclose(np.abs(foil.vertices), half)
    inside = on.sum(axis=1) == 1
    push = np.random.default_rng(346).normal(0, CRINKLE_M, len(foil.vertices)) * inside
    foil.vertices = foil.vertices + push[:, None] * on * np.sign(foil.vertices)
    return foil


def at(mesh: trimesh.Trimesh, x: float, y: float, z: float) -> trimesh.Trimesh:
    """Return the mesh moved."""
    return mesh.apply_translation((x, y, z))


def parts() -> dict[str, trimesh.Trimesh]:
    """Return the meshes by name."""
    nozzle = at(trimesh.creation.cone(0.45, 0.7, sections=24), 0, 0, -1.75)
    dots = [
        at(trimesh.creation.cylinder(0.035, 0.01, sections=16), x, y, 1.215)
        for x in (-0.19, 0.19)
        for y in (-0.19, 0.19)
    ]
    cross = [at(trimesh.creation.box(size), 0, 0, 1.33) for size in ((0.2, 0.03, 0.02), (0.03, 0.2, 0.02))]
    return {
        "target_bus": trimesh.util.concatenate([crinkled(trimesh.creation.box((1.6, 1.6, 2.2))), nozzle]),
        "target_panel": at(trimesh.creation.box((3.6, 1.4, 0.04)), 1.95, 0, 0),
        "target_ring": at(trimesh.creation.annulus(0.52, 0.6, 0.12, sections=48), 0, 0, 1.18),
        "target_plate": at(trimesh.creation.box((0.5, 0.5, 0.02)), 0, 0, 1.2),
        "target_marks": trimesh.util.concatenate([*cross, *dots]),
    }


def main() -> None:
    """Write every part."""
    for name, mesh in parts().items():
        text = trimesh.exchange.obj.export_obj(mesh, include_normals=False, digits=4, header=None)
        (SHAPES / f"{name}.obj").write_text(text)


if __name__ == "__main__":
    main()
