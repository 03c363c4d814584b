"""Wrong events of a variant, false and missed, beside the truth of its scene by point samples.

Bodies and terrain have the truth of `accuracy.rendering`, at the stretches of the stream that stand there; a board has
its own square waves, sampled. Stars and videos have no truth that shares nothing with their renderer, and no result.

The truth is drawn for at most 346 x 260 pixels: of a larger sensor the middle is judged, with pixels and focal length
as they are. Leak and noise are off. Of several stretches the events are added up.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from emulator.evaluation.accuracy.rendering import Look, Stretch, fits, looks_of, quiet
from emulator.evaluation.accuracy.sampled_scenes import SampledBoard
from emulator.evaluation.accuracy.scores import Stream, compare
from emulator.evaluation.realtime.variants import Variant
from emulator.light import LightFrame, PixelLight, Scene
from emulator.rig.loading import Rig
from emulator.run.assembly import build_frames, build_scene, build_sensor, build_steps, planned_sensor
from emulator.scene.checkerboard.table import CheckerboardParameters
from firmware_protocol.events import empty_events

__all__ = ["Truth", "Wrong", "has_truth", "middle_of", "truth_of", "wrong_events"]

_MOST_PX = (346, 260)
_BOARD = Stretch(steps=40)


@dataclass(frozen=True)
class Wrong:
    """False and missed events over those of the truth, and the number of these."""

    false: float
    missed: float
    events: int


@dataclass(frozen=True)
class Truth:
    """The events of a rig's scene, as shipped, over some stretches of its stream."""

    looks: tuple[Look, ...]
    streams: tuple[Stream, ...]


def has_truth(rig: Rig) -> bool:
    """Return whether the scene of a rig has a truth."""
    board = isinstance(rig.scene, CheckerboardParameters) and not rig.scene.rotation_deg
    return board or fits(rig)


def truth_of(variant: Variant, stretch: Stretch | None = None) -> Truth:
    """Return the truth of a variant as shipped, in the middle of its image; over `stretch` alone, where it is given.

    Raises SceneError, and MachineLacks without a ray caster.
    """
    rig = middle_of(variant.loaded())
    is_board = isinstance(rig.scene, CheckerboardParameters)
    looks = (Look(rig, stretch or _BOARD),) if is_board else tuple(looks_of([rig], stretch))
    return Truth(looks, tuple(_board_truth(look) if is_board else look.truth() for look in looks))


def wrong_events(variant: Variant, truth: Truth) -> Wrong:
    """Return the wrong events of a variant beside the truth of the same rig and size; raises SceneError."""
    rig = middle_of(variant.loaded())
    with build_scene(rig) as scene:
        streams = [_events(rig, scene, look) for look in truth.looks]
    return _added(streams, truth.streams)


def middle_of(rig: Rig) -> Rig:
    """Return a rig with the middle of its sensor, at most 346 x 260 pixels, behind the same lens."""
    sensor, lens = rig.camera.sensor, rig.camera.lens
    width, height = min(sensor.width, _MOST_PX[0]), min(sensor.height, _MOST_PX[1])
    half = math.tan(math.radians(lens.field_of_view_deg) / 2) * width / sensor.width
    lens = dataclasses.replace(lens, field_of_view_deg=2 * math.degrees(math.atan(half)))
    sensor = dataclasses.replace(sensor, width=width, height=height)
    return dataclasses.replace(rig, camera=dataclasses.replace(rig.camera, sensor=sensor, lens=lens))


def _board_truth(look: Look) -> Stream:
    with SampledBoard(look.rig.scene, look.rig.camera.size) as scene:  # type: ignore[arg-type]
        return look.events(scene, look.step_ns // look.stretch.finer, with_rate=False)[0]


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
        frame = LightFrame(t_ns, frame.light, frame.rate, _shifted(frame.at, first_ns))
        events.append(sensor.expose(frame).copy())
        steps.observe(frame)
    events.append(sensor.finish())
    return Stream.from_events(np.concatenate(events), *rig.camera.size)


def _shifted(at: PixelLight | None, by_ns: int) -> PixelLight | None:
    return None if at is None else lambda t_ns, pixels: at(t_ns + by_ns, pixels)


def _added(streams: Sequence[Stream], truths: Sequence[Stream]) -> Wrong:
    pairs = list(zip(streams, truths, strict=True))
    total, found = sum(len(truth) for _, truth in pairs), sum(len(stream) for stream, _ in pairs)
    wrong = sum(compare(stream, truth).wrong_events * len(truth) for stream, truth in pairs if len(truth))
    wrong += sum(len(stream) for stream, truth in pairs if not len(truth))
    common = (total + found - wrong) / 2
    return Wrong((found - common) / max(total, 1), (total - common) / max(total, 1), total)
