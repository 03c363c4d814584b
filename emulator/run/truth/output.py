"""`--truth FILE.h5`: from a rig to its truth file."""

from __future__ import annotations

import time
from functools import partial
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from emulator.geometry.seen import SceneGeometry
from emulator.light import Scene
from emulator.rig.loading import Rig
from emulator.rig.scene_kinds import SCENES
from emulator.run.truth.layout import About
from emulator.run.truth.recorder import TruthRecorder
from emulator.run.truth.refusal import check_truth
from emulator.run.truth.source import TruthSource, ideal_of
from emulator.sensor.event_source import EventSource
from emulator.sensor.origins import TracedSensor
from emulator.sensor.pixels.array import PixelArray
from emulator.sensor.sensor import Sensor

__all__ = ["TruthFile"]

_ABSENT = {
    "checkerboard": "depth and poses: a pattern on the chip has no distance and no place",
    "video": "depth, flow, labels and poses: a video does not tell them",
}


class TruthFile:
    """The truth file of one run; a context manager.

    Parameters
    ----------
    every : depth, flow, labels and light are written of every n-th picture.

    Attributes
    ----------
    trouble : why the file is not whole, for people; "" where it is. Known after `close`.
    """

    def __init__(self, rig: Rig, path: Path, every: int = 1) -> None:
        check_truth(rig, path, every)
        self._rig, self._path, self._every = rig, path, every
        self._recorder: TruthRecorder | None = None
        self.trouble = ""

    def source(self, sensor: EventSource, scene: Scene) -> TruthSource:
        """Return the sensor, one of `TracedSensor`, with truth beside it; raises OSError where the file cannot be."""
        if not isinstance(sensor, TracedSensor):
            raise TypeError("truth needs a sensor that traces its events")
        run, geometry = self._rig.run, scene.geometry()
        self._recorder = TruthRecorder(self._path, _about(self._rig, geometry), waits=run.pace != "realtime")
        clean = Sensor(ideal_of(sensor.parameters), run.seed, partial(PixelArray, threads=run.threads))
        return TruthSource(sensor, clean, geometry, self._recorder, self._every)

    def close(self) -> None:
        """Finish the file; a second call does nothing."""
        if self._recorder is not None:
            self._recorder.close()
            self.trouble = self._recorder.trouble

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _about(rig: Rig, geometry: SceneGeometry | None) -> About:
    """Return what the file says of the run."""
    camera, paced = rig.camera, rig.run.pace == "realtime"
    width, height = camera.size
    facts: dict[str, Any] = {
        "evstim": version("evstim"), "rig": rig.name, "title": rig.title, "seed": rig.run.seed, "camera": camera.model,
        "width": width, "height": height, "unix_us": int(time.time() * 1e6) if paced else 0,
        "light_unit": "relative to the sensor's reference", "absent": _ABSENT.get(rig.scene.kind, ""),
        **_lens_facts(rig),
    }  # fmt: skip
    if geometry is None:
        return About(camera.size, facts=facts | {"absent": facts["absent"] or "depth, flow, labels and poses"})
    return About(camera.size, geometry.names, sorted(geometry.gives), facts)


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
