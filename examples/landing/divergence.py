"""Motion over height from events, by contrast maximisation over a plane; one core, a few tens of milliseconds.

The rays of the events, turned into level axes (x east, y south, z down) with the attitude at their own times, flow as

    x' = (x w - u),  y' = (y w - v)            (u, v, w) = velocity east, south, down / height: three unknowns, 1/s

since the ground is taken as level. Carried along that flow to the middle of the window, the events of one edge meet in
one line if and only if the motion is right: F = <I, G * I> / N of their picture I, with G a Gaussian of one cell, is
then largest (Gallego et al., CVPR 2018). Addresses are spread evenly over their pixel, else "no motion" would win.

Three choices keep F from preferring a motion that is too small (docs/landing.md has the first two with known answers):

- ON events count +1 and OFF events -1. Without signs the picture has a mean, which adds most to F where early and late
  events overlap most: without motion.
- Only the part of the ground that is in view for the whole window counts, for every motion that is tried.
- An event counts (1 - w t)^2: a picture made smaller by moving its events is not a sharper one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from vehicle import matrix

from evstim import EVENT
from firmware_protocol.compiled import entry_of

Floats = npt.NDArray[np.float64]
Picture = npt.NDArray[np.float32]
Scene = tuple[Floats, Floats, Floats, Floats, Floats]  # times from the middle, x, y, signs, part that counts in cells

_CELL_PX = 2.0
_TAPS = np.array([0.0544, 0.2442, 0.4028, 0.2442, 0.0544])  # a Gaussian of one cell, to two cells
_LEAST_GAIN = 1.2  # noise alone gives up to 1.07, 1000 events of ground without detail up to 1.17
_GRID = 17
_ROUNDS = 6


@dataclass(frozen=True)
class Motion:
    """Velocity over height, 1/s, and how reliable it is."""

    east: float
    south: float
    down: float  # the divergence, 1 / time to contact
    gain: float  # contrast over that without motion; what moves too little or is mostly noise has about 1
    at_s: float  # time for which it holds, the middle of the window
    events: int  # used

    @property
    def reliable(self) -> bool:
        """True when a motion was measured."""
        return self.gain >= _LEAST_GAIN

    def row(self) -> dict[str, object]:
        """Return what belongs into a flight's log."""
        row: dict[str, object] = {"at_s": self.at_s, "down_1_s": self.down, "east_1_s": self.east}
        return row | {"south_1_s": self.south, "gain": self.gain, "events": self.events}


@dataclass(frozen=True)
class Rays:
    """Events as level rays, (n,) each; their addresses are spread over their pixels."""

    t_s: Floats  # rising
    x: Floats  # east over down
    y: Floats  # south over down
    sign: Floats  # +1 for ON, -1 for OFF
    seen: tuple[float, float, float, float]  # part in view all the time: least and most x, least and most y


