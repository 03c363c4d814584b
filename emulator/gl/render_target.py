"""Render targets of GL: a context, and the textures in which a light frame is drawn.

    fine target     R32F with depth, n x n samples a pixel
      -> mean       each pixel the mean of its n x n samples, in linear light; only in the touched region of that frame
    light frame     R32F, the sensor's size; outside the touched region it is 0, the dark sky
      -> out        (height, width) float32, row 0 on top

Camera axes are OpenCV's: x right, y down, z out. GL's rows run upward; the frame is drawn upside down there, so that
its first row comes first when it is read, and facets that are counter-clockwise here are clockwise in GL.

There are as many slots for light frames as may be pending at a time.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from emulator.gl.context import open_context, renderer_name
from emulator.light import Light, SceneError

if TYPE_CHECKING:
    import moderngl


MOST_PENDING = 3
"""Light frames that can be drawn before the first of them is taken."""


class _Slot:
    """A light frame of R32F pixels."""

    def __init__(self, gl: moderngl.Context, size: tuple[int, int]) -> None:
        self.target = gl.framebuffer([gl.texture(size, 1, dtype="f4")])
        self.target.clear()

    def receive(self, out: Light) -> None:
        if out.flags.c_contiguous:
            self.target.read_into(out, components=1, dtype="f4")
        else:
            contiguous = np.empty(out.shape, np.float32)
            self.receive(contiguous)
            out[:] = contiguous


class Readback:
    """Slots for light frames of `size` = (width, height) in the current context, used one after another."""

    def __init__(self, gl: moderngl.Context, size: tuple[int, int]) -> None:
        self._free = deque(_Slot(gl, size) for _ in range(MOST_PENDING))
        self._sent: deque[_Slot] = deque()

    @property
    def target(self) -> moderngl.Framebuffer:
        """Framebuffer for the next light frame; raises SceneError when all slots hold frames that were not taken."""
        if not self._free:
            raise SceneError(f"{MOST_PENDING} light frames are pending: take one before the next is drawn")
        return self._free[0].target

    def send(self) -> None:
        """Mark the light frame on `target` as pending."""
        self._sent.append(self._free.popleft())

    def receive(self, out: Light) -> None:
        """Write the oldest pending light frame into `out`, (height, width) float32; raises SceneError without one."""
        if not self._sent:
            raise SceneError("no light frame is pending: draw one before it is taken")
        place = self._sent.popleft()
        place.receive(out)
        self._free.append(place)


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


@dataclass(frozen=True)
class Rectangle:
    """Part of a light frame: columns `left` to `left + width`, rows `top` to `top + height`."""

    left: int
    top: int
    width: int
    height: int


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
                _require_fits(gl, size, fine_size)
                self._samples_texture = gl.texture(fine_size, 1, dtype="f4")
                self._fine = gl.framebuffer([self._samples_texture], gl.depth_renderbuffer(fine_size))
                self._readback = Readback(gl, size)
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

    def draw(
        self,
        render: Callable[[moderngl.Context], None],
        out: Light,
        prepare: Callable[[], None] | None = None,
        region: Rectangle | None = None,
    ) -> None:
        """Call `render` to draw the samples, and write their means into `out`, (height, width) float32.

        When `render` is called the context is current, the target cleared, and depth test and culling are on. `prepare`
        is called before that, for targets of its own. Nothing may be drawn outside `region`, where it is given; it
        saves time.
        """
        self.begin(render, prepare, region)
        self.take(out)

    def draw_all(self, drawings: Sequence[Callable[[], None]], outs: Sequence[Light]) -> None:
        """Write the light frames that `drawings` begin into `outs`; several are begun before the first is taken."""
        for first in range(0, len(outs), MOST_PENDING):
            for begin in drawings[first : first + MOST_PENDING]:
                begin()
            for out in outs[first : first + MOST_PENDING]:
                self.take(out)

    def begin(
        self,
        render: Callable[[moderngl.Context], None],
        prepare: Callable[[], None] | None = None,
        region: Rectangle | None = None,
    ) -> None:
        """Draw the samples as `draw` does, without waiting; `take` waits for the light frame and writes it.

        Up to `MOST_PENDING` frames can be begun before the first one is taken; they are taken in the same order.
        """
        if not self._is_open:
            raise SceneError("the scene was closed: build it again")
        target = self._readback.target
        with self.context as gl:
            if prepare is not None:
                prepare()
            self._fine.use()
            self._fine.clear()
            gl.enable_only(gl.DEPTH_TEST | gl.CULL_FACE)
            gl.front_face, gl.cull_face = "cw", "back"
            render(gl)
            self._average(gl, target, region or Rectangle(0, 0, *self.size))
            self._readback.send()
        # Leaving a context flushes it (EGL 1.5, section 3.7.3): the renderer starts now.

    def take(self, out: Light) -> None:
        """Write the oldest light frame that was begun and not taken into `out`, (height, width) float32."""
        if not self._is_open:
            raise SceneError("the scene was closed: build it again")
        with self.context:
            self._readback.receive(out)

    def _average(self, gl: moderngl.Context, target: moderngl.Framebuffer, region: Rectangle) -> None:
        target.use()
        target.clear()
        target.viewport = (region.left, region.top, region.width, region.height)
        gl.enable_only(gl.NOTHING)
        self._samples_texture.use(0)
        self._cover.render(gl.TRIANGLES, vertices=3)
        target.viewport = (0, 0, *self.size)


def depth_terms(near_m: float, far_m: float) -> tuple[float, float]:
    """Return a, b of gl_Position.z = a z + b with w = z, for points between `near_m` and `far_m` along the boresight.

    Take both from the visible objects at that moment, and coordinates relative to the camera, subtracted in float64:
    float32 depth then resolves z^2 / near / 16 million.
    """
    if not 0 < near_m < far_m:
        raise ValueError(f"near_m = {near_m:g}, far_m = {far_m:g}: must be above 0 and in this order")
    apart = far_m - near_m
    return (far_m + near_m) / apart, -2 * far_m * near_m / apart


def _require_fits(context: moderngl.Context, *sizes: tuple[int, int]) -> None:
    largest = int(context.info["GL_MAX_TEXTURE_SIZE"])
    for size in sizes:
        if max(size) > largest:
            raise SceneError(
                f"{size[0]} x {size[1]} samples are needed and this GL draws at most {largest} in a row: use fewer "
                "samples"
            )
