"""Drawing of meshes by GL: lit by the Sun by their law of reflection, with shadows from a shadow map.

The vertex shader computes the cosines of incidence and emission, and the terms that depend on the phase angle alone;
they are interpolated over a facet, as normals are, so facet edges are not visible. Phase angles come from
atan(|cross|, dot): the error of acos is 1.6e-4 rad. The fragment shader gives radiance, W m-2 sr-1:

    L = E_sun r(mu0, mu, g) sunlit + ambient r(mu, mu, 0)

where `ambient` stands for light from all around (earthshine, light from other ground), as if it came from the eye.

Facets that face away are half of any closed body; skipping them saves half of the work. Facets are sorted by the
direction of their normals into the cells of a cube's faces, so that one test decides for some hundred of them. A cell
is skipped when no facet in it can face the eye: with the cone of its normals (axis a, half-angle c), the ball around
its vertices (centre m, radius r) and the eye at e,

    angle(a, e - m) > 90 degrees + c + asin(r / |e - m|)

The light frame is the same to the last bit, because GL would discard these facets one by one.

Source of the idea: backface culling by cones of normals, Shirman and Abi-Ezzi 1993.

The shadow map holds the depths of bodies as seen from the Sun, for shadows of bodies on themselves and on one another.
It is a parallel projection, along the Sun's rays, of a sphere around all shadow casters:

    x, y    0 to 1 over the sphere's diameter        z    metres behind the sphere's sunward side

A point is in shadow when the map holds a smaller depth than its own. Four neighbouring texels are read and weighted
bilinearly, so an edge is a ramp of one texel rather than a step; a texel is at most a pixel, or the sphere's
diameter / 1024. This ramp replaces the Sun's penumbra (its half-degree disc), which is as wide as 1 / 1024 where a
shadow falls from 0.1 of the diameter away at 1 au. The map is read at the vertices where facets are about as small as
its texels or as pixels, and the results are interpolated: this is as sharp and costs a fraction. For larger facets it
is read at every fragment.

Only the sides away from the Sun are drawn into the map. They are in shadow anyway, so rounding cannot make a lit
surface shadow itself, and shadow casters may be coarser than visible bodies (by cells of eight texels). The rest of
this error, near the terminator, is avoided by lifting points along the normal by a texel and a half.

Left out: penumbras much wider than a texel, and those of one body on another far away.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from emulator.geometry.attitude import Matrix, Vector, unit
from emulator.photometry.reflectance import Reflectance
from emulator.scene.bodies.mesh import Mesh

if TYPE_CHECKING:
    import moderngl


_CELLS_A_SIDE = 4  # of each of the cube's six faces: 96 cells

Floats = npt.NDArray[np.float64]


class Cells:
    """The facets of a mesh by the direction that they face.

    Attributes
    ----------
    faces : (m, 3) int32, the mesh's facets, sorted by cell.
    """

    def __init__(self, mesh: Mesh) -> None:
        normals = _facet_normals(mesh)
        cell = _cube_cell(normals)
        order = np.argsort(cell, kind="stable")
        self.faces = np.ascontiguousarray(mesh.faces[order])
        _, first, count = np.unique(cell[order], return_index=True, return_counts=True)
        self._commands = np.zeros((len(first), 5), np.uint32)  # count, instances, first index, base vertex, instance
        self._commands[:, 0], self._commands[:, 1], self._commands[:, 2] = 3 * count, 1, 3 * first
        groups = [slice(f, f + n) for f, n in zip(first, count, strict=True)]
        sorted_normals = normals[order]
        self._axes = np.array([_unit(sorted_normals[g].sum(axis=0)) for g in groups])
        self._cones = np.array(
            [math.acos(min(1.0, float((sorted_normals[g] @ a).min()))) for g, a in zip(groups, self._axes, strict=True)]
        )
        corners = [mesh.vertices[np.unique(self.faces[g])] for g in groups]
        self._middles = np.array([(c.min(axis=0) + c.max(axis=0)) / 2 for c in corners])
        self._radii = np.array(
            [np.linalg.norm(c - m, axis=1).max() for c, m in zip(corners, self._middles, strict=True)]
        )

    @property
    def buffer_bytes(self) -> int:
        """Room that all drawing commands need."""
        return self._commands.nbytes

    def seen_from(self, eye_m: Floats) -> npt.NDArray[np.uint32]:
        """Return the drawing commands, (n, 5), of cells that may face an eye at (3,), in the body's frame."""
        towards = eye_m - self._middles
        distance = np.linalg.norm(towards, axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            spread = np.where(distance > self._radii, np.arcsin(np.minimum(1.0, self._radii / distance)), math.pi)
            angle = np.arccos(np.clip((self._axes * towards).sum(axis=1) / distance, -1, 1))
        return np.asarray(self._commands[~(angle > math.pi / 2 + self._cones + spread + 1e-3)])

    def turned_from(self, direction: Floats) -> npt.NDArray[np.uint32]:
        """Return the drawing commands, (n, 5), of cells that may turn their backs to a far `direction`, (3,)."""
        angle = np.arccos(np.clip(self._axes @ direction, -1, 1))
        return np.asarray(self._commands[~(angle < math.pi / 2 - self._cones - 1e-3)])


def draw(array: moderngl.VertexArray, commands: npt.NDArray[np.uint32], buffer: moderngl.Buffer) -> None:
    """Draw the cells of `commands`."""
    if len(commands):
        buffer.write(np.ascontiguousarray(commands))
        array.render_indirect(buffer, count=len(commands))


def _facet_normals(mesh: Mesh) -> Floats:
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    return _unit(np.cross(b - a, c - a))


def _unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-300))


