"""The surface at each pixel's middle with its depth, and optical flow of rigid bodies, in closed form.

The nearest facet at a middle is that of the renderer of light (`raster`), found by depth alone. 1 / depth is linear
over a facet in the frame, so the facet's plane gives it exactly. Where a lens has distortion, the facet is the one at
the nearest pixel of the frame without distortion, and its plane is evaluated at the ray itself: beside an outline the
label may be wrong by half a pixel.

Flow: a point of a body is at P = R q + s in the camera's axes (x right, y down, z out), with q fixed in the body, so
that

    dP/dt = R' R^T (P - s) + s' = M P + c        M = R' R^T,  c = s' - M s

and in the frame, with P = z (X, Y, 1), w = 1 / z and g = M (X, Y, 1) + w c,

    du/dt = f (g_x - X g_z)        dv/dt = f (g_y - Y g_z)

The sky has w = 0 and turns with the camera alone. R' and s' are differences of poses a moment before and after; no
light frame is used.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from emulator.geometry.camera import Pinhole, Rays, Seen
from emulator.raster.layout import Data, Screen, View, W, WHighest, WLowest, entry
from emulator.raster.renderer import Renderer
from emulator.raster.topology import join, prepare
from emulator.trajectory.pose import STILL, Pose, Timescale, Trajectory
from firmware_protocol.events import Float32s, Floats, Int32s, UInt16s

Surface = tuple[Int32s, int, bool]
"""Facets, (m, 3); number of vertices; True where the surface is visible from behind too."""


class NearestSurface:
    """The surfaces of several bodies before one camera; label k is surface k - 1.

    Parameters
    ----------
    nearest_m : facets are cut at this depth.
    """

    def __init__(self, surfaces: Sequence[Surface], camera: Pinhole, nearest_m: float) -> None:
        width, height = camera.size
        self._camera = camera
        topology = join([prepare(faces, two_sided=two_sided) for faces, _, two_sided in surfaces])
        screen = Screen(width, height, camera.focal_px, (width / 2, height / 2), nearest_m)
        self._renderer = Renderer(topology, screen)
        self._last = np.cumsum([count for _, count, _ in surfaces])
        self._nearest = np.full((height, width), -1, np.int32)
        self._dark = np.zeros(topology.entries)

    def look(self, vertices: Floats, rays: Rays, labels: UInt16s, inverse_depth: Floats) -> None:
        """Write labels and 1 / depth along `rays`; `vertices`, (n, 3) m, are all surfaces' in the camera's axes."""
        view = View(vertices, np.zeros_like(vertices), self._dark, self._dark)
        self._renderer.nearest(view, self._nearest)
        of_vertex = np.searchsorted(self._last, self._renderer.corners(), side="right") + 1
        label = of_vertex.astype(np.uint16)
        nearest_along(
            self._nearest, self._renderer.facets, label, rays.columns, rays.rows, labels, inverse_depth
        )  # fmt: skip

    def close(self) -> None:
        """Give back what the renderer holds."""
        self._renderer.close()


@entry
def nearest_along(
    nearest: Int32s, facets: Floats, label: UInt16s, columns: Floats, rows: Floats, labels: UInt16s,
    inverse_depth: Floats
) -> None:  # fmt: skip
    """Write `labels` and `inverse_depth`, 1 / depth, along rays through `columns` and `rows`.

    Parameters
    ----------
    nearest : (rows, columns), the facet at each pixel of the frame without distortion; -1 for none.
    facets : of `Renderer.facets`.
    label : (m,), of each facet.
    """
    for r in range(labels.shape[0]):
        for c in range(labels.shape[1]):
            x, y = columns[r, c], rows[r, c]
            i, j = min(max(int(y), 0), nearest.shape[0] - 1), min(max(int(x), 0), nearest.shape[1] - 1)
            f = nearest[i, j]
            if f < 0:
                labels[r, c], inverse_depth[r, c] = 0, 0.0
            else:
                w = facets[f, W] + facets[f, W + 1] * x + facets[f, W + 2] * y
                labels[r, c], inverse_depth[r, c] = label[f], min(max(w, facets[f, WLowest]), facets[f, WHighest])


Instants = tuple[Pose, Pose, Pose]
"""A pose now, a moment before, and a moment after."""

_SIDE_NS = 1_000_000  # of scene time, from now to the moments before and after


def moments(t_ns: int, time: Timescale) -> tuple[tuple[int, int, int], float]:
    """Return scene times now, before and after stream time `t_ns`, ns; the stream time between the last two, s.

    At the start, where paths may begin, the moment before is now.
    """
    now_ns = time.scene_ns(t_ns)
    first_ns, last_ns = max(now_ns - _SIDE_NS, min(now_ns, time.scene_ns(0))), now_ns + _SIDE_NS
    return (now_ns, first_ns, last_ns), (last_ns - first_ns) / (1e9 * time.factor)


def instants(t_ns: int, paths: Sequence[Trajectory], time: Timescale) -> tuple[list[Instants], float]:
    """Return the poses of `paths` at `moments`, and the stream time from the second to the third, s."""
    (now_ns, first_ns, last_ns), between_s = moments(t_ns, time)
    return [(path.pose(now_ns), path.pose(first_ns), path.pose(last_ns)) for path in paths], between_s


def motion_of(camera: Instants, body: Instants | None, between_s: float) -> Floats:
    """Return M and c of a body in the camera's axes, (3, 4), a second of stream time; None: the sky.

    Parameters
    ----------
    between_s : from before to after.
    """
    (now, s), (before, s_before), (after, s_after) = (
        camera_from_body(eye, STILL if body is None else body[k]) for k, eye in enumerate(camera)
    )
    turning = (after - before) / between_s @ now.T
    # An orthogonal matrix's rate is antisymmetric; any other part of the difference is its error.
    turning = (turning - turning.T) / 2
    out = np.zeros((3, 4))
    out[:, :3] = turning
    if body is not None:
        out[:, 3] = (s_after - s_before) / between_s - turning @ s
    return out


def camera_from_body(camera: Pose, body: Pose) -> tuple[Floats, Floats]:
    """Return the turn, (3, 3), and the shift, (3,) m, of a body's frame into the camera's axes."""
    camera_from_world = camera.world_from_body.T
    return camera_from_world @ body.world_from_body, camera_from_world @ (body.position_m - camera.position_m)


def write_depth_and_flow(inverse_depth: Floats, motions: Floats, camera: Pinhole, rays: Rays, out: Seen) -> None:
    """Write depth and flow of the points that `out.labels` name.

    Parameters
    ----------
    inverse_depth : (height, width), 1/m; not read where the label is 0.
    motions : (labels, 3, 4), of the sky and of each body, see `motion_of`.
    """
    figures = np.array([camera.focal_px, camera.width / 2, camera.height / 2])
    _write(inverse_depth, motions, figures, rays.columns, rays.rows, out.labels, out.depth, out.flow)
    if rays.bend is not None:
        _bend(rays.bend, out.flow)


@entry
def write_flow(nearest: Int32s, data: Data, flow: Float32s, labels: UInt16s) -> None:
    """Write the flow at pixels' middles, linear between the corners of facets, and 1 as label; 0 for the sky.

    Patches have the flow of the facets below them: their own corners move with the edges of shadows.

    Parameters
    ----------
    nearest : (height, width), rows of `data`; -1 for none.
    """
    vertices, faces, over = data.vertices, data.faces, data.over
    for r in range(nearest.shape[0]):
        for c in range(nearest.shape[1]):
            f = nearest[r, c]
            flow[r, c, 0] = flow[r, c, 1] = labels[r, c] = 0
            if f < 0:
                continue
            f = over[f] if over[f] >= 0 else f
            i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
            # Shares of the second and third corner, by areas: within the facet, which may be a line.
            x, y = c + 0.5 - vertices[i, 0], r + 0.5 - vertices[i, 1]
            b_x, b_y = vertices[j, 0] - vertices[i, 0], vertices[j, 1] - vertices[i, 1]
            c_x, c_y = vertices[k, 0] - vertices[i, 0], vertices[k, 1] - vertices[i, 1]
            area = b_x * c_y - b_y * c_x
            second = min(max((x * c_y - y * c_x) / area, 0.0), 1.0)
            third = min(max((y * b_x - x * b_y) / area, 0.0), 1.0 - second)
            for axis in range(2):
                v = vertices[i, 2 + axis]
                flow[r, c, axis] = v + second * (vertices[j, 2 + axis] - v) + third * (vertices[k, 2 + axis] - v)
            labels[r, c] = 1


@entry
def _write(
    inverse_depth: Floats, motions: Floats, figures: Floats, columns: Floats, rows: Floats,
    labels: UInt16s, depth: Float32s, flow: Float32s
) -> None:  # fmt: skip
    focal, x0, y0 = figures
    for r in range(labels.shape[0]):
        for c in range(labels.shape[1]):
            k = labels[r, c]
            x, y = (columns[r, c] - x0) / focal, (rows[r, c] - y0) / focal
            w = inverse_depth[r, c] if k > 0 else 0.0
            m = motions[k]
            along = m[2, 0] * x + m[2, 1] * y + m[2, 2] + w * m[2, 3]
            right = m[0, 0] * x + m[0, 1] * y + m[0, 2] + w * m[0, 3]
            down = m[1, 0] * x + m[1, 1] * y + m[1, 2] + w * m[1, 3]
            depth[r, c] = 1.0 / w if w > 0.0 else np.inf
            flow[r, c, 0] = focal * (right - x * along)
            flow[r, c, 1] = focal * (down - y * along)


@entry
def _bend(bend: Floats, flow: Float32s) -> None:
    """Convert motion in the frame without distortion into motion on the chip."""
    for r in range(flow.shape[0]):
        for c in range(flow.shape[1]):
            u, v = flow[r, c, 0], flow[r, c, 1]
            flow[r, c, 0] = bend[r, c, 0] * u + bend[r, c, 1] * v
            flow[r, c, 1] = bend[r, c, 1] * u + bend[r, c, 2] * v
