"""The newest events of a camera that looks down, as level rays: the input of the estimator."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from divergence import Rays
from vehicle import matrix

__all__ = ["Lens", "Window"]

Floats = npt.NDArray[np.float64]

_MOST_EVENTS = 30_000
_KEPT_US = 5_000_000
_CORNER_TIMES = 9


@dataclass(frozen=True)
class Lens:
    """A pinhole: focal length in pixels, size of the picture."""

    focal_px: float = 299.6
    size: tuple[int, int] = (346, 260)


class Window:
    """The events of the last five seconds, and the attitudes in them.

    Parameters
    ----------
    lens : of the camera.
    seed : of the choice among very many events, and of the places within their pixels.
    """

    def __init__(self, lens: Lens, seed: int) -> None:
        self._lens = lens
        self._draw = np.random.default_rng(seed)
        self._events: list[npt.NDArray[np.void]] = []
        self._attitudes: list[tuple[float, Floats]] = [(-1.0, np.eye(3))]  # upright, before the first one comes

    @property
    def attitude_s(self) -> float:
        """Time of the newest attitude."""
        return self._attitudes[-1][0]

    @property
    def newest_s(self) -> float:
        """Time of the newest event; below 0 before the first."""
        return float(self._events[-1]["t"][-1]) * 1e-6 if self._events else -1.0

    @property
    def events(self) -> npt.NDArray[np.void]:
        """Events of the last five seconds, (n,) EVENT, in the order in which they came."""
        if not self._events:
            return np.zeros(0, [("t", "u8"), ("x", "u2"), ("y", "u2"), ("on", "?")])
        return np.concatenate(self._events)

    def add_events(self, events: npt.NDArray[np.void]) -> None:
        """Take the next events."""
        if len(events):
            self._events.append(events)
        while self._events and self._events[0]["t"][-1] + _KEPT_US < self._events[-1]["t"][-1]:
            del self._events[0]

    def add_attitude(self, t_s: float, q_world_from_body: Floats) -> None:
        """Take the next attitude."""
        self._attitudes.append((t_s, matrix(q_world_from_body)))
        del self._attitudes[:-200]

    def replace_attitudes(self, attitudes: Iterable[tuple[float, Floats]]) -> None:
        """Take times, s, and attitudes, world from body, in the place of all earlier ones."""
        self._attitudes = [(t_s, matrix(q)) for t_s, q in attitudes]

    def counts(self, bin_us: int) -> tuple[int, npt.NDArray[np.int64]]:
        """Return the time of the oldest event, us, and the number of each bin of `bin_us` since then, (n,)."""
        if not self._events:
            return 0, np.zeros(0, np.int64)
        t_us = self.events["t"].astype(np.int64)
        return int(t_us[0]), np.bincount((t_us - t_us[0]) // bin_us)

    def rays(self, since_s: float, until_s: float) -> Rays:
        """Return the events from one time to another."""
        events = self._between(since_s, until_s)
        t_s = events["t"] * 1e-6
        x, y = (
            (events[name] + self._draw.random(len(events)) - side / 2) / self._lens.focal_px
            for name, side in zip("xy", self._lens.size, strict=True)
        )
        east, south = _level(self._turned(t_s), x, y)
        return Rays(t_s, east, south, np.where(events["on"], 1.0, -1.0), self._seen(since_s, until_s))

    def _seen(self, since_s: float, until_s: float) -> tuple[float, float, float, float]:
        """Return the part of the level plane that the whole picture held all the time."""
        right, bottom = (side / 2 / self._lens.focal_px for side in self._lens.size)
        turned = self._turned(np.linspace(since_s, until_s, _CORNER_TIMES))
        one = np.ones(_CORNER_TIMES)
        corners = [(across * right, along * bottom) for across in (-1, 1) for along in (-1, 1)]
        (a, b, c, d) = (_level(turned, x * one, y * one) for x, y in corners)  # left top, left bottom, right top, ...
        west, east = max(a[0].max(), b[0].max()), min(c[0].min(), d[0].min())
        north, south = max(a[1].max(), c[1].max()), min(b[1].min(), d[1].min())
        return float(west), float(east), float(north), float(south)

    def _between(self, since_s: float, until_s: float) -> npt.NDArray[np.void]:
        """Return a fair choice of the events of a stretch of time, not more than the estimator needs."""
        events = self.events
        first, last = np.searchsorted(events["t"], [since_s * 1e6, until_s * 1e6])
        events = events[first:last]
        place = events["y"].astype(np.uint64) * np.uint64(self._lens.size[0]) + events["x"]
        events = events[np.lexsort((place, events["t"]))]  # of one tick, the order depends on the line's blocks
        if len(events) <= _MOST_EVENTS:
            return events
        return events[np.sort(self._draw.choice(len(events), _MOST_EVENTS, replace=False))]

    def _turned(self, t_s: Floats) -> Floats:
        """Return the matrices world from body at some times, (n, 3, 3), on straight lines between those known."""
        known_s = np.array([t for t, _ in self._attitudes])
        matrices = np.array([one for _, one in self._attitudes])
        if len(known_s) == 1:
            return np.broadcast_to(matrices, (len(t_s), 3, 3))
        after = np.clip(np.searchsorted(known_s, t_s), 1, len(known_s) - 1)
        part = ((t_s - known_s[after - 1]) / (known_s[after] - known_s[after - 1]))[:, None, None]
        return matrices[after - 1] * (1 - part) + matrices[after] * part


def _level(turned: Floats, x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Return east and south over down of rays of the camera, (n,) each, at attitudes (n, 3, 3)."""
    body = np.stack([x, -y, -np.ones_like(x)], axis=1)  # the camera looks along the body's -z
    world = np.einsum("nij,nj->ni", turned, body)
    return -world[:, 0] / world[:, 2], world[:, 1] / world[:, 2]
