"""Make the parts of the rendezvous target in emulator/scene/bodies/shapes/, from simple solids, and a globe.

    python docs/make_target_spacecraft.py

Axes of every part: +z out of the docking face, metres. The parts are shapes of their own because each has its own
surface: multilayer insulation, solar cells, bare metal, black and white paint. Materials `albedo_A` give the
brightness of facets relative to the rest of their part.

    target_bus.obj       a box of 1.6 x 1.6 x 2.2 m wrapped in crinkled foil, an engine's nozzle at its back
    target_panel.obj     a solar panel, 3.6 x 1.4 m, its hinge at the origin, reaching along +x, 8 x 4 cells on both
                         sides: cells of unlike brightness, bare gaps between them, and a bus bar along each cell
    target_ring.obj      the docking ring, 1.2 m across
    target_plate.obj     the marker's black plate, 0.5 m
    target_marks.obj     its white cross, standing 0.12 m before the plate, and four dots
    globe.obj            a ball of radius 1, for planets
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt
import trimesh
from scipy.spatial import Delaunay

SHAPES = Path(__file__).parent.parent / "emulator/scene/bodies/shapes"
BOX_M = (1.6, 1.6, 2.2)
CRINKLE_M, CREASE_M, BILLOW_M = 0.015, 0.27, 0.02  # rms height of creases, distance between them, height of cushions
PANEL_M, PANEL_X_M, THICK_M = (3.6, 1.4), 0.15, 0.04
CELLS, GAP_M, BAR_M = (8, 4), 0.012, 0.008
BARE, UNLIKE = 3.0, 0.12  # brightness of gaps and bars beside cells, and rms unlikeness of cells

Floats = npt.NDArray[np.float64]


def foil() -> trimesh.Trimesh:
    """Return a box whose faces are crinkled foil: irregular flat facets between creases, the box's edges left alone."""
    rng = np.random.default_rng(346)
    half = np.array(BOX_M) / 2
    sides = [_side(rng, half, axis, sign) for axis in range(3) for sign in (-1, 1)]
    joined = trimesh.util.concatenate(sides)
    joined.merge_vertices(digits_vertex=6)
    return joined


def _side(rng: np.random.Generator, half: Floats, axis: int, sign: int) -> trimesh.Trimesh:
    """Return one face of the box; points on its edges are where the neighbour's are."""
    u, v = (k for k in range(3) if k != axis)
    inside = _creases(rng, half[u], half[v])
    points = np.concatenate([_edges(half[u], half[v]), inside])
    height = rng.normal(0, CRINKLE_M, len(points))
    height += BILLOW_M * np.cos(np.pi * points[:, 0] / half[u] / 2) * np.cos(np.pi * points[:, 1] / half[v] / 2)
    height[: len(points) - len(inside)] = 0
    vertices = np.zeros((len(points), 3))
    vertices[:, u], vertices[:, v], vertices[:, axis] = points[:, 0], points[:, 1], sign * (half[axis] + height)
    faces = Delaunay(points).simplices
    a, b, c = (vertices[faces[:, k], :] for k in range(3))
    inward = sign * np.cross(b - a, c - a)[:, axis] < 0
    faces[inward] = faces[inward, ::-1]
    return trimesh.Trimesh(vertices, faces, process=False)


def _edges(a: float, b: float) -> Floats:
    """Return points around a rectangle of half sides a and b, evenly spaced."""
    across, up = (np.linspace(-s, s, 1 + round(2 * s / CREASE_M)) for s in (a, b))
    low = [(x, s) for s in (-b, b) for x in across]
    return np.array(low + [(s, y) for s in (-a, a) for y in up[1:-1]])


def _creases(rng: np.random.Generator, a: float, b: float) -> Floats:
    """Return points inside a rectangle, about CREASE_M apart, in no order."""
    x = np.arange(-a + 0.7 * CREASE_M, a - 0.5 * CREASE_M, CREASE_M)
    y = np.arange(-b + 0.7 * CREASE_M, b - 0.5 * CREASE_M, CREASE_M)
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    return np.asarray(grid + rng.uniform(-0.38, 0.38, grid.shape) * CREASE_M)


