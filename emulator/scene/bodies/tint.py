"""Relative albedo of vertices brought to a mean of 1 over the surface, so that a body's reflectance says its mean."""

from __future__ import annotations

import dataclasses

import numpy as np
import numpy.typing as npt

from emulator.scene.bodies.mesh import Mesh

__all__ = ["mean_albedo", "with_albedo"]

Floats = npt.NDArray[np.float64]


def with_albedo(mesh: Mesh, albedo: Floats) -> Mesh:
    """Return a mesh with the albedo of its vertices, (n,) of any scale: its mean over the area becomes 1."""
    tinted = dataclasses.replace(mesh, albedo=np.ascontiguousarray(albedo[mesh.faces]))
    return dataclasses.replace(mesh, albedo=albedo[mesh.faces] / mean_albedo(tinted))


def mean_albedo(mesh: Mesh) -> float:
    """Return the mean over the area; albedo is linear over facets."""
    if mesh.albedo is None:
        return 1.0
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return float((areas * mesh.albedo.mean(axis=1)).sum() / areas.sum())
