"""What a terrain scene is, whatever draws it: ground, path of the camera, Sun and shadows, and bounds on motion."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from emulator.geometry.pinhole import Pinhole
from emulator.light import SceneError
from emulator.photometry.sun import Sun
from emulator.scene.array_cache import Progress, kept
from emulator.scene.terrain.ground import Ground
from emulator.scene.terrain.heightmap import load_heightmap
from emulator.scene.terrain.horizon import horizon_slopes, sunlit_share
from emulator.scene.terrain.relief import make_albedo, make_ridge
from emulator.scene.terrain.table import Ridge, TerrainParameters
from emulator.trajectory.building import build_trajectory
from emulator.trajectory.measured import measured_bounds
from emulator.trajectory.pose import Pose, TrajectoryError
from emulator.trajectory.pose_receiver import close_receivers, live_counts
from emulator.trajectory.timescale import Timescale

__all__ = ["TerrainWorld", "build_ground"]

_LOOKS = 240  # instants, a second of the scene apart, at which the path is looked at beforehand
_LOOK_NS = 1_000_000_000
_APART_NS = 20_000_000

Floats = npt.NDArray[np.float64]


class TerrainWorld:
    """The world of `parameters` before `pinhole`.

    Attributes
    ----------
    sun : (3,) unit, towards it.
    irradiance_w_m2 : sunlight on a surface that faces the Sun.
    motion_bound_px_s : from the path's speed, turning and height, looked at once a second of the first four minutes.
    distance_m : the least height over the ground beneath, of those looked at beforehand.

    Raises
    ------
    SceneError
        The map or the path cannot be used, or the camera is below the ground.
    """

    def __init__(self, parameters: TerrainParameters, pinhole: Pinhole) -> None:
        p = self.parameters = parameters
        self.pinhole, self.time = pinhole, Timescale(parameters.time_scale)
        try:
            self.camera = build_trajectory(p.camera)
        except (TrajectoryError, OSError) as error:
            raise SceneError(f"scene.camera: {error}") from error
        self.ground = build_ground(p)
        self.distance_m = max(min(self._heights_on_the_way()), 1e-3)
        self.motion_bound_px_s = max(self._moving_px_s(k * _LOOK_NS) for k in range(_LOOKS))
        self._sun = Sun(distance_au=p.sun_distance_au)
        self.sun = _towards(p.sun_azimuth_deg, p.sun_elevation_deg)
        albedo = self.ground.albedo
        self._brightest = 1.0 if albedo is None else float(albedo.max())
        self.irradiance_w_m2 = self._sun.irradiance_w_m2 * self._brightest

    @property
    def counts(self) -> Mapping[str, int]:
        """What poses from outside did."""
        return live_counts(self.camera)

    def notes(self, first_frame: npt.NDArray[np.float32]) -> tuple[str, ...]:
        """Return what is odd about the map, what lies beyond it, and whether the first frame is black."""
        notes = list(self.ground.notes)
        if self.parameters.sun_elevation_deg < 0:
            notes.append("the Sun is below the horizontal: only slopes that rise above it are lit")
        if not first_frame.any():
            notes.append("the first picture is black: no lit ground is before the camera")
        return tuple(notes)

    def motion_px_s(self, t_ns: int) -> float:
        """Return how fast the picture moves at stream time `t_ns`."""
        return self._moving_px_s(self.time.scene_ns(t_ns))

    def height_m(self, scene_ns: int, pose: Pose) -> float:
        """Return the camera's height over the ground beneath, or over the map's level where there is none."""
        x, y, z = (float(c) for c in pose.position_m)
        ground_m = self.ground.height_m(x, y)
        if ground_m is None:
            return max(abs(z), 1.0)
        if z <= ground_m:
            raise SceneError(
                f"the camera is {ground_m - z:.3g} m below the ground at {scene_ns * 1e-9:.3f} s, "
                f"x = {x:.6g} m, y = {y:.6g} m: the origin is on the ground in the middle of the map"
            )
        return z - ground_m

    def sunlit(self) -> npt.NDArray[np.float32]:
        """Return the share of `irradiance_w_m2` that shines on each post, times its albedo, (grids, rows, columns).

        The irradiance is that of the Sun on the brightest ground, so the share is at most 1.
        Beyond the map the body goes on at the height of the map's lowest ground: its own horizon is the least there is.
        """
        p, ground = self.parameters, self.ground
        digest = hashlib.sha256(ground.heights_m.tobytes()).hexdigest()
        azimuth = p.sun_azimuth_deg
        slopes = kept("horizon", (digest, ground.unit_m, azimuth), lambda: horizon_slopes(ground, azimuth))
        relief_m = float(np.ptp(ground.heights_m))
        dip = math.sqrt(2 * relief_m / p.body_radius_m) if p.body_radius_m else 0.0
        slopes = np.maximum(slopes, np.float32(-dip))
        share = sunlit_share(slopes, math.radians(p.sun_elevation_deg), self._sun.radius_rad)
        return share if ground.albedo is None else share * (ground.albedo / np.float32(self._brightest))

    def planes(self, pose: Pose) -> Floats:
        """Return the inward normals of the four planes through the picture's edges and of the one behind, (5, 3)."""
        pinhole = self.pinhole
        x, y = pinhole.width / 2 / pinhole.focal_px, pinhole.height / 2 / pinhole.focal_px
        inward = np.array([[1.0, 0, x], [-1.0, 0, x], [0, 1.0, y], [0, -1.0, y], [0, 0, 1.0]])
        return np.ascontiguousarray(inward @ pose.world_from_body.T)

    def close(self) -> None:
        """Close the ports of live poses; a second call does nothing."""
        close_receivers(self.camera)

    def _moving_px_s(self, scene_ns: int) -> float:
        """Return how fast the ground moves through the picture, from the path's speed, turning and height then."""
        if not math.isfinite(self.camera.speed_bound_m_s):
            return math.inf
        speed, turn = measured_bounds(self.camera.pose, [scene_ns, scene_ns + _APART_NS])
        height_m = self.height_m(scene_ns, self.camera.pose(scene_ns))
        wide = 1 + math.tan(self.pinhole.widest_rad) ** 2
        return self.pinhole.focal_px * wide * (turn + speed / max(height_m, 1e-3)) * self.time.factor

    def _heights_on_the_way(self) -> list[float]:
        """Return the camera's height over the ground at the looks; refuses a path through the ground."""
        times = [k * _LOOK_NS for k in range(_LOOKS)]
        return [self.height_m(t, self.camera.pose(t)) for t in times]


def build_ground(p: TerrainParameters) -> Ground:
    """Return the ground of `p`, from the cache where it was made before; raises SceneError."""
    if isinstance(p.ground, Ridge):
        ridge = p.ground
        heights = kept("ridge", ridge, lambda: make_ridge(ridge, Progress("making the map")).heights_m)
        albedo = kept("albedo", ridge, lambda: make_albedo(ridge)) if ridge.albedo_rms > 0 else None
        ground = Ground(ridge.size_m / ridge.posts / (1 << (len(heights) - 1)), heights, albedo=albedo)
    else:
        ground = load_heightmap(p.ground, p.body_radius_m)
    return ground.curved(p.body_radius_m) if p.body_radius_m else ground


def _towards(azimuth_deg: float, elevation_deg: float) -> Floats:
    """Return the unit vector towards the Sun, (3,)."""
    azimuth, elevation = math.radians(azimuth_deg), math.radians(elevation_deg)
    flat = math.cos(elevation)
    return np.array([flat * math.sin(azimuth), flat * math.cos(azimuth), math.sin(elevation)])
