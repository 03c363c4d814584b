"""Accuracy of the events of drawn scenes against drawing time: false and missed events, times, traces of frame rates.

A rig's scene is drawn in several ways, at the size in the rig, and each time the same sensor, without leak and noise,
observes it for the same stretch of time. The truth is the same scene by rays, to the eye and to the Sun, through up to
8 x 8 points of each pixel in light frames 7.5 to 20 ms apart, joined by straight lines. Code and data shared with the
renderers are shapes with their detail, maps, paths and laws of reflection alone (`sampled_scenes`). For each pixel
the two sequences of polarities are aligned:

    false          events that cannot be paired in order with one of the truth         both over the events of the truth
    missed         events of the truth that cannot be paired
    t50, t95       quantiles of the time error of pixels whose sequence is right, ms

Three measures show traces of the frame rate in event times, which a sensor under continuous light would not have:

    middle share   share of the events in the middle twentieth of their step: 0.05 where the step leaves no trace
    second half    events in the second half of their step over those in the first, less 1
    line           strongest line of the spectrum of event counts at the frame rate and its multiples, over the median
                   power of the spectrum
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt

from emulator.light import LightFrame, PixelLight, Scene, SceneFrames
from emulator.optics.glare import veiled
from emulator.optics.through import Through
from emulator.rig.kinds import CAMERA_MODELS
from emulator.rig.loading import Rig
from emulator.run.tuning import quiet
from emulator.scene.between import LightBetween
from emulator.scene.bodies.gl_bodies import GlBodies
from emulator.scene.bodies.raster_bodies import RasterBodies
from emulator.scene.bodies.table import BodiesParameters
from emulator.scene.terrain.gl_terrain import GlTerrain
from emulator.scene.terrain.raster_terrain import RasterTerrain
from emulator.scene.terrain.table import TerrainParameters
from emulator.sensor.sensor import Sensor
from firmware_protocol.events import empty_events
from laboratory.accuracy.sampled_scenes import SampledBodies, SampledTerrain
from laboratory.accuracy.scores import Scores, Stream, compare

_BINS_A_STEP = 64
_HARMONICS = 8


@dataclass(frozen=True, slots=True)
class Comb:
    """Traces of the frame rate; the module docstring defines each. NaN: too few events."""

    middle_share: float
    second_half: float
    line: float


def comb_of(t_us: npt.ArrayLike, step_us: float) -> Comb:
    """Return the traces that steps of `step_us`, the first at 0, leave in event times, (n,) us."""
    times = np.asarray(t_us, np.float64)
    if times.size < 2:
        return Comb(np.nan, np.nan, np.nan)
    phase = (times / step_us) % 1.0
    middle = float(np.mean(np.abs(phase - 0.5) < 0.025))
    first = int(np.count_nonzero(phase < 0.5))
    second_half = (times.size - first) / first - 1 if first else np.inf
    return Comb(middle, float(second_half), _line(times, step_us))


def _line(times_us: npt.NDArray[np.float64], step_us: float) -> float:
    """Return the strongest power at multiples of the frame rate over the median power."""
    steps = int(np.ceil(times_us.max() / step_us))
    counts, _ = np.histogram(times_us, steps * _BINS_A_STEP, (0.0, steps * step_us))
    # A window keeps the slow change of the event rate out of the other lines.
    power = np.abs(np.fft.rfft((counts - counts.mean()) * np.hanning(counts.size))) ** 2
    median = float(np.median(power[1:]))
    lines = power[steps : steps * (_HARMONICS + 1) : steps]
    return float(lines.max() / median) if median > 0 and lines.size else float("nan")


@dataclass(frozen=True)
class Stretch:
    """A part of a rig's stream, and the sampling of its truth.

    Attributes
    ----------
    start_s : of the stream.
    steps : of the rig; a multiple of four.
    samples : of the truth, along each side of a pixel with an edge; 0: exact drawings with rate take its place.
    finer : light frames of the truth in a step of the rig.
    windows : parts of the light frame with rows of their own: name, left, top, right, bottom, in pixels.
    """

    start_s: float = 0.0
    steps: int = 12
    samples: int = 8
    finer: int = 4
    windows: tuple[tuple[str, int, int, int, int], ...] = ()


LADDER = Stretch(steps=8, samples=0)
"""For the settings that differ in time alone; from step 128 on, a multiple of all periods of drawings."""

_STRETCHES = {  # with more samples where the noise of the truth would be as large as the target
    "itokawa": tuple(Stretch(start_s, finer=8) for start_s in (0.0, 10.0, 50.0)),  # whose step is the longest
    "eros": (Stretch(samples=24),),
    "eros-flyover": (Stretch(windows=(("terminator", 0, 110, 150, 260),)),),
    "rendezvous": (Stretch(samples=16),),
    "malapert": tuple(Stretch(start_s, steps=4, samples=16) for start_s in (2.0, 20.0, 45.0, 70.0, 150.0)),
}


@dataclass(frozen=True)
class Setting:
    """Settings for drawing a scene.

    Attributes
    ----------
    name : for the chart.
    samples : along each side of a pixel, by GL; 0: exact coverage, by the CPU.
    with_rate : True: the sensor gets the time derivative.
    step_share : length of the step, times the rig's.
    parts : of a pixel of terrain, along its shorter side, by the CPU; 0: that of the rig.
    drawn_every : steps between two drawings, with light moved in between; 1: each frame is drawn; 0: as shipped.
    """

    name: str
    samples: int = 0
    with_rate: bool = True
    step_share: float = 1.0
    parts: int = 0
    drawn_every: int = 1


SETTINGS = (
    Setting("as shipped", drawn_every=0),
    Setting("drawn each second step", drawn_every=2),
    Setting("drawn each fourth step", drawn_every=4),
    Setting("drawn each step"),
    Setting("drawn each step, steps / 2", step_share=0.5),
    Setting("drawn each step, steps x 2", step_share=2.0),
    Setting("drawn each step, steps x 4", step_share=4.0),
    Setting("line", with_rate=False),
    Setting("line, steps x 4", with_rate=False, step_share=4.0),
    Setting("GL, 2 x 2 samples, line", 2, with_rate=False),
    Setting("GL, 8 x 8 samples, line", 8, with_rate=False),
)
TERRAIN_SETTINGS = (*SETTINGS, Setting("1 part", parts=1), Setting("4 x 4 parts", parts=4))


@dataclass(frozen=True)
class Drawn:
    """One point of the chart.

    Attributes
    ----------
    rig, setting : names; with the start of the stretch where it is not 0.
    ms : CPU milliseconds of drawing in a step of the rig, the mean.
    false, missed : over the events of the truth.
    t50_ms, t95_ms : quantiles of time errors.
    middle, line : traces of the frame rate.
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


