"""Closed surfaces of triangles: reading of shape models, and checks before anything is drawn.

A facet's outside is the side from which its corners run counter-clockwise. Lengths are metres. The formats are the
plate tables of the Planetary Data System (`.tab`) and Wavefront OBJ, see `mesh_files`, and, in a child process, see
`guarded_reader`, digital shape kernels of SPICE (`.bds`, `.dsk`) by spiceypy, and every surface format that trimesh
reads (STL, PLY, ...); for glTF see `models`. Textures and materials are ignored, but for `usemtl albedo_A` of OBJ
files; split vertices are joined again.

    bad input                                   what happens
    no file, unreadable, no facet               SceneError
    NaN, infinite or missing vertices           SceneError
    facets that disagree on the outside         SceneError
    facets without area                         dropped, counted in `Mesh.dropped_facets`
    inside out                                  turned, `Mesh.was_inside_out`
    holes                                       left open, counted in `Mesh.open_edges`; dark sky is seen through them
"""

from __future__ import annotations

import hashlib
import io
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from emulator.light import SceneError
from emulator.scene.bodies import mesh_files
from emulator.scene.bodies.compiled import Numbers
from emulator.scene.bodies.mesh_files import PlateTable, PlateTableError, parse_plates, parse_wavefront
from emulator.scene.files import Kind, cached_arrays, read_in_child, reader_errors
from emulator.tables.toml_text import TextFileError, read_text, shortened
from firmware_protocol.compiled import checksum_of
from firmware_protocol.events import Floats, Int64s

SHAPES = Path(__file__).parent / "shapes"
"""The folder of the shape models that come with the program; its SOURCES.md gives the origin of each."""

_MOST_BYTES = 1 << 28
_CACHED_BYTES = 1 << 19  # a smaller file is parsed as soon
_PLATES = 2  # data type of a segment of plates; the only other one, 4, holds heights
_FARTHEST_M = 1e15  # squares and cubes of it stay finite; the solar system ends before


@dataclass(frozen=True, eq=False)
class Mesh:
    """A checked surface that can be drawn.

    Attributes
    ----------
    vertices : (n, 3) float64, metres, each used by a facet, no two equal.
    faces : (m, 3) int32, counter-clockwise as seen from outside.
    normals : (n, 3) float64, unit, outward: the mean of the facets around a vertex, weighted with their area.
    dropped_facets : facets without area that the source had.
    open_edges : edges with a facet on one side only; 0 for a closed surface.
    was_inside_out : True: the source had all facets the wrong way round.
    albedo : (m, 3) float64, brightness at the corners of each facet relative to the law of reflection; None: 1
        everywhere. On a smooth surface the corners at a vertex agree.
    water : (m, 3) float64, share of open water at the corners, 0 to 1, which has the glint of the Sun; None: no water.
    rough : (m, 3) float64, height of the grain at the corners over that of its octaves; None: no grain.
    """

    vertices: Floats
    faces: Numbers
    normals: Floats
    dropped_facets: int = 0
    open_edges: int = 0
    was_inside_out: bool = False
    albedo: Floats | None = None
    water: Floats | None = None
    rough: Floats | None = None

    @cached_property
    def radius_m(self) -> float:
        """The distance of the farthest vertex from the origin."""
        return float(np.linalg.norm(self.vertices, axis=1).max())

    @property
    def made_from(self) -> tuple[str, int, str]:
        """Inputs of arrays that are made of this mesh, for the cache of scenes: shape, tints, sources, numpy."""
        arrays = (self.vertices, self.normals, self.faces, self.albedo, self.water, self.rough)
        digest = hashlib.sha256(b"|".join(b"" if array is None else array.tobytes() for array in arrays)).hexdigest()
        return digest, checksum_of(Path(__file__).parent), np.__version__

    @cached_property
    def area_m2(self) -> float:
        """The surface area."""
        return float(np.linalg.norm(facet_vectors(self.vertices, self.faces), axis=1).sum())

    def tints(self, change: Callable[[Floats], Floats]) -> dict[str, Any]:
        """Return those of albedo, water and roughness that there are, by name, each as `change` returns it."""
        values = {"albedo": self.albedo, "water": self.water, "rough": self.rough}
        return {name: change(of) for name, of in values.items() if of is not None}

    def at_vertices(self, values: Floats) -> Floats:
        """Return values of vertices, (n,): the mean of those at corners, (m, 3)."""
        sums = np.bincount(self.faces.ravel(), values.ravel(), len(self.vertices))
        return np.asarray(sums / np.bincount(self.faces.ravel(), minlength=len(self.vertices)))

    @property
    def warnings(self) -> tuple[str, ...]:
        """Remarks for the user on faults of the shape that were corrected or accepted, a sentence each."""
        faults = (
            (self.dropped_facets, f"{self.dropped_facets} facets without area were dropped"),
            (self.open_edges, f"{self.open_edges} edges are open: dark sky shows through the holes"),
            (self.was_inside_out, "the mesh was inside out and was turned"),
        )
        return tuple(text for is_so, text in faults if is_so)


