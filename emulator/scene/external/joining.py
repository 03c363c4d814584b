"""Light between two images of an external renderer, and its time derivative, by the best that the images have.

    images alone   a straight line of the light of each pixel
    rate           a cubic through light and rate of both images, in each pixel (Hermite)
    motion         each visible point moves; light is that of the point in both images
    both           the cubic where a point moves up to one pixel from one image to the next, else motion

With motion, light of a pixel p at time t, a share s of the way from image 0 to image 1, is

    (1 - s) image0(q0) + s image1(q1)

q0 and q1 are the places in the images of the point that is at p at time t. It moves at a constant acceleration, from
its velocity in image 0 to that in image 1; q0 and q1 follow in a few steps of a fixed point. The time derivative is
that of the same formula.

An image that shows nothing which moves to p is left out: the surface appears or disappears in between. Where the images
give different surfaces, one that both of them show is in front of one that only one shows, because this one is hidden
in the other. If both are shown twice, the nearer one is in front, by depth, or else the faster one. If none is, both
are mixed by s. So light has no step at the time of an image.

A pixel at an edge has the light of both surfaces and the velocity of one. So each pixel has the velocity of the nearest
point among itself and its eight neighbours (the fastest without depth): an edge moves with the surface in front.
Shadows move across the surface that they fall on, so motion places their edges worse than other ones; a rate does not.

An image is given by the mean light of each pixel. Between pixels it is the Catmull-Rom cubic, held within the four
pixels around the place, so that it makes no darkness below the darkest and no light above the brightest.

That cubic spreads an edge over two pixels more. Before a black sky the logarithm of light sees it: a pixel next to the
edge begins to change as soon as the edge moves, not when the edge arrives. So where light beside a pixel is below a
tenth of that on its other side, the pixel is two parts with a straight edge between them:

    +-------+   dark light, the least of 3 x 3 pixels, in the share 1 - c of the pixel
    |  / / /|   bright light, the greatest of 3 x 3, in the share c, so that the mean is that of the pixel
    | / / / |   the edge is at right angles to the gradient of the 3 x 3 pixels
    +-------+

and light at a place is the mean over one pixel around it, in closed form: right for straight edges between two even
surfaces. (In fluid dynamics the reconstruction is called PLIC: Youngs, 1982, Time-dependent multi-material flow with
large fluid distortion.) A bright pixel with darkness two pixels away is one part, as the edge is in its neighbour. A
slope of light that goes down to black, as at the terminator of a body, is no edge: light goes on rising over 5 x 5
pixels. There the cubic stays, and between both kinds of pixels the two are mixed.

The kernels are fast because each pixel is independent, pixels that do not move are joined in place, and edges are
looked for only where the sixteen pixels of the cubic have light and near darkness; threads share the rows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from emulator.light import Light
from emulator.threads import ThreadPool, available_threads
from firmware_protocol.compiled import entry_of, kernel
from firmware_protocol.events import Float32s

_entry = entry_of(__name__, _nrt=False)
_NONE = np.zeros((0, 0), np.float32)
_NO_MOTION = np.zeros((0, 0, 2), np.float32)
_MANY_PX = 50_000
_ROWS = 16  # a thread's share of the work at a time
_STEPS = 3
_CLOSE_PX = 0.25
_SAME_PX = 1.0
_SAME_SHARE = 0.3
_RATE_PX = 1.0


@dataclass(frozen=True, eq=False)
class TimedImage:
    """One image.

    Attributes
    ----------
    t_ns : stream time.
    light : (height, width) float32.
    motion : (height, width, 2) float32, px/s, of `front_motion`; None where it is not known.
    depth : (height, width) float32, m; None where it is not known.
    rate : (height, width) float32, 1/s; None where it is not known.
    """

    t_ns: int
    light: Float32s
    motion: Float32s | None = None
    depth: Float32s | None = None
    rate: Float32s | None = None


Pair = tuple[TimedImage, TimedImage]
"""The images around a time; the same one twice where light stands still."""


def front_motion(motion: Float32s, depth: Float32s | None) -> Float32s:
    """Return, for each pixel, the velocity of the nearest point among 3 x 3 pixels; without depth, the greatest."""
    out = np.empty_like(motion)
    _write_front(motion, _NONE if depth is None else depth, out)
    return out


@_entry
def _write_front(motion: Float32s, depth: Float32s, out: Float32s) -> None:
    rows, columns = motion.shape[0], motion.shape[1]
    for row in range(rows):
        for column in range(columns):
            best, at_row, at_column = -math.inf, row, column
            for y in range(max(row - 1, 0), min(row + 2, rows)):
                for x in range(max(column - 1, 0), min(column + 2, columns)):
                    merit = -depth[y, x] if depth.size else motion[y, x, 0] ** 2 + motion[y, x, 1] ** 2
                    if merit > best:
                        best, at_row, at_column = merit, y, x
            out[row, column, 0] = motion[at_row, at_column, 0]
            out[row, column, 1] = motion[at_row, at_column, 1]


class Joined:
    """Writer of the light between two images of `size` = (width, height) px.

    `white` is the factor of the light, `threads` the number of threads that draw, 0: by the machine and the size.
    """

    def __init__(self, size: tuple[int, int], white: float = 1.0, threads: int = 0) -> None:
        self._rows, self._white = size[1], white
        self._pool = ThreadPool(threads or (available_threads() if size[0] * size[1] > _MANY_PX else 1))

    def write(self, pair: Pair, t_ns: int, light: Light, rate: Light | None = None) -> None:
        """Write the light at `t_ns`, and its derivative, (height, width) each; outside the images, the nearest one."""
        planes = _planes(pair)
        # Seconds from the first image to `t_ns`, and to the second one, both 0 at a standstill; and white.
        apart_ns = max(pair[1].t_ns - pair[0].t_ns, 0)
        terms = min(max(t_ns - pair[0].t_ns, 0), apart_ns) * 1e-9, apart_ns * 1e-9, self._white
        # Without the motion of both images its plane is empty.
        rates, write = _NONE if rate is None else rate, _write_moved if planes[2].size else _write_standing

        def share(k: int, _: int) -> None:
            write(planes, terms, (k * _ROWS, min((k + 1) * _ROWS, self._rows)), light, rates)

        self._pool.each(share, -(-self._rows // _ROWS))

    def close(self) -> None:
        """End the threads; a second call does nothing."""
        self._pool.close()


def _planes(pair: Pair) -> tuple[Float32s, ...]:
    """Return light, motion, depth and rate of both images, empty where they are not known."""
    before, after = pair
    depths, rates = _both(before.depth, after.depth), _both(before.rate, after.rate)
    return (before.light, after.light, *_both(before.motion, after.motion, _NO_MOTION), *depths, *rates)


def _both(before: Float32s | None, after: Float32s | None, none: Float32s = _NONE) -> tuple[Float32s, Float32s]:
    return (none, none) if before is None or after is None else (before, after)


_DARK_SHARE = 0.1
_PLATEAU = 1.5
_LEAST_SLANT = 1e-4


@kernel
def bounded(value: float, last: int) -> int:
    """Return the index below `value`, 0 to `last`; 0 for a NaN."""
    return int(min(max(value, 0.0), last)) if value == value else 0


@kernel
def _taps(f: float) -> tuple[float, float, float, float]:
    return (
        ((-0.5 * f + 1.0) * f - 0.5) * f, (1.5 * f - 2.5) * f * f + 1.0,
        ((-1.5 * f + 2.0) * f + 0.5) * f, (0.5 * f - 0.5) * f * f,
    )  # fmt: skip


@kernel
def _slopes(f: float) -> tuple[float, float, float, float]:
    return (-1.5 * f + 2.0) * f - 0.5, (4.5 * f - 5.0) * f, (-4.5 * f + 4.0) * f + 0.5, (1.5 * f - 1.0) * f


@kernel
def sampled(image: Float32s, y: float, x: float) -> tuple[float, float, float]:
    """Return the value at a point, and its derivatives along rows and columns; at (r, c) the value of that pixel."""
    last_row, last_column = image.shape[0] - 1, image.shape[1] - 1
    row, column = bounded(y, last_row), bounded(x, last_column)
    fy, fx = min(max(y - row, 0.0), 1.0), min(max(x - column, 0.0), 1.0)
    ty, dy = _taps(fy), _slopes(fy)
    tx, dx = _taps(fx), _slopes(fx)
    value = down = across = 0.0
    low, high = math.inf, -math.inf
    dark, bright = math.inf, -math.inf
    for j in range(4):
        r = min(max(row + j - 1, 0), last_row)
        line = slope = 0.0
        for i in range(4):
            c = min(max(column + i - 1, 0), last_column)
            sample = image[r, c]
            line += tx[i] * sample
            slope += dx[i] * sample
            dark, bright = min(dark, sample), max(bright, sample)
            if 1 <= i <= 2 and 1 <= j <= 2:
                low, high = min(low, sample), max(high, sample)
        value += ty[j] * line
        down += dy[j] * line
        across += ty[j] * slope
    held = min(max(value, low), high)
    if dark > _DARK_SHARE * bright or bright <= 0.0:
        return held, down, across
    if held != value:
        down = across = 0.0
    return _with_edges(image, (row, column), (fy, fx), (held, down, across))


@kernel
def _with_edges(image: Float32s, at: Any, f: Any, cubic: Any) -> tuple[float, float, float]:
    """Return value and derivatives at the shares `f` behind the pixel `at`, with its straight edges."""
    share = share_down = share_across = 0.0
    value = down = across = 0.0
    for j in range(2):
        tall, to_down = (f[0], 1.0) if j else (1.0 - f[0], -1.0)
        for i in range(2):
            wide, to_right = (f[1], 1.0) if i else (1.0 - f[1], -1.0)
            edge = _edge(image, at[0] + j, at[1] + i)
            if edge[0]:
                share += tall * wide
                share_down += to_down * wide
                share_across += to_right * tall
            mean, line_y, line_x = _parts(edge, (0.0 if j else f[0], 0.0 if i else f[1]), (tall, wide), f)
            value += mean
            down += to_down * line_y
            across += to_right * line_x
    return (
        cubic[0] + share * (value - cubic[0]),
        cubic[1] + share * (down - cubic[1]) + share_down * (value - cubic[0]),
        cubic[2] + share * (across - cubic[2]) + share_across * (value - cubic[0]),
    )


@kernel
def _edge(image: Float32s, row: int, column: int) -> Any:
    """Return whether a pixel is in two parts, dark and bright light, and its edge.

    The dark part is ny v + nx u <= d, with v and u from 0 to 1 down and to the right, back where n is negative;
    |ny| + |nx| = 1.
    """
    last_row, last_column = image.shape[0] - 1, image.shape[1] - 1
    row, column = min(row, last_row), min(column, last_column)
    dark, bright = math.inf, -math.inf  # of the pixel and its neighbours
    darkest, brightest = math.inf, -math.inf  # of 5 x 5 pixels
    gy = gx = 0.0
    for j in range(-2, 3):
        r = min(max(row + j, 0), last_row)
        for i in range(-2, 3):
            sample = image[r, min(max(column + i, 0), last_column)]
            darkest, brightest = min(darkest, sample), max(brightest, sample)
            if -1 <= j <= 1 and -1 <= i <= 1:
                dark, bright = min(dark, sample), max(bright, sample)
                gy += j * (2 - i * i) * sample
                gx += i * (2 - j * j) * sample
    level = image[row, column]
    steep = abs(gy) + abs(gx)
    if level <= dark or steep == 0.0:
        return level <= _DARK_SHARE * bright, level, level, 0.5, 0.5, 0.0
    if darkest > _DARK_SHARE * bright or brightest > _PLATEAU * bright:
        return False, level, level, 0.5, 0.5, 0.0
    if dark > _DARK_SHARE * bright:
        return True, level, level, 0.5, 0.5, 0.0
    ny, nx = gy / steep, gx / steep
    return True, dark, bright, ny, nx, _offset((bright - level) / (bright - dark), min(abs(ny), abs(nx)))


@kernel
def _offset(area: float, least: float) -> float:
    """Return d of the half plane that holds `area` of a pixel; `least` is the smaller component of its normal."""
    m = max(least, _LEAST_SLANT)
    corner = 0.5 * m / (1.0 - m)
    if area <= corner:
        return math.sqrt(2.0 * area * m * (1.0 - m))
    if area >= 1.0 - corner:
        return 1.0 - math.sqrt(2.0 * (1.0 - area) * m * (1.0 - m))
    return area * (1.0 - m) + 0.5 * m


@kernel
def _squared(value: float) -> float:
    return value * value if value > 0.0 else 0.0


@kernel
def _parts(edge: Any, low: Any, size: Any, f: Any) -> tuple[float, float, float]:
    """Return light over a rectangle of a pixel, and along its borders at v = f[0] and u = f[1].

    The rectangle begins at `low` and has the height and width `size`.
    """
    _, dark, bright, ny, nx, d = edge
    v, u = low
    tall, wide = size
    at_v, at_u = f
    if bright == dark:
        return dark * tall * wide, dark * wide, dark * tall
    if ny < 0.0:
        v, at_v = 1.0 - v - tall, 1.0 - at_v
    if nx < 0.0:
        u, at_u = 1.0 - u - wide, 1.0 - at_u
    ny = min(max(abs(ny), _LEAST_SLANT), 1.0 - _LEAST_SLANT)
    nx = 1.0 - ny
    left = d - ny * v - nx * u
    area = _squared(left) - _squared(left - nx * wide) - _squared(left - ny * tall)
    area = (area + _squared(left - nx * wide - ny * tall)) / (2.0 * nx * ny)
    along_y = min(max((d - ny * at_v - nx * u) / nx, 0.0), wide)
    along_x = min(max((d - nx * at_u - ny * v) / ny, 0.0), tall)
    step = bright - dark
    return bright * tall * wide - step * area, bright * wide - step * along_y, bright * tall - step * along_x


@kernel
def _differ(vx: float, vy: float, wx: float, wy: float, apart_s: float) -> bool:
    """Return whether two velocities are those of different surfaces; one surface turns, or comes nearer."""
    apart = math.hypot(vx - wx, vy - wy)
    return apart * apart_s > _SAME_PX and apart > _SAME_SHARE * (math.hypot(vx, vy) + math.hypot(wx, wy))


@kernel
def _at(front: Float32s, y: float, x: float) -> tuple[float, float]:
    """Return the velocity, along x and y, of the pixel at a point; its index is that of its middle."""
    row, column = bounded(y + 0.5, front.shape[0] - 1), bounded(x + 0.5, front.shape[1] - 1)
    return front[row, column, 0], front[row, column, 1]


@kernel
def _source(motion: Float32s, other: Float32s, y: float, x: float, guess: Any, terms: Any) -> Any:
    """Return the point of one image that is at (y, x) at the time, and its velocity then.

    Also the error of the path in px, and whether the other image shows the point too.

    `terms` are seconds from the image to the time and to the other image, both negative from the later one. The point
    moves at a constant acceleration, from its velocity in one image to that in the other.
    """
    t_s, apart_s = terms
    vx, vy = guess
    wx, wy = vx, vy
    error, in_both = 0.0, True
    for _ in range(_STEPS):
        bend = 0.5 * t_s / apart_s
        at_x, at_y = x - t_s * (vx + (wx - vx) * bend), y - t_s * (vy + (wy - vy) * bend)
        new_x, new_y = _at(motion, at_y, at_x)
        wx, wy = _at(other, at_y + 0.5 * apart_s * (new_y + wy), at_x + 0.5 * apart_s * (new_x + wx))
        in_both = not _differ(new_x, new_y, wx, wy, abs(apart_s))
        if not in_both:  # the other image shows another surface there
            wx, wy = new_x, new_y
        error = (abs(new_x - vx) + abs(new_y - vy)) * abs(t_s)
        vx, vy = new_x, new_y
    bend = t_s / apart_s
    at_x, at_y = x - t_s * (vx + 0.5 * (wx - vx) * bend), y - t_s * (vy + 0.5 * (wy - vy) * bend)
    return at_y, at_x, vy + (wy - vy) * bend, vx + (wx - vx) * bend, error, in_both


@kernel
def _found(motion: Float32s, other: Float32s, depth: Float32s, at: Any, guesses: Any, terms: Any) -> Any:
    """Return point, velocity, distance and rank of the surface of an image that is at the pixel at the time.

    Ranks: 0 there is none, 1 the other image does not show it, 2 it does.
    """
    best = (at[0], at[1], 0.0, 0.0, math.inf, 0)
    for guess in guesses:
        y, x, vy, vx, error, in_both = _source(motion, other, at[0], at[1], guess, terms)
        if not error <= _CLOSE_PX:
            continue
        distance, rank = -math.hypot(vx, vy), 2 if in_both else 1
        if depth.size:
            distance = depth[bounded(y + 0.5, depth.shape[0] - 1), bounded(x + 0.5, depth.shape[1] - 1)]
        if rank > best[5] or (rank == best[5] and distance < best[4]):
            best = (y, x, vy, vx, distance, rank)
    return best


@kernel
def _joined(a: float, b: float, slope_a: float, slope_b: float, terms: Any) -> tuple[float, float]:
    """Return value and derivative of the cubic through two values with slopes, a line where these are not known."""
    t_s, apart_s, _ = terms
    s, line = t_s / apart_s, (b - a) / apart_s
    if slope_a != slope_a or slope_b != slope_b:
        return a + (b - a) * s, line
    bend_a, bend_b = slope_a - line, slope_b - line
    # the line, and a cubic that is 0 at both ends with the slopes that are left
    value = a + (b - a) * s + apart_s * s * (1 - s) * (bend_a * (1 - s) - bend_b * s)
    return value, line + bend_a * (1 - s) * (1 - 3 * s) + bend_b * s * (3 * s - 2)


@kernel
def _standing(planes: Any, terms: Any, row: int, column: int) -> tuple[float, float]:
    """Return light and derivative of a pixel in place."""
    first, last, _, _, _, _, rate0, rate1 = planes
    if terms[1] == 0.0:
        return first[row, column], 0.0
    slopes = (rate0[row, column], rate1[row, column]) if rate0.size else (math.nan, math.nan)
    value, slope = _joined(first[row, column], last[row, column], slopes[0], slopes[1], terms)
    return (value, slope) if value >= 0.0 else (0.0, 0.0)


@kernel
def _moved(planes: Any, terms: Any, row: int, column: int) -> tuple[float, float]:
    """Return light and derivative of a pixel by the motion of the points that it shows."""
    first, last, front0, front1, depth0, depth1, rate, _ = planes
    t_s, apart_s, _ = terms
    v0, v1 = (front0[row, column, 0], front0[row, column, 1]), (front1[row, column, 0], front1[row, column, 1])
    moved_px = apart_s * max(math.hypot(v0[0], v0[1]), math.hypot(v1[0], v1[1]))
    if moved_px == 0.0 or (rate.size and moved_px <= _RATE_PX):
        return _standing(planes, terms, row, column)
    at, guesses = (row, column), (v0, v1)
    y0, x0, vy0, vx0, far0, rank0 = _found(front0, front1, depth0, at, guesses, (t_s, apart_s))
    y1, x1, vy1, vx1, far1, rank1 = _found(front1, front0, depth1, at, guesses, (t_s - apart_s, -apart_s))
    share = t_s / apart_s
    if rank0 and rank1 and _differ(vx0, vy0, vx1, vy1, apart_s):
        if rank0 != rank1:
            share = 0.0 if rank0 > rank1 else 1.0
        elif rank0 == 2:
            share = 0.0 if far0 <= far1 else 1.0
    elif rank0 != rank1 and not (rank0 and rank1):
        share = 0.0 if rank0 else 1.0
    value0, down0, across0 = sampled(first, y0, x0)
    value1, down1, across1 = sampled(last, y1, x1)
    slope = -(1 - share) * (down0 * vy0 + across0 * vx0) - share * (down1 * vy1 + across1 * vx1)
    if 0.0 < share < 1.0:
        slope += (value1 - value0) / apart_s
    return (1 - share) * value0 + share * value1, slope


@_entry
def _write_moved(planes: Any, terms: Any, rows: tuple[int, int], light: Light, rate: Light) -> None:
    for row in range(rows[0], rows[1]):
        for column in range(light.shape[1]):
            value, slope = _moved(planes, terms, row, column)
            light[row, column] = value * terms[2]
            if rate.size:
                rate[row, column] = slope * terms[2]


@_entry
def _write_standing(planes: Any, terms: Any, rows: tuple[int, int], light: Light, rate: Light) -> None:
    for row in range(rows[0], rows[1]):  # in one loop with a choice between both this takes four times as long
        for column in range(light.shape[1]):
            value, slope = _standing(planes, terms, row, column)
            light[row, column] = value * terms[2]
            if rate.size:
                rate[row, column] = slope * terms[2]


def compile_kernels() -> None:
    """Compile all kernels, or read them from disk, before a run needs them."""
    still = np.zeros((1, 1), np.float32)
    joined = Joined((1, 1), threads=1)
    for motion in (None, front_motion(np.zeros((1, 1, 2), np.float32), None)):
        image = TimedImage(0, still, motion)
        joined.write((image, image), 0, still.copy(), still.copy())
