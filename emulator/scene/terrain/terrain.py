"""Ground under a low Sun, seen from a camera that flies over it or lands on it.

Light is radiance, W m-2 sr-1, 400 to 700 nm: sunlight by the ground's law of reflection, with the shadows that the
ground throws on itself and their penumbra, and an even light from all around. The ground curves with the body. What is
not modelled: light from slope to slope, and what lies beyond the map, where the picture is black.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from emulator.geometry.pinhole import Pinhole
from emulator.gl.render_target import Stage, depth_terms
from emulator.light import Light, Scene, SceneError
from emulator.photometry.sun import Sun
from emulator.scene.array_cache import Progress, kept
from emulator.scene.terrain.ground import Ground
from emulator.scene.terrain.ground_mesh import GroundMesh, GroundView, shading
from emulator.scene.terrain.heightmap import load_heightmap
from emulator.scene.terrain.horizon import horizon_slopes, sunlit_share
from emulator.scene.terrain.quadtree import LEAST_REACH, Quadtree
from emulator.scene.terrain.relief import make_ridge
from emulator.scene.terrain.table import Ridge, TerrainParameters
from emulator.trajectory.building import build_trajectory
from emulator.trajectory.measured import measured_bounds
from emulator.trajectory.pose import Pose, TrajectoryError
from emulator.trajectory.pose_receiver import close_receivers, live_counts
from emulator.trajectory.timescale import Timescale

if TYPE_CHECKING:
    import moderngl

__all__ = ["Terrain", "build_ground"]

_LOOKS = 240  # instants, a second of the scene apart, at which the path is looked at beforehand
_LOOK_NS = 1_000_000_000
_FINEST_PX = 0.25
_APART_NS = 20_000_000
_NEAR_SHARE = 0.25  # of the camera's height: nothing is nearer, along the boresight

Floats = npt.NDArray[np.float64]


class Terrain(Scene):
    """The ground of `parameters` as `pinhole` sees it, in radiance.

    Raises
    ------
    SceneError
        The map or the path cannot be used, the camera is below the ground, or there is no GL.
    """

    def __init__(self, parameters: TerrainParameters, pinhole: Pinhole) -> None:
        p = self._p = parameters
        self._pinhole, self._time = pinhole, Timescale(parameters.time_scale)
        try:
            self._camera = build_trajectory(p.camera)
        except (TrajectoryError, OSError) as error:
            raise SceneError(f"scene.camera: {error}") from error
        self._ground = build_ground(p)
        self._heights_m = self._heights_on_the_way()
        self._fastest_px_s = max(self._moving_px_s(k * _LOOK_NS) for k in range(_LOOKS))
        reach = max(pinhole.focal_px / _facet_px(p, pinhole), LEAST_REACH)
        self._tree = Quadtree(self._ground, reach)
        sun = Sun(distance_au=p.sun_distance_au)
        self._sun, self._irradiance = _towards(p.sun_azimuth_deg, p.sun_elevation_deg), sun.irradiance_w_m2
        sunlit = self._sunlit(sun)
        self._stage = Stage(pinhole.size, p.samples)
        with self._stage.context as gl:
            cells = shading(self._ground, sunlit, self._sun)
            self._mesh = GroundMesh(gl, self._ground, cells, p.reflectance, (reach, self._tree.crowd))

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self._pinhole.size

    @property
    def renderer(self) -> str:
        """The name of what draws, in GL's words."""
        return self._stage.renderer

    @property
    def motion_bound_px_s(self) -> float:
        """From the path's speed, turning and height, looked at once a second of the first four minutes."""
        return self._fastest_px_s

    @property
    def distance_m(self) -> float:
        """The least height over the ground beneath, of those looked at beforehand."""
        return max(min(self._heights_m), 1e-3)

    @property
    def notes(self) -> tuple[str, ...]:
        """What is odd about the map, what lies beyond it, and a black picture."""
        notes = list(self._ground.notes)
        if self._p.sun_elevation_deg < 0:
            notes.append("the Sun is below the horizontal: only slopes that rise above it are lit")
        picture = np.zeros(self.size[::-1], np.float32)
        self.light(0, picture)
        if not picture.any():
            notes.append("the first picture is black: no lit ground is before the camera")
        return tuple(notes)

    @property
    def counts(self) -> Mapping[str, int]:
        """What poses from outside did."""
        return live_counts(self._camera)

    def light(self, t_ns: int, out: Light) -> None:
        """Write the radiance at `t_ns` into `out`, (height, width) float32; raises SceneError below the ground."""
        self.lights((t_ns,), (out,))

    def lights(self, times_ns: Sequence[int], outs: Sequence[Light]) -> None:
        """Write the radiance at several times into their pictures."""
        self._stage.draw_all([self._beginning(t_ns) for t_ns in times_ns], outs)

    def close(self) -> None:
        """Give back the GL context and the port; a second call does nothing."""
        self._stage.close()
        close_receivers(self._camera)

    def _beginning(self, t_ns: int) -> Callable[[], None]:
        """Return what lets the stage begin the picture of `t_ns`; whatever can fail has been done."""
        scene_ns = self._time.scene_ns(t_ns)
        pose = self._camera.pose(scene_ns)
        view = self._view(pose, self._height_m(scene_ns, pose))
        blocks = self._tree.blocks(pose.position_m, _planes(pose, self._pinhole))
        return partial(self._stage.begin, partial(self._render, view, blocks))

    def _render(self, view: GroundView, blocks: list[npt.NDArray[np.int32]], _: moderngl.Context) -> None:
        self._mesh.render(view, self._sun, blocks)

    def _view(self, pose: Pose, height_m: float) -> GroundView:
        far_m = 1.5 * self._ground.half_m + float(np.linalg.norm(pose.position_m))
        near_m = _NEAR_SHARE * min(height_m, far_m)
        turned = pose.world_from_body.T
        return GroundView(
            pose.position_m,
            turned,
            self._pinhole.zoom,
            depth_terms(near_m, 2 * far_m),
            self._irradiance,
            self._p.ambient_w_m2,
        )

    def _motion_px_s(self, t_ns: int) -> float:
        return self._moving_px_s(self._time.scene_ns(t_ns))

    def _moving_px_s(self, scene_ns: int) -> float:
        """Return how fast the ground moves through the picture, from the path's speed, turning and height then."""
        if not math.isfinite(self._camera.speed_bound_m_s):
            return math.inf
        speed, turn = measured_bounds(self._camera.pose, [scene_ns, scene_ns + _APART_NS])
        height_m = self._height_m(scene_ns, self._camera.pose(scene_ns))
        wide = 1 + math.tan(self._pinhole.widest_rad) ** 2
        return self._pinhole.focal_px * wide * (turn + speed / max(height_m, 1e-3)) * self._time.factor

    def _heights_on_the_way(self) -> list[float]:
        """Return the camera's height over the ground at the looks; refuses a path through the ground."""
        times = [k * _LOOK_NS for k in range(_LOOKS)]
        return [self._height_m(t, self._camera.pose(t)) for t in times]

    def _height_m(self, scene_ns: int, pose: Pose) -> float:
        """Return the camera's height over the ground beneath, or over the map's level where there is none."""
        x, y, z = (float(c) for c in pose.position_m)
        ground_m = self._ground.height_m(x, y)
        if ground_m is None:
            return max(abs(z), 1.0)
        if z <= ground_m:
            raise SceneError(
                f"the camera is {ground_m - z:.3g} m below the ground at {scene_ns * 1e-9:.3f} s, "
                f"x = {x:.6g} m, y = {y:.6g} m: the origin is on the ground in the middle of the map"
            )
        return z - ground_m

    def _sunlit(self, sun: Sun) -> npt.NDArray[np.float32]:
        """Return the share of the Sun that each post sees.

        Beyond the map the body goes on at the height of the map's lowest ground: its own horizon is the least there is.
        """
        azimuth, ground = self._p.sun_azimuth_deg, self._ground
        digest = hashlib.sha256(ground.heights_m.tobytes()).hexdigest()
        slopes = kept("horizon", (digest, ground.unit_m, azimuth), lambda: horizon_slopes(ground, azimuth))
        radius_m, relief_m = self._p.body_radius_m, float(np.ptp(ground.heights_m))
        dip = math.sqrt(2 * relief_m / radius_m) if radius_m else 0.0
        slopes = np.maximum(slopes, np.float32(-dip))
        return sunlit_share(slopes, math.radians(self._p.sun_elevation_deg), sun.radius_rad)