def find_shape(name: str) -> Path:
    """Return the file of a shape: a path, or the name of a shipped model such as 'eros022540'."""
    path = Path(name).expanduser()
    if path.is_file():
        return path
    shipped = {p.stem: p for p in SHAPES.iterdir() if p.suffix in (".tab", ".obj")}
    if name in shipped:
        return shipped[name]
    names = ", ".join(sorted(shipped))
    raise SceneError(f"no shape model {name!r}: there is no such file, and the shipped ones are {names}")


def load_mesh(path: Path, units_m: float = 1000.0) -> Mesh:
    """Read a shape model whose unit of length is `units_m` metres (1000: kilometres, as in most published models).

    Raises SceneError with the file's name, the fault and, where it is known, the line.
    """
    if not (np.isfinite(units_m) and units_m > 0):
        raise SceneError(f"units of {units_m} m for {path.name}: a unit of length is a positive number of metres")
    vertices, faces, albedo = _read(path)
    try:
        return build_mesh(vertices * units_m, faces, albedo)
    except SceneError as error:
        raise SceneError(f"{path}: {error}") from error


def build_mesh(
    vertices: npt.ArrayLike, faces: npt.ArrayLike, albedo: Floats | None = None, *, turns: bool = True
) -> Mesh:
    """Check, clean and complete a surface.

    Parameters
    ----------
    vertices : (n, 3) metres.
    faces : (m, 3) vertex numbers from 0.
    albedo : (m,) relative albedo of each facet.
    turns : True: a surface that is inside out is turned; false: the corners are in the right order.
    """
    points = np.asarray(vertices, np.float64).reshape(-1, 3)
    corners = np.asarray(faces, np.int64).reshape(-1, 3)
    _require_sound(points, corners)
    points, corners = _join_equal_vertices(points, corners)
    sides = points[corners] - points[np.roll(corners, 1, axis=1)]
    longest2 = (sides**2).sum(axis=2).max(axis=1)
    valid = np.linalg.norm(facet_vectors(points, corners), axis=1) > 1e-12 * longest2  # less is rounding
    if not valid.any():
        raise SceneError("no facet has any area: nothing to draw")
    dropped, corners = int((~valid).sum()), corners[valid]
    open_edges = _count_open_edges(corners)
    # Tetrahedra between each facet and the middle of the mesh: their volume is negative where it is inside out.
    heights = points[corners[:, 0]] - points[corners].mean(axis=(0, 1))
    inside_out = turns and bool((facet_vectors(points, corners) * heights).sum() < 0)
    if inside_out:
        corners = corners[:, ::-1]
    used, corners = np.unique(corners, return_inverse=True)
    points, triangles = points[used], corners.reshape(-1, 3).astype(np.int32)
    tinted = None if albedo is None else np.repeat(albedo[valid], 3).reshape(-1, 3)
    return Mesh(points, triangles, vertex_normals(points, triangles), dropped, open_edges, inside_out, tinted)


