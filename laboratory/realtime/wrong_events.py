"""Wrong events of a variant, false and missed, beside the truth of its scene by rays.

Bodies and terrain have the truth of `accuracy.rendering`, at the stretches of the stream that stand there; a board has
its own square waves, sampled. Stars and videos have no truth that shares nothing with their renderer, and no result.

The truth is drawn for at most 346 x 260 pixels: of a larger sensor the middle is judged, with pixels and focal length
as they are. Leak and noise are off. Several stretches are judged as one stream of all their pixels.
A truth takes minutes, so it can be stored.
"""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np

from emulator.light import LightFrame, PixelLight, Scene
from emulator.rig.loading import Rig
from emulator.run.assembly import build_frames, build_scene, build_sensor, build_steps, planned_sensor
from emulator.run.tuning import quiet
from emulator.scene.checkerboard.table import CheckerboardParameters
from firmware_protocol.events import empty_events
from laboratory.accuracy.rendering import Look, Stretch, comb_of, false_and_missed, fits, looks_of
from laboratory.accuracy.sampled_scenes import SampledBoard
from laboratory.accuracy.scores import Stream, compare
from laboratory.realtime.variants import Variant

_MOST_PX = (346, 260)
TRUTH = "rays to the eye, and to the Sun from .002 of a side"  # in the keys of stored results: others are not used
_BOARD = Stretch(steps=40)


@dataclass(frozen=True)
class Wrong:
    """Errors of the events of a variant; `accuracy.rendering` defines each.

    Attributes
    ----------
    false, missed : over the events of the truth.
    events : of the truth.
    t50_ms, t95_ms : quantiles of time errors; None where no pixel has the true sequence.
    middle : share of the events in the middle twentieth of the rig's shipped step.
    """

    false: float
    missed: float
    events: int
    t50_ms: float | None
    t95_ms: float | None
    middle: float | None


@dataclass(frozen=True)
class Truth:
    """The events of a rig's scene, as shipped, over some stretches of its stream."""

    looks: tuple[Look, ...]
    streams: tuple[Stream, ...]


def has_truth(rig: Rig) -> bool:
    """Return whether the scene of a rig has a truth."""
    board = isinstance(rig.scene, CheckerboardParameters) and not rig.scene.rotation_deg
    return board or fits(rig)


def truth_of(variant: Variant, stretch: Stretch | None = None, folder: Path | None = None) -> Truth:
    """Return the truth of a variant as shipped, in the middle of its image; over `stretch` alone, where it is given.

    It is stored in `folder`, and read from there the next time. Raises SceneError, MachineLacks without a ray caster,
    and OSError.
    """
    rig = middle_of(variant.loaded())
    looks = tuple(looks_of([rig], stretch)) if fits(rig) else (Look(rig, stretch or _BOARD),)
    if folder is None:
        return Truth(looks, tuple(map(_true_events, looks)))
    folder.mkdir(parents=True, exist_ok=True)
    stored = (folder / f"{variant.rig}-{variant.size.name}-{_digest(variant, look)}.npz" for look in looks)
    return Truth(looks, tuple(map(_stored, looks, stored)))


def _digest(variant: Variant, look: Look) -> str:
    text = f"{version('evstim')} {TRUTH} {_MOST_PX} {look.stretch}\n{variant.text(0)}"
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _stored(look: Look, path: Path) -> Stream:
    """Return the true events of a stretch from a file, which is written where it is missing."""
    if not path.exists():
        stream = _true_events(look)
        part = path.with_suffix(".part")
        with part.open("wb") as file:
            np.savez_compressed(file, t_us=stream.t_us, on=stream.on, first=stream.first)
        part.replace(path)  # an interrupt leaves no half of a file
    with np.load(path) as arrays:
        return Stream(arrays["t_us"], arrays["on"], arrays["first"])


def _true_events(look: Look) -> Stream:
    if fits(look.rig):
        return look.truth()
    with SampledBoard(look.rig.scene, look.rig.camera.size) as scene:  # type: ignore[arg-type]
        return look.events(scene, look.step_ns // look.stretch.finer, with_rate=False)[0]


def wrong_events(variant: Variant, truth: Truth) -> Wrong:
    """Return the wrong events of a variant beside the truth of the same rig and size; raises SceneError."""
    rig = middle_of(variant.loaded())
    with build_scene(rig) as scene:
        streams = [_events(rig, scene, look) for look in truth.looks]
    return _compared(_joined(streams), _joined(truth.streams), truth.looks[0].step_ns)


def middle_of(rig: Rig) -> Rig:
    """Return a rig with the middle of its sensor, at most 346 x 260 pixels, behind the same lens."""
    sensor, lens = rig.camera.sensor, rig.camera.lens
    width, height = min(sensor.width, _MOST_PX[0]), min(sensor.height, _MOST_PX[1])
    half = math.tan(math.radians(lens.field_of_view_deg) / 2) * width / sensor.width
    lens = dataclasses.replace(lens, field_of_view_deg=2 * math.degrees(math.atan(half)))
    sensor = dataclasses.replace(sensor, width=width, height=height)
    return dataclasses.replace(rig, camera=dataclasses.replace(rig.camera, sensor=sensor, lens=lens))


def _events(rig: Rig, scene: Scene, look: Look) -> Stream:
    """Return the events of a stretch in the steps of `rig`, as a session makes them."""
    parameters, frames = quiet(planned_sensor(rig, scene)), build_frames(rig, scene)
    sensor, steps = build_sensor(rig, parameters), build_steps(rig, frames, parameters)
    first_ns, end_ns = round(look.stretch.start_s * 1e9), look.stretch.steps * look.step_ns
    frame = frames.draw(first_ns)
    sensor.reset(LightFrame(0, frame.light))
    steps.observe(LightFrame(0, frame.light, frame.rate))
    events, t_ns = [empty_events()], 0
    while t_ns < end_ns:
        t_ns = min(t_ns + steps.step_ns, end_ns)
        frame = frames.draw(first_ns + t_ns)
        frame = dataclasses.replace(frame, t_ns=t_ns, at=_shifted(frame.at, first_ns), changed=None)
        events.append(sensor.expose(frame).copy())
        steps.observe(frame)
    events.append(sensor.finish())
    return Stream.from_events(np.concatenate(events), *rig.camera.size)


def _shifted(at: PixelLight | None, by_ns: int) -> PixelLight | None:
    return None if at is None else lambda t_ns, pixels: at(t_ns + by_ns, pixels)


def _joined(streams: Sequence[Stream]) -> Stream:
    """Return streams as one of all their pixels."""
    starts = np.cumsum([0, *map(len, streams)])
    firsts = [stream.first[:-1] + start for stream, start in zip(streams, starts[:-1], strict=True)]
    times, signs = (np.concatenate([getattr(stream, name) for stream in streams]) for name in ("t_us", "on"))
    return Stream(times, signs, np.concatenate([*firsts, starts[-1:]]).astype(np.int64))


def _compared(stream: Stream, truth: Stream, step_ns: int) -> Wrong:
    scores, middle = compare(stream, truth), comb_of(stream.t_us, step_ns / 1000).middle_share
    return Wrong(
        *false_and_missed(scores), len(truth), *map(_finite, (scores.t50_us / 1000, scores.t95_us / 1000, middle))
    )


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
