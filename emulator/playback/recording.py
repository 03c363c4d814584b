"""Recordings of events that a rig plays, and their readers.

    .npz       written by `--record` and the listeners; the part after the last restart of the camera's clock
    others     every format that `evstim convert` reads, in a child process, see docs/recordings.md

A recording is read whole into memory, 13 bytes an event.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from emulator.light import MachineLacks, SceneError
from emulator.scene.kind import SceneKind
from emulator.tables.typed_table import NO_FILE, RigFile
from firmware_protocol.events import Events, join_events
from transports.needs import Need, package
from transports.recording.format import format_to_read, format_to_write
from transports.recording.guarded import OpenRecording
from transports.recording.part import Frame, LibraryMissing, RecordingError
from transports.recording.record import ArrayFileError, load_record

__all__ = ["RECORDING", "RecordingParameters", "load_recording", "read_events", "read_frames"]


@dataclass(frozen=True)
class RecordingParameters:
    """Events from a file, through read-out, camera and links.

    Attributes
    ----------
    path
        The recording, beside the rig file.
    time_scale
        Speed of the playback, relative to the recording.
    loop
        Whether it restarts at its end; else the camera sends no events from there on.
    through_readout
        Whether events pass the sensor's arbiter, which delays them and loses some where too many come at once; those of
        a real camera have passed one already.
    """

    kind: ClassVar[str] = "recording"
    path: RigFile = NO_FILE
    time_scale: float = 1.0
    loop: bool = True
    through_readout: bool = False

    def __post_init__(self) -> None:
        if not self.path:
            raise ValueError("path is missing: name a recording, .npz or .aedat4")
        if not 1e-6 <= self.time_scale <= 1e6:
            raise ValueError(f"time_scale is {self.time_scale}: it must be 1e-6 to 1e6")


def _needs(parameters: RecordingParameters) -> tuple[Need, ...]:
    path = Path(parameters.path)
    if path.suffix == ".npz":
        return ()
    try:
        needed = (format_to_read(path) if path.exists() else format_to_write(path)).needs
    except (OSError, RecordingError):  # reported when it is opened
        return ()
    return (package(needed),) if needed else ()


RECORDING = SceneKind(
    RecordingParameters,
    "emulator.playback.replay:blank",
    events="emulator.playback.replay:replay",
    needs=_needs,
)


def read_events(path: Path, known: tuple[int, int] | None = None) -> tuple[Events, tuple[int, int] | None]:
    """Read a recording: (n,) EVENT, sorted, and the sensor's (width, height) where the file contains it, or `known`.

    Raises SceneError where the file cannot be read, holds no events, or goes back in time.
    """
    events, size = _read(path, known)
    if not len(events):
        raise SceneError(f"{path}: holds no events")
    back = np.flatnonzero(events["t"][1:] < events["t"][:-1])
    if back.size:
        k = int(back[0]) + 1
        raise SceneError(f"{path}: event {k} goes back in time, from {events['t'][k - 1]} to {events['t'][k]} us")
    return events, size


def read_frames(path: Path) -> list[Frame]:
    """Read the frames of a recording that cover the whole array; none where its format has none.

    Raises SceneError where the file cannot be read.
    """
    if path.suffix == ".npz":
        return []
    try:
        with OpenRecording(path, None) as recording:
            frames = [frame for part in recording.parts() for frame in part.frames]
            size = recording.facts.size
    except LibraryMissing as error:
        raise MachineLacks(f"{path}: {error}") from error
    except RecordingError as error:
        raise SceneError(f"{path}: {error}") from error
    except OSError as error:
        raise SceneError(f"{path}: cannot be read: {error.strerror or error}") from error
    return [frame for frame in frames if size is None or frame.pixels.shape[:2] == size[::-1]]


def load_recording(path: Path, size: tuple[int, int]) -> Events:
    """Read a recording, (n,) EVENT, sorted, its first event at time 0.

    Raises
    ------
    SceneError
        The file cannot be read, holds no events, or events that a sensor of `size` = (width, height) cannot have.
    """
    events, _ = read_events(path, size)
    outside = np.flatnonzero((events["x"] >= size[0]) | (events["y"] >= size[1]))
    if outside.size:
        k = int(outside[0])
        raise SceneError(
            f"{path}: event {k} is at ({events['x'][k]}, {events['y'][k]}), outside a sensor of {size[0]} x {size[1]} "
            "pixels; give the camera the model that recorded it"
        )
    events["t"] -= events["t"][0]
    return events


def _read(path: Path, known: tuple[int, int] | None) -> tuple[Events, tuple[int, int] | None]:
    if path.suffix == ".npz":
        return _read_npz(path), known
    try:
        with OpenRecording(path, known) as recording:
            events = join_events([part.events for part in recording.parts()])
            return events.copy(), recording.facts.size
    except LibraryMissing as error:
        raise MachineLacks(f"{path}: {error}") from error
    except RecordingError as error:
        raise SceneError(f"{path}: {error}") from error
    except OSError as error:
        raise SceneError(f"{path}: cannot be read: {error.strerror or error}") from error


def _read_npz(path: Path) -> Events:
    try:
        events, restarts = load_record(path)
    except OSError as error:
        raise SceneError(f"{path}: cannot be read: {error.strerror or error}") from error
    except ArrayFileError as error:
        raise SceneError(str(error)) from error
    return events[restarts[-1] :].copy() if restarts else events
