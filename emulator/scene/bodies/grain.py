"""Grain of ground: craters, boulders or noise at all scales, at the vertices of facets and, below them, in each pixel.

A sum of octaves. All are the same random function of the place in space, a tile, each at half the wavelength of the one
before and shifted by its own way:

    height = sum of height_k h(q / wave_k + shift_k)        slope: its gradient, along the surface

Vertices carry the octaves that are long enough for their facets. The rest of each octave is added to the drawn light of
the pixels whose middle shows a facet, so that a surface is the same however fine its facets are. There light is
multiplied by the law of reflection with the normal of the place, turned by the slopes, over the law with that normal.
The mean of a wave over a pixel is a share of that in its middle; what a pixel cannot resolve fades out. Where some of a
pixel turns away from the Sun, the range of its facet's cosine of incidence shows how much.

The rate of light at a fixed pixel is that of the place q below it in the body's frame. With the facet's plane A P = 1,
a ray P = s d, and the body's velocity v = M P + c there (see `raster.surfaces`),

    dq/dt = R^T (d ds/dt - v)        ds/dt = s A v

Left out: shadows of the grain, light from slope to slope, grain beyond the facets' terminator; ambient light is taken
for sunlight; GL draws only what facets carry.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.geometry.camera import Pinhole
from emulator.light import Light, Region
from emulator.photometry.reflection_kernels import Law, reflect
from emulator.raster.layout import Data, Owners, W
from emulator.raster.renderer import Renderer
from emulator.scene.bodies.compiled import ZERO, Numbers, Point, dot, entry, minus, plus, row
from emulator.sensor.numerics.compiled import Real, lane
from emulator.threads import ThreadPool
from firmware_protocol.events import Float32s, Floats

Tile = Float32s

_SIDE = 32  # texels of the tile along each axis: with 64 it does not fit a cache, and takes 1.5 times as long
_LAST = _SIDE - 1
TEXELS = 8.0  # a wavelength
RIM = 0.25  # of a crater's depth, its height over the ground around
CRATER_REACH = 1.7  # radii
_CRATERED = 0.3  # of an octave's ground, if craters did not overlap
_NOISE = 0.6  # rms, of that of craters
_SHARPEST = 2.0  # waves in a wavelength of the octave: finer ones would be lost between texels
_FADED_IN = 0.05  # octaves: fainter ones are left out
_FADED = 1.0, 2.0  # pixels a wave: fading begins and ends
_WIDTH2 = (
    1.2  # a pixel's mean of a wave is 1 - 1.2 (longer side / wave)^2 of it; sinc has 1.6 by the mean square of both
)
_LEAST_COSINE = 0.01  # of emission
_FAINT, _DARK = 3e-4, 1e-9  # reflected, 1/sr: below it light grows no more; least divisor
_MOST_SLANT = 0.05  # least cosine of emission for the width of a pixel on the ground
_BETWEEN_S = 1e-6  # of rates
_ROWS = 16  # a thread takes at a time


@cache
def noise_tile() -> Tile:
    """Return slope, (3,), for a wavelength of 1, and height, rms 1, of an octave of noise that repeats, (32^3, 4)."""
    noise = np.fft.rfftn(np.random.default_rng(11).standard_normal(3 * (_SIDE,)))
    waves = np.linalg.norm(_waves(), axis=0)
    noise[(waves <= math.sqrt(0.5)) | (waves >= math.sqrt(2))] = 0
    return _with_slopes(noise)


@cache
def crater_tile() -> Tile:
    """Return such a tile of craters of all ages on noise. In space they are balls, which the ground cuts anywhere."""
    rng, extent = np.random.default_rng(12), _SIDE / TEXELS
    along, bowls = np.arange(_SIDE) / TEXELS, np.zeros(3 * (_SIDE,))
    filled = 0.0
    while filled < _CRATERED:
        radius, age = 0.35 * 2 ** rng.random(), crater_age(rng.random())
        x, y, z = ((along - middle + extent / 2) % extent - extent / 2 for middle in extent * rng.random(3))
        r = np.sqrt(x[:, None, None] ** 2 + y[:, None] ** 2 + z**2) / radius
        bowls += radius * crater_height(r, age, RIM * age)
        filled += 4 / 3 * math.pi * (radius / extent) ** 3
    waves = np.linalg.norm(_waves(), axis=0)
    bowls = np.fft.irfftn(np.fft.rfftn(bowls) * np.exp(-((waves / _SHARPEST) ** 4)) * (waves > 0))
    return _with_slopes(np.fft.rfftn(bowls / bowls.std() + _NOISE * noise_tile()[:, 3].reshape(bowls.shape)))


def crater_age(lot: npt.ArrayLike) -> Floats:
    """Return the share of the depth of fresh craters that is left, of random numbers from 0 to 1: most are old."""
    return np.asarray(0.25 + 0.75 * np.square(lot))


def crater_height(r: Floats, depth: Floats, rim: Floats) -> Floats:
    """Return the height in radii of a crater's floor and rim over the ground around, at `r` radii from its middle."""
    apron = np.clip((CRATER_REACH - r) / (CRATER_REACH - 1), 0, 1)
    return np.where(r < 1, depth * (r * r - 1 + rim * np.minimum(r, 1) ** 2), depth * rim * apron**2)


