r"""Surfaces in Wavefront OBJ files, text <-> vertices and facets, as far as a shape has them.

    v x y z [more]          a vertex; weights and colours behind it are ignored
    f a b c [d ...]         a facet of three corners or more, which is cut into triangles around its first corner
                            a corner is  v, v/vt, v//vn or v/vt/vn;  v counts from 1, or backwards from -1
    usemtl albedo_0.5       the facets that follow are half as bright as the body's law of reflection says
    usemtl NAME             the facets that follow are as bright as the law says
    \ at a line's end       the line goes on

Every other statement (textures, normals, groups, curves) and everything behind # is ignored.

Source: Wavefront Advanced Visualizer, appendix B1, "Object Files (.obj)".
"""

from __future__ import annotations

import itertools
import math
from typing import NoReturn

import numpy as np

from emulator.scene.bodies.plates import PlateTable, PlateTableError

__all__ = ["parse_wavefront"]

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
                corners += _triangles(_corners(number, words, len(points) // 3))
                albedo += [now] * (len(corners) // 3 - len(albedo))
            case ["usemtl"]:
                now = _albedo(number, words)
    facets = np.array(corners, np.int64).reshape(-1, 3)
    tinted = np.array(albedo) if any(a != 1 for a in albedo) else None
    return PlateTable(np.array(points, np.float64).reshape(-1, 3), facets, tinted)


def _albedo(number: int, words: list[str]) -> float:
    """Return the relative albedo that a material's name says, 1 for other names."""
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
    """Return the vertices of a facet, from 0; those that are not there yet may follow."""
    if not 4 <= len(words) <= 1 + _MOST_CORNERS:
        _refuse(number, words, f"'f a b c' with three to {_MOST_CORNERS} corners")
    try:
        named = [int(word.partition("/")[0][:18]) for word in words[1:]]
    except ValueError:
        _refuse(number, words, "'f a b c' with whole numbers, each perhaps with /texture/normal")
    return [n - 1 if n > 0 else count + n if n < 0 else -1 for n in named]


def _triangles(corners: list[int]) -> list[int]:
    first = corners[0]
    return [n for pair in itertools.pairwise(corners[1:]) for n in (first, *pair)]


def _refuse(number: int, words: list[str], wanted: str) -> NoReturn:
    raise PlateTableError(f"line {number}: {' '.join(words)[:60]!r} is not {wanted}")
