"""A mesh drawn by GL into a picture of light: supersampled, averaged over each pixel, read back.

    fine target     R32F, n x n samples a pixel, only the rectangle of the picture that the mesh can reach
      -> mean       each pixel the mean of its n x n samples, in linear light
    picture         R32F, the sensor's size; outside the rectangle it stays 0, the dark sky
      -> out        (height, width) float32, row 0 on top

Camera axes are OpenCV's: x right, y down, z out. GL's rows run upward; the picture is drawn upside down there, so that
its first row comes first when it is read, and facets that are counter-clockwise to us are clockwise to GL.

Lommel-Seeliger needs mu0 / (mu0 + mu), which does not change when the normal gets longer or shorter. So the two
cosines are computed at the vertices and interpolated, which is the same as interpolating the normal and costs the
fragments one division.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from emulator.scene.base import Light, SceneError
from emulator.scene.gl import open_context, renderer_name
from emulator.scene.mesh import Mesh

if TYPE_CHECKING:
    import moderngl

__all__ = ["Raster", "Rectangle", "View"]

_VERTEX = """
#version 430
uniform mat3 camera_from_body;
uniform vec3 sun;        // to the Sun, camera axes
uniform float range;     // to the body's centre, body radii
uniform vec2 zoom;       // focal length over half the picture
in vec3 position;        // body radii
in vec3 normal;
out vec2 cosines;        // of incidence and of emission
void main() {
    vec3 from_centre = camera_from_body * position;
    vec3 outward = camera_from_body * normal;
    vec3 ray = from_centre + vec3(0.0, 0.0, range);
    cosines = vec2(dot(outward, sun), -dot(outward, normalize(ray)));
    // near and far planes one radius before and behind the centre; written so that a long range cancels nothing
    gl_Position = vec4(zoom * ray.xy, range * from_centre.z + 1.0, ray.z);
}
"""

_FRAGMENT = """
#version 430
uniform float full;      // light where both cosines are equal, times two
in vec2 cosines;
out float light;
void main() {
    float lit = max(cosines.x, 0.0);
    // at the limb an interpolated normal can lean away from the eye: by a little, and it counts as that little
    light = full * lit / max(lit + abs(cosines.y), 1e-20);
}
"""

_CORNERS = """
#version 430
void main() {
    gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0);
}
"""

_MEAN = """
#version 430
const int N = %(samples)d;
uniform sampler2D fine;
uniform ivec2 corner;    // of the rectangle in the picture
out float light;

float sum_of_gathers(vec2 first) {   // four samples a time, a third faster on llvmpipe
    vec4 sum = vec4(0.0);
    for (int j = 1; j < N; j += 2)
        for (int i = 1; i < N; i += 2)
            sum += textureGather(fine, (first + vec2(i, j)) / vec2(textureSize(fine, 0)));
    return dot(sum, vec4(1.0));
}

float sum_of_fetches(ivec2 first) {
    float sum = 0.0;
    for (int j = 0; j < N; ++j)
        for (int i = 0; i < N; ++i)
            sum += texelFetch(fine, first + ivec2(i, j), 0).r;
    return sum;
}