def _waves() -> Floats:
    """Return the waves of a tile's spectrum along each axis, in a wavelength of the octave, (3, 32, 32, 17)."""
    counts = np.fft.fftfreq(_SIDE, 1 / TEXELS)
    return np.stack(np.meshgrid(counts, counts, np.fft.rfftfreq(_SIDE, 1 / TEXELS), indexing="ij"))


def _with_slopes(heights: npt.NDArray[np.complex128]) -> Tile:
    spectra = [*(2j * math.pi * wave * heights for wave in _waves()), heights]
    fields = np.stack([np.fft.irfftn(spectrum).ravel() for spectrum in spectra], axis=1)
    return np.ascontiguousarray(fields / fields[:, 3].std(), np.float32)


@lane
def _texel(place: float) -> tuple[int, Real]:
    """Return the texel before a place, in wavelengths, along an axis, and the share of the way to the next."""
    texels = place * TEXELS
    before = math.floor(texels)
    return int(before) & _LAST, np.float32(texels - before)


@lane
def look_up(fields: Tile, place: Point, drift: Point) -> tuple[Real, ...]:
    """Return slope and height of a tile at a place, in wavelengths, then their rates; `drift` is the rate of the place.

    They are linear between texels along each axis. All is in float32 and without a loop over the four values of a
    texel, so that these become one vector: 25 in place of 63 ns.
    """
    i, u = _texel(place[0])
    j, v = _texel(place[1])
    k, w = _texel(place[2])
    du, dv = np.float32(TEXELS * drift[0]), np.float32(TEXELS * drift[1])
    dw = np.float32(TEXELS * drift[2])
    east = north = up = height = east_rate = north_rate = up_rate = height_rate = np.float32(0.0)
    # Four pairs of texels along z: the share of each, the share's rate, and the pair's mean and difference.
    for pair in range(4):
        of_x, of_x_rate = (u, du) if pair & 1 else (np.float32(1.0) - u, -du)
        of_y, of_y_rate = (v, dv) if pair & 2 else (np.float32(1.0) - v, -dv)
        share, growth = of_x * of_y, of_x_rate * of_y + of_x * of_y_rate
        along = share * dw
        first = (((i + (pair & 1)) & _LAST) * _SIDE + ((j + (pair >> 1)) & _LAST)) * _SIDE
        a, b = first + k, first + ((k + 1) & _LAST)
        east_step = fields[b, 0] - fields[a, 0]
        north_step = fields[b, 1] - fields[a, 1]
        up_step = fields[b, 2] - fields[a, 2]
        height_step = fields[b, 3] - fields[a, 3]
        east_here = fields[a, 0] + w * east_step
        north_here = fields[a, 1] + w * north_step
        up_here = fields[a, 2] + w * up_step
        height_here = fields[a, 3] + w * height_step
        east += share * east_here
        north += share * north_here
        up += share * up_here
        height += share * height_here
        east_rate += growth * east_here + along * east_step
        north_rate += growth * north_here + along * north_step
        up_rate += growth * up_here + along * up_step
        height_rate += growth * height_here + along * height_step
    return east, north, up, height, east_rate, north_rate, up_rate, height_rate


