"""Heightmaps from files: `.npy`, and GeoTIFF as far as a map of a planet needs it.

Of a GeoTIFF these tags are read (OGC 19-008r4; GDAL for the last one), beside the heights of its first band:

    33550   ModelPixelScale    distance of posts east and north, in the unit of the projection, metres
    33922   ModelTiepoint      column, row, 0 -> x, y, z in the plane of the projection
    42113   GDAL_NODATA        a number as text: the value of posts without a measurement

Pillow reads GeoTIFF, in a child process (see `guarded_reader`). It supports the common compressions, also LZW, for
which tifffile would need the large package imagecodecs.

The plane of a polar stereographic projection is stretched: at a distance rho from the pole by 1 + (rho / 2 R)^2, which
is 0.12 % at 86 degrees. If the map's middle is given, the distance of posts is reduced by this factor.
"""

from __future__ import annotations

import math
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from emulator.light import SceneError
from emulator.scene.files import read_array, read_in_child, reader_errors
from emulator.scene.terrain.ground import Ground, nested
from emulator.scene.terrain.table import Heightmap
from firmware_protocol.events import Floats

_STEEPEST_DEG = 75.0
_FARTHEST = 100.0  # tangent of half the angle from the projection's pole: 1 is the equator
_HIGHEST = 1e12
_LEAST_POSTS, _MOST_POSTS = 3, 1 << 14
_AROUND = [[1, 1, 1], [1, 0, 1], [1, 1, 1]]  # the eight neighbours of a post


def load_heightmap(p: Heightmap, body_radius_m: float) -> Ground:
    """Read a map; raises SceneError where it cannot be read, has too many holes, or its units make no ground.

    Raises MachineLacks where pillow is missing.
    """
    read = _read(Path(p.path))
    try:
        heights, post_m, centre_m = _map(read)
        post_m, centre_m = p.post_m or post_m, p.centre_m or centre_m
        if not post_m:
            raise SceneError("has no distance of posts: give post_m")
        notes: list[str] = []
        if centre_m is not None and body_radius_m:
            from_pole_m = math.hypot(*centre_m)
            tangent = from_pole_m / (2 * body_radius_m)
            if tangent > _FARTHEST:
                raise SceneError(f"its middle is {from_pole_m:.3g} m from its projection's pole: beyond the body")
            post_m /= 1 + tangent**2
            latitude = 90 - math.degrees(2 * math.atan(tangent))
            notes.append(f"its middle is {latitude:.2f} degrees from the equator")
        rows, columns = heights.shape
        if min(rows, columns) < _LEAST_POSTS or max(rows, columns) > _MOST_POSTS:
            raise SceneError(f"has {rows} x {columns} posts: {_LEAST_POSTS} to {_MOST_POSTS} a side are drawn")
        heights, holes = filled(heights * p.units_m, p.fill_share)
        if holes:
            notes.append(f"{holes} of {heights.size} posts are holes, filled from their neighbours")
        rise = float(np.sqrt((np.diff(heights, axis=1) ** 2).mean()))
        if (slope_deg := math.degrees(math.atan(rise / post_m))) > _STEEPEST_DEG:
            raise SceneError(
                f"its slopes are {slope_deg:.0f} degrees, root mean square: look at units_m and post_m ({post_m:g} m)"
            )
    except SceneError as error:
        raise type(error)(f"{p.path}: {error}") from error
    return nested(post_m, [heights[::-1]], tuple(notes))


def filled(heights: Floats, most_share: float) -> tuple[Floats, int]:
    """Return heights with each hole (not finite) given the mean of its neighbours, from its edge inwards, and how many.

    Raises SceneError when more than `most_share` of the posts are holes.
    """
    from scipy import ndimage  # loaded where it is used

    holes = ~np.isfinite(heights)
    count = int(holes.sum())
    if count > most_share * heights.size:
        raise SceneError(
            f"{count} of {heights.size} posts ({100 * count / heights.size:.1f} %) are holes, more than fill_share = "
            f"{most_share:g} allows: fill them with care, or raise fill_share"
        )
    out = np.where(holes, 0.0, heights)
    while holes.any():
        around = ndimage.correlate((~holes).astype(np.float64), _AROUND, mode="constant")
        total = ndimage.correlate(np.where(holes, 0.0, out), _AROUND, mode="constant")
        ready = holes & (around > 0)
        out[ready] = total[ready] / around[ready]
        holes = holes & ~ready
    return out, count


