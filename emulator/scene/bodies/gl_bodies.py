"""Bodies in sunlight drawn by GL, by points in each pixel: for a quick look, and as a check of the CPU painter.

The scene has any number of bodies, each on its path, and a camera on its own path. A body has its pose in the world, or
in the frame of another body that it is fixed to (a panel on a spacecraft). Light is radiance, W m-2 sr-1, 400 to 700
nm, by each body's law of reflection; all positions are relative to the camera, subtracted in float64.

Detail: a mesh whose facets would be smaller than `detail_px` even at the closest approach is simplified to vertices at
that distance, with the normals of the fine mesh (see `coarser`). Shadow casters are as coarse as the map (see
`ShadowMap`). Left out: light from one surface onto another, but for an even `ambient_w_m2`.

Only the part of a light frame that bodies can touch is drawn: the rectangle around the boxes of the bodies. A box has
its sides along the body's own axes. While all of its corners are in front of the camera, its contents appear between
the corners; with corners in front and behind, they may appear anywhere.

The vertex shader computes the cosines of incidence and emission, and the terms that depend on the phase angle alone;
they are interpolated over a facet, as normals are, so facet edges are not visible. Phase angles come from
atan(|cross|, dot): the error of acos is 1.6e-4 rad. The fragment shader gives radiance, W m-2 sr-1:

    L = E_sun r(mu0, mu, g) sunlit + ambient r(mu, mu, 0)

where `ambient` stands for light from all around (earthshine, light from other ground), as if it came from the eye.

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
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from emulator.geometry.attitude import Vector, unit
from emulator.geometry.camera import Pinhole, Rays
from emulator.gl.render_target import Rectangle, RenderTarget, depth_terms
from emulator.photometry.reflectance import Reflectance
from emulator.scene.bodies.mesh import Mesh
from emulator.scene.bodies.raster_bodies import BodiesGeometry
from emulator.scene.bodies.regolith import coarser, facet_size_m, flat
from emulator.scene.bodies.table import BodiesParameters
from emulator.scene.bodies.world import BodyWorld, middle
from emulator.scene.world import GlScene
from emulator.trajectory.pose import Pose

if TYPE_CHECKING:
    import moderngl


Floats = npt.NDArray[np.float64]
Matrix = npt.NDArray[np.float64]

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


class ShadowMap:
    """The shadow map of one scene.

    Parameters
    ----------
    radius_m : of the sphere around all shadow casters.
    pixel_m : width of a pixel on the bodies at the closest range: finer texels would have no effect.

    Attributes
    ----------
    range_m : depth of the map.
    lift_m : distance by which points are lifted along their normals before the map is read.
    coarse_m : size of cells in which the meshes of shadow casters are simplified.
    """

    def __init__(self, context: moderngl.Context, radius_m: float, pixel_m: float) -> None:
        self._context, self.range_m = context, 2 * radius_m
        fine = 2 ** math.ceil(math.log2(max(1.0, self.range_m / pixel_m)))
        texels = min(max(fine, _LEAST_TEXELS), _MOST_TEXELS)
        self._depths = context.depth_texture((texels, texels))
        self._depths.compare_func = ""
        self._depths.repeat_x = self._depths.repeat_y = False
        self._target = context.framebuffer(depth_attachment=self._depths)
        self._program = context.program(vertex_shader=_VERTEX, fragment_shader=_FRAGMENT)
        self._program["range_m"] = self.range_m
        self.texel_m = self.range_m / texels
        self.lift_m = _LIFT_TEXELS * self.texel_m
        self.coarse_m = _COARSE_TEXELS * self.texel_m

    def caster(self, mesh: Mesh) -> moderngl.VertexArray:
        """Take a mesh that casts shadows, as coarse as the resolution of the map allows, into the context's memory."""
        gl = self._context
        positions = [(gl.buffer(mesh.vertices.astype(np.float32)), "3f", "position")]
        return gl.vertex_array(self._program, positions, index_buffer=gl.buffer(mesh.faces))

    def from_world(self, sun: Vector, centre_m: Vector) -> Matrix:
        """Return shadow_from_world, (4, 4), for a Sun in the direction (3,) and the sphere's centre (3,)."""
        z = -unit(sun)
        x = unit(np.cross(z, np.eye(3)[int(np.argmin(np.abs(z)))]))
        axes = np.vstack([x / self.range_m, np.cross(z, x) / self.range_m, z])
        matrix = np.eye(4)
        matrix[:3, :3] = axes
        matrix[:3, 3] = np.array([0.5, 0.5, self.range_m / 2]) - axes @ centre_m
        return matrix

    def render(self, casters: Iterable[tuple[moderngl.VertexArray, npt.NDArray[np.float64]]]) -> None:
        """Draw the whole map: each caster with its shadow_from_body, (4, 4)."""
        gl = self._context
        self._target.use()
        self._target.clear()
        gl.enable_only(gl.DEPTH_TEST | gl.CULL_FACE)
        gl.front_face, gl.cull_face = "cw", "front"
        for caster, shadow_from_body in casters:
            self._program["shadow_from_body"] = tuple(shadow_from_body.T.ravel())
            caster.render()

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

    `shadows` is the shadow map, None for no shadows; with `at_vertices` it is read at the vertices only.
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
        self._array = context.vertex_array(
            self._program,
            [(context.buffer(points), "3f 3f 1f", "position", "normal", "albedo")],
            index_buffer=context.buffer(mesh.faces),
            skip_errors=True,  # a black body's shader has no use for normals
        )

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
        self._array.render()


