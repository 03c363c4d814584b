"""How right the events of drawn scenes are: false and missed events, times, and traces of the picture rate, against ms.

A rig's scene is drawn in several ways, and each time the same sensor, without leak and noise, looks at it for the same
stretch of time. The truth is the same scene by 16 x 16 point samples a pixel at a sixteenth of the step, joined by
straight lines, from code that shares nothing with the renderers but the facets, the paths and the laws of reflection
(`sampled_bodies`). Rigs are looked at with half as many pixels a side and steps twice as long, so that motion in pixels
a step is that of the rig. For each pixel the two sequences of polarities are laid side by side:

    false      events that cannot be paired in order with one of the truth         both over the events of the truth
    missed     events of the truth that cannot be paired
    t50, t95   quantiles of the time error of pixels whose sequence is right, ms
    middle     share of the events in the middle twentieth of the step (see `comb`); 0.05 where there is no trace
    line       strongest spectral line at the picture rate over the median power
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from emulator.accuracy.comb import comb_of
from emulator.accuracy.metrics import compare
from emulator.accuracy.sampled_bodies import SampledBodies
from emulator.accuracy.sequences import Events as Sequences
from emulator.accuracy.sequences import common_subsequences
from emulator.accuracy.stream import Stream
from emulator.light import Scene
from emulator.optics.through import Through
from emulator.rig.camera_models import CAMERA_MODELS
from emulator.rig.loading import Rig
from emulator.run.frames import Pictures
from emulator.scene.bodies.gl_bodies import GlBodies
from emulator.scene.bodies.raster_bodies import RasterBodies
from emulator.scene.bodies.table import BodiesParameters
from emulator.sensor.effects import NoiseParameters
from emulator.sensor.sensor import Sensor
from firmware_protocol.events import Events, empty_events

__all__ = ["SETTINGS", "Drawn", "Setting", "fits", "rendering_rows"]

_STEPS = 24
_FINER = 16
_HALF = 2  # of the pixels a side, and steps as many times longer


@dataclass(frozen=True)
class Setting:
    """How a scene is drawn.

    Attributes
    ----------
    name : for the chart.
    samples : along each side of a pixel, by GL; 0: exact coverage, by the CPU.
    with_rate : whether the sensor gets the time derivative.
    step_share : length of the step, times the rig's.
    """

    name: str
    samples: int = 0
    with_rate: bool = True
    step_share: float = 1.0


SETTINGS = (
    Setting("exact light and rate"),
    Setting("exact light and rate, steps x 2", step_share=2.0),
    Setting("exact light and rate, steps x 4", step_share=4.0),
    Setting("exact light, line", with_rate=False),
    Setting("exact light, line, steps x 4", with_rate=False, step_share=4.0),
    Setting("GL, 2 x 2 samples, line", 2, with_rate=False),
    Setting("GL, 4 x 4 samples, line", 4, with_rate=False),
)


@dataclass(frozen=True)
class Drawn:
    """One point of the chart.

    Attributes
    ----------
    rig, setting : names.
    ms : CPU milliseconds a picture, least.
    false, missed : over the events of the truth.
    t50_ms, t95_ms : quantiles of time errors.
    middle, line : traces of the picture rate.
    events : of the truth.
    """

    rig: str
    setting: str
    ms: float
    false: float
    missed: float
    t50_ms: float
    t95_ms: float
    middle: float
    line: float
    events: int

    def row(self) -> dict[str, Any]:
        """Return it for tables."""
        return dataclasses.asdict(self)


@dataclass(frozen=True)
class _Look:
    """A rig's camera at half size, over some steps."""

    rig: Rig
    size: tuple[int, int]
    duration_ns: int

    def scene(self, build: Callable[..., Scene]) -> Scene:
        """Return the scene that `build(parameters, pinhole)` makes, through the rig's lens."""
        camera = self.rig.camera
        return Through(camera.lens, CAMERA_MODELS[camera.model].chip, self.size, partial(build, self.rig.scene))

    def events(self, scene: Scene, step_ns: int, *, with_rate: bool) -> tuple[Stream, float]:
        """Return the events of the stretch in steps of `step_ns`, and the least CPU milliseconds a picture."""
        sensor = Sensor(self._quiet(), self.rig.run.seed)
        pictures = Pictures(scene, with_rate=with_rate)
        pictures.draw(0)
        sensor.reset(pictures.light, 0)
        events, spent_s = [empty_events()], []
        for t_ns in range(step_ns, self.duration_ns + 1, step_ns):
            start_s = time.process_time()
            pictures.draw(t_ns)
            spent_s.append(time.process_time() - start_s)
            events.append(sensor.expose(pictures.light, t_ns, pictures.rate))
        events.append(sensor.finish())
        return Stream.from_events(_joined(events), *self.size), 1e3 * min(spent_s)

    def _quiet(self) -> Any:
        width, height = self.size
        sensor = self.rig.camera.sensor
        return dataclasses.replace(sensor, width=width, height=height, leak_hz=0.0, noise=NoiseParameters())


def fits(rig: Rig) -> bool:
    """Return whether a rig's scene is one of bodies."""
    return isinstance(rig.scene, BodiesParameters)


def rendering_rows(rigs: Sequence[Rig], steps: int = _STEPS) -> Iterator[Drawn]:
    """Yield one row for each rig and setting; `steps` steps of the rig, a multiple of four."""
    for rig in rigs:
        step_ns = _HALF * rig.run.step_us * 1000
        size = max(8, rig.camera.size[0] // _HALF), max(8, rig.camera.size[1] // _HALF)
        look = _Look(rig, size, steps * step_ns)
        with look.scene(SampledBodies) as scene:
            truth, _ = look.events(scene, step_ns // _FINER, with_rate=False)
        for setting in SETTINGS:
            own_ns = round(step_ns * setting.step_share)
            with look.scene(_builder(rig, setting)) as scene:
                stream, ms = look.events(scene, own_ns, with_rate=setting.with_rate)
            yield _compared((rig.name, setting.name), stream, truth, ms, own_ns)


def _builder(rig: Rig, setting: Setting) -> Callable[..., Scene]:
    if not setting.samples:
        return RasterBodies
    return lambda parameters, pinhole: GlBodies(dataclasses.replace(parameters, samples=setting.samples), pinhole)


def _joined(events: list[Events]) -> Events:
    return np.concatenate(events)


def _compared(names: tuple[str, str], stream: Stream, truth: Stream, ms: float, step_ns: int) -> Drawn:
    ours, known = (Sequences(s.t_us, s.on, s.first) for s in (stream, truth))
    common, total = int(common_subsequences(ours, known).sum()), max(1, len(truth))
    scores, comb = compare(stream, truth), comb_of(stream.t_us, step_ns / 1000)
    false, missed = (len(stream) - common) / total, (len(truth) - common) / total
    times = scores.t50_us / 1000, scores.t95_us / 1000
    return Drawn(*names, ms, false, missed, *times, comb.middle_share, comb.line, len(truth))