class Octaves(NamedTuple):
    """Octaves of a grain, the longest first.

    Attributes
    ----------
    waves_m, heights_m : (n,) wavelengths, and rms heights.
    on_facets : (n,), share of each that vertices carry.
    tints : (n,), rms relative albedo below facets.
    shifts : (n, 3) wavelengths.
    fields : the tile.
    """

    waves_m: Floats
    heights_m: Floats
    on_facets: Floats
    tints: Floats
    shifts: Floats
    fields: Tile


def octaves(longest_m: float, shortest_m: float, gain: float, seed: int, fields: Tile) -> Octaves:
    """Return octaves of a total rms height of 1 m, all at vertices; the last ones fade in as `shortest_m` shrinks.

    `gain` is the height of an octave over that of the one before.
    """
    count = min(max(math.ceil(math.log2(longest_m / shortest_m) - _FADED_IN), 0), 24)
    waves_m = longest_m * np.exp2(-np.arange(count, dtype=np.float64))
    heights = np.float_power(gain, np.arange(count, dtype=np.float64))
    heights *= np.clip(waves_m / shortest_m - 1, 0, 1) / math.sqrt(float((heights**2).sum())) if count else 1.0
    shifts = _SIDE / TEXELS * np.random.default_rng([seed, 17]).random((count, 3))
    return Octaves(waves_m, heights, np.ones(count), np.zeros(count), shifts, fields)


def on_facets(o: Octaves, slope: float, tint: float, model_m: float, facet_m: float) -> Octaves:
    """Return octaves for a surface of facets of `facet_m`, the side of a square as large.

    Parameters
    ----------
    slope : rms, of the facets of the shape model, of `model_m`, by the first two octaves.
    tint : rms relative albedo of each octave below facets.
    """
    # Slope for a wavelength of 1, between texels; a triangle shows the mean slope over its sides.
    steep = TEXELS * math.sqrt(2.0) * float(np.diff(o.fields[:, 3].reshape(-1, _SIDE).astype(float), axis=1).std())
    seen = o.heights_m / o.waves_m * np.sinc(math.sqrt(4 / math.sqrt(3)) * model_m / o.waves_m)
    heights_m = o.heights_m * slope / (steep * max(float(np.linalg.norm(seen[:2])), 1e-12))
    carried = np.clip(o.waves_m / (2 * facet_m) - 1, 0, 1)
    return o._replace(heights_m=heights_m, on_facets=carried, tints=tint * (1 - carried))


@entry
def write_heights(points: Floats, o: Octaves, out: Floats) -> None:
    """Write the heights, m, of what vertices carry at points, (n, 3) m."""
    for k in range(len(points)):
        out[k] = 0.0
        for n in range(len(o.waves_m)):
            height_m = o.on_facets[n] * o.heights_m[n]
            if height_m != 0.0:
                place = plus(row(o.shifts, n), 1.0 / o.waves_m[n], row(points, k))
                out[k] += height_m * look_up(o.fields, place, ZERO)[3]


def fractal_noise(points: Floats, longest: float, shortest: float, gain: float, seed: int) -> Floats:
    """Return noise at places, (n,), its root mean square about 1 where all octaves are there; see `octaves`."""
    out = np.empty(len(points))
    write_heights(points, octaves(longest, shortest, gain, seed, noise_tile()), out)
    return out


class Ground(NamedTuple):
    """A body with grain.

    Attributes
    ----------
    first : number of its first point among those of all bodies.
    normals, rough : (n, 3) and (n,) of its points, as in `Surface`.
    octaves : the grain.
    law : of its reflection.
    brightest : W m-2, no less than the most light of the Sun that it gets, times its relative albedo.
    """

    first: int
    normals: Floats
    rough: Floats
    octaves: Octaves
    law: Law
    brightest: float


class Placed(NamedTuple):
    """A body before the camera, m and s; a pixel's place is (x, y, 1).

    Attributes
    ----------
    rays : (3, 3), ray of depth 1, in the body's frame, of a pixel's place.
    motion : (3, 4), M and c of `surfaces.motion_of` for places times depth.
    eye : (3,), the camera's place in the body's frame.
    sun : (3,), direction of the Sun there.
    focal_px : of the camera.
    """

    rays: Floats
    motion: Floats
    eye: Floats
    sun: Floats
    focal_px: float