void main() {
    ivec2 first = (ivec2(gl_FragCoord.xy) - corner) * N;
    float sum = N %% 2 == 0 ? sum_of_gathers(vec2(first)) : sum_of_fetches(first);
    light = sum / float(N * N);
}
"""


@dataclass(frozen=True)
class Rectangle:
    """Part of a picture: columns `left` to `left + width`, rows `top` to `top + height`."""

    left: int
    top: int
    width: int
    height: int


@dataclass(frozen=True)
class View:
    """How the mesh is seen and lit.

    Attributes
    ----------
    camera_from_body : (3, 3) rotation.
    sun : (3,) unit, towards the Sun in camera axes.
    range_radii : distance of the body's origin, on the boresight, in radii of the mesh; > 1.
    zoom : focal length over half the picture's width and height.
    full : twice the light of a facet seen and lit under equal angles.
    """

    camera_from_body: npt.NDArray[np.float64]
    sun: npt.NDArray[np.float64]
    range_radii: float
    zoom: tuple[float, float]
    full: float


class Raster:
    """Draws `mesh` into pictures of `size` = (width, height), `samples` x `samples` a pixel, inside `reach` only."""

    def __init__(self, mesh: Mesh, size: tuple[int, int], samples: int, reach: Rectangle) -> None:
        self._size, self._samples, self._reach = size, samples, reach
        self._is_open = True
        self._context = open_context()
        self.renderer = renderer_name(self._context)
        try:
            with self._context:
                _require_fits(self._context, size, (reach.width * samples, reach.height * samples))
                self._build(mesh)
        except SceneError:
            self.close()
            raise

    def close(self) -> None:
        """Release the context and what lives in it; a second call does nothing."""
        if self._is_open:
            self._is_open = False
            self._context.release()

    def _build(self, mesh: Mesh) -> None:
        gl, reach, n = self._context, self._reach, self._samples
        fine_size = (reach.width * n, reach.height * n)
        self._samples_texture = gl.texture(fine_size, 1, dtype="f4")
        self._fine = gl.framebuffer([self._samples_texture], gl.depth_renderbuffer(fine_size))
        self._picture = gl.framebuffer([gl.renderbuffer(self._size, 1, dtype="f4")])
        self._picture.clear()
        self._shading = gl.program(vertex_shader=_VERTEX, fragment_shader=_FRAGMENT)
        self._mean = gl.program(vertex_shader=_CORNERS, fragment_shader=_MEAN % {"samples": n})
        self._mean["corner"] = (reach.left, reach.top)
        points = np.hstack([mesh.vertices / mesh.radius_m, mesh.normals]).astype(np.float32)
        self._facets = gl.vertex_array(
            self._shading,
            [(gl.buffer(points), "3f 3f", "position", "normal")],
            index_buffer=gl.buffer(np.ascontiguousarray(mesh.faces)),
        )
        self._cover = gl.vertex_array(self._mean, [])

    def draw(self, view: View, out: Light) -> None:
        """Write the light into `out`, (height, width) float32."""
        if not self._is_open:
            raise SceneError("the scene was closed: it draws no more")
        with self._context:
            self._draw_samples(view)
            self._average()
            if out.flags.c_contiguous:
                self._picture.read_into(out, components=1, dtype="f4")
            else:
                out[:] = np.frombuffer(self._picture.read(components=1, dtype="f4"), np.float32).reshape(out.shape)

    def _draw_samples(self, view: View) -> None:
        gl, reach, n = self._context, self._reach, self._samples
        shading = self._shading
        shading["camera_from_body"] = tuple(view.camera_from_body.T.ravel())  # GL stores columns
        shading["sun"], shading["zoom"] = tuple(view.sun), view.zoom
        shading["range"], shading["full"] = view.range_radii, view.full
        self._fine.use()
        self._fine.viewport = (-reach.left * n, -reach.top * n, self._size[0] * n, self._size[1] * n)
        gl.enable_only(gl.DEPTH_TEST | gl.CULL_FACE)
        gl.front_face = "cw"
        self._fine.clear(viewport=(0, 0, reach.width * n, reach.height * n))
        self._facets.render()

    def _average(self) -> None:
        gl, reach = self._context, self._reach
        self._picture.use()
        self._picture.viewport = (reach.left, reach.top, reach.width, reach.height)
        gl.enable_only(gl.NOTHING)
        self._samples_texture.use(0)
        self._cover.render(gl.TRIANGLES, vertices=3)
        self._picture.viewport = (0, 0, *self._size)


def _require_fits(context: moderngl.Context, *sizes: tuple[int, int]) -> None:
    most = int(context.info["GL_MAX_TEXTURE_SIZE"])
    for size in sizes:
        if max(size) > most:
            raise SceneError(
                f"{size[0]} x {size[1]} samples are needed and this GL draws at most {most} in a row: use fewer samples"
            )
