"""`evstim picture SOURCE FILE`: the light and the events of a rig or of a recording as a picture or a movie."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
from cyclopts import Parameter

from emulator.cli.checks import failures, parsed_size, prepared, reading
from emulator.cli.output import GOOD, WRONG_USE, Failure, Json, console, print_json
from emulator.light import Light
from emulator.report.pictures import MOVIES, Rgb, captioned, event_picture, save_movie, save_png, scaled, white_of
from emulator.rig.loading import Rig, load_rig
from emulator.run.assembly import build_frames, build_scene, build_sensor
from emulator.run.kernels import parts_of
from firmware_protocol.events import Events, copy_events, empty_events, join_events
from transports.recording.files import OpenRecording
from transports.recording.format import is_recording
from transports.recording.part import Frame, RecordingError

_WINDOWS_MS = (20.0, 50.0, 100.0, 200.0, 500.0)  # tried in this order
_ENOUGH = 0.005  # events for each pixel of the sensor
_FPS = 25


@dataclass(frozen=True)
class PictureOptions:
    """Content of the picture.

    Attributes
    ----------
    at_s
        Stream time of the picture, or of a movie's first one, seconds; of a recording after its first event, or its end
        where it ends before.
    window_ms
        Draw the events of this time before it, milliseconds. Default: 20 to 500, as long as it takes to show some; 40
        in a movie, the time of one of its pictures.
    seconds
        Length of a movie, stream time, seconds.
    brightness
        Level of the brightest light, as a share of white.
    size
        WIDTHxHEIGHT of the sensor, such as 346x260, for recordings that do not contain it.
    """

    at_s: float = 0.5
    window_ms: float | None = None
    seconds: float = 2.0
    brightness: float = 0.4
    size: str | None = None


_DEFAULTS = PictureOptions()


Look = tuple[float, Light, Events]
"""Stream time in seconds, the light then, and the events of the window before it."""
_Looks = Callable[[PictureOptions, float], Iterator[Look]]


def picture(
    source: str, file: Path, /, *, show: Annotated[PictureOptions, Parameter(name="*")] = _DEFAULTS, json: Json = False
) -> int:
    """Write a picture (.png) or movie (.gif, .mp4): the light, ON events in orange, OFF events in blue.

    The light of a recording is that of its frames, where it has any.

    Parameters
    ----------
    source
        Path of a rig file, the name of a shipped rig, or a recording in any format that can be read.
    file
        File to write; its suffix determines the format.
    show
        Content of the picture.
    """
    if file.suffix.lower() not in (".png", *MOVIES):
        raise Failure(f"{file}: the name must end in .png, {' or '.join(MOVIES)}, got {file.suffix!r}", WRONG_USE)
    with failures(), _source(source, show) as (name, seen):
        events, description = (_movie if file.suffix.lower() in MOVIES else _still)(name, seen, file, show)
    if json:
        print_json({"rig": source, "source": source, "file": file, "events": events})
    else:
        console.print(f"{file}: {events} events {description}")
    return GOOD


@contextmanager
def _source(source: str, show: PictureOptions) -> Iterator[tuple[str, _Looks]]:
    """Return the name of a rig or recording, and the function that gives its looks."""
    path = Path(source)
    if not is_recording(path):
        rig = load_rig(source)
        prepared(parts_of(rig))
        yield rig.name, partial(looks, rig)
        return
    with reading(path), OpenRecording(path, parsed_size(show.size)) as recording:
        if recording.facts.size is None:
            raise RecordingError("it does not contain the size of its sensor: give --size, such as 346x260")
        yield path.name, partial(_recorded_looks, recording, recording.facts.size)


def _still(name: str, seen: _Looks, file: Path, show: PictureOptions) -> tuple[int, str]:
    """Write one picture; return its number of events, and a description."""
    longest_ms = show.window_ms or _WINDOWS_MS[-1]
    at_s, light, events = next(seen(dataclasses.replace(show, seconds=0.0), longest_ms))
    window_ms = show.window_ms or _window_ms(events, at_s, light.size)
    events = events[events["t"] >= _begin_us(at_s, window_ms)]
    rgb = scaled(event_picture(light, events, dimming=show.brightness))
    save_png(file, captioned(rgb, _caption(name, at_s, window_ms)))
    return len(events), f"of {window_ms:g} ms over the light at {at_s:g} s"


def _movie(name: str, seen: _Looks, file: Path, show: PictureOptions) -> tuple[int, str]:
    """Write a movie; return its number of events, and a description."""
    count, white = 0, 0.0
    window_ms = show.window_ms or 1000 / _FPS

    def drawn() -> Iterator[Rgb]:
        nonlocal count, white
        for at_s, light, events in seen(show, window_ms):
            white = white or white_of(light)
            count += len(events)
            rgb = scaled(event_picture(light, events, white=white or None, dimming=show.brightness))
            yield captioned(rgb, _caption(name, at_s, window_ms))

    save_movie(file, drawn(), _FPS)
    return count, f"in {show.seconds:g} s from {show.at_s:g} s, {_FPS} pictures a second"


def _caption(name: str, at_s: float, window_ms: float) -> str:
    return f"{name}  {at_s:.2f} s, events of {window_ms:g} ms"


def _begin_us(at_s: float, window_ms: float) -> int:
    return max(0, round(at_s * 1e6) - round(window_ms * 1000))


def _window_ms(events: Events, at_s: float, pixels: int) -> float:
    """Return the shortest window that shows enough events."""
    for window_ms in _WINDOWS_MS:
        if np.count_nonzero(events["t"] >= _begin_us(at_s, window_ms)) >= _ENOUGH * pixels:
            return window_ms
    return _WINDOWS_MS[-1]


def look(rig: Rig, at_s: float, window_ms: float) -> tuple[Light, Events]:
    """Run the scene and the sensor alone up to `at_s`; return the light then and the events of the window before."""
    return next(looks(rig, PictureOptions(at_s, seconds=0.0), window_ms))[1:]


def looks(rig: Rig, show: PictureOptions, window_ms: float, fps: int = _FPS) -> Iterator[Look]:
    """Yield the time, the light and the events of the window before it, at `at_s` and on to the end of the movie."""
    sensor = build_sensor(rig, rig.camera.sensor)
    step_ns, due_ns = rig.run.step_us * 1000, round(show.at_s * 1e9)
    end_ns = due_ns + round(show.seconds * 1e9)
    # The filter has settled and the window is full after so many steps; earlier steps would change nothing visible.
    # Counted back from the end, because a window may be shorter than a step.
    steps = min(50 + math.ceil(window_ms * 1e6 / step_ns), due_ns // step_ns)
    start_ns = due_ns - steps * step_ns
    seen = empty_events()
    with build_scene(rig) as scene:
        frames = build_frames(rig, scene)
        sensor.reset(frames.draw(start_ns))
        for t_ns in range(start_ns + step_ns, end_ns + step_ns + 1, step_ns):
            if t_ns > due_ns:
                seen = seen[seen["t"] >= _begin_us(due_ns * 1e-9, window_ms)]
                yield due_ns * 1e-9, frames.last.light.copy(), seen
                due_ns += 10**9 // fps
            if due_ns > end_ns:
                return
            seen = np.concatenate([seen, sensor.expose(frames.draw(t_ns))])


def _recorded_looks(
    recording: OpenRecording, size: tuple[int, int], show: PictureOptions, window_ms: float
) -> Iterator[Look]:
    """Yield the same of a recording, in the time since its first event; the last one where it ends."""
    due_us = round(show.at_s * 1e6)
    end_us = due_us + round(show.seconds * 1e6)
    last_us, start_us = 0, -1
    light = np.zeros(size[::-1], np.float32)
    frames, seen = list[Frame](), empty_events()

    def at(t_us: int) -> Look:
        nonlocal light
        while frames and frames[0].t_us - start_us <= t_us:
            light = frames.pop(0).pixels.astype(np.float32)
        return t_us * 1e-6, light, seen[(seen["t"] >= _begin_us(t_us * 1e-6, window_ms)) & (seen["t"] < t_us)]

    for part in recording.parts():
        frames += (frame for frame in part.frames if frame.pixels.shape == size[::-1])
        if not len(part.events):
            continue
        start_us = int(part.events["t"][0]) if start_us < 0 else start_us
        events = copy_events(part.events)
        events["t"] -= np.uint64(start_us)
        last_us = int(events["t"][-1])
        seen = join_events([seen[seen["t"] >= _begin_us(min(due_us, last_us) * 1e-6, window_ms)], events])
        while due_us <= min(last_us, end_us):
            yield at(due_us)
            due_us += 10**6 // _FPS
        if due_us > end_us:
            return
    if start_us < 0:
        raise RecordingError("holds no events")
    yield at(last_us + 1)
