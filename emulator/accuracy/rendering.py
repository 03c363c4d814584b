"""Effect of cheaper drawing on the events: milliseconds a frame against false and missed events.

A rig's scene is drawn with fewer samples a pixel and with coarser facets, and each time the same sensor, without leak
and noise, looks at it for the same stretch of time. The reference is the scene at 4 x 4 samples with every facet. For
each pixel the two sequences of polarities are compared; events that cannot be paired in order are

    false     in the cheaper frame's events only        both over the events of the reference
    missed    in the reference's events only
"""

from __future__ import annotations

import dataclasses
import statistics
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from emulator.accuracy.sequences import Events as Sequences
from emulator.accuracy.sequences import common_subsequences
from emulator.accuracy.stream import Stream
from emulator.rig.loading import Rig
from emulator.run.frames import Pictures
from emulator.run.scene_assembly import build_scene
from emulator.sensor.effects import NoiseParameters
from emulator.sensor.sensor import Sensor
from firmware_protocol.events import Events, empty_events

__all__ = ["SETTINGS", "Drawn", "Setting", "fits", "rendering_rows"]

_STEPS = 60


@dataclass(frozen=True)
class Setting:
    """Settings with which a scene is drawn.

    Attributes
    ----------
    name : str
        Label in the chart.
    samples : int
        Samples along each side of a pixel.
    detail_px : float, optional
        Size of the smallest facets, pixels; 0 for all facets, None for the rig's own value.
    """

    name: str
    samples: int
    detail_px: float | None = None


REFERENCE = Setting("reference", 4, 0.0)
SETTINGS = (
    Setting("1 sample", 1),
    Setting("2 x 2", 2),
    Setting("3 x 3", 3),
    Setting("4 x 4", 4),
    Setting("2 x 2, every facet", 2, 0.0),
    Setting("3 x 3, every facet", 3, 0.0),
    Setting("2 x 2, facets of 2 px", 2, 2.0),
    Setting("2 x 2, facets of 4 px", 2, 4.0),
)


@dataclass(frozen=True)
class Drawn:
    """One point of the chart.

    Attributes
    ----------
    rig, setting : str
        Names.
    ms : float
        Milliseconds a frame, median.
    false, missed : float
        False and missed events over the events of the reference.
    events : int
        Events of the reference.
    """

    rig: str
    setting: str
    ms: float
    false: float
    missed: float
    events: int

    def row(self) -> dict[str, Any]:
        """Return it for tables."""
        return dataclasses.asdict(self)


def fits(rig: Rig) -> bool:
    """Tell whether a rig's scene is drawn with samples at all."""
    return hasattr(rig.scene, "samples")


def rendering_rows(rigs: Sequence[Rig], steps: int = _STEPS) -> Iterator[Drawn]:
    """Yield one row for each rig and setting."""
    for rig in rigs:
        reference, _ = _look(rig, REFERENCE, steps)
        for setting in SETTINGS:
            stream, ms = _look(rig, setting, steps)
            yield _compared(rig.name, setting.name, stream, reference, ms)


def _look(rig: Rig, setting: Setting, steps: int) -> tuple[Stream, float]:
    """Return the events of a stretch of the rig's run, drawn as `setting` says, and milliseconds a picture."""
    changes: dict[str, Any] = {"samples": setting.samples}
    if setting.detail_px is not None:
        changes["detail_px"] = setting.detail_px
    changed = dataclasses.replace(rig, scene=dataclasses.replace(rig.scene, **changes))
    quiet = dataclasses.replace(rig.camera.sensor, leak_hz=0.0, noise=NoiseParameters())
    sensor, step_ns = Sensor(quiet, rig.run.seed), rig.run.step_us * 1000
    events, seconds = [empty_events()], []
    with build_scene(changed) as scene:
        pictures = Pictures(scene, with_rate=True)
        pictures.draw(0)
        sensor.reset(pictures.light, 0)
        for k in range(1, steps + 1):
            start_s = time.perf_counter()
            pictures.draw(k * step_ns)
            seconds.append(time.perf_counter() - start_s)
            events.append(sensor.expose(pictures.light, k * step_ns, pictures.rate))
    events.append(sensor.finish())
    width, height = rig.camera.size
    return Stream.from_events(_joined(events), width, height), 1e3 * statistics.median(seconds)


def _joined(events: list[Events]) -> Events:
    return np.concatenate(events)


def _compared(rig: str, setting: str, stream: Stream, reference: Stream, ms: float) -> Drawn:
    ours, known = (Sequences(s.t_us, s.on, s.first) for s in (stream, reference))
    common = int(common_subsequences(ours, known).sum())
    total = max(1, len(reference))
    return Drawn(rig, setting, ms, (len(stream) - common) / total, (len(reference) - common) / total, len(reference))
