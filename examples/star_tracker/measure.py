"""Error of a star tracker's attitude over angular rate: `python measure.py [FOLDER]`.

For each rate it runs tracker.toml, cuts the events into windows in which stars move by `MOVE_PX` pixels, solves the
attitude of each, and compares it with the true one. It writes star-tracker.csv, star-tracker.json and the chart
star-tracker.png into FOLDER.
"""

from __future__ import annotations

import csv
import dataclasses
import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation
from star_tracker import Solution, Tracker, hot_pixels

import evstim

__all__ = ["Measured", "errors_arcsec", "main", "measure", "recorded", "true_attitude"]

RATES_DEG_S = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0)
MOVE_PX = 10.0
WINDOWS = 20
SETTLE_PX = 15.0  # motion before the first window
RIG = Path(__file__).parent / "tracker.toml"

Floats = npt.NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class Measured:
    """Windows at one rate.

    `errors` has a row for each solved window: along the motion, across it, and about the boresight, arc-seconds.
    """

    rate_deg_s: float
    window_ms: float
    solutions: tuple[Solution, ...]
    errors: Floats

    @property
    def solved(self) -> int:
        """Windows with an attitude."""
        return len(self.errors)


def turning(rig: evstim.Rig, rate_deg_s: float) -> evstim.Rig:
    """Return the rig with the camera turning so that the boresight sweeps at `rate_deg_s`."""
    path = rig.scene.camera
    off_pole = math.sin(math.radians(path.tilt_deg))
    camera = dataclasses.replace(path, precession_deg_s=rate_deg_s / off_pole)
    step_us = max(500, min(50_000, round(0.3e6 / (rate_deg_s * pixels_a_degree(rig)))))
    run = dataclasses.replace(rig.run, step_us=step_us)
    return dataclasses.replace(rig, scene=dataclasses.replace(rig.scene, camera=camera), run=run)


def pixels_a_degree(rig: evstim.Rig) -> float:
    """Return the focal length in pixels a degree."""
    half = math.radians(rig.camera.lens.field_of_view_deg / 2)
    return math.radians(rig.camera.sensor.width / 2 / math.tan(half))


def true_attitude(rig: evstim.Rig, t_s: float) -> Floats:
    """Return the rotation (3, 3) of the ICRS to the camera's axes: a tilt about x, then a turn about the pole."""
    path = rig.scene.camera
    turn = Rotation.from_euler("z", path.precession_deg_s * t_s, degrees=True)
    tilt = Rotation.from_euler("x", path.tilt_deg, degrees=True)
    return np.asarray((turn * tilt).as_matrix().T)


def errors_arcsec(found: Floats, true: Floats, motion_px: tuple[float, float]) -> tuple[float, float, float]:
    """Return the error of the boresight along the stars' motion and across it, and the error of roll, arc-seconds.

    Along is positive where the stars were placed ahead of their true places in the picture.
    """
    turn = Rotation.from_matrix(found @ true.T).as_rotvec() * math.degrees(1) * 3600
    moved = np.array([turn[1], -turn[0]])  # of stars near the boresight, right and down
    along = np.array(motion_px) / math.hypot(*motion_px)
    return float(moved @ along), float(moved @ np.array([-along[1], along[0]])), float(turn[2])


def recorded(rig: evstim.Rig, seconds: float) -> npt.NDArray[Any]:
    """Return the events of a run."""
    with evstim.run(rig, seconds=seconds, pace="free") as run:
        return np.concatenate([events.copy() for events in run])


def measure(rig: evstim.Rig, tracker: Tracker, rate_deg_s: float, windows: int = WINDOWS) -> Measured:
    """Run at one rate and solve `windows` windows."""
    rig = turning(rig, rate_deg_s)
    speed_px_s = rate_deg_s * pixels_a_degree(rig)
    window_us, settle_us = MOVE_PX / speed_px_s * 1e6, SETTLE_PX / speed_px_s * 1e6
    events = recorded(rig, (settle_us + window_us * windows) * 1e-6)
    size = rig.camera.sensor.width, rig.camera.sensor.height
    events = events[~hot_pixels(events, size)[events["y"], events["x"]]]
    solutions, errors = [], []
    for k in range(windows):
        middle_us = settle_us + (k + 0.5) * window_us
        near = events[np.abs(events["t"] - middle_us) <= window_us / 2]
        solution = tracker.solve(near, middle_us)
        solutions.append(solution)
        if solution.camera_from_world is not None and solution.motion is not None:
            way = solution.motion.right_px_s, solution.motion.down_px_s
            errors.append(errors_arcsec(solution.camera_from_world, true_attitude(rig, middle_us * 1e-6), way))
    return Measured(rate_deg_s, window_us * 1e-3, tuple(solutions), np.array(errors).reshape(-1, 3))
