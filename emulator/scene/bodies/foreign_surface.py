"""Surfaces of formats that trimesh reads (STL, PLY, GLB, ...); for a child process, see `foreign_file`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import trimesh

from emulator.light import SceneError
from emulator.tables.text_file import shortened

__all__ = ["read_surface"]


def read_surface(path: Path) -> dict[str, npt.NDArray[Any]]:
    """Return `vertices` (n, 3) float64 in the file's unit and `faces` (m, 3) int64; textures are ignored."""
    with path.open("rb") as file:
        try:
            loaded = trimesh.load_mesh(file, file_type=path.suffix[1:].lower(), process=False, skip_materials=True)
            vertices, faces = np.asarray(loaded.vertices, np.float64), np.asarray(loaded.faces, np.int64)
        except (MemoryError, ImportError):
            raise
        except Exception as error:  # its readers answer a broken file with whatever the parsing ran into
            raise SceneError(f"trimesh cannot read it as a surface ({shortened(error)})") from error
    return {"vertices": vertices, "faces": faces}
