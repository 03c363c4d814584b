"""Closed surfaces of triangles: reading shape models, and judging them before anything is drawn.

A facet's outside is the side from which its corners go round counter-clockwise. Lengths are metres. Read are the plate
tables of the Planetary Data System (`.tab`, see `plates`) and every surface format that trimesh reads (OBJ, STL, PLY,
...), of which textures and materials are ignored and split vertices are joined again.

    bad input                                   what happens
    no file, unreadable, no facet               SceneError
    NaN, infinite or missing vertices           SceneError
    facets that disagree on the outside         SceneError
    facets without area                         dropped, counted in `Mesh.dropped_facets`
    inside out                                  turned, `Mesh.was_inside_out`
    holes                                       kept, counted in `Mesh.open_edges`; dark sky is seen through them
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property
from io import BytesIO
from pathlib import Path

import numpy as np
import numpy.typing as npt

from emulator.light import SceneError
from emulator.scene.bodies.plates import PlateTableError, parse_plates

__all__ = ["SHAPES", "Mesh", "build_mesh", "find_shape", "load_mesh"]

SHAPES = Path(__file__).parent / "shapes"
"""The folder of the shape models that come with the program; its SOURCES.md tells where each is from."""

_FARTHEST_M = 1e15  # squares and cubes of it stay finite; the solar system ends before

_OBJ_LOOKS = re.compile(rb"^[ \t]*(mtllib|usemtl|vt)\b.*$", re.MULTILINE)
"""Lines of an OBJ file on materials and textures. trimesh needs Pillow for them, which is no base dependency."""

_Points = npt.NDArray[np.float64]
_Faces = npt.NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class Mesh:
    """A surface that has been judged fit to draw.

    Attributes
    ----------
    vertices : (n, 3) float64, metres, each used by a facet, no two equal.
    faces : (m, 3) int32, counter-clockwise as seen from outside.
    normals : (n, 3) float64, unit, outward: the mean of the facets around a vertex, weighted with their area.
    dropped_facets : facets without area that the source had.
    open_edges : edges with a facet on one side only; 0 for a closed surface.
    was_inside_out : whether the source had all facets the wrong way round.
    """

    vertices: _Points
    faces: _Faces
    normals: _Points
    dropped_facets: int = 0
    open_edges: int = 0
    was_inside_out: bool = False

    @cached_property
    def radius_m(self) -> float:
        """The distance of the farthest vertex from the origin."""
        return float(np.linalg.norm(self.vertices, axis=1).max())

    @property
    def volume_m3(self) -> float:
        """The enclosed volume, by the divergence theorem; means nothing for a mesh with holes."""
        return float(_signed_volume(self.vertices, self.faces))

    @property
    def area_m2(self) -> float:
        """The surface area."""
        return float(np.linalg.norm(_facet_vectors(self.vertices, self.faces), axis=1).sum())

    @property
    def warnings(self) -> tuple[str, ...]:
        """What was found odd and put right or let pass, a sentence each, for people."""
        found = (
            (self.dropped_facets, f"{self.dropped_facets} facets without area were dropped"),
            (self.open_edges, f"{self.open_edges} edges are open: dark sky shows through the holes"),
            (self.was_inside_out, "the mesh was inside out and was turned"),
        )
        return tuple(text for is_so, text in found if is_so)


def find_shape(name: str) -> Path:
    """Return the file of a shape: a path, or the name of a shipped model such as 'eros022540'."""
    path = Path(name).expanduser()
    if path.is_file():
        return path
    shipped = {p.stem: p for p in SHAPES.iterdir() if p.suffix in (".tab", ".obj")}
    if name in shipped:
        return shipped[name]
    known = ", ".join(sorted(shipped))
    raise SceneError(f"no shape model {name!r}: there is no such file, and the shipped ones are {known}")


def load_mesh(path: Path, units_m: float = 1000.0) -> Mesh:
    """Read a shape model whose unit of length is `units_m` metres (1000: kilometres, as in most published models).

    Raises
    ------
    SceneError
        With the file's name, what is wrong and, where it can be told, the line.
    """
    if not (np.isfinite(units_m) and units_m > 0):
        raise SceneError(f"units of {units_m} m for {path.name}: a unit of length is a positive number of metres")
    try:
        vertices, faces = _read_plates(path) if path.suffix.lower() == ".tab" else _read_with_trimesh(path)
        return build_mesh(vertices * units_m, faces)
    except OSError as error:
        raise SceneError(f"shape model {path} cannot be read: {error.strerror or error}") from error
    except (PlateTableError, SceneError) as error:
        raise SceneError(f"shape model {path}: {error}") from error


def build_mesh(vertices: npt.ArrayLike, faces: npt.ArrayLike) -> Mesh:
    """Judge, clean and complete a surface.

    Parameters
    ----------
    vertices : (n, 3) metres.
    faces : (m, 3) vertex numbers from 0.
    """
    points = np.asarray(vertices, np.float64).reshape(-1, 3)
    corners = np.asarray(faces, np.int64).reshape(-1, 3)
    _require_sound(points, corners)
    points, corners = _join_equal_vertices(points, corners)
    kept = _with_area(points, corners)
    if not kept.any():
        raise SceneError("no facet has any area: nothing to draw")
    dropped, corners = int((~kept).sum()), corners[kept]
    open_edges = _count_open_edges(corners)
    inside_out = bool(_signed_volume(points, corners) < 0)
    if inside_out:
        corners = corners[:, ::-1]
    used, corners = np.unique(corners, return_inverse=True)
    points, triangles = points[used], corners.reshape(-1, 3).astype(np.int32)
    return Mesh(points, triangles, _vertex_normals(points, triangles), dropped, open_edges, inside_out)


def _read_plates(path: Path) -> tuple[_Points, npt.NDArray[np.int64]]:
    table = parse_plates(path.read_text("ascii", errors="replace"))
    return table.vertices, table.facets


def _read_with_trimesh(path: Path) -> tuple[_Points, npt.NDArray[np.int64]]:
    """Read any other format; trimesh takes half a second to import, so only when it is needed."""
    import trimesh

    file_type = path.suffix[1:].lower()
    data = path.read_bytes()
    data = _OBJ_LOOKS.sub(b"", data) if file_type == "obj" else data
    try:
        loaded = trimesh.load_mesh(BytesIO(data), file_type=file_type, process=False, skip_materials=True)
        return np.asarray(loaded.vertices, np.float64), np.asarray(loaded.faces, np.int64)
    except Exception as error:  # its readers answer a broken file with whatever the parsing ran into
        raise SceneError(f"trimesh cannot read it as a surface ({error})") from error


def _require_sound(points: _Points, corners: npt.NDArray[np.int64]) -> None:
    if not len(points) or not len(corners):
        raise SceneError(f"{len(points)} vertices and {len(corners)} facets: nothing to draw")
    bad = ~(np.abs(points) < _FARTHEST_M).all(axis=1)  # NaN compares false
    if bad.any():
        raise SceneError(
            f"{bad.sum()} vertices are not finite or beyond {_FARTHEST_M:g} m, "
            f"the first is number {bad.argmax()} (counted from 0)"
        )
    lost = ((corners < 0) | (corners >= len(points))).any(axis=1)
    if lost.any():
        first = int(lost.argmax())
        raise SceneError(
            f"{lost.sum()} facets name a vertex that is not there: facet {first} (counted from 0) has "
            f"{corners[first].tolist()}, and there are {len(points)} vertices"
        )


def _join_equal_vertices(points: _Points, corners: npt.NDArray[np.int64]) -> tuple[_Points, npt.NDArray[np.int64]]:
    """Give vertices at the same place one number: files with textures or several grids repeat those on the seams."""
    order = np.lexsort(points.T)
    is_new = np.empty(len(points), bool)
    is_new[0], is_new[1:] = True, (points[order[1:]] != points[order[:-1]]).any(axis=1)
    first = order[is_new]  # lexsort is stable: the lowest number of each place
    number = np.empty(len(points), np.int64)
    number[order] = first[np.cumsum(is_new) - 1]
    return points, number[corners]


def _facet_vectors(points: _Points, corners: npt.NDArray[np.integer]) -> _Points:
    """Outward normals as long as the facets' areas, (m, 3)."""
    a, b, c = (points[corners[:, i]] for i in range(3))
    return np.asarray(np.cross(b - a, c - a) / 2)


