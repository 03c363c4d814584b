"""Stars, planets and debris: points of light on a dark sky, without any GL.

The world's axes are those of the catalogue (ICRS) and the camera turns among them along its path. A star's irradiance E
falls on the chip as if its pixel saw the radiance E f^2 / cos^3 (f: focal length in pixels, a pixel's solid angle being
cos^3 / f^2), spread over pixels by the lens's blur. A moving body of radius R at the distance d is a point too:

    E = E_sun p (R / d)^2 phi(a),    phi(a) = (sin a + (pi - a) cos a) / pi       (a Lambert sphere)

with its geometric albedo p and phase angle a. Light and its time derivative are closed forms; only pixels that a point
touches are computed. Distortion is applied to directions and so costs nothing; a body more than a pixel across, or one
behind another, is beyond this scene.

Optical flow: stars are infinitely far and turn with the camera. A moving point covers no pixel; pixels whose centres
lie within two standard deviations of its blur, or within a pixel, have its label, its depth and its flow.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from emulator.geometry.attitude import unit
from emulator.geometry.camera import Given, Pinhole, Rays, SceneGeometry, ScenePoses, Seen
from emulator.light import Light, Region, SceneError
from emulator.optics.lens import Chip, LensParameters, bent_rays, straight_columns_and_rows
from emulator.raster.surfaces import instants, motion_of, write_depth_and_flow
from emulator.scene.kind import SizedScene
from emulator.scene.stars.catalogue import Boxes, Stars, boxes_of, clear, irradiance_w_m2, load_stars, splat
from emulator.scene.stars.skies import draw_field, load_gaia
from emulator.scene.stars.table import StarsParameters
from emulator.trajectory.building import build_trajectories
from emulator.trajectory.live import close_receivers, live_counts
from emulator.trajectory.pose import Pose, Timescale, Trajectory, TrajectoryError
from firmware_protocol.events import Floats

_REACH = 2.0  # standard deviations


class StarsGeometry(SceneGeometry):
    """The geometry of a sky with a blur of standard deviation `sigma_px`; label k is the k-th moving point.

    `paths` are those of the camera and of the points.
    """

    gives: frozenset[Given] = frozenset({"poses", "depth", "flow", "labels"})

    def __init__(
        self, paths: Sequence[Trajectory], time: Timescale, camera: Pinhole, sigma_px: float, rays: Rays
    ) -> None:
        self._paths, self._time = paths, time
        self._camera, self._rays = camera, rays
        self.names = tuple(f"point {k}" for k in range(1, len(paths)))
        self._reach_px = max(1.0, _REACH * sigma_px)
        self._inverse_depth = np.zeros_like(rays.columns)

    def look(self, t_ns: int, out: Seen) -> None:
        """Write depth, flow and labels at `t_ns`."""
        (camera, *points), between_s = instants(t_ns, self._paths, self._time)
        out.labels.fill(0)
        focal, (width, height) = self._camera.focal_px, self._camera.size
        for k, point in enumerate(points):
            place = camera[0].world_from_body.T @ (point[0].position_m - camera[0].position_m)
            if place[2] <= 0:
                continue
            column, row = width / 2 + focal * place[0] / place[2], height / 2 + focal * place[1] / place[2]
            touched = np.hypot(self._rays.columns - column, self._rays.rows - row) <= self._reach_px
            touched &= (out.labels == 0) | (self._inverse_depth < 1 / place[2])  # not under nearer points
            out.labels[touched], self._inverse_depth[touched] = k + 1, 1 / place[2]
        motions = np.array([motion_of(camera, body, between_s) for body in (None, *points)])
        write_depth_and_flow(self._inverse_depth, motions, self._camera, self._rays, out)

    def places(self, t_ns: int) -> ScenePoses:
        """Return the poses at `t_ns`."""
        scene_ns = self._time.scene_ns(t_ns)
        camera, *points = (path.pose(scene_ns) for path in self._paths)
        places = np.array([pose.position_m for pose in points]).reshape(-1, 3)
        turns = np.array([pose.q_world_from_body for pose in points]).reshape(-1, 4)
        return ScenePoses(camera.position_m, camera.q_world_from_body, places, turns)


_SHARPEST_PX = 0.3  # no lens is sharper; a blur of nothing would make light jump from pixel to pixel
_APART_NS = 1_000_000  # poses from which velocities are taken


class StarField(SizedScene):
    """The sky of `parameters` through `lens` on `chip`, in light relative to the sensor's reference.

    Raises SceneError where a path cannot be used.
    """

    def __init__(self, parameters: StarsParameters, size: tuple[int, int], lens: LensParameters, chip: Chip) -> None:
        super().__init__(size)
        self._p, self._lens = parameters, lens
        self._pinhole = lens.pinhole(size)
        self._sigma_px = max(_SHARPEST_PX, lens.blur_sigma_px(chip, self._pinhole.focal_px))
        self.path_time = Timescale(parameters.time_scale)
        try:
            self.camera_path, *self._paths = build_trajectories(
                [parameters.camera, *(point.path for point in parameters.points)]
            )
        except (TrajectoryError, OSError) as error:
            raise SceneError(f"scene: {error}") from error
        stars = stars_of(parameters)
        self._directions, self._magnitudes = stars.directions, stars.magnitudes
        self._irradiance = irradiance_w_m2(stars.magnitudes, stars.sun_magnitude)
        self._sun = unit(parameters.sun.direction)
        self._boxes: Boxes = np.empty((0, 4), np.int64)
        self._cone_cosine = max(0.05, math.cos(min(math.pi, 1.2 * self._pinhole.widest_rad + 0.02)))

    @property
    def motion_bound_px_s(self) -> float:
        """Bound from the camera's turning; infinite where points or live poses move."""
        if self._paths:
            return math.inf
        stretch = 1 + math.tan(self._pinhole.widest_rad) ** 2
        return self.camera_path.bounds.turn_rad_s * self.path_time.factor * self._pinhole.focal_px * stretch

    @property
    def counts(self) -> Mapping[str, int]:
        """Counts of poses received from outside."""
        return live_counts(self.camera_path, *self._paths)

    def geometry(self, rays: Rays | None = None) -> StarsGeometry:
        """Return the flow of the sky, with the positions of the moving points."""
        if rays is None:
            columns, rows = straight_columns_and_rows(self._lens, self._pinhole)
            rays = bent_rays(self._lens, columns, rows, self._pinhole)
        paths = self.camera_path, *self._paths
        return StarsGeometry(paths, self.path_time, self._pinhole, self._sigma_px, rays)

    def stars_at(self, t_ns: int) -> tuple[Floats, Floats]:
        """Return columns and rows, (n, 2), and magnitudes, (n,), of the stars in or near the light frame of `t_ns`."""
        camera = self.camera_path.pose(self.path_time.scene_ns(t_ns))
        in_view = self._near(camera)
        seen = self._seen(self._directions[in_view], camera)
        return np.array(self.size) / 2 + self._pinhole.focal_px * seen[:, :2], self._magnitudes[in_view]

    def close(self) -> None:
        """Close the sockets of live poses."""
        close_receivers(self.camera_path, *self._paths)

    def light_and_rate(self, t_ns: int, light: Light, rate: Light) -> None:
        """Write light and rate in closed form: only the boxes of points, if they are the arrays of the last call."""
        points = self._points(t_ns)
        sky = np.float32(self._p.sky_w_m2_sr * self._lens.light_per_radiance)
        hold_last = self._arrays.are(light, rate)
        if not hold_last:
            light.fill(sky)
            rate.fill(0)
        clear(self._boxes, sky, light, rate)  # always, so that the kernel is loaded before the run begins
        before, self._boxes = self._boxes, np.empty((len(points), 4), np.int64)
        boxes_of(points, self._sigma_px, self.size, self._boxes)
        splat(points, self._sigma_px, self._boxes, light, rate)
        boxes = np.concatenate([before, self._boxes])
        self.changed = Region(0, self.size[1], 0, self.size[0], boxes) if hold_last else None

    def _points(self, t_ns: int) -> Floats:
        """Return column, row, light, px/s and px/s of every point near the light frame, (n, 5).

        They come from two instants, before and after: the mean is the position, the difference the speed.
        """
        before_ns, after_ns = (self.path_time.scene_ns(t_ns + d) for d in (-_APART_NS, _APART_NS))
        before, after = self.camera_path.pose(before_ns), self.camera_path.pose(after_ns)
        stars = self._near(before)
        moving_before, shine = self._moving(before_ns, before)
        moving_after, _ = self._moving(after_ns, after)
        behind = self._seen(np.vstack([self._directions[stars], moving_before]), before)
        ahead = self._seen(np.vstack([self._directions[stars], moving_after]), after)
        focal, middle = self._pinhole.focal_px, np.array(self.size) / 2
        place = middle + focal / 2 * (ahead[:, :2] + behind[:, :2])
        light = np.concatenate([self._irradiance[stars], shine]) * focal**2 * self._lens.light_per_radiance
        speed = focal / (2e-9 * _APART_NS) * (ahead[:, :2] - behind[:, :2])
        return np.column_stack([place, light * ahead[:, 2], speed])

    def _near(self, camera: Pose) -> npt.NDArray[np.intp]:
        """Return the numbers of the stars in front of the camera, in or near the light frame."""
        return np.flatnonzero(self._directions @ camera.world_from_body[:, 2] > self._cone_cosine)

    def _seen(self, directions: Floats, camera: Pose) -> Floats:
        """Return the image of directions in the world, (n, 3): two tangents and the cosine off the axis, (n, 3)."""
        rays = directions @ camera.world_from_body
        x, y = self._lens.bend(rays[:, 0] / rays[:, 2], rays[:, 1] / rays[:, 2])
        return np.column_stack([x, y, rays[:, 2]])

    def _moving(self, scene_ns: int, camera: Pose) -> tuple[Floats, Floats]:
        """Return directions (n, 3) and irradiances (n,) of the moving points, dark where they are behind the camera."""
        if not self._paths:
            return np.zeros((0, 3)), np.zeros(0)
        away = np.array([path.pose(scene_ns).position_m for path in self._paths]) - camera.position_m
        distance = np.linalg.norm(away, axis=1)
        if not distance.all():
            raise SceneError(f"at {scene_ns * 1e-9:g} s the camera is inside one of the scene's points")
        to_point = away / distance[:, None]
        angle = np.arccos(np.clip(-to_point @ self._sun, -1, 1))
        phase = (np.sin(angle) + (math.pi - angle) * np.cos(angle)) / math.pi
        shine = np.array([p.albedo * p.radius_m**2 for p in self._p.points]) / distance**2 * phase
        boresight = camera.world_from_body[:, 2]
        is_ahead = to_point @ boresight > self._cone_cosine
        to_point[~is_ahead] = boresight
        return to_point, np.where(is_ahead, self._p.sun.irradiance_w_m2 * shine, 0.0)


def stars_of(parameters: StarsParameters) -> Stars:
    """Return the stars of a sky, brightest first; raises MachineLacks without the package of the catalogue."""
    if parameters.drawn is not None:
        return draw_field(parameters.drawn)
    if parameters.catalogue == "gaia":
        return load_gaia(parameters.faintest_g, parameters.epoch_year)
    return load_stars(parameters.faintest_v, parameters.epoch_year)
