"""Sensor of a run that also records the truth of its events, for `--truth FILE.h5`.

    light --+--> traced sensor ----> events, origins --+
            +--> ideal sensor -----> clean events -----+--> recorder
    scene ----> poses, depth, flow, labels ------------+

For the run it is a source of events like any other. `check_truth` decides before anything is opened whether there can
be truth of a run.
"""

from __future__ import annotations

import dataclasses
import hashlib
import math
import time
from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from emulator.geometry.camera import SceneGeometry, Seen
from emulator.light import LightFrame, Scene
from emulator.rig.kinds import SCENES
from emulator.rig.loading import Rig
from emulator.run.truth.file import LAYERS, About, Rows, TruthRecorder
from emulator.run.truth.origins import TracedSensor
from emulator.sensor.chip.defects import at_temperature
from emulator.sensor.parameters import KickParameters
from emulator.sensor.presets import PRESETS, SensorParameters
from emulator.sensor.sensor import EventSource, Sensor, own_pixels
from firmware_protocol.events import Events, join_events
from transports import Closing
from transports.needs import install_command


@dataclass(frozen=True)
class TruthSelection:
    """Content of a truth beside the events.

    Attributes
    ----------
    every : light, depth, flow and labels are written of every n-th light frame; None: of `rate_hz` a second.
    rate_hz : the first light frame from each multiple of 1 / rate_hz on.
    layers : of `LAYERS`, as far as the scene has them.
    """

    every: int | None = None
    rate_hz: float = 25.0
    layers: tuple[str, ...] = LAYERS

    def number(self, t_ns: int, frames: int) -> int:
        """Return the number of the interval of a light frame at `t_ns`, after `frames` others; its first is written."""
        return math.floor(t_ns * 1e-9 * self.rate_hz + 1e-6) if self.every is None else frames // self.every

    def pictures(self, rig: Rig) -> tuple[float, float]:
        """Return the number of light frames a second of a run, and the bytes a second of them, not compressed."""
        step_hz = 1e6 / rig.run.step_us
        pictures_hz = min(step_hz, self.rate_hz) if self.every is None else step_hz / self.every
        width, height = rig.camera.size
        pixel_bytes = sum(size for layer, size in _PIXEL_BYTES.items() if layer in self.layers)
        return pictures_hz, pictures_hz * width * height * pixel_bytes


ALL = TruthSelection()
_PIXEL_BYTES = {"light": 4, "depth": 4, "flow": 8, "labels": 2}

_CLEAN = ("threshold_on", "threshold_off")  # parameters that may change while the clean sensor runs


def ideal_of(parameters: SensorParameters) -> SensorParameters:
    """Return the ideal sensor of the same size, thresholds and dark current: no mismatch, noise, leak or delay."""
    chip = at_temperature(parameters)
    return dataclasses.replace(
        PRESETS["ideal"],
        width=chip.width,
        height=chip.height,
        threshold_on=chip.threshold_on,
        threshold_off=chip.threshold_off,
        dark_current_relative=chip.dark_current_relative,
    )


