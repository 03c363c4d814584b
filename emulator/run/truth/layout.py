"""The layout of a truth file, HDF5, version 1.

    /                   attributes    format "evstim-truth", version, evstim, rig, title, seed, camera, width, height,
                                      unix_us, light_unit, absent, complete, missing_pictures, missing_events
                                      and, where the scene is seen through a lens: focal_px, centre_px,
                                      distortion (k1 k2 p1 p2 k3), radiance_per_light
    /labels/name        (b + 1,) text               name of each label; 0 is "sky"
    /poses/t            (m,) f8, us                 every picture of the run
          /camera_position_m            (m, 3) f8         in the world
          /camera_q_world_from_camera   (m, 4) f8         scalar first; camera axes x right, y down, z out
          /bodies_position_m            (m, b, 3) f8      body k - 1 has label k
          /bodies_q_world_from_body     (m, b, 4) f8
    /pictures/t         (n,) f8, us                 every picture, or every n-th
             /light     (n, height, width) f4       what the sensor gets, linear, 1 at the sensor's reference
             /depth     (n, height, width) f4, m    along the boresight (z); inf: sky
             /flow      (n, height, width, 2) f4    px/s to the right and down, of the point at the pixel's middle
             /labels    (n, height, width) u2       what the pixel's middle shows
    /events/t           (e,) u8, us                 as the sensor reads them out
           /x  /y       (e,) u2                     column, row; (0, 0) is the upper left pixel
           /p           (e,) u1                     1: brighter
           /origin      (e,) u1, an HDF5 enum       what raised it: unknown, signal, leak, noise, background, particle
           /label       (e,) u2                     of its pixel in the nearest of /pictures, before or after it
    /clean_events/t  /x  /y  /p  /label             of an ideal sensor of the same thresholds on the same light

All times are microseconds of stream time: the camera's own time where its clock has no error and nobody resets it.
The world is right-handed, in metres; q_world_from_x turns coordinates along the axes of x into those along the world's.
What a scene does not know has no data set, and `absent` tells why. While it is written, and after its writer was
killed, the file opens as h5py.File(path, swmr=True).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from emulator.geometry.seen import Given
from emulator.sensor.origin_codes import Origin

__all__ = ["FORMAT", "VERSION", "About", "create"]

FORMAT, VERSION = "evstim-truth", 1

_CHUNK_BYTES = 1 << 15
_PACKED = {"compression": "gzip", "compression_opts": 1, "shuffle": True}
_EVENTS = {"t": "<u8", "x": "<u2", "y": "<u2", "p": "u1"}


@dataclass(frozen=True)
class About:
    """What a truth file says of its run.

    Attributes
    ----------
    size : (width, height).
    names : of the labels from 1 on.
    gives : which of "poses", "depth", "flow", "labels" the scene knows.
    facts : attributes of the file.
    """

    size: tuple[int, int]
    names: Sequence[str] = ()
    gives: Sequence[Given] = ()
    facts: Mapping[str, Any] = field(default_factory=dict)


def create(path: Path, about: About) -> h5py.File:
    """Return a new file with all its data sets, empty, which others may read while it grows; raises OSError."""
    file = h5py.File(path, "w", libver="latest")
    file.attrs.update(format=FORMAT, version=VERSION, **about.facts)
    file.attrs.update(complete=False, missing_pictures=0, missing_events=0)
    width, height = about.size
    file["labels/name"] = np.array(["sky", *about.names], h5py.string_dtype())
    bodies, picture = len(about.names), (height, width)
    if "poses" in about.gives:
        _poses(file, bodies)
    _rows(file, "pictures/t", (), "<f8", unit="us")
    _rows(file, "pictures/light", picture, "<f4", unit="1 at the sensor's reference, linear")
    if "depth" in about.gives:
        _rows(file, "pictures/depth", picture, "<f4", unit="m along the boresight; inf: sky")
    if "flow" in about.gives:
        _rows(file, "pictures/flow", (*picture, 2), "<f4", unit="px/s, to the right and down")
    if "labels" in about.gives:
        _rows(file, "pictures/labels", picture, "<u2")
    _events(file, about)
    file.swmr_mode = True
    return file


def _poses(file: h5py.File, bodies: int) -> None:
    _rows(file, "poses/t", (), "<f8", unit="us")
    _rows(file, "poses/camera_position_m", (3,), "<f8")
    _rows(file, "poses/camera_q_world_from_camera", (4,), "<f8", unit="w x y z")
    if bodies:
        _rows(file, "poses/bodies_position_m", (bodies, 3), "<f8")
        _rows(file, "poses/bodies_q_world_from_body", (bodies, 4), "<f8", unit="w x y z")


def _events(file: h5py.File, about: About) -> None:
    for group in ("events", "clean_events"):
        for name, kind in _EVENTS.items():
            _rows(file, f"{group}/{name}", (), kind)
        if "labels" in about.gives:
            _rows(file, f"{group}/label", (), "<u2")
        file[group].attrs.update(width=about.size[0], height=about.size[1])
    codes = {origin.name.lower(): int(origin) for origin in Origin}
    _rows(file, "events/origin", (), h5py.enum_dtype(codes, basetype="u1"))


def _rows(file: h5py.File, name: str, shape: tuple[int, ...], kind: Any, unit: str = "") -> None:
    """Make a data set of rows of this shape that grows; a large picture is a chunk of its own."""
    chunk = max(1, _CHUNK_BYTES // (math.prod(shape) * np.dtype(kind).itemsize))
    data = file.create_dataset(name, (0, *shape), kind, maxshape=(None, *shape), chunks=(chunk, *shape), **_PACKED)
    if unit:
        data.attrs["unit"] = unit