def _read(path: Path) -> PlateTable:
    """Return vertices, facets and their albedo: two formats by own readers, others by libraries in a child process."""
    parse = {".tab": parse_plates, ".obj": parse_wavefront}.get(path.suffix.lower())
    if parse is None:
        reader = "read_dsk" if path.suffix.lower() in (".bds", ".dsk") else "read_surface"
        arrays = read_in_child(f"{__name__}:{reader}", path)
        return PlateTable(arrays["vertices"], arrays["faces"])
    try:
        text = read_text(path, _MOST_BYTES)
        if len(text) < _CACHED_BYTES:
            return parse(text)
        made_from = (hashlib.sha256(text.encode()).hexdigest(), checksum_of(Path(mesh_files.__file__)))
        kinds = Kind(np.float64, 2), Kind(np.int64, 2), Kind(np.float64, 1)
        return PlateTable(*cached_arrays("shape", made_from, lambda: parse(text), kinds))
    except (TextFileError, PlateTableError) as error:
        raise SceneError(f"{path}: {error}") from error


def _require_sound(points: Floats, corners: Int64s) -> None:
    if not len(corners):
        raise SceneError("no facet, nothing to draw: a cloud of points needs facets first, for instance by MeshLab")
    if not len(points):
        raise SceneError("no vertex, nothing to draw")
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


def _join_equal_vertices(points: Floats, corners: Int64s) -> tuple[Floats, Int64s]:
    """Give vertices at the same place one number: files with textures or several grids repeat those on the seams."""
    order = np.lexsort(points.T)
    is_new = np.empty(len(points), bool)
    is_new[0], is_new[1:] = True, (points[order[1:]] != points[order[:-1]]).any(axis=1)
    first = order[is_new]  # lexsort is stable: the lowest number of each place
    number = np.empty(len(points), np.int64)
    number[order] = first[np.cumsum(is_new) - 1]
    return points, number[corners]


def facet_vectors(points: Floats, corners: npt.NDArray[np.integer]) -> Floats:
    """Outward normals as long as the facets' areas, (m, 3)."""
    a, b, c = (points[corners[:, i]] for i in range(3))
    return np.asarray(np.cross(b - a, c - a) / 2)


def group_means(values: Floats, number: npt.NDArray[np.integer], counts: npt.NDArray[np.integer]) -> Floats:
    """Return means of the rows of `values`, (n, k), over groups: `number`, (n,), of each row; `counts` of members."""
    sums = np.column_stack([np.bincount(number, column, len(counts)) for column in values.T])
    return np.asarray(sums / counts[:, None])


def _count_open_edges(corners: Int64s) -> int:
    """Count the edges with one facet; refuse edges that two facets pass in the same direction."""
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


def vertex_normals(points: Floats, corners: Numbers) -> Floats:
    """Return the mean of the normals of the facets around each vertex, weighted with their area, (n, 3) unit."""
    facets = facet_vectors(points, corners)
    sums = np.zeros_like(points)
    for axis in range(3):
        for corner in corners.T:
            sums[:, axis] += np.bincount(corner, facets[:, axis], len(points))
    length = np.linalg.norm(sums, axis=1)
    lost = length < 1e-9 * np.linalg.norm(facets, axis=1).max()
    if lost.any():  # both sides of a sheet cancel: any facet of the vertex serves
        for corner in corners.T:
            sums[corner[lost[corner]]] = facets[lost[corner]]
        length = np.linalg.norm(sums, axis=1)
    return np.asarray(sums / length[:, None])


def read_surface(path: Path) -> dict[str, npt.NDArray[Any]]:
    """Return `vertices` (n, 3) float64 in the file's unit and `faces` (m, 3) int64; textures are ignored."""
    import trimesh  # in the child process alone: it takes a second

    with reader_errors("trimesh cannot read it as a surface"):
        data, kind = path.read_bytes(), path.suffix[1:].lower()
        _require_complete(data, kind)
        try:
            loaded = trimesh.load_mesh(io.BytesIO(data), file_type=kind, process=False, skip_materials=True)
        except ImportError as error:
            if error.name != "charset_normalizer":
                raise
            raise SceneError("holds octets that are not UTF-8 text: it is damaged, or of another format") from error
        vertices, faces = np.asarray(loaded.vertices, np.float64), np.asarray(loaded.faces, np.int64)
    return {"vertices": vertices, "faces": faces}


