"""Ground under a low Sun drawn by GL, by points in each pixel: for a quick look, and as a check of the CPU painter.

Light is that of `raster_terrain`. Blocks of facets come from a `Quadtree`, as fine as they are visible, and their
vertices slide as described in `quadtree`. The position of a vertex is whole lattice units from the camera plus the
camera's rest, the same float32 on every grid: neighbours share their vertices to the last bit, and there are no cracks.

The detail is that of the fine map, however coarse the facets. A sample is moved along its ray from its facet to the map
by a secant, as `pixel_hits` does for the CPU. There a texture of the posts gives

    r, g    slopes east and north       b    height of the Sun's middle over the horizon, in its radii
                                        a    albedo, 1 for the brightest ground

linear between posts. The share of the Sun s follows from b for each sample: between posts it is not linear, and the
edge of a shadow is where the Sun crosses the horizon. A sample that is larger than a cell between posts takes the mean
of cells of its area (mipmaps). There b is within -1 and 1, where s is nearly linear in it. Outlines are those of
facets. The radiance is

    L = E_sun r(mu0, mu, g) s a + ambient r(u, u, 0)

where mu0 is taken towards the mean height of the part of the disc above the horizon (`ground.sunlit`), and u is the
height of the eye's direction over level ground: light from all around does not depend on slopes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from emulator.geometry.camera import Pinhole, Rays
from emulator.gl.render_target import RenderTarget, depth_terms
from emulator.scene.terrain.quadtree import LEAST_REACH, Quadtree, block_facets
from emulator.scene.terrain.raster_terrain import RasterTerrain, TerrainGeometry, facet_px
from emulator.scene.terrain.table import TerrainParameters
from emulator.scene.terrain.world import TerrainWorld
from emulator.scene.world import GlScene
from emulator.trajectory.parameters import BasiliskPath, LivePath
from emulator.trajectory.pose import Pose

if TYPE_CHECKING:
    import moderngl


_VERTEX = """
#version 430
uniform sampler2D heights;
uniform ivec2 first;         // of the grid's first post, lattice units from the camera's whole ones
uniform int pitch;           // lattice units between posts
uniform float unit;          // m
uniform vec3 rest;           // the camera's place less its whole lattice units, m
uniform vec2 site;           // from the camera, m
uniform float reach, crowd;  // see Quadtree
uniform mat3 camera_from_world;
uniform float ambient;
uniform vec2 zoom, depth;    // see RenderTarget
in ivec2 corner;             // in the block, 0 to 16
in ivec3 block;              // its first post, and posts from vertex to vertex
out vec2 at;                 // posts from the grid's first one
out vec3 ray;                // from the camera, m
out float around;            // radiance of the ambient light
%(reflectance)s
vec3 place(ivec2 post) {
    return vec3(vec2(first + post * pitch) * unit, texelFetch(heights, post, 0).r) - rest;
}

void main() {
    ivec2 last = textureSize(heights, 0) - 1;
    ivec2 own = min(block.xy + corner * block.z, last), next = min(block.xy + (corner & ~1) * block.z, last);
    vec3 fine = place(own), coarse = place(next);
    vec2 from_site = abs(fine.xy - site);
    float away = max(length(fine), crowd * max(from_site.x, from_site.y));
    float slid = clamp((away / (reach * unit * float(pitch * block.z)) - 0.7) / 0.29, 0.0, 1.0);
    ray = mix(fine, coarse, slid);
    at = mix(vec2(own), vec2(next), slid);
    float level = clamp(-normalize(ray).z, 0.02, 1.0);
    around = ambient * reflect_sun(level, level, 0.0);
    vec3 ahead = camera_from_world * ray;
    gl_Position = vec4(zoom * ahead.xy, depth.x * ahead.z + depth.y, ahead.z);
}
"""

_FRAGMENT = """
#version 430
uniform sampler2D heights, posts;
uniform int pitch;
uniform float unit, irradiance;
uniform vec3 rest;
uniform vec3 sun, top;       // towards the middle of its disc, and from there to its top, world
in vec2 at;
in vec3 ray;
in float around;
out float radiance;
%(reflectance)s
vec2 on_map(vec2 post) {
    return (post + 0.5) / vec2(textureSize(heights, 0));
}