def _cube_cell(directions: Floats) -> npt.NDArray[np.int64]:
    """Return the cell of the cube around the origin through which each direction, (n, 3), goes."""
    axis = np.abs(directions).argmax(axis=1)
    rows = np.arange(len(directions))
    major = directions[rows, axis]
    side = 2 * axis + (major < 0)
    u, v = (directions[rows, (axis + k) % 3] / np.abs(major) for k in (1, 2))
    across, down = (np.clip(((w + 1) / 2 * _CELLS_A_SIDE).astype(np.int64), 0, _CELLS_A_SIDE - 1) for w in (u, v))
    return np.asarray((side * _CELLS_A_SIDE + down) * _CELLS_A_SIDE + across)


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
"""`float sunlit(vec3 in_shadow_map)`: the visible share of the Sun's disc at a point."""


class ShadowCaster:
    """A mesh that casts shadows, as coarse as the resolution of the map allows."""

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
    """The shadow map of one scene.

    Parameters
    ----------
    radius_m : of the sphere around all shadow casters.
    pixel_m : width of a pixel on the bodies at the closest range: finer texels would have no effect.

    Attributes
    ----------
    lift_m : distance by which points are lifted along their normals before the map is read.
    coarse_m : size of cells in which the meshes of shadow casters are simplified.
    """

    def __init__(self, context: moderngl.Context, radius_m: float, pixel_m: float) -> None:
        self._context, self._range_m = context, 2 * radius_m
        fine = 2 ** math.ceil(math.log2(max(1.0, self._range_m / pixel_m)))
        texels = min(max(fine, _LEAST_TEXELS), _MOST_TEXELS)
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

    def caster(self, mesh: Mesh) -> ShadowCaster:
        """Take a mesh into the context's memory."""
        return ShadowCaster(self._context, self._program, mesh)

    def from_world(self, sun: Vector, centre_m: Vector) -> Matrix:
        """Return shadow_from_world, (4, 4), for a Sun in the direction (3,) and the sphere's centre (3,)."""
        z = -unit(sun)
        x = unit(np.cross(z, np.eye(3)[int(np.argmin(np.abs(z)))]))
        axes = np.vstack([x / self._range_m, np.cross(z, x) / self._range_m, z])
        matrix = np.eye(4)
        matrix[:3, :3] = axes
        matrix[:3, 3] = np.array([0.5, 0.5, self._range_m / 2]) - axes @ centre_m
        return matrix

    def render(self, casters: Iterable[tuple[ShadowCaster, npt.NDArray[np.float64]]]) -> None:
        """Draw the whole map: each caster with its shadow_from_body, (4, 4)."""
        gl = self._context
        self._target.use()
        self._target.clear()
        gl.enable_only(gl.DEPTH_TEST | gl.CULL_FACE)
        gl.front_face, gl.cull_face = "cw", "front"
        for caster, shadow_from_body in casters:
            self._program["shadow_from_body"] = tuple(shadow_from_body.T.ravel())
            caster.render(unit(-shadow_from_body[2, :3]))  # the map's third axis points away from the Sun

    def use(self) -> None:
        """Put the map where shaders look for it."""
        self._depths.use(0)


_VERTEX_FACETS = """
#version 430
uniform mat3 camera_from_body;
uniform vec3 place;          // of the body's origin, camera axes, m
uniform vec3 sun;            // towards it, camera axes
uniform vec2 zoom;           // see Pinhole
uniform vec2 depth;          // terms for depths from the body's origin, so that a long range cancels nothing
uniform mat4 shadow_from_body;
in vec3 position, normal;
in float albedo;             // relative to the law of reflection
out float tint;
out vec4 angles;             // cosines of incidence and emission, terms of the phase angle
out vec3 in_shadow_map;      // or the share of the Sun, in x
%(reflectance)s
%(sunlit)s
void main() {
    vec3 outward = camera_from_body * normal;
    vec3 from_origin = camera_from_body * position;
    vec3 ray = from_origin + place;
    vec3 eye = -normalize(ray);
    float phase = atan(length(cross(sun, eye)), dot(sun, eye));
    angles = vec4(dot(outward, sun), dot(outward, eye), phase_terms(phase));
    in_shadow_map = (shadow_from_body * vec4(position + normal * %(lift)s, 1.0)).xyz;
    %(answer)s
    tint = albedo;
    gl_Position = vec4(zoom * ray.xy, depth.x * from_origin.z + depth.y, ray.z);
}
"""

