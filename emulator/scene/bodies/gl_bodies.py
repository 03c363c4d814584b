"""Bodies in sunlight drawn by GL: the facets and the light of the CPU's painter, averaged over points in each pixel.

    poses at t --> facets, and the light at their corners (`LitBodies`) --> GL --> mean of samples x samples points

Light, W m-2 sr-1, is linear over a facet on the screen, shadows are patches on facets, all as in `raster_bodies`; what
differs is the mean of a pixel, which is exact there, and that GL draws no `grain` below facets. There is no time
derivative: one from two draws has more error at edges than a straight line between light frames.

The vertex shader reads the corners of its facet from buffers, as the CPU wrote them, so that no array is written anew
for each corner: it finds there too whether the facet is seen from its back. Of depth its logarithm is compared, in 24
bits from the nearest vertex to the farthest, and so with the same relative error for a spacecraft and for the planet
behind it. Vertices come relative to the nearest depth, so that a long range cancels nothing in float32. Patches are
drawn last, a few of the 2^24 steps nearer than they are.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from emulator.geometry.camera import Pinhole, Rays
from emulator.gl.render_target import RenderTarget
from emulator.light import Region
from emulator.raster.layout import View
from emulator.scene.bodies.raster_bodies import LIFT, NEAREST_SHARE, BodiesGeometry, LitBodies
from emulator.scene.bodies.table import BodiesParameters
from emulator.scene.bodies.world import BodyWorld
from emulator.scene.world import GlScene
from emulator.threads import available_threads

if TYPE_CHECKING:
    import moderngl


_VERTEX = """
#version 430
layout(std430, binding = 0) readonly buffer Places { float place[]; };      // camera axes, m, z less near
layout(std430, binding = 1) readonly buffer Faces { int corner[]; };        // vertices of facets
layout(std430, binding = 2) readonly buffer Shades { int entry[]; };        // in the list of light, for each corner
layout(std430, binding = 3) readonly buffer Radiance { float light[]; };
layout(std430, binding = 4) readonly buffer Sides { uint two_sided[]; };    // four facets a word
uniform vec2 zoom;                                                          // see Pinhole.zoom
uniform float near;                                                         // m: what is nearer is cut
noperspective out float radiance;
out float beyond;                                                           // depth less near, m

vec3 vertex(int k) {
    int first = 3 * corner[k];
    return vec3(place[first], place[first + 1], place[first + 2]);
}

