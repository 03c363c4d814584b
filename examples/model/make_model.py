"""A spacecraft with a turning solar panel, as a GLB file: two nodes and one animation.

    python make_model.py [FOLDER]

writes spacecraft.glb into FOLDER, by default beside this file. The node "panel" is a child of "bus" and turns about x
once in 20 s. A glTF file is JSON and a block of octets (Khronos, glTF 2.0 specification); Blender and CAD programs
write the same, with more in it.
"""

from __future__ import annotations

import json
import struct
import sys
from pathlib import Path

import numpy as np

TURN_S = 20.0
FLOAT, SHORT = 5126, 5123
FACES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]


def box(size: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and corners of triangles, counter-clockwise from outside."""
    vertices = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]) * size
    corners = [corner for a, b, c, d in FACES for corner in (a, b, c, a, c, d)]
    return vertices.astype("<f4"), np.array(corners, "<u2")


class Octets:
    """The binary block, with its views and accessors."""

    def __init__(self) -> None:
        self.data = b""
        self.views: list[dict[str, int]] = []
        self.accessors: list[dict[str, object]] = []

    def add(self, array: np.ndarray, component: int, kind: str) -> int:
        """Append an array; return the number of its accessor."""
        self.views.append({"buffer": 0, "byteOffset": len(self.data), "byteLength": array.nbytes})
        accessor = {"bufferView": len(self.accessors), "componentType": component, "count": len(array), "type": kind}
        low_high = {"min": np.atleast_1d(array.min(0)).tolist(), "max": np.atleast_1d(array.max(0)).tolist()}
        self.accessors.append(accessor | low_high)
        self.data += array.tobytes() + bytes(-array.nbytes % 4)
        return len(self.accessors) - 1

    def mesh(self, size: tuple[float, float, float], material: int) -> dict[str, object]:
        """Append a box; return its mesh."""
        vertices, corners = box(size)
        position, indices = self.add(vertices, FLOAT, "VEC3"), self.add(corners, SHORT, "SCALAR")
        return {"primitives": [{"attributes": {"POSITION": position}, "indices": indices, "material": material}]}


def material(name: str, grey: float, metallic: float, roughness: float) -> dict[str, object]:
    """Return a material of glTF."""
    surface = {"baseColorFactor": [grey] * 3 + [1.0], "metallicFactor": metallic, "roughnessFactor": roughness}
    return {"name": name, "pbrMetallicRoughness": surface}


def glb() -> bytes:
    """Return the file."""
    octets = Octets()
    meshes = [octets.mesh((1.2, 1.0, 1.6), 0), octets.mesh((4.0, 0.04, 1.4), 1)]
    angles = np.linspace(0, 2 * np.pi, 9)
    turns = np.stack([np.sin(angles / 2), 0 * angles, 0 * angles, np.cos(angles / 2)], axis=1)
    times = octets.add((angles / (2 * np.pi) * TURN_S).astype("<f4"), FLOAT, "SCALAR")
    rotations = octets.add(turns.astype("<f4"), FLOAT, "VEC4")
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [
            {"name": "bus", "mesh": 0, "children": [1]},
            {"name": "panel", "mesh": 1, "translation": [2.8, 0.0, 0.0]},
        ],
        "meshes": meshes,
        "materials": [material("foil", 0.6, 0.5, 0.6), material("cells", 0.08, 0.0, 0.3)],
        "animations": [
            {
                "name": "turn",
                "samplers": [{"input": times, "output": rotations}],
                "channels": [{"sampler": 0, "target": {"node": 1, "path": "rotation"}}],
            }
        ],
        "buffers": [{"byteLength": len(octets.data)}],
        "bufferViews": octets.views,
        "accessors": octets.accessors,
    }
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = (
        struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(octets.data), b"BIN\0") + octets.data
    )
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


if __name__ == "__main__":
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent
    (folder / "spacecraft.glb").write_bytes(glb())
