"""Ground under a low Sun drawn by GL, by points in each pixel: for a quick look, and as a check of the CPU painter.

Light is radiance, W m-2 sr-1, 400 to 700 nm: sunlight by the ground's law of reflection, with the shadows that the
ground casts on itself and their penumbra, and an even light from all around. The ground curves with the body. Not
modelled: light from slope to slope, and ground beyond the map, where the light frame is black.

Blocks of facets come from a `Quadtree`, as fine as they are visible. A vertex is a post; in the last third of its
level's range it slides along its facet's side to the neighbour that the next coarser level has too, so that the change
of levels is continuous. Its position is whole lattice units from the camera plus the camera's rest, the same float32 on
every grid: neighbours share their vertices to the last bit, and there are no cracks.

Light comes from a texture of cells between posts, averaged over the area of a sample (mipmaps):

    r, g    east and north component of the normal          b    cosine of incidence x sunlit share
                                                            a    cosine of incidence, never below 0

so slopes and shadows are those of the fine map, however coarse the facets. The radiance is

    L = E_sun r(mu0, mu, g) b / a + ambient r(u, u, 0)

where u is the height of the eye's direction over level ground: light from all around does not depend on slopes.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from emulator.geometry.camera import Pinhole, Rays
from emulator.gl.render_target import RenderTarget, depth_terms
from emulator.photometry.reflectance import Reflectance
from emulator.scene.terrain.ground import Ground
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
uniform vec3 sun;            // towards it, world
uniform float ambient;
uniform vec2 zoom, depth;    // see RenderTarget
in ivec2 corner;             // in the block, 0 to 16
in ivec3 block;              // its first post, and posts from vertex to vertex
out vec2 cell;
out vec4 seen;               // towards the eye, and phase angle
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
    vec3 ray = mix(fine, coarse, slid);
    cell = mix(vec2(own), vec2(next), slid) / vec2(last);
    vec3 eye = -normalize(ray);
    seen = vec4(eye, atan(length(cross(sun, eye)), dot(sun, eye)));
    float level = clamp(eye.z, 0.02, 1.0);
    around = ambient * reflect_sun(level, level, 0.0);
    vec3 ahead = camera_from_world * ray;
    gl_Position = vec4(zoom * ahead.xy, depth.x * ahead.z + depth.y, ahead.z);
}
"""

_FRAGMENT = """
#version 430
uniform sampler2D cells;
uniform float irradiance;
in vec2 cell;
in vec4 seen;
in float around;
out float radiance;
%(reflectance)s
void main() {
    vec4 ground = texture(cells, cell);
    vec3 normal = vec3(ground.rg, sqrt(max(1.0 - dot(ground.rg, ground.rg), 0.0)));
    float mu = max(dot(normal, seen.xyz), 0.02);
    radiance = irradiance * reflect_sun(ground.a, mu, seen.w) * ground.b / max(ground.a, 1e-6) + around;
}
"""


@dataclass(frozen=True, eq=False)
class GroundView:
    """Pose of the camera and inputs of the shaders.

    Attributes
    ----------
    position_m : (3,) in the world.
    camera_from_world : (3, 3).
    zoom, depth : see `Pinhole.zoom`, `render_target.depth_terms`.
    irradiance, ambient : W/m2.
    """

    position_m: npt.NDArray[np.float64]
    camera_from_world: npt.NDArray[np.float64]
    zoom: tuple[float, float]
    depth: tuple[float, float]
    irradiance: float
    ambient: float