def _with_area(points: _Points, corners: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
    """Tell which facets have an area above rounding, beside their longest side."""
    sides = points[corners] - points[np.roll(corners, 1, axis=1)]
    longest2 = (sides**2).sum(axis=2).max(axis=1)
    return np.asarray(np.linalg.norm(_facet_vectors(points, corners), axis=1) > 1e-12 * longest2)


def _signed_volume(points: _Points, corners: npt.NDArray[np.integer]) -> float:
    """Return the sum of the tetrahedra between each facet and the middle of the mesh: negative when inside out."""
    middle = points[corners].mean(axis=(0, 1))
    return float(np.einsum("ij,ij->", _facet_vectors(points, corners), points[corners[:, 0]] - middle) / 3)


def _count_open_edges(corners: npt.NDArray[np.int64]) -> int:
    """Count the edges with one facet; refuse edges that facets pass in the same direction without an answer."""
    start, end = corners.ravel(), np.roll(corners, -1, axis=1).ravel()
    low, high = np.minimum(start, end), np.maximum(start, end)
    _, edge = np.unique(low * (int(high.max()) + 1) + high, return_inverse=True)
    balance = np.abs(np.bincount(edge, weights=np.where(start < end, 1.0, -1.0)))
    wrong = int((balance > 1).sum())
    if wrong:
        raise SceneError(
            f"facets disagree on which side is outside ({wrong} edges are passed twice in one direction): "
            "make the winding one, for instance with trimesh.repair.fix_winding"
        )
    return int((balance == 1).sum())


def _vertex_normals(points: _Points, corners: _Faces) -> _Points:
    facets = _facet_vectors(points, corners)
    sums = np.zeros_like(points)
    for axis in range(3):
        for corner in corners.T:
            sums[:, axis] += np.bincount(corner, facets[:, axis], len(points))
    length = np.linalg.norm(sums, axis=1)
    lost = length < 1e-9 * np.linalg.norm(facets, axis=1).max()
    if lost.any():  # both sides of a sheet cancel: any facet of the vertex will do
        for corner in corners.T:
            sums[corner[lost[corner]]] = facets[lost[corner]]
        length = np.linalg.norm(sums, axis=1)
    return np.asarray(sums / length[:, None])