void main() {
    int facet = gl_VertexID / 3;
    vec3 a = vertex(3 * facet), b = vertex(3 * facet + 1), c = vertex(3 * facet + 2);
    bool from_both = (two_sided[facet >> 2] >> 8 * (facet & 3) & 255u) != 0u;
    vec3 at = vertex(gl_VertexID);
    radiance = light[entry[gl_VertexID]];
    beyond = at.z;
    gl_Position = vec4(zoom * at.xy, at.z - near, at.z + near);  // no farthest plane
    bool from_front = dot(cross(b - a, c - a), a + vec3(0.0, 0.0, near)) < 0.0;
    if (!from_front && !from_both) gl_Position = vec4(0.0);  // three equal corners: no facet
}
"""

_FRAGMENT = """
#version 430
uniform float near, octaves, lift;
noperspective in float radiance;
in float beyond;
out float light;
void main() {
    light = max(radiance, 0.0);
    float u = beyond / near;
    float octave = u < 0.01 ? u * (1.0 - u * (0.5 - u / 3.0)) * 1.442695 : log2(1.0 + u);
    gl_FragDepth = octave / octaves - lift;
}
"""

_LIFT = 4 / 2**24  # of patches
_ROOM = 0.01
_NOTHING, _MARGIN_PX = Region(0, 1, 0, 1), 1  # of pixels, for rounding by GL and to float32


class GlBodies(GlScene[BodyWorld]):
    """The bodies of `parameters` as `pinhole` sees them, in radiance, drawn by GL.

    Raises SceneError where a shape or a path cannot be used, the camera begins inside a body, or there is no GL.
    """

    def __init__(self, parameters: BodiesParameters, pinhole: Pinhole) -> None:
        world = BodyWorld(parameters, pinhole)
        super().__init__(world, RenderTarget(pinhole.size, parameters.samples))
        self._pinhole = pinhole
        self._lit = LitBodies(world, pinhole, available_threads())
        with self._render_target.context as gl:
            self._program = gl.program(vertex_shader=_VERTEX, fragment_shader=_FRAGMENT)
            self._array = gl.vertex_array(self._program, [])
            self._buffers = [gl.buffer(reserve=64) for _ in range(5)]

    def geometry(self, rays: Rays | None = None) -> BodiesGeometry:
        """Return depth, flow and labels of the bodies, from shapes and poses alone."""
        return BodiesGeometry(self._world, rays)

    def close(self) -> None:
        """End the threads, release the GL context, and close the ports; a second call does nothing."""
        self._lit.close()
        super().close()

    def _drawing(self, t_ns: int) -> tuple[Callable[[moderngl.Context], None], Region]:
        view = self._lit.view(t_ns)
        places_m = view.positions_m
        ahead_m = places_m[places_m[:, 2] > NEAREST_SHARE * self.distance_m, 2]
        near_m, far_m = (float(ahead_m.min()), float(ahead_m.max())) if len(ahead_m) else (0.5, 1.0)
        # Room for patches, which are nearer than their facets, and for rounding.
        room_m = min(_ROOM * (far_m - near_m) + 2 * LIFT * near_m, _ROOM * near_m)
        render = partial(self._draw, view, near_m - room_m, far_m + room_m)
        return render, touched_region(places_m, self._pinhole)

    def _draw(self, view: View, near_m: float, far_m: float, gl: moderngl.Context) -> None:
        """Draw all facets between two depths, then all patches."""
        topology = self._lit.topology
        facets = int(np.count_nonzero(topology.over < 0))
        sides = np.zeros(-(-len(topology.faces) // 4) * 4, np.uint8)
        sides[: len(topology.faces)] = topology.two_sided
        arrays: tuple[npt.NDArray[np.generic], ...] = (
            (view.positions_m[: topology.vertices] - [0, 0, near_m]).astype(np.float32),
            topology.faces,
            topology.shades,
            view.radiance[: topology.entries].astype(np.float32),
            sides,
        )
        for binding, array in enumerate(arrays):
            if array.nbytes > self._buffers[binding].size:  # a buffer grows as needed
                self._buffers[binding].release()
                self._buffers[binding] = gl.buffer(reserve=2 * array.nbytes)
            buffer = self._buffers[binding]
            buffer.orphan()
            if array.nbytes:
                buffer.write(np.ascontiguousarray(array))
            buffer.bind_to_storage_buffer(binding)
        self._program["zoom"], self._program["near"] = self._pinhole.zoom, near_m
        self._program["octaves"] = math.log1p((far_m - near_m) / near_m) / math.log(2)
        gl.enable_only(gl.DEPTH_TEST)
        for first, last, lift in ((0, facets, 0.0), (facets, len(topology.faces), _LIFT)):
            self._program["lift"] = lift
            self._array.render(gl.TRIANGLES, vertices=3 * (last - first), first=3 * first)


def touched_region(places_m: npt.NDArray[np.float64], pinhole: Pinhole) -> Region:
    """Return a region around all between points, (n, 3) m in the camera's axes; the frame if any is behind it."""
    size = np.array(pinhole.size)
    ahead = places_m[:, 2] > 0
    if not ahead.any():
        return _NOTHING
    if not ahead.all():
        return Region(0, pinhole.height, 0, pinhole.width)
    with np.errstate(over="ignore"):
        seen = pinhole.focal_px * places_m[:, :2] / places_m[:, 2:] + size / 2
    first = np.clip(np.floor(seen.min(axis=0)) - _MARGIN_PX, 0, size - 1).astype(int)
    last = np.clip(np.ceil(seen.max(axis=0)) + _MARGIN_PX, first + 1, size).astype(int)
    return Region(int(first[1]), int(last[1]), int(first[0]), int(last[0]))