void main() {
    // What lifting the facet by a metre moves the sample along its ray, in metres and in posts; bounded edge-on.
    vec3 away = cross(dFdx(ray), dFdy(ray));
    vec3 lift = ray * away.z / max(dot(away, ray), 0.05 * length(away) * length(ray));
    vec2 move = lift.xy / (unit * float(pitch));
    float lifted = texture(heights, on_map(at)).r - rest.z - ray.z;
    float height = texture(heights, on_map(at + lifted * move)).r - rest.z - ray.z - lifted * lift.z;
    float apart = lifted - height;
    lifted += height * clamp(lifted / (apart != 0.0 ? apart : 1e-12), 0.5, 2.0);

    float cells = abs(determinant(mat2(dFdx(at), dFdy(at))));
    vec4 ground = textureLod(posts, on_map(at + lifted * move), 0.5 * log2(max(cells, 1e-12)));
    vec3 normal = normalize(vec3(-ground.rg, 1.0)), eye = -normalize(ray + lifted * lift);
    float x = clamp(ground.b, -1.0, 1.0), chord = sqrt(1.0 - x * x);
    float share = 0.5 + (x * chord + asin(x)) / radians(180.0);
    float rise = chord * chord * chord / max(1.5 * radians(180.0) * share, 1e-6);  // of the part above the horizon
    float mu0 = max(dot(normal, sun + rise * top), 0.0), mu = max(dot(normal, eye), 0.02);
    float phase = atan(length(cross(sun, eye)), dot(sun, eye));
    radiance = irradiance * reflect_sun(mu0, mu, phase) * share * ground.a + around;
}
"""


_MOST_RADII = 6e4  # a 16-bit float ends at 65504; a distant Sun is small


class GroundMesh:
    """The ground of a world in a context's memory; for `reach` and `crowd` see `Quadtree`."""

    def __init__(self, context: moderngl.Context, world: TerrainWorld, reach: float, crowd: float) -> None:
        gl, ground, p = context, world.ground, world.parameters
        self._ground = ground
        law = {"reflectance": p.reflectance.glsl()}
        self._program = gl.program(vertex_shader=_VERTEX % law, fragment_shader=_FRAGMENT % law)
        self._set(heights=0, posts=1, unit=ground.unit_m, reach=reach, crowd=crowd, zoom=world.pinhole.zoom)
        sun, top = map(tuple, world.disc)
        self._set(sun=sun, top=top, irradiance=world.irradiance_w_m2, ambient=p.ambient_w_m2)
        size = ground.shape[::-1]
        self._heights = [gl.texture(size, 1, z.tobytes(), dtype="f4") for z in ground.heights_m]
        self._posts = [gl.texture(size, 4, dtype="f2") for _ in ground.heights_m]
        sun_radii = world.sun_radii()
        for grid, texture in enumerate(self._posts):
            north, east = np.gradient(ground.heights_m[grid], ground.post_m(grid))
            albedo = np.ones_like(east) if ground.albedo is None else ground.albedo[grid] / ground.albedo.max()
            radii = np.clip(sun_radii[grid], -_MOST_RADII, _MOST_RADII)
            light = np.stack([east, north, radii, albedo], axis=-1, dtype=np.float16)
            bounded = light.copy()
            np.clip(light[..., 2], -1, 1, out=bounded[..., 2])
            texture.write(bounded.tobytes())
            texture.build_mipmaps()
            texture.write(light.tobytes())
            texture.filter = gl.LINEAR_MIPMAP_NEAREST, gl.LINEAR  # b with and without bounds cannot be mixed
        for texture in (*self._heights, *self._posts):
            texture.repeat_x = texture.repeat_y = False
        corners, facets = map(gl.buffer, block_facets())
        self._blocks = [gl.buffer(reserve=12 * 64) for _ in ground.heights_m]
        self._arrays = [
            gl.vertex_array(self._program, [(corners, "2i4", "corner"), (blocks, "3i4/i", "block")], facets)
            for blocks in self._blocks
        ]

    def render(self, pose: Pose, near_m: float, far_m: float, blocks: list[npt.NDArray[np.int32]]) -> None:
        """Draw the blocks of each grid as the camera at `pose` sees them, from `near_m` to `far_m`."""
        ground, place = self._ground, pose.position_m
        units = np.floor(place[:2] / ground.unit_m).astype(np.int64)
        self._set(
            rest=(*(place[:2] - units * ground.unit_m), place[2]),
            site=tuple(-place[:2]),
            camera_from_world=tuple(pose.world_from_body.ravel()),  # the inverse, and GL stores columns
            depth=depth_terms(near_m, far_m),
        )
        for grid, chosen in enumerate(blocks):
            if len(chosen):
                self._set(first=tuple(int(c) for c in np.array(ground.first(grid)) - units), pitch=1 << grid)
                if chosen.nbytes > self._blocks[grid].size:
                    self._blocks[grid].orphan(2 * chosen.nbytes)
                self._blocks[grid].write(chosen)
                self._heights[grid].use(0)
                self._posts[grid].use(1)
                self._arrays[grid].render(instances=len(chosen))

    def _set(self, **values: object) -> None:
        for name, value in values.items():
            if name in self._program:  # GL drops what a shader does not use
                self._program[name] = value