def placed(turn: Floats, shift: Floats, motion: Floats, sun: Floats, pinhole: Pinhole) -> Placed:
    """Return where a body is.

    Parameters
    ----------
    turn, shift : camera_from_body, (3, 3), and its place in the camera's axes, (3,).
    motion : (3, 4), of `surfaces.motion_of`.
    """
    x, y, focal_px = pinhole.width / 2, pinhole.height / 2, pinhole.focal_px
    to_pixels = np.array([[focal_px, 0, x], [0, focal_px, y], [0, 0, 1.0]])
    from_pixels = np.linalg.inv(to_pixels)
    moved = to_pixels @ motion
    moved[:, :3] = moved[:, :3] @ from_pixels
    return Placed(np.ascontiguousarray(turn.T @ from_pixels), moved, -shift @ turn, sun, focal_px)


class Row(NamedTuple):
    """The pixels of a row that show the body; memory of a thread.

    Attributes
    ----------
    columns : (width,).
    fields : (8, width), slope and brightness, and their rates.
    normals, eyes : (3, width) in the body's frame, of the facet, and towards the camera.
    places, drifts : (3, width) in the body's frame, m, and their rates at the fixed pixel, a second.
    incidence, emission, reflected : (3, width), cosines and law without slopes, with them, and an instant later.
    widths_m : (width,), the longer side of a pixel on the ground.
    rough : (width,).
    ranges : (width,), by how much cosines of incidence differ within the pixel from that in its middle.
    chords : (width,), squared, between the Sun and the eye.
    """

    columns: Numbers
    fields: Floats
    normals: Floats
    eyes: Floats
    places: Floats
    drifts: Floats
    incidence: Floats
    emission: Floats
    reflected: Floats
    widths_m: Floats
    rough: Floats
    ranges: Floats
    chords: Floats


def new_row(width: int) -> Row:
    """Return room for a row."""
    vectors, numbers = np.zeros((7, 3, width)), np.zeros((4, width))
    return Row(np.zeros(width, np.int32), np.zeros((8, width)), *vectors, *numbers)


@entry
def add_grain(  # noqa: PLR0913, PLR0917
    first: int, last: int, owners: Numbers, data: Data, shades: Numbers, ground: Ground, placed: Placed, room: Row,
    light: Tile, rate: Tile,
) -> None:  # fmt: skip
    """Multiply the light of rows of a light frame, (height, width), by that of a body's grain, and renew its rate.

    Parameters
    ----------
    owners : (height, width), of `raster.Owners`.
    data, shades : of `Renderer`.
    """
    for r in range(first, last):
        count = _list_ground(r, light, owners, data, shades, ground, placed, room)
        _sum_octaves(count, ground, room)
        _turn_normals(count, placed, room)
        law = ground.law
        for k in range(3):
            reflect(
                law.kind, law.parameters, room.incidence[k], room.emission[k], room.chords, count, room.reflected[k]
            )
        for i in range(count):
            even, now, later, c = room.reflected[0, i], room.reflected[1, i], room.reflected[2, i], room.columns[i]
            # Near the terminator light may be that of brighter facets in the pixel, which must not grow much.
            per_even = 1.0 / max(even, min(now, _FAINT), _DARK)
            if light[r, c] * per_even > ground.brightest:
                continue
            value = light[r, c] * now * per_even
            changing = (rate[r, c] * now + light[r, c] * (later - now) / _BETWEEN_S) * per_even
            bright = 1.0 + room.rough[i] * room.fields[3, i]
            light[r, c] = max(value * bright, 0.0)
            rate[r, c] = changing * bright + value * room.rough[i] * room.fields[7, i]


@lane
def _list_ground(  # noqa: PLR0913, PLR0917
    r: int, light: Tile, owners: Numbers, data: Data, shades: Numbers, ground: Ground, placed: Placed, out: Row
) -> int:
    """Write the lit pixels of a row that show the body, and the ground there; return their number."""
    count = last = 0
    while last < light.shape[1]:
        first, f = last, owners[r, last]
        while last < light.shape[1] and owners[r, last] == f:
            last += 1
        if f >= 0:
            f = data.over[f] if data.over[f] >= 0 else f
            count = _list_facet(r, first, last, f, count, light, data, shades, ground, placed, out)
    return count