_FRAGMENT_FACETS = """
#version 430
uniform float irradiance, ambient;
in vec4 angles;
in vec3 in_shadow_map;
in float tint;
out float radiance;
%(reflectance)s
%(sunlit)s
void main() {
    float lit = reflect_at(angles.x, angles.y, angles.zw);
    if (lit > 0.0) lit *= %(share)s;
    radiance = irradiance * lit;
    if (ambient > 0.0) {
        float around = abs(angles.y);
        radiance += ambient * reflect_sun(around, around, 0.0);
    }
    radiance *= tint;
}
"""

# Shader code by the place where the shadow map is read: nowhere, at vertices, at fragments.
_NOWHERE = {"vertex": "", "answer": "", "fragment": "", "share": "1.0"}
_AT_VERTICES = {
    "vertex": SUNLIT_GLSL,
    "answer": "in_shadow_map.x = sunlit(in_shadow_map);",
    "fragment": "",
    "share": "in_shadow_map.x",
}
_AT_FRAGMENTS = {"vertex": "", "answer": "", "fragment": SUNLIT_GLSL, "share": "sunlit(in_shadow_map)"}


@dataclass(frozen=True, eq=False)
class Frame:
    """Inputs of the shaders that all bodies of a light frame have in common.

    Attributes
    ----------
    sun : (3,) unit, towards the Sun in camera axes.
    zoom, depth : see `Pinhole.zoom`, `render_target.depth_terms`.
    irradiance, ambient : W/m2.
    """

    sun: npt.NDArray[np.float64]
    zoom: tuple[float, float]
    depth: tuple[float, float]
    irradiance: float
    ambient: float


class Facets:
    """One mesh in a context's memory, with its law of reflection.

    Parameters
    ----------
    shadows : the shadow map; None for no shadows.
    at_vertices : read the map at the vertices only.
    """

    def __init__(
        self,
        context: moderngl.Context,
        mesh: Mesh,
        law: Reflectance,
        shadows: ShadowMap | None,
        *,
        at_vertices: bool = False,
    ) -> None:
        self._shadows = shadows
        shading = _NOWHERE if shadows is None else _AT_VERTICES if at_vertices else _AT_FRAGMENTS
        lift = repr(float(shadows.lift_m if shadows else 0.0))
        law_text = law.glsl()
        answer, share = shading["answer"], shading["share"]
        self._program = context.program(
            vertex_shader=_VERTEX_FACETS
            % {"reflectance": law_text, "sunlit": shading["vertex"], "lift": lift, "answer": answer},
            fragment_shader=_FRAGMENT_FACETS % {"reflectance": law_text, "sunlit": shading["fragment"], "share": share},
        )
        if shadows:
            self._program["range_m"] = shadows.range_m
        points = np.hstack([mesh.vertices, mesh.normals, mesh.vertex_albedo[:, None]]).astype(np.float32)
        self._cells = Cells(mesh)
        self._array = context.vertex_array(
            self._program,
            [(context.buffer(points), "3f 3f 1f", "position", "normal", "albedo")],
            index_buffer=context.buffer(self._cells.faces),
            skip_errors=True,  # a black body's shader has no use for normals
        )
        self._commands = context.buffer(reserve=self._cells.buffer_bytes)

    def render(
        self,
        frame: Frame,
        camera_from_body: npt.NDArray[np.float64],
        place_m: npt.NDArray[np.float64],
        shadow_from_body: npt.NDArray[np.float64],
    ) -> None:
        """Draw; matrices (3, 3) and (4, 4), the body's origin (3,) in camera axes."""
        a, b = frame.depth
        values = {
            "camera_from_body": tuple(camera_from_body.T.ravel()),  # GL stores columns
            "place": tuple(place_m),
            "sun": tuple(frame.sun),
            "zoom": frame.zoom,
            "depth": (a, a * place_m[2] + b),
            "irradiance": frame.irradiance,
            "ambient": frame.ambient,
            "shadow_from_body": tuple(shadow_from_body.T.ravel()),
        }
        for name, value in values.items():
            if name in self._program:  # GL drops what a shader does not use
                self._program[name] = value
        if self._shadows:
            self._shadows.use()
        draw(self._array, self._cells.seen_from(-(camera_from_body.T @ place_m)), self._commands)
