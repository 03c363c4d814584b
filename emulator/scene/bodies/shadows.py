"""Shadows of bodies on themselves and on one another: a map of depths as the Sun sees them.

Along the Sun's rays the map is a parallel projection of a sphere around all that throws shadows:

    x, y    0 to 1 over the sphere's diameter        z    metres behind the sphere's sunward side

A point is in the dark when the map holds a smaller depth than its own. Four neighbours are asked and their answers
weighted bilinearly, so an edge is a ramp of one texel rather than a step; a texel is at most a pixel, or the sphere's
diameter / 1024. That stands for the Sun's penumbra (its half-degree disc), which is as wide as 1 / 1024 where a shadow
falls from 0.1 of the diameter away at 1 au.

Only the sides away from the Sun are drawn into the map. They lie in the dark anyway, so a lit surface cannot throw a
shadow on itself by rounding, and what throws may be coarser than what is seen (by cells of eight texels). What is left
of that trouble, near the terminator, is lifted off along the normal by a texel and a half.

Left out: penumbras much wider than a texel, and those of one body on another far away.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from emulator.geometry.attitude import Matrix, Vector, unit
from emulator.scene.bodies.culling import Cells, draw
from emulator.scene.bodies.mesh import Mesh

if TYPE_CHECKING:
    import moderngl

__all__ = ["SUNLIT_GLSL", "ShadowMap", "Thrower"]

_LEAST_TEXELS, _MOST_TEXELS = 256, 1024
_LIFT_TEXELS = 1.5
_COARSE_TEXELS = 8

_VERTEX = """
#version 430
uniform mat4 shadow_from_body;
uniform float range_m;
in vec3 position;
void main() {
    vec3 s = (shadow_from_body * vec4(position, 1.0)).xyz;
    gl_Position = vec4(s.xy * 2.0 - 1.0, s.z / range_m * 2.0 - 1.0, 1.0);
}
"""
_FRAGMENT = "#version 430\nvoid main() {}\n"

SUNLIT_GLSL = """
uniform sampler2D depths;
uniform float range_m;
float sunlit(vec3 s) {
    vec2 at = s.xy * float(textureSize(depths, 0).x) - 0.5;
    vec2 part = fract(at);
    vec4 free = step(vec4(s.z / range_m), textureGather(depths, (floor(at) + 1.0) / float(textureSize(depths, 0).x)));
    vec2 across = mix(free.wx, free.zy, part.x);   // lower and upper row
    return mix(across.x, across.y, part.y);
}
"""
"""`float sunlit(vec3 in_shadow_map)`: the share of the Sun that a point sees."""


class Thrower:
    """A mesh that throws shadows, as coarse as the map can show."""

    def __init__(self, context: moderngl.Context, program: moderngl.Program, mesh: Mesh) -> None:
        self._cells = Cells(mesh)
        self._array = context.vertex_array(
            program,
            [(context.buffer(mesh.vertices.astype(np.float32)), "3f", "position")],
            index_buffer=context.buffer(self._cells.faces),
        )
        self._commands = context.buffer(reserve=self._cells.buffer_bytes)

    def render(self, sun: Vector) -> None:
        """Draw the sides away from the Sun, which is at `sun` (3,) in the body's frame, into the map."""
        draw(self._array, self._cells.turned_from(sun), self._commands)


class ShadowMap:
    """The map of one stage.

    Parameters
    ----------
    radius_m : of the sphere around all that throws shadows.
    pixel_m : what a pixel spans at the closest range: finer texels would not be seen.

    Attributes
    ----------
    lift_m : how far points are to be lifted along their normals before they are looked up.
    coarse_m : how coarse what throws shadows may be.
    """

    def __init__(self, context: moderngl.Context, radius_m: float, pixel_m: float) -> None:
        self._context, self._range_m = context, 2 * radius_m
        wanted = 2 ** math.ceil(math.log2(max(1.0, self._range_m / pixel_m)))
        texels = min(max(wanted, _LEAST_TEXELS), _MOST_TEXELS)
        self._depths = context.depth_texture((texels, texels))
        self._depths.compare_func = ""
        self._depths.repeat_x = self._depths.repeat_y = False
        self._target = context.framebuffer(depth_attachment=self._depths)
        self._program = context.program(vertex_shader=_VERTEX, fragment_shader=_FRAGMENT)
        self._program["range_m"] = self._range_m
        self.texel_m = self._range_m / texels
        self.lift_m = _LIFT_TEXELS * self.texel_m
        self.coarse_m = _COARSE_TEXELS * self.texel_m

    @property
    def range_m(self) -> float:
        """Depth of the map."""
        return self._range_m

    def thrower(self, mesh: Mesh) -> Thrower:
        """Take a mesh into the context's memory."""
        return Thrower(self._context, self._program, mesh)

    def from_world(self, sun: Vector, centre_m: Vector) -> Matrix:
        """Return shadow_from_world, (4, 4), for a Sun in the direction (3,) and the sphere's centre (3,)."""
        z = -unit(sun)
        x = unit(np.cross(z, np.eye(3)[int(np.argmin(np.abs(z)))]))
        axes = np.vstack([x / self._range_m, np.cross(z, x) / self._range_m, z])
        matrix = np.eye(4)
        matrix[:3, :3] = axes
        matrix[:3, 3] = np.array([0.5, 0.5, self._range_m / 2]) - axes @ centre_m
        return matrix

    def render(self, throwers: Iterable[tuple[Thrower, npt.NDArray[np.float64]]]) -> None:
        """Draw the map anew: each thrower with its shadow_from_body, (4, 4)."""
        gl = self._context
        self._target.use()
        self._target.clear()
        gl.enable_only(gl.DEPTH_TEST | gl.CULL_FACE)
        gl.front_face, gl.cull_face = "cw", "front"
        for thrower, shadow_from_body in throwers:
            self._program["shadow_from_body"] = tuple(shadow_from_body.T.ravel())
            thrower.render(unit(-shadow_from_body[2, :3]))  # the map's third axis goes away from the Sun

    def use(self) -> None:
        """Put the map where shaders look for it."""
        self._depths.use(0)