_BLACK = Rectangle(0, 0, 1, 1)
_ROUNDING_PX = 1  # what float32 and GL's rounding may add


def box_corners(points: Floats) -> Floats:
    """Return the corners, (8, 3), of the box around points, (n, 3)."""
    low, high = points.min(axis=0), points.max(axis=0)
    return np.asarray([np.where([k & 1, k & 2, k & 4], high, low) for k in range(8)])


def touched_region(boxes: Iterable[Floats], pinhole: Pinhole) -> Rectangle:
    """Return a rectangle around the visible parts of `boxes`, each the corners of one, (8, 3), in the camera's axes."""
    frame = Rectangle(0, 0, *pinhole.size)
    before = [corners for corners in boxes if (corners[:, 2] > 0).any()]
    if not before:
        return _BLACK
    corners = np.concatenate(before)
    if (corners[:, 2] <= 0).any():
        return frame
    size = np.array(pinhole.size)
    with np.errstate(over="ignore"):
        seen = pinhole.focal_px * corners[:, :2] / corners[:, 2:] + size / 2
    first = np.clip(np.floor(seen.min(axis=0)) - _ROUNDING_PX, 0, size - 1).astype(int)
    last = np.clip(np.ceil(seen.max(axis=0)) + _ROUNDING_PX, first + 1, size).astype(int)
    return Rectangle(*map(int, first), *map(int, last - first))


_FINE = 2.0  # pixels or texels: for facets as small as this, shadows are computed at their corners
_APART = 100.0  # ratio of ranges from which on farther bodies get a depth range of their own
_NEAREST_SHARE = 1e-4  # of the farthest depth: no nearer plane, or float32 depth would resolve nothing
_ROOM = 1.01  # of a body's radius: what rounding may add to it


@dataclass(frozen=True, eq=False)
class _Seen:
    """A body's pose in the camera's axes."""

    camera_from_body: Matrix
    place_m: Matrix


@dataclass(eq=False)
class _Part:
    """A body as it is drawn."""

    mesh: Mesh
    corners: Matrix
    facets: Facets | None = None
    caster: moderngl.VertexArray | None = None