def build_ground(p: TerrainParameters) -> Ground:
    """Return the ground of `p`, from the cache where it was made before; raises SceneError."""
    if isinstance(p.ground, Ridge):
        ridge = p.ground
        heights = kept("ridge", ridge, lambda: make_ridge(ridge, Progress("making the map")).heights_m)
        ground = Ground(ridge.size_m / ridge.posts / (1 << (len(heights) - 1)), heights)
    else:
        ground = load_heightmap(p.ground, p.body_radius_m)
    return ground.curved(p.body_radius_m) if p.body_radius_m else ground


def _facet_px(p: TerrainParameters, pinhole: Pinhole) -> float:
    """Return the side of a facet; two facets are a quad."""
    affordable = math.sqrt(2 * pinhole.width * pinhole.height / p.most_facets)
    return max(p.detail_px, affordable) if p.detail_px else _FINEST_PX


def _towards(azimuth_deg: float, elevation_deg: float) -> Floats:
    """Return the unit vector towards the Sun, (3,)."""
    azimuth, elevation = math.radians(azimuth_deg), math.radians(elevation_deg)
    flat = math.cos(elevation)
    return np.array([flat * math.sin(azimuth), flat * math.cos(azimuth), math.sin(elevation)])


def _planes(pose: Pose, pinhole: Pinhole) -> Floats:
    """Return the inward normals of the four planes through the picture's edges and of the one behind, (5, 3)."""
    x, y = pinhole.width / 2 / pinhole.focal_px, pinhole.height / 2 / pinhole.focal_px
    inward = np.array([[1.0, 0, x], [-1.0, 0, x], [0, 1.0, y], [0, -1.0, y], [0, 0, 1.0]])
    return np.ascontiguousarray(inward @ pose.world_from_body.T)
