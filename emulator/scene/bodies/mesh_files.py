r"""Text formats of shape models <-> vertices and facets: plate tables of small bodies, and Wavefront OBJ.

Plate tables are those of the NASA Planetary Data System. Two families are in use:

    tagged (Thomas, NEAR collected models)      counted (Gaskell, ver*.tab)
        v  x y z        one line a vertex           nv [nf]
        f  i j k        one line a facet            [n] x y z       nv lines, with or without their number
                                                    [nf]            unless given above
                                                    [n] i j k       nf lines, likewise

Facets count vertices from 0 or from 1; the table does not state which, so the smallest index used decides. Blank lines
and lines that begin with # are skipped. Lengths are in the table's own unit, most often kilometres.

Of a Wavefront OBJ file the statements of a shape are read:

    v x y z [more]          a vertex; weights and colours behind it are ignored
    f a b c [d ...]         a facet of three corners or more, which is cut into triangles around its first corner
                            a corner is  v, v/vt, v//vn or v/vt/vn;  v counts from 1, or backwards from -1
    usemtl albedo_0.5       the facets that follow are half as bright as by the body's law of reflection
    usemtl NAME             the facets that follow are as bright as by the law
    \ at a line's end       the line continues

Every other statement (textures, normals, groups, curves) and everything behind # is ignored.

Source: Wavefront Advanced Visualizer, appendix B1, "Object Files (.obj)".
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple, NoReturn

import numpy as np
import numpy.typing as npt


class PlateTableError(ValueError):
    """The text has no valid format; the message names the line."""


class PlateTable(NamedTuple):
    """Contents of a file, before any check of the shape.

    Attributes
    ----------
    vertices : (n, 3) float64, the table's unit.
    facets : (m, 3) int64, counting from 0; may be out of range, which the checks of the shape find.
    albedo : (m,) float64, brightness of each facet relative to its body's law of reflection; None: 1 everywhere.
    """

    vertices: npt.NDArray[np.float64]
    facets: npt.NDArray[np.int64]
    albedo: npt.NDArray[np.float64] | None = None


_Row = tuple[int, list[str]]


def parse_plates(text: str) -> PlateTable:
    """Read a plate table of either family; raises `PlateTableError`."""
    rows = [(n, words) for n, line in enumerate(text.splitlines(), 1) if (words := line.split())]
    rows = [row for row in rows if not row[1][0].startswith("#")]
    if not rows:
        raise PlateTableError("the file holds no line of a plate table")
    tagged = rows[0][1][0] in ("v", "f")
    vertex_rows, facet_rows = _split_tagged(rows) if tagged else _split_counted(rows)
    vertices = _numbers(vertex_rows)
    indices = [_whole_numbers(row, "three vertex numbers") for row in facet_rows]
    facets = np.array(indices, np.int64).reshape(-1, 3)
    return PlateTable(vertices, facets - 1 if facets.size and facets.min() == 1 else facets)


def _split_tagged(rows: list[_Row]) -> tuple[list[_Row], list[_Row]]:
    """Separate the lines by their first letter, which is removed."""
    parts: dict[str, list[_Row]] = {"v": [], "f": []}
    for line, words in rows:
        if words[0] not in parts or len(words) != 4:
            _refuse(line, words, "'v x y z' or 'f i j k'")
        parts[words[0]].append((line, words[1:]))
    return parts["v"], parts["f"]


def _split_counted(rows: list[_Row]) -> tuple[list[_Row], list[_Row]]:
    """Separate the lines by the counts that precede them."""
    counts = _counts(rows[0], (1, 2))
    start, end = 1, 1 + counts[0]
    vertices = rows[start:end]
    if len(counts) == 1:
        if end >= len(rows):
            raise PlateTableError(f"line {rows[0][0]} announces {counts[0]} vertices: the file ends before the facets")
        counts += _counts(rows[end], (1,))
        end += 1
    facets = rows[end:]
    if len(vertices) != counts[0] or len(facets) != counts[1]:
        raise PlateTableError(
            f"{counts[0]} vertices and {counts[1]} facets are announced, {len(vertices)} and {len(facets)} are there"
        )
    return _without_number(vertices, "vertex"), _without_number(facets, "facet")


def _counts(row: _Row, allowed: tuple[int, ...]) -> list[int]:
    if len(row[1]) not in allowed:
        _refuse(*row, "a count")
    return _whole_numbers(row, "a count")


def _whole_numbers(row: _Row, expected: str) -> list[int]:
    line, words = row
    if not all(word.isdecimal() and len(word) < 18 for word in words):
        _refuse(line, words, expected)
    return [int(word) for word in words]


def _without_number(rows: list[_Row], content: str) -> list[_Row]:
    """Remove the running number where lines have one."""
    for line, words in rows:
        if len(words) not in (3, 4):
            _refuse(line, words, f"a {content} of three numbers, with or without its running number before them")
    return [(line, words[-3:]) for line, words in rows]


def _numbers(rows: list[_Row]) -> npt.NDArray[np.float64]:
    """Read three floats a line; Fortran writes 1.0D+01 for 1.0E+01."""
    numbers: list[float] = []
    for line, words in rows:
        try:
            numbers += [float(word.replace("D", "E")) for word in words]
        except ValueError:
            _refuse(line, words, "three numbers")
    return np.array(numbers, np.float64).reshape(-1, 3)


def _refuse(line: int, words: list[str], expected: str) -> NoReturn:
    raise PlateTableError(f"line {line}: {' '.join(words)[:60]!r} is not {expected}")


_MOST_CORNERS = 1000
_TINT, _BRIGHTEST = "albedo_", 100.0


def parse_wavefront(text: str) -> PlateTable:
    """Read an OBJ file; raises `PlateTableError` with the line."""
    points: list[float] = []
    corners: list[int] = []
    albedo: list[float] = []
    now = 1.0
    for number, line in enumerate(text.replace("\\\n", " ").splitlines(), 1):
        words = line.partition("#")[0].split()
        match words[:1]:
            case ["v"]:
                points += _point(number, words)
            case ["f"]:
                first, *later = _corners(number, words, len(points) // 3)
                corners += [n for pair in itertools.pairwise(later) for n in (first, *pair)]
                albedo += [now] * (len(corners) // 3 - len(albedo))
            case ["usemtl"]:
                now = _albedo(number, words)
    facets = np.array(corners, np.int64).reshape(-1, 3)
    tinted = np.array(albedo) if any(a != 1 for a in albedo) else None
    return PlateTable(np.array(points, np.float64).reshape(-1, 3), facets, tinted)


def _albedo(number: int, words: list[str]) -> float:
    """Return the relative albedo in a material's name, 1 for other names."""
    name = words[1] if len(words) == 2 else ""
    if not name.startswith(_TINT):
        return 1.0
    try:
        value = float(name.removeprefix(_TINT))
    except ValueError:
        value = math.nan
    if not 0 <= value <= _BRIGHTEST:
        _refuse(number, words, f"'usemtl albedo_A' with a number of 0 to {_BRIGHTEST:g}")
    return value


def _point(number: int, words: list[str]) -> list[float]:
    try:
        x, y, z = (float(word) for word in words[1:4])
    except ValueError:
        _refuse(number, words, "'v x y z' with three numbers")
    return [x, y, z]


def _corners(number: int, words: list[str], count: int) -> list[int]:
    """Return the vertices of a facet, from 0; vertices may be defined later in the file."""
    if not 4 <= len(words) <= 1 + _MOST_CORNERS:
        _refuse(number, words, f"'f a b c' with three to {_MOST_CORNERS} corners")
    try:
        named = [int(word.partition("/")[0][:18]) for word in words[1:]]
    except ValueError:
        _refuse(number, words, "'f a b c' with whole numbers, each perhaps with /texture/normal")
    if not all(n > 0 or -count <= n < 0 for n in named):
        _refuse(number, words, f"a facet of vertices that count from 1, or backwards from -1 to -{count}")
    return [n - 1 if n > 0 else count + n for n in named]