class TruthSensor(TracedSensor):
    """A sensor of a run whose events have their truth; `record_truth` comes before the first light frame."""

    def record_truth(
        self,
        put: Callable[[Rows], None],
        clean: Sensor | None,
        geometry: SceneGeometry | None,
        selection: TruthSelection,
    ) -> None:
        """Send the truth to `put`.

        Parameters
        ----------
        clean : the ideal sensor, for clean events.
        geometry : of the scene; None where it has none.
        """
        self._put = put
        self._clean = clean
        self._geometry = geometry
        self._selection = selection
        self._seen = Seen.of(self.parameters.width, self.parameters.height)
        self._labels = np.zeros_like(self._seen.labels)
        self._gives = frozenset() if geometry is None else geometry.gives & {*selection.layers}
        self._count, self._number = 0, -1
        self._labelled_us = -math.inf
        self._events = _Queue("events")
        self._clean_events = _Queue("clean_events")

    def adjust(self, name: str, value: float) -> None:
        """Set a parameter of the sensor, and a threshold of the clean one too."""
        super().adjust(name, value)
        if self._clean is not None and name in _CLEAN:
            self._clean.adjust(name, value)

    def with_kicks(self, kicks: KickParameters) -> None:
        """Return None: the truth of disturbed events is not traced."""

    def reset(self, frame: LightFrame) -> None:
        """Start at the time of `frame`."""
        super().reset(frame)
        if self._clean is not None:
            self._clean.reset(frame)
        self._count, self._number = 0, -1
        self._record(frame)

    def expose(self, frame: LightFrame) -> Events:
        """Move to the time of `frame` and return the sensor's events; see `Sensor.expose`."""
        events = super().expose(frame)
        self._events.add(events, self.origins)
        if self._clean is not None:
            self._clean_events.add(self._clean.expose(frame))
        self._record(frame)
        return events

    def finish(self) -> Events:
        """Return the events that have not left yet; events that wait for a later frame have the last frame's labels."""
        events = super().finish()
        self._events.add(events, self.origins)
        if self._clean is not None:
            self._clean_events.add(self._clean.finish())
        self._put(self._event_rows(math.inf, self._labels))
        return events

    def _record(self, frame: LightFrame) -> None:
        """Record the poses of a frame, and of some the rest with the events up to it."""
        rows = self._pose_rows(frame.t_ns)
        number = self._selection.number(frame.t_ns, self._count)
        if number != self._number:
            rows |= self._frame_rows(frame)
        self._count, self._number = self._count + 1, number
        if rows:
            self._put(rows)

    def _pose_rows(self, t_ns: int) -> dict[str, Any]:
        placed = self._geometry.places(t_ns) if self._geometry is not None and "poses" in self._gives else None
        if placed is None:
            return {}
        rows = {
            "poses/t": np.array([t_ns / 1000]),
            "poses/camera_position_m": placed.camera_m[None],
            "poses/camera_q_world_from_camera": placed.q_world_from_camera[None],
        }
        if len(placed.bodies_m):
            rows["poses/bodies_position_m"] = placed.bodies_m[None]
            rows["poses/bodies_q_world_from_body"] = placed.q_world_from_bodies[None]
        return rows

    def _frame_rows(self, frame: LightFrame) -> dict[str, Any]:
        t_ns = frame.t_ns
        rows: dict[str, Any] = {"pictures/t": np.array([t_ns / 1000])}
        if "light" in self._selection.layers:
            rows["pictures/light"] = frame.light[None]
        if self._geometry is not None and self._gives - {"poses"}:
            self._geometry.look(t_ns, self._seen)
        for name in sorted(self._gives - {"poses"}):
            rows[f"pictures/{name}"] = getattr(self._seen, name)[None]
        return rows | self._event_rows(t_ns / 1000, self._seen.labels)

    def _event_rows(self, t_us: float, labels: npt.NDArray[np.uint16]) -> dict[str, Any]:
        """Return the events before `t_us`, each with its label in the nearer frame, and store the new labels."""
        middle_us = (self._labelled_us + t_us) / 2 if math.isfinite(t_us) else math.inf
        pictures = (self._labels, labels, middle_us) if "labels" in self._gives else None
        rows = self._events.rows(pictures) | self._clean_events.rows(pictures)
        self._labels[:], self._labelled_us = labels, t_us
        return rows


_Pictures = tuple[npt.NDArray[np.uint16], npt.NDArray[np.uint16], float]


class _Queue:
    """Events that wait for the labels of the next light frame."""

    def __init__(self, group: str) -> None:
        self._group = group
        self._events: list[Events] = []
        self._origins: list[npt.NDArray[np.uint8]] = []

    def add(self, events: Events, origins: npt.NDArray[np.uint8] | None = None) -> None:
        """Add events, and their origins where they have any."""
        if len(events):
            self._events.append(events)
            self._origins += [] if origins is None else [origins]

    def rows(self, pictures: _Pictures | None) -> dict[str, Any]:
        """Return and remove them; `pictures`: labels before and after, and the time from which the latter hold."""
        if not self._events:
            return {}
        events, group = join_events(self._events), self._group
        rows = {f"{group}/{name}": events[name] for name in ("t", "x", "y")}
        rows[f"{group}/p"] = events["on"].astype(np.uint8)
        if self._origins:
            rows[f"{group}/origin"] = np.concatenate(self._origins)
        if pictures is not None:
            before, after, middle_us = pictures
            place = events["y"], events["x"]
            rows[f"{group}/label"] = np.where(events["t"] < middle_us, before[place], after[place])
        self._events, self._origins = [], []
        return rows


SUFFIXES = (".h5", ".hdf5")


class TruthRefused(ValueError):
    """There can be no truth of this run; the message contains the reason."""


def check_truth(rig: Rig, selection: TruthSelection = ALL, path: Path | None = None) -> None:
    """Raise TruthRefused where there is no truth of the rig, or not in `path`, ImportError where h5py is missing."""
    if path is not None and path.suffix not in SUFFIXES:
        raise TruthRefused(f"{path} must end in {' or '.join(SUFFIXES)}")
    if selection.every is not None and selection.every < 1:
        raise TruthRefused(f"every {selection.every}th picture: it must be 1 or more")
    if SCENES[rig.scene.kind].events:
        raise TruthRefused(f"a {rig.scene.kind} plays events that exist already: their origin is not known")
    if path is not None and find_spec("h5py") is None:
        raise ImportError(f"it needs h5py: {install_command('files')}")


_OF_SURFACES = ("depth", "flow", "labels", "poses")
ABSENT: Mapping[str, tuple[tuple[str, ...], str]] = {
    "checkerboard": (("depth", "poses"), "a pattern on the chip has no distance and no place"),
    "video": (_OF_SURFACES, "a video does not contain them"),
    "ros2": (_OF_SURFACES, "images do not contain them"),
    "external": (_OF_SURFACES, "a renderer sends light alone"),
}
"""Layers that scenes of a kind do not have, and the reason."""