def panel() -> tuple[trimesh.Trimesh, Floats]:
    """Return the solar panel and the brightness of each of its facets."""
    x, bare_x, cell_x = _lines(PANEL_M[0], CELLS[0], 0.0)
    y, bare_y, cell_y = _lines(PANEL_M[1], CELLS[1], BAR_M)
    unlike = np.random.default_rng(16).normal(1, UNLIKE, CELLS)
    corners, tint = [], []
    for i, j in np.ndindex(len(x) - 1, len(y) - 1):
        square = np.array([(x[i], y[j]), (x[i + 1], y[j]), (x[i + 1], y[j + 1]), (x[i], y[j + 1])])
        for side in (1, -1):
            around = square[::side]
            corners.append(np.column_stack([around, np.full(4, side * THICK_M / 2)]))
            tint.append(BARE if bare_x[i] or bare_y[j] else unlike[cell_x[i], cell_y[j]])
    for rim in _rims(x, y):
        corners.append(rim)
        tint.append(BARE)
    vertices = np.concatenate(corners) + (PANEL_X_M + PANEL_M[0] / 2, 0, 0)
    first = 4 * np.arange(len(corners))[:, None]
    faces = np.concatenate([first + (0, 1, 2), first + (0, 2, 3)], axis=1).reshape(-1, 3)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    mesh.merge_vertices(digits_vertex=6)
    return mesh, np.repeat(np.round(tint, 2), 2)


def _lines(length_m: float, cells: int, bar_m: float) -> tuple[Floats, list[bool], list[int]]:
    """Return where lines across a panel lie, which stretches between them are bare, and of which cell each is."""
    pitch = (length_m - GAP_M) / cells
    places, bare, cell = [-length_m / 2], [], []
    for k in range(cells):
        start = -length_m / 2 + k * pitch
        middle = start + (pitch + GAP_M) / 2
        stops = [start + GAP_M, *((middle - bar_m / 2, middle + bar_m / 2) if bar_m else ()), start + pitch]
        places += stops
        bare += [True, False, True, False][: len(stops)]
        cell += [k] * len(stops)
    return np.array([*places, length_m / 2]), [*bare, True], [*cell, cells - 1]


def _rims(x: Floats, y: Floats) -> Iterator[Floats]:
    """Yield the four-cornered pieces around the panel's edge."""
    z = THICK_M / 2
    for a, b in itertools.pairwise(x):
        for edge, way in ((y[0], 1), (y[-1], -1)):
            yield np.array([(a, edge, -z), (b, edge, -z), (b, edge, z), (a, edge, z)])[::way]
    for a, b in itertools.pairwise(y):
        for edge, way in ((x[0], -1), (x[-1], 1)):
            yield np.array([(edge, a, -z), (edge, b, -z), (edge, b, z), (edge, a, z)])[::way]


def at(mesh: trimesh.Trimesh, x: float, y: float, z: float) -> trimesh.Trimesh:
    """Return the mesh moved."""
    return mesh.apply_translation((x, y, z))


def parts() -> dict[str, tuple[trimesh.Trimesh, Floats | None]]:
    """Return the meshes by name, with the brightness of their facets."""
    nozzle = at(trimesh.creation.cone(0.45, 0.7, sections=24), 0, 0, -1.75)
    dots = [
        at(trimesh.creation.cylinder(0.035, 0.01, sections=16), x, y, 1.215)
        for x in (-0.19, 0.19)
        for y in (-0.19, 0.19)
    ]
    cross = [at(trimesh.creation.box(size), 0, 0, 1.33) for size in ((0.2, 0.03, 0.02), (0.03, 0.2, 0.02))]
    return {
        "target_bus": (trimesh.util.concatenate([foil(), nozzle]), None),
        "target_panel": panel(),
        "target_ring": (at(trimesh.creation.annulus(0.52, 0.6, 0.12, sections=48), 0, 0, 1.18), None),
        "target_plate": (at(trimesh.creation.box((0.5, 0.5, 0.02)), 0, 0, 1.2), None),
        "target_marks": (trimesh.util.concatenate([*cross, *dots]), None),
        "globe": (trimesh.creation.icosphere(subdivisions=3), None),
    }


def text(mesh: trimesh.Trimesh, tint: Floats | None) -> str:
    """Return an OBJ file."""
    lines = ["v {:.5f} {:.5f} {:.5f}".format(*place) for place in mesh.vertices]
    now = 1.0
    for k in range(len(mesh.faces)) if tint is None else np.argsort(tint, kind="stable"):
        if tint is not None and tint[k] != now:
            now = float(tint[k])
            lines.append(f"usemtl albedo_{now:g}")
        lines.append("f {} {} {}".format(*(mesh.faces[k] + 1)))
    return "\n".join(lines) + "\n"


def main() -> None:
    """Write every part."""
    for name, (mesh, tint) in parts().items():
        (SHAPES / f"{name}.obj").write_text(text(mesh, tint))


if __name__ == "__main__":
    main()