def estimate(rays: Rays, guess: Motion, spread: float, focal_px: float, reach_px: tuple[float, float]) -> Motion:
    """Return the motion that fits events best.

    The divergence is looked for within `spread` (1/s) around the guess, the other two from the guess on.

    Parameters
    ----------
    focal_px, reach_px : focal length; half the size of the picture made of the events, (across, along).
    """
    size = tuple(int(2 * reach / _CELL_PX) + 9 for reach in reversed(reach_px))
    pictures = np.zeros(size, np.float32), np.zeros(size, np.float32)
    first_s, last_s = float(rays.t_s[0]), float(rays.t_s[-1])
    middle_s, half_s = (first_s + last_s) / 2, (last_s - first_s) / 2
    theta = np.array([guess.east, guess.south, guess.down])
    scale = max(1 - (abs(theta[2]) + spread) * half_s, 0.3)
    across, along = np.abs(theta[:2]) * half_s
    part = np.array(rays.seen) * scale + np.array([across, -across, along, -along])  # in view all the time
    scene = (rays.t_s - middle_s, rays.x, rays.y, rays.sign, part * focal_px / _CELL_PX)

    def contrast(trial: Floats) -> float:
        return float(_contrast(scene, trial, focal_px / _CELL_PX, pictures, _TAPS))

    theta = max((np.array([*theta[:2], down]) for down in theta[2] + np.linspace(-spread, spread, _GRID)), key=contrast)
    best = contrast(theta)
    cell_1_s = 2 * _CELL_PX / (max(last_s - first_s, 1e-3) * focal_px)  # at the edge
    steps = np.diag([cell_1_s, cell_1_s, 2 * cell_1_s])
    for _ in range(_ROUNDS):
        for step in steps[[2, 0, 1]]:  # to the top of a parabola along each unknown
            below, above = contrast(theta - step), contrast(theta + step)
            bend = below - 2 * best + above
            shift = np.clip((below - above) / (2 * bend), -1, 1) if bend < 0 else np.sign(above - below)
            trial = theta + shift * step
            if (value := contrast(trial)) > best:
                theta, best = trial, value
        steps = steps * 0.6
    return Motion(*theta.tolist(), gain=best / max(contrast(np.zeros(3)), 1e-9), at_s=middle_s, events=len(rays.t_s))


@entry_of(fastmath=True)
def _contrast(scene: Scene, theta: Floats, scale: float, pictures: tuple[Picture, Picture], taps: Floats) -> float:
    """Return <I, G * I> / N; one pass over the events, two over a picture of a quarter of the pixels."""
    t, x, y, sign, part = scene
    picture, spare = pictures
    rows, columns = picture.shape
    picture[:] = 0
    left, right = max(part[0] + columns / 2, 2.0), min(part[1] + columns / 2, columns - 3.0)
    top, bottom = max(part[2] + rows / 2, 2.0), min(part[3] + rows / 2, rows - 3.0)
    for k in range(t.size):
        column = (x[k] - t[k] * (x[k] * theta[2] - theta[0])) * scale + columns / 2
        row = (y[k] - t[k] * (y[k] * theta[2] - theta[1])) * scale + rows / 2
        if not (left <= column < right and top <= row < bottom):
            continue
        i, j = int(row), int(column)
        a, b = np.float32(row - i), np.float32(column - j)
        shrunk = 1 - t[k] * theta[2]
        one, weight = np.float32(1), np.float32(sign[k] * shrunk * shrunk)
        picture[i, j] += weight * (one - a) * (one - b)
        picture[i, j + 1] += weight * (one - a) * b
        picture[i + 1, j] += weight * a * (one - b)
        picture[i + 1, j + 1] += weight * a * b
    return _blurred_product(picture, spare, taps) / t.size


@entry_of(fastmath=True)
def _blurred_product(picture: Picture, spare: Picture, taps: Floats) -> float:
    """Return the sum of a picture times itself blurred."""
    rows, columns = picture.shape
    a, b, c = np.float32(taps[0]), np.float32(taps[1]), np.float32(taps[2])
    for i in range(rows):
        for j in range(2, columns - 2):
            p = picture[i]
            spare[i, j] = a * (p[j - 2] + p[j + 2]) + b * (p[j - 1] + p[j + 1]) + c * p[j]
    total = np.float32(0)
    for i in range(2, rows - 2):
        line = np.float32(0)
        for j in range(2, columns - 2):
            vertical = a * (spare[i - 2, j] + spare[i + 2, j]) + b * (spare[i - 1, j] + spare[i + 1, j])
            line += picture[i, j] * (vertical + c * spare[i, j])
        total += line
    return total


_MOST_EVENTS = 30_000
_KEPT_US = 5_000_000
_CORNER_TIMES = 9


@dataclass(frozen=True)
class Lens:
    """A pinhole: focal length in pixels, size of the picture."""

    focal_px: float = 299.6
    size: tuple[int, int] = (346, 260)