class RunTruth(Closing):
    """Truth of one run, for `build_session`; a context manager.

    Attributes
    ----------
    about : description of the run. Valid after `begin`.
    trouble : reason why it is not complete, for people; "" where it is. Valid after `close`.
    """

    about: About

    def __init__(self, rig: Rig, selection: TruthSelection = ALL, path: Path | None = None) -> None:
        check_truth(rig, selection, path)
        self._rig = rig
        self._selection = selection
        self._digest = hashlib.blake2b(digest_size=8)
        self.trouble = ""

    def _open(self) -> None:
        """Begin the file, where there is one, of `about`; raises OSError."""

    @abstractmethod
    def _put(self, rows: Rows) -> None:
        """Take rows, which the run may change afterwards."""

    def close(self) -> None:
        """Finish the file, where there is one; a second call does nothing."""

    @property
    def digest(self) -> str:
        """Digest of all that was written, of a run that is not paced: the same run has the same one."""
        return self._digest.hexdigest()

    def begin(self, sensor: EventSource, scene: Scene) -> None:
        """Record the truth of a `TruthSensor` of the run; raises OSError where the file cannot be."""
        if not isinstance(sensor, TruthSensor):
            raise TypeError("truth needs a sensor that traces its events")
        run, geometry = self._rig.run, scene.geometry()
        self.about = _about(self._rig, geometry, self._selection.layers)
        self._open()
        clean = None
        if "clean_events" in self._selection.layers:
            clean = Sensor(ideal_of(sensor.parameters), run.seed, partial(own_pixels, threads=run.threads))
        sensor.record_truth(self._take, clean, geometry, self._selection)

    def _take(self, rows: Rows) -> None:
        if self._rig.run.pace == "free":
            for name, values in rows.items():
                self._digest.update(name.encode())
                self._digest.update(np.ascontiguousarray(values).data)
        self._put(rows)


class TruthFile(RunTruth):
    """Truth in an HDF5 file."""

    def __init__(self, rig: Rig, path: Path, selection: TruthSelection = ALL) -> None:
        super().__init__(rig, selection, path)
        self._path = path
        self._recorder: TruthRecorder | None = None

    def _open(self) -> None:
        self._recorder = TruthRecorder(self._path, self.about, waits=self._rig.run.pace != "realtime")

    def _put(self, rows: Rows) -> None:
        assert self._recorder is not None
        self._recorder.put(rows)

    def close(self) -> None:
        """Finish the file; a second call does nothing."""
        if self._recorder is not None:
            self._recorder.close()
            self.trouble = self._recorder.trouble


class TruthArrays(RunTruth):
    """Truth in memory, by the names of the data sets of a truth file."""

    def __init__(self, rig: Rig, selection: TruthSelection = ALL) -> None:
        super().__init__(rig, selection)
        self._rows: dict[str, list[npt.NDArray[Any]]] = {}

    def _put(self, rows: Rows) -> None:
        for name, values in rows.items():
            self._rows.setdefault(name, []).append(values.copy())

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """Return the data sets; each that had no row is missing."""
        return {name: np.concatenate(rows) for name, rows in self._rows.items()}


def _about(rig: Rig, geometry: SceneGeometry | None, selected: tuple[str, ...]) -> About:
    """Return the description of the run in the file."""
    camera, paced = rig.camera, rig.run.pace == "realtime"
    width, height = camera.size
    lacking, reason = ABSENT.get(rig.scene.kind, (() if geometry else _OF_SURFACES, "this scene gives none"))
    gives, names = (geometry.gives, geometry.names) if geometry else ((), ())
    facts: dict[str, Any] = {
        "evstim": version("evstim"), "rig": rig.name, "title": rig.title, "seed": rig.run.seed, "camera": camera.model,
        "width": width, "height": height, "unix_us": int(time.time() * 1e6) if paced else 0,
        "light_unit": "relative to the sensor's reference",
        "absent": f"{', '.join(lacking)}: {reason}" if lacking else "", **_lens_facts(rig),
    }  # fmt: skip
    layers = [layer for layer in selected if layer in ("light", "clean_events") or layer in gives]
    return About(camera.size, names, layers, facts)


def _lens_facts(rig: Rig) -> dict[str, Any]:
    if SCENES[rig.scene.kind].lens == "none":
        return {}
    lens, (width, height) = rig.camera.lens, rig.camera.size
    return {
        "focal_px": lens.pinhole((width, height)).focal_px,
        "centre_px": [width / 2, height / 2],
        "distortion": [lens.k1, lens.k2, lens.p1, lens.p2, lens.k3],
        "radiance_per_light": 1 / lens.light_per_radiance,
    }
