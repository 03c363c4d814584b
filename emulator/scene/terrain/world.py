"""Parts of a terrain scene that all renderers share: ground, path of the camera, Sun, shadows, bounds on motion.

Shadows come from the height of the horizon towards the Sun, at every post of a ground. It is found by a sweep along the
Sun's azimuth: lines parallel to it, one post apart, are followed from the sunward edge of the map. The profile up to
the current point is stored as its upper convex hull, on which the horizon of the next point is the tangent: points
below the hull are dropped for good, so the work is a few steps a post. A line through a fine grid begins on the coarser
ones around it, so the shadow of a far mountain falls on near detail too. Heights are linear between posts, and horizons
between lines.

The Sun's disc is half a degree wide. The share of it above a straight horizon is, with x the height of its middle above
the horizon in its radii,

    1/2 + (x sqrt(1 - x^2) + asin x) / pi        -1 <= x <= 1

which is the penumbra: behind a 10 m rock under a Sun 2 degrees high it is about 80 m wide (`ground.sunlit`).
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from emulator.geometry.camera import Pinhole
from emulator.light import SceneError
from emulator.photometry.reflectance import Sun
from emulator.scene.files import Kind, cached_array, cached_arrays, report_progress
from emulator.scene.terrain.ground import Ground, Pyramid, build_pyramid, map_entry, table_of
from emulator.scene.terrain.heightmap import load_heightmap
from emulator.scene.terrain.relief import make_albedo, make_ridge
from emulator.scene.terrain.table import Ridge, TerrainParameters
from emulator.threads import ThreadPool, available_threads
from emulator.trajectory.building import build_trajectory
from emulator.trajectory.live import close_receivers, live_counts
from emulator.trajectory.pose import Pose, Timescale, Trajectory, TrajectoryError, instants_over, measured_bounds
from firmware_protocol.compiled import checksum_of
from firmware_protocol.events import Float32s, Floats


def horizon_slopes(ground: Ground, azimuth_deg: float) -> Float32s:
    """Return the tangent of the horizon's elevation at every post, (grids, rows, columns) float32.

    The azimuth is 0 along +y and 90 along +x. Posts with no ground towards the Sun have -1000.
    """
    azimuth = math.radians(azimuth_deg)
    east, north = math.sin(azimuth), math.cos(azimuth)
    swapped = abs(east) > abs(north)
    heights = ground.heights_m.transpose(0, 2, 1) if swapped else ground.heights_m
    across, along = (north, east) if swapped else (east, north)
    if along < 0:  # the lines run down the rows in any case
        heights = heights[:, ::-1]
    walked = np.ascontiguousarray(heights)
    length_m = ground.unit_m * math.hypot(across, along) / abs(along)
    out, pool = np.empty_like(walked), ThreadPool(available_threads())
    pool.each(lambda grid, _: _sweep(walked, grid, across / abs(along), length_m, out[grid]), len(walked))
    pool.close()
    if along < 0:
        out = out[:, ::-1]
    return np.ascontiguousarray(out.transpose(0, 2, 1) if swapped else out)


@map_entry
def _sweep(heights: Float32s, grid: int, drift: float, length_m: float, out: Float32s) -> None:
    """Write the horizons' slopes on one grid, (rows, columns); the Sun is towards higher rows.

    Lines move towards the Sun by `drift` columns a row; between two lattice rows they are `length_m` long.
    """
    rows, columns = heights.shape[1], heights.shape[2]
    spread = abs(drift) * (rows - 1)
    before = math.ceil(spread) if drift > 0 else 0  # lines that enter by a side
    lines = columns + math.ceil(spread) + 1
    sheared = np.empty((rows, lines), np.float32)
    room = len(heights) * rows + 2
    place, height = np.empty(room), np.empty(room)
    for line in range(lines):
        _follow(heights, grid, line - before, drift, length_m, place, height, sheared[:, line])
    for i in range(rows):
        for j in range(columns):
            at = j - drift * i + before
            low = min(int(at), lines - 2)
            part = np.float32(at - low)
            out[i, j] = sheared[i, low] * (1 - part) + sheared[i, low + 1] * part


@map_entry
def _follow(  # noqa: PLR0913, PLR0917
    heights: Float32s, grid: int, column: float, drift: float, length_m: float, place: Floats, height: Floats,
    out: Float32s
) -> None:  # fmt: skip
    """Follow one line towards lower rows, and write the horizons at the rows of `grid`, (rows,).

    Parameters
    ----------
    column, drift : of the line at row 0 of the grid, and columns a row.
    length_m : of the line, a lattice row.
    place, height : room for the hull's points, places along the line and heights.
    """
    rows, columns = heights.shape[1], heights.shape[2]
    on_hull = 0
    k = len(heights) - 1
    middle_row, middle_column = (rows - 1) // 2, (columns - 1) // 2
    y0, x0 = -(middle_row << grid), (column - middle_column) * (1 << grid)
    y = (rows - 1 - middle_row) << k
    while y >= y0:
        x = x0 + drift * (y - y0)
        while (
            k > grid and y <= (rows - 1 - middle_row) << (k - 1) and _is_on(x / (1 << (k - 1)) + middle_column, columns)
        ):
            k -= 1
        at = x / (1 << k) + middle_column
        if _is_on(at, columns):
            t, z = -y * length_m, _height(heights, k, x, y)
            slope = -1e3
            while on_hull:
                slope = (height[on_hull - 1] - z) / (t - place[on_hull - 1])
                if on_hull == 1 or (height[on_hull - 2] - z) / (t - place[on_hull - 2]) < slope:
                    break
                on_hull -= 1
            place[on_hull], height[on_hull] = t, z
            on_hull += 1
            if k == grid:
                out[(y >> k) + middle_row] = slope
        elif k == grid:
            out[(y >> k) + middle_row] = -1e3
        y -= 1 << k


@map_entry
def _height(heights: Float32s, grid: int, x: float, y: int) -> float:
    """Return the height at a lattice place on a grid, or from a coarser one where it lies beside it."""
    rows, columns = heights.shape[1], heights.shape[2]
    at = x / (1 << grid) + (columns - 1) // 2
    while grid + 1 < len(heights) and not 0.0 <= at <= columns - 1.0:
        grid += 1
        at = x / (1 << grid) + (columns - 1) // 2
    at, up = min(max(at, 0.0), columns - 1.0), y / (1 << grid) + (rows - 1) // 2
    row, column = min(int(up), rows - 2), min(int(at), columns - 2)
    part, above = at - column, up - row
    low = heights[grid, row, column] * (1 - part) + heights[grid, row, column + 1] * part
    high = heights[grid, row + 1, column] * (1 - part) + heights[grid, row + 1, column + 1] * part
    return float(low * (1 - above) + high * above)


@map_entry
def _is_on(at: float, columns: int) -> bool:
    """Return whether a column lies on a grid, or so near that a line there is needed at the next row.

    One column beyond the border is needed to interpolate between lines, and a line moves by at most two columns from
    one row of a coarser grid to the next.
    """
    return -3.0 <= at <= columns + 2.0


_LOOKS = 240  # instants at which the path is sampled in advance
_APART_NS = 20_000_000
_CACHED_POSTS = 1 << 20  # the light of fewer is computed as fast as it is read


class TerrainWorld:
    """The world of `parameters` before `pinhole`.

    Raises SceneError where the map or the path cannot be used, or the camera is below the ground.

    Attributes
    ----------
    sun : (3,) unit, towards it.
    disc : (2, 3), `sun` and from the middle of its disc to its top.
    irradiance_w_m2 : sunlight on a surface that faces the Sun, times the albedo of the brightest ground.
    motion_bound_px_s : from the path's speed, turning and height, sampled over the whole path.
    distance_m : the least sampled height over the ground beneath.
    """

    paths: Sequence[Trajectory] = ()

    def __init__(self, parameters: TerrainParameters, pinhole: Pinhole) -> None:
        p = self.parameters = parameters
        self.pinhole, self.time = pinhole, Timescale(parameters.time_scale)
        try:
            self.camera = build_trajectory(p.camera)
        except (TrajectoryError, OSError) as error:
            raise SceneError(f"scene.camera: {error}") from error
        self.ground = build_ground(p)
        looks = instants_over([self.camera], self.time.scene_ns(0), _LOOKS)
        self.distance_m = max(min(self.height_m(t, self.camera.pose(t)) for t in looks), 1e-3)  # refuses a path below
        self.motion_bound_px_s = max(map(self._moving_px_s, looks))
        self._sun = Sun(distance_au=p.sun_distance_au)
        azimuth, elevation = math.radians(p.sun_azimuth_deg), math.radians(p.sun_elevation_deg)
        flat = math.cos(elevation)
        self.sun = np.array([flat * math.sin(azimuth), flat * math.cos(azimuth), math.sin(elevation)])
        up = np.array([-math.sin(elevation) * math.sin(azimuth), -math.sin(elevation) * math.cos(azimuth), flat])
        self.disc = np.stack([self.sun, self._sun.radius_rad * up])
        albedo = self.ground.albedo
        self.irradiance_w_m2 = self._sun.irradiance_w_m2 * (1.0 if albedo is None else float(albedo.max()))

    @property
    def counts(self) -> Mapping[str, int]:
        """Counts of poses received from outside."""
        return live_counts(self.camera)

    def notes(self, first_frame: Float32s) -> tuple[str, ...]:
        """Return remarks on faults of the map, on views beyond it, and on a black first frame."""
        notes = list(self.ground.notes)
        if self.parameters.sun_elevation_deg < 0:
            notes.append("the Sun is below the horizontal: only slopes that rise above it are lit")
        if not first_frame.any():
            notes.append("the first light frame is black: the camera sees no lit ground")
        return tuple(notes)

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

    def sun_radii(self) -> Float32s:
        """Return the height of the Sun's middle over the horizon of each post, in its radii, (grids, rows, columns).

        Beyond the map the body continues at the height of the map's lowest ground, which gives the least horizon.
        """
        p, ground = self.parameters, self.ground
        slopes = horizon_slopes(ground, p.sun_azimuth_deg)
        relief_m = float(np.ptp(ground.heights_m))
        dip = math.sqrt(2 * relief_m / p.body_radius_m) if p.body_radius_m else 0.0
        slopes = np.arctan(np.maximum(slopes, np.float32(-dip)))
        return (np.float32(math.radians(p.sun_elevation_deg)) - slopes) / np.float32(self._sun.radius_rad)

    def pyramid(self, levels: int) -> Pyramid:
        """Return `levels` levels of the ground in the light of the Sun.

        Those of a large ground come from the cache of scenes where the same sources have made them of the same ground
        and Sun before: a start then takes some seconds less.
        """
        p, ground = self.parameters, self.ground
        if ground.heights_m.size < _CACHED_POSTS:
            return build_pyramid(ground, self.sun_radii(), self.disc, levels)
        digest = hashlib.sha256(ground.heights_m.data)
        if ground.albedo is not None:
            digest.update(ground.albedo.data)
        sun = p.sun_azimuth_deg, p.sun_elevation_deg, p.sun_distance_au, p.body_radius_m
        code = checksum_of(Path(__file__).parent), np.__version__
        made_from = digest.hexdigest(), ground.unit_m, ground.heights_m.shape, levels, sun, code

        kinds = Kind(np.float32, 1), Kind(np.uint16, 1), Kind(np.uint16, 1)
        heights, moments, shadows = cached_arrays(
            "light", made_from, lambda: build_pyramid(ground, self.sun_radii(), self.disc, levels)[:-1], kinds
        )
        return Pyramid(heights, moments, shadows, table_of(ground, levels))

    def planes(self, pose: Pose) -> Floats:
        """Return the inward normals of the four planes through the frame's edges and of the one behind, (5, 3)."""
        pinhole = self.pinhole
        x, y = pinhole.width / 2 / pinhole.focal_px, pinhole.height / 2 / pinhole.focal_px
        inward = np.array([[1.0, 0, x], [-1.0, 0, x], [0, 1.0, y], [0, -1.0, y], [0, 0, 1.0]])
        return np.ascontiguousarray(inward @ pose.world_from_body.T)

    def close(self) -> None:
        """Close the ports of live poses; a second call does nothing."""
        close_receivers(self.camera)

    def _moving_px_s(self, scene_ns: int) -> float:
        """Return the speed of the ground in the light frame, from the path's speed, turning and height then."""
        if not math.isfinite(self.camera.bounds.speed_m_s):
            return math.inf
        speed, turn = measured_bounds(self.camera.pose, [scene_ns, scene_ns + _APART_NS])
        height_m = self.height_m(scene_ns, self.camera.pose(scene_ns))
        wide = 1 + math.tan(self.pinhole.widest_rad) ** 2
        return self.pinhole.focal_px * wide * (turn + speed / max(height_m, 1e-3)) * self.time.factor


def build_ground(p: TerrainParameters) -> Ground:
    """Return the ground of `p`, from the cache where it was made before; raises SceneError."""
    if isinstance(p.ground, Ridge):
        ridge = p.ground
        progress = partial(report_progress, "making the map")
        heights = cached_array("ridge", ridge, lambda: make_ridge(ridge, progress).heights_m)
        albedo = cached_array("albedo", ridge, lambda: make_albedo(ridge)) if ridge.albedo_rms > 0 else None
        ground = Ground(ridge.size_m / ridge.posts / (1 << (len(heights) - 1)), heights, albedo=albedo)
    else:
        ground = load_heightmap(p.ground, p.body_radius_m)
    return ground.curved(p.body_radius_m) if p.body_radius_m else ground
