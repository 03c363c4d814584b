"""Recordings of events that a rig plays, and their readers.

Every format that `evstim convert` reads is played, see docs/recordings.md; of an `.npz` record the part after the last
restart of the camera's clock. A recording is read whole into memory, 13 bytes an event.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

from msgspec import Meta

from emulator.light import MachineLacks, SceneError
from emulator.scene.kind import SceneKind
from emulator.tables.typed_table import NO_FILE, RigFile
from firmware_protocol.bounds import check_bounds
from firmware_protocol.events import Events, join_events
from firmware_protocol.recordings.part import Frame
from transports.needs import Need, package
from transports.recording.event_files import library_of
from transports.recording.files import OpenRecording
from transports.recording.format import format_to_read, format_to_write
from transports.recording.part import LibraryMissing, RecordingError, wrong_event


@dataclass(frozen=True)
class RecordingParameters:
    """Events from a file, through read-out, camera and links.

    Attributes
    ----------
    path : the recording, beside the rig file.
    time_scale : speed of the playback, relative to the recording.
    loop : whether it restarts at its end; else the camera sends no events from there on.
    through_readout : whether events pass the sensor's arbiter, which delays them and may lose some; those of a real
        camera have passed one already.
    """

    kind: ClassVar[str] = "recording"
    path: RigFile = NO_FILE
    time_scale: Annotated[float, Meta(ge=1e-6, le=1e6)] = 1.0
    loop: bool = True
    through_readout: bool = False

    def __post_init__(self) -> None:
        if not self.path:
            raise ValueError("path is missing: name a recording, .npz or .aedat4")
        check_bounds(self)


def _needs(parameters: RecordingParameters) -> tuple[Need, ...]:
    path = Path(parameters.path)
    try:
        needed = (format_to_read(path) if path.exists() else format_to_write(path)).needs
        needed = library_of(path) if needed == "faery" else needed
    except (OSError, RecordingError):  # reported when it is opened
        return ()
    return (package(needed),) if needed else ()


RECORDING = SceneKind(
    RecordingParameters, "emulator.playback.replay:blank", events="emulator.playback.replay:replay", needs=_needs
)


def read_events(path: Path, size: tuple[int, int] | None = None) -> tuple[Events, tuple[int, int] | None]:
    """Read a recording: (n,) EVENT, sorted, and the sensor's (width, height) where the file contains it, or `known`.

    Raises SceneError where the file cannot be read, holds no events, or goes back in time.
    """
    with _opened(path, size) as recording:
        events = join_events([part.events for part in recording.parts()]).copy()
    if not len(events):
        raise SceneError(f"{path}: holds no events")
    return events, recording.facts.size


def read_frames(path: Path) -> list[Frame]:
    """Read a recording's frames that cover the whole array; none where its format has none. Raises SceneError."""
    with _opened(path, None) as recording:
        frames = [frame for part in recording.parts() for frame in part.frames]
    size = recording.facts.size
    return [frame for frame in frames if size is None or frame.pixels.shape[:2] == size[::-1]]


def load_recording(path: Path, size: tuple[int, int]) -> Events:
    """Read a recording, (n,) EVENT, sorted, its first event at time 0.

    Raises SceneError where it cannot be read, holds no events, or events outside a sensor of `size` = (width, height).
    """
    events, _ = read_events(path, size)
    if (wrong := wrong_event(events, 0, size)) is not None:
        raise SceneError(f"{path}: event {wrong[0]} {wrong[1]}; give the camera the model that recorded it")
    events["t"] -= events["t"][0]
    return events


@contextmanager
def _opened(path: Path, size: tuple[int, int] | None) -> Iterator[OpenRecording]:
    """Open a recording, and turn its errors into SceneError or MachineLacks."""
    try:
        with OpenRecording(path, size) as recording:
            yield recording
    except LibraryMissing as error:
        raise MachineLacks(f"{path}: {error}") from error
    except RecordingError as error:
        raise SceneError(f"{path}: {error}") from error
    except OSError as error:
        raise SceneError(f"{path}: cannot be read: {error.strerror or error}") from error