_FINEST_PX = 0.25
_NEAR_SHARE = 0.25  # of the camera's height: nothing is nearer, along the boresight


class GlTerrain(GlScene[TerrainWorld]):
    """The ground of `parameters` as `pinhole` sees it, in radiance.

    Raises SceneError where the map or the path cannot be used, the camera is below the ground, or there is no GL.
    """

    def __init__(self, parameters: TerrainParameters, pinhole: Pinhole) -> None:
        world = TerrainWorld(parameters, pinhole)
        super().__init__(world, RenderTarget(pinhole.size, parameters.samples))
        self._own_facets: RasterTerrain | None = None
        reach = max(pinhole.focal_px / facet_px(parameters, pinhole, _FINEST_PX), LEAST_REACH)
        self._tree = Quadtree(world.ground, reach)
        with self._render_target.context as gl:
            self._mesh = GroundMesh(gl, world, reach, self._tree.crowd)

    def geometry(self, rays: Rays | None = None) -> TerrainGeometry | None:
        """Return depth, flow and labels of the ground, from facets drawn by the CPU; None where poses are live."""
        if isinstance(self._world.parameters.camera, LivePath | BasiliskPath):
            return None  # the facets need a path of their own, and its port is in use
        self._own_facets = RasterTerrain(self._world.parameters, self._world.pinhole)
        return self._own_facets.geometry(rays)

    def close(self) -> None:
        """Release the GL context and the port; a second call does nothing."""
        if self._own_facets is not None:
            self._own_facets.close()
        super().close()

    def _drawing(self, t_ns: int) -> tuple[Callable[[moderngl.Context], None], None]:
        world = self._world
        scene_ns = world.time.scene_ns(t_ns)
        pose = world.camera.pose(scene_ns)
        far_m = 1.5 * world.ground.half_m + float(np.linalg.norm(pose.position_m))
        near_m = _NEAR_SHARE * min(world.height_m(scene_ns, pose), far_m)
        blocks = self._tree.blocks(pose.position_m, world.planes(pose))
        return lambda _: self._mesh.render(pose, near_m, 2 * far_m, blocks), None