class GroundMesh:
    """A ground in a context's memory.

    `cells` are of `shading`; for `reach` and `crowd` see `Quadtree`.
    """

    def __init__(
        self,
        context: moderngl.Context,
        ground: Ground,
        cells: npt.NDArray[np.float16],
        law: Reflectance,
        reach: float,
        crowd: float,
    ) -> None:
        gl = self._context = context
        self._ground = ground
        self._program = gl.program(
            vertex_shader=_VERTEX % {"reflectance": law.glsl()}, fragment_shader=_FRAGMENT % {"reflectance": law.glsl()}
        )
        self._set(heights=0, cells=1, unit=ground.unit_m, reach=reach, crowd=crowd)
        rows, columns = ground.shape
        self._heights = [gl.texture((columns, rows), 1, z.tobytes(), dtype="f4") for z in ground.heights_m]
        self._cells = [gl.texture((columns - 1, rows - 1), 4, c.tobytes(), dtype="f2") for c in cells]
        for texture in self._cells:
            texture.build_mipmaps()
            texture.filter = gl.LINEAR_MIPMAP_NEAREST, gl.LINEAR  # a fifth faster on llvmpipe
            texture.repeat_x = texture.repeat_y = False
        corners, facets = block_facets()
        self._corners, self._facets = gl.buffer(corners), gl.buffer(facets)
        self._blocks = [gl.buffer(reserve=12 * 64) for _ in ground.heights_m]
        self._arrays = [self._array(blocks) for blocks in self._blocks]

    def render(self, view: GroundView, sun: npt.NDArray[np.float64], blocks: list[npt.NDArray[np.int32]]) -> None:
        """Draw the blocks of each grid; `sun` is the unit vector towards it in the world, (3,)."""
        ground, place = self._ground, view.position_m
        units = np.floor(place[:2] / ground.unit_m).astype(np.int64)
        self._set(
            rest=(*(place[:2] - units * ground.unit_m), place[2]),
            site=tuple(-place[:2]),
            camera_from_world=tuple(view.camera_from_world.T.ravel()),  # GL stores columns
            sun=tuple(sun),
            zoom=view.zoom,
            depth=view.depth,
            irradiance=view.irradiance,
            ambient=view.ambient,
        )
        for grid, chosen in enumerate(blocks):
            if len(chosen):
                self._set(first=tuple(int(c) for c in np.array(ground.first(grid)) - units), pitch=1 << grid)
                self._render_grid(grid, chosen)

    def _render_grid(self, grid: int, chosen: npt.NDArray[np.int32]) -> None:
        if chosen.nbytes > self._blocks[grid].size:
            self._blocks[grid].release()
            self._arrays[grid].release()
            self._blocks[grid] = self._context.buffer(reserve=2 * chosen.nbytes)
            self._arrays[grid] = self._array(self._blocks[grid])
        self._blocks[grid].write(chosen)
        self._heights[grid].use(0)
        self._cells[grid].use(1)
        self._arrays[grid].render(instances=len(chosen))

    def _array(self, blocks: moderngl.Buffer) -> moderngl.VertexArray:
        return self._context.vertex_array(
            self._program, [(self._corners, "2i4", "corner"), (blocks, "3i4/i", "block")], index_buffer=self._facets
        )

    def _set(self, **values: object) -> None:
        for name, value in values.items():
            if name in self._program:  # GL drops what a shader does not use
                self._program[name] = value


def shading(ground: Ground, sunlit: npt.NDArray[np.float32], sun: npt.NDArray[np.float64]) -> npt.NDArray[np.float16]:
    """Return the texture of the cells, (grids, rows - 1, columns - 1, 4), see the module docstring.

    Where a finer grid lies in a coarser one, the coarser one's cells are the means of the finer one's.

    `sunlit`, (grids, rows, columns), is the visible share of the Sun's disc at each post; `sun`, (3,), is towards it.
    """
    grids = [_cells(z, ground.post_m(k), sunlit[k], sun) for k, z in enumerate(ground.heights_m)]
    for finer, coarser in itertools.pairwise(grids):
        means = (finer[::2, ::2] + finer[1::2, ::2] + finer[::2, 1::2] + finer[1::2, 1::2]) / 4
        top, left = len(coarser) // 4, coarser.shape[1] // 4
        coarser[top : top + len(means), left : left + means.shape[1]] = means
    return np.stack(grids).astype(np.float16)


def _cells(
    z: npt.NDArray[np.float32], post_m: float, sunlit: npt.NDArray[np.float32], sun: npt.NDArray[np.float64]
) -> npt.NDArray[np.float32]:
    a, b, c, d = z[:-1, :-1], z[:-1, 1:], z[1:, :-1], z[1:, 1:]
    east, north = (a + c - b - d) / np.float32(2 * post_m), (a + b - c - d) / np.float32(2 * post_m)
    length = np.sqrt(1 + east * east + north * north)
    s = sun.astype(np.float32)
    incidence = np.maximum((east * s[0] + north * s[1] + s[2]) / length, 0)
    share = (sunlit[:-1, :-1] + sunlit[:-1, 1:] + sunlit[1:, :-1] + sunlit[1:, 1:]) / 4
    return np.stack([east / length, north / length, incidence * share, incidence], axis=-1)


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
        sunlit = world.sunlit()
        with self._render_target.context as gl:
            cells = shading(world.ground, sunlit, world.sun)
            self._mesh = GroundMesh(gl, world.ground, cells, parameters.reflectance, reach, self._tree.crowd)

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
        view = self._view(pose, world.height_m(scene_ns, pose))
        blocks = self._tree.blocks(pose.position_m, world.planes(pose))
        return lambda _: self._mesh.render(view, world.sun, blocks), None

    def _view(self, pose: Pose, height_m: float) -> GroundView:
        world = self._world
        far_m = 1.5 * world.ground.half_m + float(np.linalg.norm(pose.position_m))
        near_m = _NEAR_SHARE * min(height_m, far_m)
        turned = pose.world_from_body.T
        return GroundView(
            pose.position_m,
            turned,
            world.pinhole.zoom,
            depth_terms(near_m, 2 * far_m),
            world.irradiance_w_m2,
            world.parameters.ambient_w_m2,
        )
