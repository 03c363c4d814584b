"""A star tracker for events: windows of equal motion, centroids at the window's middle time, and an attitude.

    ON events -> streaks -> motion of the picture -> events moved to the middle time -> centroids -> attitude

OFF events are left out: in the dark a pixel follows falling light slowly, so they trail behind by many pixels. The
motion of the picture is measured from the events themselves; no gyroscope is needed. It is that of a far sky before a
turning camera: a shift and a turn about the middle, the same for all stars. The solver is tetra3rs, with a catalogue
of its own (Gaia); it has no idea of the attitude before.
"""

from __future__ import annotations

import dataclasses
import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import tetra3rs
from scipy import ndimage
from scipy.stats import poisson

__all__ = ["Motion", "Solution", "Tracker", "centroids", "hot_pixels", "motion_of"]

Floats = npt.NDArray[np.float64]
Events = npt.NDArray[Any]
"""(n,) with fields t (us), x, y, on; as `evstim.run` gives them."""

STREAK_EVENTS, STAR_EVENTS = 12, 6
FALSE_REGIONS = 1.0
ROUNDS = 2
MATCH_PX = 3.0


@dataclass(frozen=True)
class Motion:
    """Motion of the picture about its middle: a shift in px/s and a turn in rad/s."""

    right_px_s: float
    down_px_s: float
    turn_rad_s: float

    def at(self, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        """Return the speed of places measured from the middle, px/s."""
        return self.right_px_s - self.turn_rad_s * y, self.down_px_s + self.turn_rad_s * x


@dataclass(frozen=True)
class Solution:
    """Attitude at the middle of a window.

    Attributes
    ----------
    camera_from_world : (3, 3), rotation of directions in the ICRS to the camera's axes; None where there is none.
    centroids : number of centroids.
    matched : number of them that the solver matched with stars.
    motion : of the picture; None where no star left a streak.
    """

    camera_from_world: Floats | None
    centroids: int
    matched: int
    motion: Motion | None


def hot_pixels(events: Events, size: tuple[int, int], parts: int = 8) -> npt.NDArray[np.bool_]:
    """Return which pixels have events in most parts of a recording, (height, width): no star stays that long."""
    width, height = size
    edges = np.linspace(events["t"][0], int(events["t"][-1]) + 1, parts + 1)
    busy = np.zeros((height, width), np.int64)
    for first, last in itertools.pairwise(edges):
        part = events[(events["t"] >= first) & (events["t"] < last)]
        there = np.zeros((height, width), bool)
        there[part["y"], part["x"]] = True
        busy += there
    return busy > parts / 2


def motion_of(events: Events, size: tuple[int, int]) -> Motion | None:
    """Return the motion of the picture from the streaks of bright stars; None without a streak.

    The events of each streak are fitted by a straight line over time, then all lines by one motion. Events are then
    moved back along it, so that fainter stars become streaks, and what motion is left is fitted again.
    """
    motion = Motion(0.0, 0.0, 0.0)
    if not len(events):
        return None
    for _ in range(ROUNDS):
        x, y = moved(events, motion, float(events["t"].mean()), size)
        labels, count = _labels(x, y, size)
        lines = [_line(events["t"][own], x[own], y[own]) for own in _each(labels, count, STREAK_EVENTS)]
        if not lines:
            return None
        more = _agreed(np.array(lines))
        motion = Motion(*(a + b for a, b in zip(dataclasses.astuple(motion), dataclasses.astuple(more), strict=True)))
    return motion


def moved(events: Events, motion: Motion, t_us: float, size: tuple[int, int]) -> tuple[Floats, Floats]:
    """Return columns and rows of events from the picture's middle, moved along the motion to `t_us`, (n,) each."""
    x, y = events["x"] + 0.5 - size[0] / 2, events["y"] + 0.5 - size[1] / 2
    later_s = (t_us - events["t"].astype(float)) * 1e-6
    right, down = motion.at(x, y)
    return x + right * later_s, y + down * later_s


def _agreed(lines: Floats) -> Motion:
    """Return the motion of most lines: those off by more than three times the median are left out, three times."""
    x, y, right, down, weight = lines.T
    motion = Motion(float(np.median(right)), float(np.median(down)), 0.0)
    for _ in range(3):
        off = np.hypot(*(a - b for a, b in zip(motion.at(x, y), (right, down), strict=True)))
        good = off <= 3 * np.median(off) + 1e-9
        motion = _fitted(x[good], y[good], right[good], down[good], weight[good])
    return motion


def _line(t_us: npt.NDArray[Any], x: Floats, y: Floats) -> tuple[float, float, float, float, float]:
    """Return place, speed and weight of a streak."""
    t = t_us.astype(float) * 1e-6
    t -= t.mean()
    spread = max(float(t @ t), 1e-12)
    return float(x.mean()), float(y.mean()), float(t @ x) / spread, float(t @ y) / spread, spread


def _fitted(x: Floats, y: Floats, right: Floats, down: Floats, weight: Floats) -> Motion:
    """Return the motion nearest to the speeds of some places, by least squares; of one place, a shift."""
    zero, one, root = np.zeros_like(x), np.ones_like(x), np.sqrt(np.concatenate([weight, weight]))
    columns = [np.concatenate([one, zero]), np.concatenate([zero, one])]
    if len(x) > 2:
        columns.append(np.concatenate([-y, x]))
    best, *_ = np.linalg.lstsq(np.column_stack(columns) * root[:, None], np.concatenate([right, down]) * root)
    return Motion(*(float(v) for v in best), *([0.0] if len(best) < 3 else []))


def _labels(x: Floats, y: Floats, size: tuple[int, int]) -> tuple[npt.NDArray[np.int64], int]:
    """Return the region of each event, (n,), 0 where there is none, and the number of regions.

    A region is connected and has more events in 5 x 5 pixels than noise makes: noise spread evenly would have
    `FALSE_REGIONS` in a picture.
    """
    width, height = size
    column, row = np.floor(x + width / 2).astype(int), np.floor(y + height / 2).astype(int)
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    column, row = column.clip(0, width - 1), row.clip(0, height - 1)
    counts = np.zeros((height, width))
    np.add.at(counts, (row[inside], column[inside]), 1)
    near = ndimage.uniform_filter(counts, 5, mode="constant") * 25
    mean = max(float(np.median(near)), 12.5 * len(x) / counts.size)
    labels, count = ndimage.label(near >= poisson.isf(FALSE_REGIONS / counts.size, mean) + 1)
    return np.where(inside, labels[row, column], 0), count


def _each(labels: npt.NDArray[np.int64], count: int, least: int) -> list[npt.NDArray[np.intp]]:
    """Return the indices of the events of each region that has at least `least`."""
    order = np.argsort(labels, kind="stable")
    edges = np.searchsorted(labels[order], np.arange(1, count + 2))
    return [order[a:b] for a, b in itertools.pairwise(edges) if b - a >= least]


def centroids(events: Events, motion: Motion, t_us: float, size: tuple[int, int]) -> Floats:
    """Return columns and rows from the middle, and numbers of events, of the stars at `t_us`, (n, 3), bright first."""
    x, y = moved(events, motion, t_us, size)
    labels, count = _labels(x, y, size)
    found = [(x[own].mean(), y[own].mean(), len(own)) for own in _each(labels, count, STAR_EVENTS)]
    return np.array(sorted(found, key=lambda star: -star[2])).reshape(-1, 3)


class Tracker:
    """Attitudes from windows of events.

    Parameters
    ----------
    size : (width, height) of the picture, pixels.
    width_deg : field of view of its width.
    epoch_year : of the solver's star places.
    """

    def __init__(self, size: tuple[int, int], width_deg: float, epoch_year: float = 2016.0) -> None:
        self._size, self._width_deg = size, width_deg
        self._stars = tetra3rs.SolverDatabase.generate_from_gaia(
            max_fov_deg=1.1 * width_deg, star_max_magnitude=7.5, epoch_proper_motion_year=epoch_year
        )

    def solve(self, events: Events, t_us: float) -> Solution:
        """Return the attitude at `t_us` from the ON events around it."""
        events = events[events["on"]]
        motion = motion_of(events, self._size)
        if motion is None:
            return Solution(None, 0, 0, None)
        places = centroids(events, motion, t_us, self._size)
        if len(places) < 4:
            return Solution(None, len(places), 0, motion)
        found = self._stars.solve_from_centroids(
            places,
            fov_estimate_deg=self._width_deg,
            fov_max_error_deg=0.1,
            image_shape=self._size[::-1],
            match_radius=MATCH_PX / self._size[0],
            solve_timeout_ms=None,
            max_patterns_checked=20_000,
        )
        if not found:
            return Solution(None, len(places), 0, motion)
        return Solution(np.asarray(found.rotation_matrix_icrs_to_camera), len(places), found.num_matches, motion)