_STL_HEAD, _STL_FACET = 84, 50  # octets
_COUNTED = {  # heads of texts with a line for each vertex and facet
    "ply": re.compile(rb"ply\b.*?format\s+ascii.*?end_header", re.DOTALL),
    "off": re.compile(rb"\s*[A-Z]*OFF\s+(?:#[^\n]*\n\s*)*(\d{1,18})\s+(\d{1,18})\s+\d+"),
}
_MOST_HEAD = 1 << 16


def _require_complete(data: bytes, kind: str) -> None:
    """Raise SceneError where an STL, PLY or OFF file is cut: trimesh returns the facets that are there, or none."""
    if kind == "stl" and (b"\0" in data or data[:5].lower() != b"solid"):
        count = int.from_bytes(data[_STL_HEAD - 4 : _STL_HEAD], "little")
        missing = _STL_HEAD + _STL_FACET * count - len(data)
        if missing > 0:
            raise SceneError(f"is cut: {count} facets are announced, and {missing} of their octets are missing")
        if missing:
            raise SceneError(f"is damaged: {-missing} octets follow the {count} facets that it announces")
    elif kind == "stl" and not data.rstrip().splitlines()[-1].lower().lstrip().startswith(b"endsolid"):
        raise SceneError(f"is cut after {data.lower().count(b'endfacet')} facets: no 'endsolid' ends it")
    elif kind in _COUNTED and (head := _COUNTED[kind].match(data[:_MOST_HEAD])):
        counts = head.groups() or re.findall(rb"(?m)^\s*element\s+\w+\s+(\d{1,18})", head[0])
        announced = sum(map(int, counts))
        lines = sum(bool(line.partition(b"#")[0].strip()) for line in data[head.end() :].splitlines()[1:])
        if lines < announced:
            raise SceneError(
                f"is cut: {announced} vertices and facets are announced, a line each, and {lines} are there"
            )


def read_dsk(path: Path) -> dict[str, npt.NDArray[Any]]:
    """Return the plates of all segments of a digital shape kernel, as `read_surface`; lengths are kilometres.

    The axes are those of the body-fixed frame that the segments name; they must all name the same.

    Source: NAIF, "DSK Required Reading", plates of data type 2.
    """
    import spiceypy  # an extra

    try:
        segments = list(_segments(spiceypy, spiceypy.dasopr(str(path))))
    except spiceypy.SpiceyError as error:
        raise SceneError(f"SPICE cannot read it as a shape kernel ({shortened(error)})") from error
    frames = {frame for frame, _, _ in segments}
    if len(frames) > 1:
        raise SceneError(
            f"its segments are in {len(frames)} frames ({sorted(frames)}): split it, one frame in each file"
        )
    starts = np.cumsum([0] + [len(vertices) for _, vertices, _ in segments])
    faces = [corners + (start - 1) for (_, _, corners), start in zip(segments, starts[:-1], strict=True)]
    return {"vertices": np.concatenate([vertices for _, vertices, _ in segments]), "faces": np.concatenate(faces)}


def _segments(spice: Any, handle: int) -> Iterator[tuple[int, Floats, Int64s]]:
    """Yield of each segment its frame's number, vertices, and plates that count vertices from 1."""
    segment = spice.dlabfs(handle)
    while segment is not None:
        about = spice.dskgd(handle, segment)
        if about.dtype != _PLATES:
            raise SceneError(f"a segment of it has data of type {about.dtype}; only plates (type 2) can be drawn")
        vertices, plates = spice.dskz02(handle, segment)
        yield (
            about.frmcde,
            np.asarray(spice.dskv02(handle, segment, 1, vertices), np.float64),
            np.asarray(spice.dskp02(handle, segment, 1, plates), np.int64),
        )
        try:
            segment = spice.dlafns(handle, segment)
        except spice.NotFoundError:
            segment = None