@lane
def _list_facet(  # noqa: PLR0913, PLR0915, PLR0917
    r: int, first: int, last: int, f: int, count: int,
    light: Tile, data: Data, shades: Numbers, ground: Ground, placed: Placed, out: Row,
) -> int:  # fmt: skip
    """Write the ground in the lit ones of the pixels first to last - 1 of a row, which show facet f.

    What is the same for all of them is computed once; a facet has some four pixels of a row.
    """
    points = (shades[f, 0] - ground.first, shades[f, 1] - ground.first, shades[f, 2] - ground.first)
    if min(points[0], points[1], points[2]) < 0 or max(points[0], points[1], points[2]) >= len(ground.rough):
        return count
    # What the second and the third corner add to what is at the first one.
    normal, rough = row(ground.normals, points[0]), ground.rough[points[0]]
    normal1, rough1 = minus(row(ground.normals, points[1]), normal), ground.rough[points[1]] - rough
    normal2, rough2 = minus(row(ground.normals, points[2]), normal), ground.rough[points[2]] - rough
    corners, plane = data.faces[f], data.facets[f]
    y = r + 0.5
    x0, y0 = data.vertices[corners[0], 0], data.vertices[corners[0], 1]
    x1, y1 = data.vertices[corners[1], 0] - x0, data.vertices[corners[1], 1] - y0
    x2, y2 = data.vertices[corners[2], 0] - x0, data.vertices[corners[2], 1] - y0
    area = x1 * y2 - y1 * x2
    if area == 0.0 or rough == rough1 == rough2 == 0.0:  # clear sky
        return count
    per_area = 1.0 / area
    # Somewhat more than half of the change of the cosine of incidence over the pixel: its other facets differ too.
    sun = row(placed.sun.reshape(1, 3), 0)
    of_x = dot(normal1, sun) * y2 - dot(normal2, sun) * y1
    of_y = dot(normal2, sun) * x1 - dot(normal1, sun) * x2
    reach = 0.6 * math.sqrt(of_x * of_x + of_y * of_y) * abs(per_area)
    m, turn = placed.motion, placed.rays
    eye = row(placed.eye.reshape(1, 3), 0)
    for c in range(first, last):
        x = c + 0.5
        w = plane[W] + plane[W + 1] * x + plane[W + 2] * y
        if not (light[r, c] > 0.0 and w > 0.0):
            continue
        second = min(max(((x - x0) * y2 - (y - y0) * x2) * per_area, 0.0), 1.0)
        third = min(max((x1 * (y - y0) - y1 * (x - x0)) * per_area, 0.0), 1.0 - second)
        upright = plus(plus(normal, second, normal1), third, normal2)
        per_upright = 1.0 / math.sqrt(max(dot(upright, upright), 1e-300))
        # Where the ray through the middle of the pixel meets the facet's plane, and how fast the body passes there.
        depth, place = 1.0 / w, (x, y, 1.0)
        moved = (dot(row(m, 0), place), dot(row(m, 1), place), dot(row(m, 2), place))
        speed = plus((m[0, 3], m[1, 3], m[2, 3]), depth, moved)
        nearer = depth * (plane[W + 1] * speed[0] + plane[W + 2] * speed[1] + plane[W] * speed[2])
        drift = plus((nearer * x, nearer * y, nearer), -1.0, speed)
        ray = (dot(row(turn, 0), place), dot(row(turn, 1), place), dot(row(turn, 2), place))
        per_ray = 1.0 / math.sqrt(dot(ray, ray))
        for k in range(3):
            out.places[k, count] = eye[k] + depth * ray[k]
            out.drifts[k, count] = dot(row(turn, k), drift)
            out.eyes[k, count] = -per_ray * ray[k]
            out.normals[k, count] = per_upright * upright[k]
        slant = max(-per_ray * per_upright * dot(upright, ray), _MOST_SLANT)
        out.widths_m[count] = depth / (placed.focal_px * slant)
        out.rough[count] = rough + second * rough1 + third * rough2
        out.ranges[count] = reach
        out.columns[count] = c
        count += 1
    return count