class GlBodies(GlScene[BodyWorld]):
    """The bodies of `parameters` as `pinhole` sees them, in radiance, drawn by GL.

    Raises SceneError where a shape or a path cannot be used, the camera begins inside a body, or there is no GL.
    """

    def __init__(self, parameters: BodiesParameters, pinhole: Pinhole) -> None:
        world = BodyWorld(parameters, pinhole)
        super().__init__(world, RenderTarget(pinhole.size, parameters.samples))
        self._p, self._pinhole = world.parameters, pinhole
        self._sun = unit(parameters.sun.direction)
        self._casters = [k for k, body in enumerate(self._p.bodies) if body.throws_shadow]
        self._parts = [_Part(mesh, box_corners(mesh.vertices)) for mesh in world.meshes]
        self._shadows: ShadowMap | None = None
        with self._render_target.context as gl:
            self._upload(gl)

    def geometry(self, rays: Rays | None = None) -> BodiesGeometry:
        """Return depth, flow and labels of the bodies, from shapes and poses alone."""
        return BodiesGeometry(self._world, rays)

    def _upload(self, gl: moderngl.Context) -> None:
        """Copy meshes into the context's memory, with as much detail as is visible."""
        world = self._world
        if self._p.shadows and self._casters:
            # a tenth more than in the first minute, for what comes later
            around_m = 1.1 * world.arrangement.radius_m(self._casters)
            self._shadows = ShadowMap(gl, around_m, self.distance_m / self._pinhole.focal_px)
        for k, (body, part) in enumerate(zip(self._p.bodies, self._parts, strict=True)):
            seen = world.as_seen(k)
            # Facets of at most two pixels, or two texels of the shadow map, read it at their corners.
            texel_m = self._shadows.texel_m if self._shadows else 0.0
            fine = body.smooth and facet_size_m(seen) <= _FINE * max(texel_m, world.metres_a_pixel(k))
            shown = seen if body.smooth else flat(seen)
            shadows = self._shadows if self._may_be_shaded(k) else None
            part.facets = Facets(gl, shown, body.reflectance, shadows, at_vertices=fine)
            if self._shadows and body.throws_shadow:
                part.caster = self._shadows.caster(coarser(part.mesh, self._shadows.coarse_m))

    def _may_be_shaded(self, k: int) -> bool:
        """Return whether body k is, at the start, within the shadow map; a planet behind the scene is not."""
        if self._shadows is None:
            return False
        poses, parts = self._world.arrangement.poses(self._world.time.scene_ns(0)), self._parts
        centre = middle([(poses[j], parts[j].mesh.radius_m) for j in self._casters])
        away_m = float(np.linalg.norm(poses[k].position_m - centre))
        return away_m - parts[k].mesh.radius_m < self._shadows.range_m

    def _shadow_from_bodies(self, poses: list[Pose]) -> list[Matrix]:
        """Return shadow_from_body of each body, (4, 4)."""
        if self._shadows is None:
            return [np.eye(4)] * len(poses)
        shadow_from_world = self._shadows.from_world(
            self._sun, middle([(poses[k], self._parts[k].mesh.radius_m) for k in self._casters])
        )
        return [shadow_from_world @ _matrix(pose) for pose in poses]

    def _drawing(self, t_ns: int) -> Callable[[], None]:
        scene_ns = self._world.time.scene_ns(t_ns)
        camera, poses = self._world.camera.pose(scene_ns), self._world.arrangement.poses(scene_ns)
        camera_from_world = camera.world_from_body.T
        seen = [
            _Seen(camera_from_world @ pose.world_from_body, camera_from_world @ (pose.position_m - camera.position_m))
            for pose in poses
        ]
        frames = self._frames(camera_from_world @ self._sun, seen)
        shadow_from_bodies = self._shadow_from_bodies(poses)
        boxes = (part.corners @ s.camera_from_body.T + s.place_m for part, s in zip(self._parts, seen, strict=True))
        return partial(
            self._render_target.begin,
            partial(self._render, frames, seen, shadow_from_bodies),
            partial(self._cast, shadow_from_bodies),
            touched_region(boxes, self._pinhole),
        )

    def _cast(self, shadow_from_bodies: list[Matrix]) -> None:
        """Draw the shadow map."""
        if self._shadows is not None:
            placed = zip(self._parts, shadow_from_bodies, strict=True)
            self._shadows.render([(part.caster, matrix) for part, matrix in placed if part.caster is not None])

    def _render(
        self,
        frames: list[tuple[Frame, list[int]]],
        seen: list[_Seen],
        shadow_from_bodies: list[Matrix],
        gl: moderngl.Context,
    ) -> None:
        for number, (frame, members) in enumerate(frames):
            if number:
                _forget_depth(gl)
            for k in members:
                facets, how = self._parts[k].facets, seen[k]
                if facets is not None:
                    facets.render(frame, how.camera_from_body, how.place_m, shadow_from_bodies[k])

    def _frames(self, sun: Matrix, seen: list[_Seen]) -> list[tuple[Frame, list[int]]]:
        """Return the groups of bodies that are drawn together, with their common inputs, the farthest group first.

        Bodies much farther than all others get a depth range of their own.
        """
        ends = [
            (float(how.place_m[2]) - part.mesh.radius_m * _ROOM, float(how.place_m[2]) + part.mesh.radius_m * _ROOM)
            for how, part in zip(seen, self._parts, strict=True)
        ]
        frames: list[tuple[Frame, list[int]]] = []
        for k in sorted(range(len(ends)), key=lambda k: ends[k][0]):
            if not frames or ends[k][0] > _APART * max(ends[j][1] for j in frames[-1][1]) > 0:
                frames.append((self._frame(sun, [ends[k]]), [k]))
            else:
                members = [*frames[-1][1], k]
                frames[-1] = self._frame(sun, [ends[j] for j in members]), members
        return frames[::-1]

    def _frame(self, sun: Matrix, ends: list[tuple[float, float]]) -> Frame:
        """Return the common inputs of bodies between these depths; depths behind the camera are ignored."""
        ahead = [(near_m, far_m) for near_m, far_m in ends if far_m > 0]
        far_m = max((far_m for _, far_m in ahead), default=1.0)
        near_m = min((near_m for near_m, _ in ahead), default=0.5)
        return Frame(
            sun,
            self._pinhole.zoom,
            depth_terms(max(near_m, _NEAREST_SHARE * far_m), far_m),
            self._p.sun.irradiance_w_m2,
            self._p.ambient_w_m2,
        )


def _forget_depth(gl: moderngl.Context) -> None:
    """Clear the depth of the target, not its light: the next bodies are drawn in front of all earlier ones."""
    target = gl.fbo
    target.color_mask = False, False, False, False
    target.clear()
    target.color_mask = True, True, True, True
    target.use()  # the mask takes effect


def _matrix(pose: Pose) -> Matrix:
    """Return world_from_body, (4, 4)."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = pose.world_from_body, pose.position_m
    return matrix