@dataclass(frozen=True)
class Look:
    """A rig's camera over a stretch of its stream."""

    rig: Rig
    stretch: Stretch

    @property
    def step_ns(self) -> int:
        """The rig's step."""
        return self.rig.run.step_us * 1000

    def scene(self, build: Callable[..., Scene]) -> Scene:
        """Return the scene that `build(parameters, pinhole)` makes, through the rig's lens."""
        camera = self.rig.camera
        chip = CAMERA_MODELS[camera.model].chip
        return veiled(Through(camera.lens, chip, camera.size, partial(build, self.rig.scene)), camera.lens)

    def truth(self) -> Stream:
        """Return the events of the scene by point samples, or by exact drawings in finer steps."""
        samples = self.stretch.samples
        sampled = partial(SampledTerrain if _is_ground(self.rig) else SampledBodies, samples=samples)
        with self.scene(sampled if samples else _builder(self.rig, SETTINGS[0])) as scene:
            return self.events(scene, self.step_ns // self.stretch.finer, with_rate=not samples)[0]

    def events(self, scene: Scene, step_ns: int, *, with_rate: bool) -> tuple[Stream, float]:
        """Return the events of the stretch in steps of `step_ns`, and the mean CPU milliseconds a frame."""
        sensor = Sensor(quiet(self.rig.camera.sensor), self.rig.run.seed)
        frames = SceneFrames(scene, with_rate=with_rate, with_pixel_light=scene.refines)
        first_ns = round(self.stretch.start_s * 1e9)
        sensor.reset(LightFrame(0, frames.draw(first_ns).light))
        events, spent_s = [empty_events()], []
        for t_ns in range(step_ns, self.stretch.steps * self.step_ns + 1, step_ns):
            start_s = time.process_time()
            frame = frames.draw(first_ns + t_ns)
            if isinstance(scene, LightBetween):  # for drawings that another thread makes ahead
                scene.wait()
            spent_s.append(time.process_time() - start_s)
            seen = dataclasses.replace(frame, t_ns=t_ns, at=_since(first_ns, frame.at), changed=None)
            events.append(sensor.expose(seen))
        events.append(sensor.finish())
        return Stream.from_events(np.concatenate(events), *self.rig.camera.size), 1e3 * sum(spent_s) / len(spent_s)


def _since(first_ns: int, at: PixelLight | None) -> PixelLight | None:
    """Return the light of single pixels by the time since `first_ns`."""
    return None if at is None else (lambda t_ns, pixels: at(first_ns + t_ns, pixels))


def fits(rig: Rig) -> bool:
    """Return whether a rig's scene is one of bodies or terrain."""
    return isinstance(rig.scene, BodiesParameters | TerrainParameters)


def rendering_rows(rigs: Sequence[Rig], stretch: Stretch | None = None, *, as_shipped: bool = False) -> Iterator[Drawn]:
    """Yield a row for each rig, stretch, setting and window; of each rig `stretch` alone, where it is given.

    `as_shipped` leaves out all settings but the first.
    """
    for look in looks_of(rigs, stretch):
        rig, start_s = look.rig, look.stretch.start_s
        name = f"{rig.name}, {start_s:g} s" if start_s else rig.name
        truth = look.truth()
        for setting in _settings_of(look)[: 1 if as_shipped else None]:
            own_ns = round(look.step_ns * setting.step_share)
            with look.scene(_builder(rig, setting)) as drawn:
                every_ns = setting.drawn_every * own_ns or rig.run.drawing_us * 1000
                scene = drawn if 0 < every_ns <= own_ns else LightBetween(drawn, own_ns, every_ns)
                stream, frame_ms = look.events(scene, own_ns, with_rate=setting.with_rate)
                ms = frame_ms / setting.step_share
                scene.close()
            yield _compared((name, setting.name), stream, truth, ms, own_ns)
            for part, *window in look.stretch.windows:
                inside = [_inside(each, rig.camera.size, window) for each in (stream, truth)]
                yield _compared((f"{name}, {part}", setting.name), inside[0], inside[1], ms, own_ns)


def _inside(stream: Stream, size: tuple[int, int], window: Sequence[int]) -> Stream:
    """Return the events in a window: left, top, right, bottom."""
    rows, columns = np.divmod(stream.pixel, size[0])
    left, top, right, bottom = window
    return stream.where((left <= columns) & (columns < right) & (top <= rows) & (rows < bottom))


def rows_of(rigs: Sequence[Rig], stretch: Stretch | None = None, *, as_shipped: bool = False) -> int:
    """Return how many rows there will be."""
    looks = [(_settings_of(look), look.stretch.windows) for look in looks_of(rigs, stretch)]
    return sum((1 if as_shipped else len(settings)) * (1 + len(windows)) for settings, windows in looks)


def looks_of(rigs: Sequence[Rig], stretch: Stretch | None) -> Iterator[Look]:
    """Yield the stretches of each rig; `stretch` alone, where it is given."""
    for rig in rigs:
        for own in (stretch,) if stretch else _STRETCHES.get(rig.name, (Stretch(),)):
            start_s = own.start_s if own.samples else 128 * rig.run.step_us * 1e-6
            yield Look(rig, dataclasses.replace(own, start_s=start_s))


def _settings_of(look: Look) -> tuple[Setting, ...]:
    ways = TERRAIN_SETTINGS if _is_ground(look.rig) else SETTINGS
    return ways if look.stretch.samples else tuple(way for way in ways if way.with_rate and not way.parts)


def _is_ground(rig: Rig) -> bool:
    return isinstance(rig.scene, TerrainParameters)


def _builder(rig: Rig, setting: Setting) -> Callable[..., Scene]:
    by_cpu, by_gl = (RasterTerrain, GlTerrain) if _is_ground(rig) else (RasterBodies, GlBodies)
    drawn: Callable[..., Scene] = by_gl if setting.samples else by_cpu
    samples = setting.samples or setting.parts
    if not samples:
        return drawn
    return lambda parameters, pinhole: drawn(dataclasses.replace(parameters, samples=samples), pinhole)


def false_and_missed(scores: Scores) -> tuple[float, float]:
    """Return false and missed events over those of the truth, from the sum of both and the numbers of events."""
    total = max(scores.true_events, 1)
    wrong = scores.wrong_events * total if scores.true_events else scores.events
    more = scores.events - scores.true_events
    return max(wrong + more, 0.0) / 2 / total, max(wrong - more, 0.0) / 2 / total  # rounded, a 0 may be below 0


def _compared(names: tuple[str, str], stream: Stream, truth: Stream, ms: float, step_ns: int) -> Drawn:
    scores, comb = compare(stream, truth), comb_of(stream.t_us, step_ns / 1000)
    times = scores.t50_us / 1000, scores.t95_us / 1000
    return Drawn(*names, ms, *false_and_missed(scores), *times, comb.middle_share, comb.line, len(truth))