@lane
def _sum_octaves(count: int, ground: Ground, out: Row) -> None:
    """Write slope and brightness of the grain in the pixels of a row, and their rates, one octave after another."""
    o, fields = ground.octaves, out.fields
    fields[:, :count] = 0.0
    for n in range(len(o.waves_m)):
        per_m = 1.0 / o.waves_m[n]
        slope, tint = (1.0 - o.on_facets[n]) * o.heights_m[n] * per_m, o.tints[n]
        if slope == tint == 0.0:
            continue
        for i in range(count):
            wave_px = 1.0 / (out.widths_m[i] * per_m)
            share = min((wave_px - _FADED[0]) / (_FADED[1] - _FADED[0]), 1.0)
            if share <= 0.0:
                continue
            share *= 1.0 - _WIDTH2 / (wave_px * wave_px)
            place = plus(row(o.shifts, n), per_m, (out.places[0, i], out.places[1, i], out.places[2, i]))
            drift = plus(ZERO, per_m, (out.drifts[0, i], out.drifts[1, i], out.drifts[2, i]))
            at = look_up(o.fields, place, drift)
            fields[0, i] += slope * share * at[0]
            fields[1, i] += slope * share * at[1]
            fields[2, i] += slope * share * at[2]
            fields[3, i] += tint * share * at[3]
            fields[4, i] += slope * share * at[4]
            fields[5, i] += slope * share * at[5]
            fields[6, i] += slope * share * at[6]
            fields[7, i] += tint * share * at[7]


@lane
def _turn_normals(count: int, placed: Placed, out: Row) -> None:
    """Write the cosines of incidence and emission without slopes, with those of now, and those of an instant later."""
    sun, fields = row(placed.sun.reshape(1, 3), 0), out.fields
    for i in range(count):
        normal = (out.normals[0, i], out.normals[1, i], out.normals[2, i])
        eye = (out.eyes[0, i], out.eyes[1, i], out.eyes[2, i])
        chord = minus(sun, eye)
        out.chords[i] = min(dot(chord, chord), 4.0)
        # Cosines of incidence are taken as even over the pixel's range around their mean; below 0 there is no light.
        reach = out.ranges[i]
        for k in range(3):
            turned = normal
            if k > 0:
                later_s = _BETWEEN_S * (k - 1)
                slope = plus(
                    (fields[0, i], fields[1, i], fields[2, i]), later_s, (fields[4, i], fields[5, i], fields[6, i])
                )
                turned = plus(plus(normal, -out.rough[i], slope), out.rough[i] * dot(slope, normal), normal)
            length = math.sqrt(dot(turned, turned))
            incidence = dot(turned, sun) / length
            if abs(incidence) < reach:
                incidence = (incidence + reach) ** 2 / (4.0 * reach)
            out.incidence[k, i] = incidence
            out.emission[k, i] = max(dot(turned, eye) / length, _LEAST_COSINE)


class GrainLayer:
    """The grain of bodies over what a renderer draws.

    Attributes
    ----------
    owners : for `Renderer.draw`; empty where no body has grain.
    bodies : numbers of the bodies in whose frames grounds are.

    Parameters
    ----------
    grounds : by the number of the first body of the group in whose frame they are.
    """

    def __init__(self, grounds: Mapping[int, list[Ground]], size: tuple[int, int], threads: int) -> None:
        width, height = size if grounds else (0, 0)
        self.owners = Owners.of(width, height)
        self.bodies = tuple(grounds)
        self._grounds = grounds
        self._rows = [new_row(width) for _ in range(threads)]
        self._pool = ThreadPool(threads)

    def add(self, renderer: Renderer, placed: Mapping[int, Placed], touched: Region, light: Light, rate: Light) -> None:
        """Add the grain to what `renderer` has drawn, with the bodies `placed` by number."""
        data, shades = renderer.data, renderer.shades
        first, last = touched.first_row, touched.last_row
        for body, grounds in self._grounds.items():
            for ground in grounds:

                def work(k: int, thread: int, ground: Ground = ground, at: Placed = placed[body]) -> None:
                    start = first + k * _ROWS
                    end, room = min(start + _ROWS, last), self._rows[thread]
                    add_grain(start, end, self.owners.facets, data, shades, ground, at, room, light, rate)

                self._pool.each(work, -(-(last - first) // _ROWS))

    def close(self) -> None:
        """End the threads; a second call does nothing."""
        self._pool.close()
