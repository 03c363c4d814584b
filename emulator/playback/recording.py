"""Recordings of events as a rig names them, and how they are read.

    .npz       what `--record` and the listeners write; the part after the last restart of the camera's clock
    .aedat4    recordings of iniVation's cameras; read by faery (`pip install 'evstim[files]'`)
    .es .dat .raw .csv   likewise, as far as faery reads them

A recording is taken whole into memory, 13 bytes an event.
"""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from emulator.light import MachineLacks, SceneError
from emulator.scene.kind import SceneKind
from emulator.tables.files import NO_FILE, RigFile
from firmware_protocol.events import EVENT, Events
from transports.link.record import load_record

__all__ = ["RECORDING", "RecordingParameters", "load_recording"]

_MOST_EVENTS = 1 << 31


@dataclass(frozen=True)
class RecordingParameters:
    """Events from a file, through read-out, camera and links.

    Attributes
    ----------
    path
        The recording, beside the rig file.
    time_scale
        How much faster than recorded it is played.
    loop
        Whether it begins anew at its end; else the camera is silent from there on.
    through_readout
        Whether the sensor's arbiter takes part, which delays events and loses some where too many come at once; a
        recording of a real camera has been through one already.
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


RECORDING = SceneKind(RecordingParameters, "emulator.playback.replay:blank", events="emulator.playback.replay:replay")


def load_recording(path: Path, size: tuple[int, int]) -> Events:
    """Read a recording, (n,) EVENT, sorted, its first event at time 0.

    Raises
    ------
    SceneError
        The file cannot be read, holds no events, or events that a sensor of `size` = (width, height) cannot have.
    """
    events = _read_npz(path) if path.suffix == ".npz" else _read_with_faery(path)
    if not len(events):
        raise SceneError(f"{path}: holds no events")
    outside = np.flatnonzero((events["x"] >= size[0]) | (events["y"] >= size[1]))
    if outside.size:
        k = int(outside[0])
        raise SceneError(
            f"{path}: event {k} is at ({events['x'][k]}, {events['y'][k]}), outside a sensor of {size[0]} x {size[1]} "
            "pixels; give the camera the model that recorded it"
        )
    back = np.flatnonzero(events["t"][1:] < events["t"][:-1])
    if back.size:
        k = int(back[0]) + 1
        raise SceneError(f"{path}: event {k} goes back in time, from {events['t'][k - 1]} to {events['t'][k]} us")
    events["t"] -= events["t"][0]
    return events


def _read_npz(path: Path) -> Events:
    try:
        events, restarts = load_record(path)
        if events.dtype != EVENT:
            raise ValueError(f"its events are {events.dtype}, not {EVENT}")
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise SceneError(f"{path}: cannot be read as a recording of evstim: {error}") from error
    return events[restarts[-1] :].copy() if restarts else events


def _read_with_faery(path: Path) -> Events:
    try:
        import faery
    except ImportError as error:
        raise MachineLacks(f"{path}: reading {path.suffix} needs faery: pip install 'evstim[files]'") from error
    if not path.is_file():
        raise SceneError(f"{path}: no such file")
    try:
        packets = [packet.astype(EVENT) for packet in faery.events_stream_from_file(path)]
    except (OSError, RuntimeError, ValueError, AttributeError) as error:
        raise SceneError(f"{path}: cannot be read: {error}") from error
    return np.concatenate(packets) if packets else np.empty(0, EVENT)
