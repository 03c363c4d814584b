"""Independent references: rays against triangles one by one, and against a mesh by embree."""

import numpy as np
import pytest


def _rays(screen, side):
    inner = (np.arange(side) + 0.5) / side
    x = (np.arange(screen.width)[:, None] + inner).ravel()
    y = (np.arange(screen.height)[:, None] + inner).ravel()
    x, y = np.meshgrid((x - screen.centre_px[0]) / screen.focal_px, (y - screen.centre_px[1]) / screen.focal_px)
    return np.stack([x, y, np.ones_like(x)], axis=-1)


def _box(screen, corners, side):
    """Rows and columns of rays that can meet a facet: all of them where it reaches behind the camera."""
    if corners[:, 2].min() <= 0:
        return np.s_[:, :]
    x, y = (corners[:, k] / corners[:, 2] * screen.focal_px + screen.centre_px[k] for k in (0, 1))
    first = [max(int(np.floor(v.min())) - 1, 0) * side for v in (y, x)]
    end = [max(int(np.ceil(v.max())) + 1, 0) * side for v in (y, x)]
    return np.s_[first[0] : end[0], first[1] : end[1]]


def _means(samples, side):
    rows, columns = samples.shape
    return samples.reshape(rows // side, side, columns // side, side).mean(axis=(1, 3))


@pytest.fixture(scope="session")
def sample():
    """(screen, points, faces, radiance of facets, side) -> mean of side x side rays a pixel; Moeller and Trumbore."""

    def draw(screen, points, faces, radiance, side, two_sided=False):
        all_rays = _rays(screen, side)
        nearest, picture = np.full(all_rays.shape[:2], np.inf), np.zeros(all_rays.shape[:2])
        for corners, value in zip(points[faces], radiance, strict=True):
            box = _box(screen, corners, side)
            rays, depth, light = all_rays[box], nearest[box], picture[box]
            e1, e2 = corners[1] - corners[0], corners[2] - corners[0]
            p = np.cross(rays, e2)
            det = p @ e1
            with np.errstate(all="ignore"):
                u = p @ -corners[0] / det
                q = np.cross(-corners[0], e1)
                v, t = rays @ q / det, e2 @ q / det
                hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > screen.nearest_m) & (t < depth)
                hit &= (det > 0) | (two_sided & (det < 0))
            depth[hit], light[hit] = t[hit], value
        return _means(picture, side)

    return draw


@pytest.fixture(scope="session")
def trace():
    """(screen, points, faces, radiance of vertices, side) -> mean of side^2 rays a pixel, by embree.

    The rays of a pixel are a lattice by the golden ratio: on a grid an edge along an axis passes whole rows at a time.
    """
    import trimesh
    from trimesh.ray.ray_pyembree import RayMeshIntersector

    def draw(screen, points, faces, radiance, side):
        k = np.arange(side * side)
        row, column, u = np.broadcast_arrays(*np.ogrid[: screen.height, : screen.width, : side * side])
        x = column + (u * 0.6180339887498949) % 1
        y = row + (k + 0.5) / side**2
        x, y = (x - screen.centre_px[0]) / screen.focal_px, (y - screen.centre_px[1]) / screen.focal_px
        flat = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
        mesh = trimesh.Trimesh(points, faces, process=False, validate=False)
        hit = RayMeshIntersector(mesh).intersects_first(np.zeros_like(flat), flat)
        light, on = np.zeros(len(flat)), hit >= 0
        a, b, c = (points[faces[:, k]] for k in range(3))
        opposite = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=1)  # Cramer's rule, once a facet
        shares = np.einsum("nij,nj->ni", opposite[hit[on]], flat[on])
        shares /= shares.sum(axis=1, keepdims=True)
        light[on] = (shares * radiance[faces[hit[on]]]).sum(axis=1)
        return light.reshape(screen.height, screen.width, side * side).mean(axis=-1)

    return draw


@pytest.fixture(scope="session")
def picture():
    """(renderer, view) -> light, rate and box, in arrays of their own."""

    def draw(renderer, view):
        shape = renderer.screen.height, renderer.screen.width
        light, rate = np.full(shape, np.nan, np.float32), np.full(shape, np.nan, np.float32)
        return light, rate, renderer.draw(view, light, rate)

    return draw
