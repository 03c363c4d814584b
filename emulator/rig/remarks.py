"""Remarks on a valid rig with values that may be mistakes."""

from __future__ import annotations

import dataclasses
import math
import stat
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from emulator.light import SceneError
from emulator.rig.loading import Rig, RigError
from emulator.sensor.noise.law import corner_hz, rms
from emulator.sensor.presets import SensorParameters
from emulator.tables.typed_table import RigFile, field_types

_QUESTIONABLE_THRESHOLD = 2.0
_LIGHTS = 30
_LEAST_DEVIATIONS = 1.6


def remarks(rig: Rig) -> list[str]:
    """Return a sentence on each value that may be a mistake; files that cannot be read are not its subject."""
    sentences = []
    for name in ("threshold_on", "threshold_off"):
        value = getattr(rig.camera.sensor, name)
        if value > _QUESTIONABLE_THRESHOLD:
            sentences.append(
                f"camera.sensor.{name} is {value:g}: an event for each change of light by a factor of "
                f"{math.exp(value):.3g}; real sensors have 0.1 to 0.5"
            )
    paths = _paths(rig) if hasattr(rig.scene, "camera") else ()
    return [*sentences, *_noise(rig.camera.sensor), *paths]


def _noise(sensor: SensorParameters) -> Iterator[str]:
    """Yield a sentence where the noise is stronger than any that its law was compared with."""
    largest = float(rms(sensor, corner_hz(sensor, np.geomspace(1e-6, 10, _LIGHTS))).max())
    least = min(sensor.threshold_on, sensor.threshold_off) / max(largest, 1e-9)
    if least < _LEAST_DEVIATIONS:
        yield (
            f"camera.sensor.noise: a threshold is {least:.2g} rms of the noise, and such a pixel fires all the time; "
            f"events of noise are checked from {_LEAST_DEVIATIONS:g} rms on"
        )


def _paths(rig: Rig) -> Iterator[str]:
    """Yield a sentence on each path that ends before the run, or needs a simulation where there is none."""
    from emulator.trajectory.building import read_path
    from emulator.trajectory.parameters import BasiliskPath, FilePath
    from emulator.trajectory.pose import TrajectoryError

    scale = getattr(rig.scene, "time_scale", 1.0)
    for where, table in _tables(rig.scene, "scene"):
        if isinstance(table, BasiliskPath):
            yield f"{where} stays where the rig puts it: only `evstim vizard` meets a Basilisk simulation"
        if not isinstance(table, FilePath):
            continue
        try:
            end_s = read_path(table)[1][1] * 1e-9 / scale
        except TrajectoryError:
            continue
        if rig.run.seconds > end_s:
            yield (
                f"{where}: {table.path} ends after {end_s:.6g} s and the run after {rig.run.seconds:g} s: the last "
                "pose holds from then on"
            )


@dataclass(frozen=True)
class OpenedFile:
    """A file that a rig names.

    Attributes
    ----------
    key : of the rig, such as "scene.path".
    bytes : its size; None for a folder.
    is_read : whether its content was read too; otherwise it was opened, and may still be damaged.
    """

    key: str
    path: str
    bytes: int | None
    is_read: bool


def open_files(rig: Rig) -> list[OpenedFile]:
    """Open every file that the rig names, and read its trajectories; raises RigError with the key."""
    from emulator.scene.bodies.mesh import find_shape
    from emulator.scene.bodies.models import MODEL_READERS, read_model
    from emulator.scene.bodies.table import BodyTable
    from emulator.trajectory.building import read_path
    from emulator.trajectory.parameters import FilePath, SpicePath
    from emulator.trajectory.pose import TrajectoryError
    from emulator.trajectory.spice import read_spice

    opened = []
    for where, table in _tables(rig.scene, "scene"):
        is_model = isinstance(table, BodyTable) and Path(table.shape).suffix.lower() in MODEL_READERS
        is_read = is_model or isinstance(table, FilePath | SpicePath)
        for name, annotation in field_types(type(table)).items():
            value = getattr(table, name)
            files = value if annotation == tuple[RigFile, ...] else [value] if annotation is RigFile and value else []
            for file in files:
                path = find_shape(file) if isinstance(table, BodyTable) else Path(file)
                size = _open(f"{rig.name}: {where}.{name}", path)
                opened.append(OpenedFile(f"{where}.{name}", str(path), size, is_read))
        try:
            if isinstance(table, BodyTable) and is_model:
                read_model(Path(table.shape))
            elif isinstance(table, FilePath):
                read_path(table)
            elif isinstance(table, SpicePath):
                read_spice(table)
        except SceneError as error:
            raise RigError(f"{rig.name}: {where}.shape: {error}") from error
        except TrajectoryError as error:
            raise RigError(f"{rig.name}: {where}: {error}") from error
    return opened


def _open(where: str, path: Path) -> int | None:
    """Return the size of a file that can be opened, None for a folder; raises RigError.

    The status comes first: a FIFO would wait for a writer when it is opened, and a device may have no end.
    """
    try:
        status = path.stat()
        if stat.S_ISDIR(status.st_mode):  # a folder of images
            return None
        if not stat.S_ISREG(status.st_mode):
            raise RigError(f"{where}: {path} is no regular file: name a file with content of its own")
        if not status.st_size:
            raise RigError(f"{where}: {path} is empty")
        path.open("rb").close()
    except (OSError, ValueError) as error:  # ValueError: a name with a NUL
        raise RigError(f"{where}: {path} cannot be opened: {getattr(error, 'strerror', None) or error}") from error
    return status.st_size


def _tables(value: object, where: str) -> Iterator[tuple[str, object]]:
    """Yield a table of a rig and those in it, with their keys; without paths that a program gives."""
    from emulator.trajectory.live import GivenPath

    if isinstance(value, tuple):
        for number, table in enumerate(value):
            yield from _tables(table, f"{where}[{number}]")
    elif dataclasses.is_dataclass(value) and not isinstance(value, GivenPath):
        yield where, value
        for field in dataclasses.fields(value):
            yield from _tables(getattr(value, field.name), f"{where}.{field.name}")
