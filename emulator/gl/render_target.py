"""Render target of GL: a context, and the textures in which a light frame is drawn.

    fine target     R32F with depth, n x n samples a pixel
      -> mean       R32F, the sensor's size: each pixel the mean of its n x n samples, in linear light; only in the
                    touched region of that frame, 0 outside, the dark sky
      -> out        (height, width) float32, row 0 on top

Camera axes are OpenCV's: x right, y down, z out. GL's rows run upward; the frame is drawn upside down there, so that
its first row comes first when it is read, and facets that are counter-clockwise here are clockwise in GL.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from emulator.gl.context import open_context, renderer_name
from emulator.light import Light, Region, SceneError

if TYPE_CHECKING:
    import moderngl


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
    ivec2 first = ivec2(gl_FragCoord.xy) * N;
    float sum = N %% 2 == 0 ? sum_of_gathers(vec2(first)) : sum_of_fetches(first);
    light = sum / float(N * N);
}
"""


class RenderTarget:
    """A context in this thread, for light frames of `size` = (width, height), `samples` x `samples` a pixel.

    Raises SceneError where there is no GL, or the light frame is too large for it.
    """

    def __init__(self, size: tuple[int, int], samples: int) -> None:
        self.size, self.samples = size, samples
        self._is_open = True
        self.context = open_context()
        self.renderer = renderer_name(self.context)
        try:
            with self.context as gl:
                fine_size = (size[0] * samples, size[1] * samples)
                if max(fine_size) > (largest := int(gl.info["GL_MAX_TEXTURE_SIZE"])):
                    raise SceneError(
                        f"{fine_size[0]} x {fine_size[1]} samples are needed and this GL draws at most {largest} in a "
                        "row: use fewer samples"
                    )
                self._samples_texture = gl.texture(fine_size, 1, dtype="f4")
                self._fine = gl.framebuffer([self._samples_texture], gl.depth_renderbuffer(fine_size))
                self._light = gl.framebuffer([gl.texture(size, 1, dtype="f4")])
                self._mean = gl.program(vertex_shader=_CORNERS, fragment_shader=_MEAN % {"samples": samples})
                self._cover = gl.vertex_array(self._mean, [])
        except SceneError:
            self.close()
            raise

    def close(self) -> None:
        """Release the context with its objects; a second call does nothing."""
        if self._is_open:
            self._is_open = False
            self.context.release()

    def draw(self, render: Callable[[moderngl.Context], None], out: Light, region: Region | None = None) -> None:
        """Call `render` to draw the samples, and write their means into `out`, (height, width) float32.

        When `render` is called the context is current, the target cleared, and depth test and culling are on. Nothing
        may be drawn outside `region`, where it is given; it saves time.
        """
        if not self._is_open:
            raise SceneError("the scene was closed: build it again")
        contiguous = out if out.flags.c_contiguous else np.empty(out.shape, np.float32)
        with self.context as gl:
            self._fine.use()
            self._fine.clear()
            gl.enable_only(gl.DEPTH_TEST | gl.CULL_FACE)
            gl.front_face, gl.cull_face = "cw", "back"
            render(gl)
            self._light.use()
            self._light.clear()
            top, bottom, left, right = region.bounds if region else (0, self.size[1], 0, self.size[0])
            self._light.viewport = (left, top, right - left, bottom - top)
            gl.enable_only(gl.NOTHING)
            self._samples_texture.use(0)
            self._cover.render(gl.TRIANGLES, vertices=3)
            self._light.viewport = (0, 0, *self.size)
            self._light.read_into(contiguous, components=1, dtype="f4")
        if contiguous is not out:
            out[:] = contiguous


def depth_terms(near_m: float, far_m: float) -> tuple[float, float]:
    """Return a, b of gl_Position.z = a z + b with w = z, for points between `near_m` and `far_m` along the boresight.

    Take both from the visible objects at that moment, and coordinates relative to the camera, subtracted in float64:
    float32 depth then resolves z^2 / near / 16 million.
    """
    if not 0 < near_m < far_m:
        raise ValueError(f"near_m = {near_m:g}, far_m = {far_m:g}: must be above 0 and in this order")
    apart = far_m - near_m
    return (far_m + near_m) / apart, -2 * far_m * near_m / apart