def _read(path: Path) -> dict[str, npt.NDArray[Any]]:
    """Return `heights`, and of a GeoTIFF `scale`, `tie` and `nodata`."""
    match path.suffix.lower():
        case ".npy":
            return {"heights": read_array(path)}
        case ".tif" | ".tiff":
            return read_in_child("emulator.scene.terrain.heightmap:read_geotiff", path)
    raise SceneError(f"{path}: unknown format: name the file .npy or .tif")


def _map(arrays: dict[str, npt.NDArray[Any]]) -> tuple[Floats, float, tuple[float, float] | None]:
    """Return heights with NaN for holes, the distance of posts, 0 if not known, and the middle on the projection."""
    array = arrays["heights"]
    if array.ndim != 2 or array.dtype.kind not in "fiu":
        raise SceneError(f"holds {array.dtype} of shape {array.shape}: heights are numbers in rows and columns")
    with np.errstate(invalid="ignore"):  # signalling NaN become holes like the others
        heights = np.asarray(array, np.float64)
    if "nodata" in arrays:
        text = str(arrays["nodata"])
        try:
            nothing = float(text.strip("\0 \n") or "nan")
        except ValueError as error:
            raise SceneError(f"its GDAL_NODATA tag is {text!r}, which is no number") from error
        heights[np.isclose(heights, nothing, rtol=1e-6)] = np.nan
    highest = float(np.abs(heights[np.isfinite(heights)]).max(initial=0.0))
    if highest > _HIGHEST:
        raise SceneError(
            f"has heights of up to {highest:g}: the value for no data must be NaN, or be named by GDAL_NODATA"
        )
    scale = arrays.get("scale", np.zeros(0))
    if not scale.size:
        return heights, 0.0, None
    if len(scale) < 2 or not math.isclose(scale[0], scale[1], rel_tol=1e-6):
        raise SceneError(f"its posts are {scale[0]:g} by {scale[-1]:g} apart: square ones are needed")
    post_m = float(scale[0])
    if not 1e-6 <= post_m <= 1e9:
        raise SceneError(f"its posts are {post_m:g} apart: 1e-6 to 1e9 are drawn")
    tie = arrays["tie"]
    if len(tie) < 6 or not np.isfinite(tie[:5]).all():
        return heights, post_m, None
    column, row, _, x, y = (float(v) for v in tie[:5])  # a pixel, and its place in the projection
    return heights, post_m, (x + (array.shape[1] / 2 - column) * post_m, y - (array.shape[0] / 2 - row) * post_m)


_NUMBER_TAGS = {"scale": 33550, "tie": 33922}
_NODATA = 42113


def read_geotiff(path: Path) -> dict[str, npt.NDArray[Any]]:
    """Return `heights`, `scale` and `tie` (empty where the file has none), and `nodata`, a text."""
    from PIL import Image, UnidentifiedImageError

    with reader_errors("is damaged, or too large"), warnings.catch_warnings(action="error"):
        try:
            image = Image.open(path)
        except UnidentifiedImageError as error:
            raise SceneError("is not a TIFF that pillow reads") from error
        with image:
            tags = dict(getattr(image, "tag_v2", {}))
            values = {name: tags.get(tag) for name, tag in _NUMBER_TAGS.items()}
            numbers = {name: np.array(v if isinstance(v, tuple) else (), np.float64) for name, v in values.items()}
            return numbers | {"heights": np.array(image), "nodata": np.array(str(tags.get(_NODATA, ""))[:100])}