class Window:
    """The events of the last five seconds; the seed is of their places within pixels, and of a choice among many."""

    def __init__(self, lens: Lens, seed: int) -> None:
        self._lens = lens
        self._draw = np.random.default_rng(seed)
        self._events: list[npt.NDArray[np.void]] = []

    @property
    def newest_s(self) -> float:
        """Time of the newest event; below 0 before the first."""
        return float(self._events[-1]["t"][-1]) * 1e-6 if self._events else -1.0

    @property
    def events(self) -> npt.NDArray[np.void]:
        """Events of the last five seconds, (n,) EVENT, in the order in which they came."""
        return np.concatenate([np.zeros(0, EVENT), *self._events])

    def add_events(self, events: npt.NDArray[np.void]) -> None:
        """Take the next events."""
        if len(events):
            self._events.append(events)
        while self._events and self._events[0]["t"][-1] + _KEPT_US < self._events[-1]["t"][-1]:
            del self._events[0]

    def rays(self, since_s: float, until_s: float, attitudes: Sequence[tuple[float, Floats]]) -> Rays:
        """Return the events from one time to another: a fair choice of them, not more than the estimator needs.

        `attitudes` are two or more times, s, and attitudes, world from body.
        """
        events = self.events
        first, last = np.searchsorted(events["t"], [since_s * 1e6, until_s * 1e6])
        events = events[first:last]
        events = events[np.lexsort((events["x"], events["y"], events["t"]))]  # the line's blocks change those of a tick
        if len(events) > _MOST_EVENTS:
            events = events[np.sort(self._draw.choice(len(events), _MOST_EVENTS, replace=False))]
        t_s = events["t"] * 1e-6
        x, y = (
            (events[name] + self._draw.random(len(events)) - side / 2) / self._lens.focal_px
            for name, side in zip("xy", self._lens.size, strict=True)
        )
        east, south = _level(_turned(attitudes, t_s), x, y)
        seen = self._seen(_turned(attitudes, np.linspace(since_s, until_s, _CORNER_TIMES)))
        return Rays(t_s, east, south, np.where(events["on"], 1.0, -1.0), seen)

    def _seen(self, turned: Floats) -> tuple[float, float, float, float]:
        """Return the part of the level plane that the whole picture holds at all attitudes, (n, 3, 3)."""
        right, bottom = (side / 2 / self._lens.focal_px for side in self._lens.size)
        one = np.ones(len(turned))
        corners = [(across * right, along * bottom) for across in (-1, 1) for along in (-1, 1)]
        (a, b, c, d) = (_level(turned, x * one, y * one) for x, y in corners)  # left top, left bottom, right top, ...
        west, east = max(a[0].max(), b[0].max()), min(c[0].min(), d[0].min())
        north, south = max(a[1].max(), c[1].max()), min(b[1].min(), d[1].min())
        return float(west), float(east), float(north), float(south)


def _turned(attitudes: Sequence[tuple[float, Floats]], t_s: Floats) -> Floats:
    """Return the matrices world from body at some times, (n, 3, 3), on straight lines between those known."""
    known_s = np.array([t for t, _ in attitudes])
    matrices = np.array([matrix(q) for _, q in attitudes])
    after = np.clip(np.searchsorted(known_s, t_s), 1, len(known_s) - 1)
    part = ((t_s - known_s[after - 1]) / (known_s[after] - known_s[after - 1]))[:, None, None]
    return matrices[after - 1] * (1 - part) + matrices[after] * part


def _level(turned: Floats, x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Return east and south over down of rays of the camera, (n,) each, at attitudes (n, 3, 3)."""
    body = np.stack([x, -y, -np.ones_like(x)], axis=1)  # the camera looks along the body's -z
    world = np.einsum("nij,nj->ni", turned, body)
    return -world[:, 0] / world[:, 2], world[:, 1] / world[:, 2]
