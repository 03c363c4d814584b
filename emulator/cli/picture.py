"""`evstim picture SOURCE FILE`, `evstim play SOURCE`: light and events of a rig or recording in a file, or on a screen.

A character of the terminal shows two pixels, the upper half block U+2580 in the colour of one over that of the other
(24-bit colours: ISO 8613-6, SGR 38;2 and 48;2). The alternate screen (xterm, DECSET 1049) is left at every end, and
while the process is stopped. The window is Tk's, which comes with Python; it gets pictures as PPM.
"""

from __future__ import annotations

import dataclasses
import math
import os
import shutil
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from cyclopts import Parameter

from emulator.cli.checks import failures, prepared
from emulator.cli.output import ESCAPES, GOOD, LACKING, WRONG_USE, Failure, Flag, Json, failing, print_result
from emulator.cli.recordings import AS_IT_IS, Table, recording_of
from emulator.cli.signals import handle_suspension, ignore_stop_signals
from emulator.light import Light
from emulator.report.pictures import MOVIES, Rgb, captioned, event_picture, save_movie, save_png, scaled, white_of
from emulator.rig.loading import Rig, load_rig
from emulator.run.assembly import build_frames, build_scene, build_sensor
from emulator.run.kernels import parts_of
from firmware_protocol.events import Events, copy_events, empty_events, join_events
from firmware_protocol.recordings.part import Frame
from transports.link.pacing import MonotonicClock
from transports.recording.files import OpenRecording
from transports.recording.format import is_recording
from transports.recording.part import RecordingError

_WINDOWS_MS = (20.0, 50.0, 100.0, 200.0, 500.0)  # tried in this order
_ENOUGH = 0.005  # events for each pixel of the sensor
_LONGEST_S = 1e9
_ALLOWED = {
    "at_s": (0.0, _LONGEST_S),
    "window_ms": (0.001, 1e6),
    "seconds": (0.0, _LONGEST_S),
    "brightness": (0.0, 1.0),
    "speed": (1e-6, 1e6),
    "fps": (1, 100),
}


@Parameter(name="*")
@dataclass(frozen=True)
class PictureOptions:
    """Content of the picture.

    Attributes
    ----------
    at_s
        Stream time of the picture, or of a movie's first one, seconds; of a recording the time after its first event,
        or its end where it ends before.
    window_ms
        Draw the events of this time before it, milliseconds. Default: 20 to 500, as long as it takes to show some; in a
        movie the time from one of its pictures to the next.
    seconds
        Length of a movie, stream time, seconds.
    brightness
        Level of the brightest light, as a share of white.
    size
        WIDTHxHEIGHT of the sensor, such as 346x260, for recordings that do not contain it.
    topic
        Topic of the events, of a ROS bag with those of several cameras.
    speed
        Stream time that passes in a second of a movie, seconds.
    fps
        Pictures in a second of a movie.
    table
        Columns and times of a table of text.
    """

    at_s: float = 0.5
    window_ms: float | None = None
    seconds: float = 2.0
    brightness: float = 0.4
    size: str | None = None
    topic: str | None = None
    speed: float = 1.0
    fps: int = 25
    table: Table = AS_IT_IS

    def check(self) -> None:
        """Raise Failure for a number that is outside its range, or none."""
        for name, (low, high) in _ALLOWED.items():
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                option = name.replace("_", "-")
                raise Failure(f"--{option} must be between {low:g} and {high:g}, got {value:g}", WRONG_USE)

    @property
    def period_s(self) -> float:
        """Stream time from one picture of a movie to the next, seconds."""
        return self.speed / self.fps


@Parameter(name="*")
@dataclass(frozen=True)
class PlayOptions(PictureOptions):
    """Content of the pictures in the terminal or window.

    Attributes
    ----------
    at_s
        Stream time of the first picture, seconds.
    seconds
        Stream time to show, seconds. Default: to the end of a recording; a rig until Ctrl-C.
    """

    at_s: float = 0.0
    seconds: float = math.inf


Look = tuple[float, Light, Events]
"""Stream time in seconds, the light then, and the events of the window before it."""
_Looks = Callable[[PictureOptions, float], Iterator[Look]]
_Draw = Callable[[Light, Events], Rgb]
_Put = Callable[[Light, Events, _Draw, str, int], None]
"""Show a picture of light and events, drawn by a function, with a text, at a time in ns."""
_Screen = Callable[[MonotonicClock], AbstractContextManager[_Put]]
_LARGEST_TERMINAL = (1280, 512)  # columns and lines: a picture of 1280 x 1022 pixels, 20 MB at most
_TICK_NS = 10_000_000  # from one look at the window's keys to the next
_ENTER, _LEAVE = "\x1b[?1049h\x1b[?25l\x1b[2J", "\x1b[0m\x1b[?25h\x1b[?1049l"


def picture(source: str, file: Path, /, *, show: PictureOptions = PictureOptions(), json: Json = False) -> int:
    """Write a picture (.png) or movie (.gif, .mp4): the light, ON events in orange, OFF events in blue.

    The light of a recording is that of its frames, where it has any.

    Parameters
    ----------
    source
        Path of a rig file, the name of a shipped rig, or a recording in any format that can be read.
    file
        File to write; its suffix determines the format.
    """
    if file.suffix.lower() not in (".png", *MOVIES):
        raise Failure(f"{file}: the name must end in .png, {' or '.join(MOVIES)}, got {file.suffix!r}", WRONG_USE)
    with failures():
        events, description = draw(source, file, show)
    result = {"rig": source, "source": source, "file": file, "events": events}
    print_result(json, result, [f"{file}: {events} events {description}"])
    return GOOD


def draw(source: str, file: Path, show: PictureOptions) -> tuple[int, str]:
    """Write the picture or movie; return its number of events, and a description. Raises as `failures` expects."""
    with _source(source, show) as (name, seen):
        events, description = (_movie if file.suffix.lower() in MOVIES else _still)(name, seen, file, show)
    return events, description + (", counted from the first event" if is_recording(Path(source)) else "")


def play(
    source: str,
    /,
    *,
    out: Path | None = None,
    window: Flag = False,
    show: PlayOptions = PlayOptions(),
    json: Json = False,
) -> int:
    """Show the events of a rig or a recording in the terminal: ON events in orange, OFF events in blue, over the light.

    A rig is simulated alone, without its links; where this takes longer it is shown slower. Ctrl-C ends it.

    Parameters
    ----------
    source
        Path of a rig file, the name of a shipped rig, or a recording in any format that can be read.
    out
        Write this picture (.png) or movie (.gif, .mp4) instead, as `evstim picture` does.
    window
        Open a window instead: the space bar pauses, q ends, and so does closing it.
    """
    if show.seconds == math.inf:
        if out is not None and not is_recording(Path(source)):
            raise Failure("--out: a rig has no end: give --seconds, such as 2", WRONG_USE)
        show = dataclasses.replace(show, seconds=_LONGEST_S)
    if out is not None:
        return picture(source, out, show=show, json=json)
    if not window and (sys.stdout is None or not sys.stdout.isatty() or os.environ.get("TERM") == "dumb"):
        advice = f"`evstim picture {source} FILE.gif` writes a movie"
        raise Failure(f"stdout is not a terminal that can show pictures; {advice}", WRONG_USE)
    screen = partial(_window, _tk()) if window else _terminal
    with failures(), _source(source, show) as (name, seen):
        shown = _play(name, seen, show, screen)
    lengths = f"{shown['stream_s']:.2f} s of stream time in {shown['wall_s']:.2f} s"
    line = f"{name}: {shown['events']} events in {shown['pictures']} pictures, {lengths}"
    print_result(json, {"source": source, **shown}, [line])
    return GOOD


def _play(name: str, seen: _Looks, show: PictureOptions, screen: _Screen) -> dict[str, float]:
    """Show the pictures at their times until the last one or a signal; return their counts and lengths."""
    clock = MonotonicClock()
    period_ns = 10**9 // show.fps
    white = 0.0
    window_ms = show.window_ms or 1000 * show.period_s
    shown = {"events": 0, "pictures": 0, "stream_s": 0.0, "wall_s": 0.0}
    with ExitStack() as stack:
        try:
            for at_s, light, events in seen(show, window_ms):
                if not shown["pictures"]:
                    begin_ns = due_ns = clock.now_ns()
                    put = stack.enter_context(screen(clock))
                white = white or white_of(light)
                draw = partial(event_picture, white=white or None, dimming=show.brightness)
                put(light, events, draw, _caption(name, at_s, window_ms), due_ns)
                now_ns = clock.now_ns()
                due_ns = max(due_ns, now_ns - period_ns) + period_ns  # one that is late delays those after it
                shown["events"] += len(events)
                shown["pictures"] += 1
                shown |= {"stream_s": at_s - show.at_s, "wall_s": (now_ns - begin_ns) * 1e-9}
        except KeyboardInterrupt:
            ignore_stop_signals()
    return shown


@contextmanager
def _terminal(clock: MonotonicClock) -> Iterator[_Put]:
    """Show pictures in the terminal, as large as they fit into it then; the shell's text and cursor come back."""

    def put(light: Light, events: Events, draw: _Draw, caption: str, due_ns: int) -> None:
        columns, rows = np.minimum(shutil.get_terminal_size(), _LARGEST_TERMINAL).tolist()
        lines = _characters(draw(*_reduced(light, events, columns, 2 * (rows - 1))), columns, rows)
        clock.sleep_until(due_ns)
        sys.stdout.write(lines + caption[: columns - 1] + "\x1b[J")
        sys.stdout.flush()

    # Not through the stream: a signal may interrupt a write to it.
    handle_suspension(*(partial(os.write, 1, text.encode()) for text in (_LEAVE, _ENTER)))
    sys.stdout.write(_ENTER)
    try:
        yield put
    finally:
        signal.signal(signal.SIGTSTP, signal.SIG_DFL)
        sys.stdout.write(_LEAVE)
        sys.stdout.flush()


def _tk() -> Any:
    """Return a window of Tk that is not shown yet; raises Failure where Tk or a display is missing."""
    with failing(LACKING, ImportError, at="--window needs Python's tkinter (Debian: apt-get install python3-tk)"):
        from tkinter import TclError, Tk
    with failing(LACKING, TclError, at="--window needs a display: set DISPLAY, or play in the terminal without it"):
        root = Tk(className="evstim")
    root.withdraw()
    return root


@contextmanager
def _window(root: Any, clock: MonotonicClock) -> Iterator[_Put]:
    """Show pictures in a window; the space bar pauses, q or closing it raises KeyboardInterrupt."""
    from tkinter import Label, PhotoImage

    pressed = {"space": False, "q": False}
    label, image = Label(root, bg="black", fg="white", compound="top"), PhotoImage(master=root, format="PPM")
    label.pack()
    root.bind("<space>", lambda _: pressed.update(space=not pressed["space"]))
    root.bind("q", lambda _: pressed.update(q=True))
    root.protocol("WM_DELETE_WINDOW", lambda: pressed.update(q=True))
    root.deiconify()

    def put(light: Light, events: Events, draw: _Draw, caption: str, due_ns: int) -> None:
        rgb = scaled(draw(light, events))
        root.update()
        while not pressed["q"] and ((now_ns := clock.now_ns()) < due_ns or pressed["space"]):
            clock.sleep_until(now_ns + _TICK_NS if pressed["space"] else min(due_ns, now_ns + _TICK_NS))
            root.update()
        if pressed["q"]:
            raise KeyboardInterrupt
        image.configure(data=b"P6 %d %d 255\n" % (rgb.shape[1], rgb.shape[0]) + rgb.tobytes())
        label.configure(image=image, text=caption)
        root.update()

    try:
        yield put
    finally:
        root.destroy()


def _reduced(light: Light, events: Events, columns: int, rows: int) -> tuple[Light, Events]:
    """Return light and events on at most so many pixels: the brightest light of a block, and all its events."""
    height, width = light.shape
    share = min(1.0, columns / width, rows / height)
    y, x = (np.arange(max(1, int(count * share))) * count // max(1, int(count * share)) for count in light.shape)
    reduced = copy_events(events)
    reduced["y"] = np.searchsorted(y, events["y"], "right") - 1
    reduced["x"] = np.searchsorted(x, events["x"], "right") - 1
    return np.maximum.reduceat(np.maximum.reduceat(light, y, axis=0), x, axis=1), reduced


def _characters(rgb: Rgb, columns: int, rows: int) -> str:
    """Return the lines of half blocks that show a picture in a terminal of this size, from its top on."""
    height, width = rgb.shape[:2]
    factor = max(1, min(columns // width, 2 * (rows - 1) // height))
    rgb = rgb.repeat(factor, axis=0).repeat(factor, axis=1)
    rgb = np.concatenate([rgb, np.zeros((len(rgb) % 2, *rgb.shape[1:]), np.uint8)])
    lines = []
    for upper, lower in zip(rgb[::2].tolist(), rgb[1::2].tolist(), strict=True):
        line, before = "", None
        for pair in zip(upper, lower, strict=True):
            if pair != before:
                (r, g, b), (r2, g2, b2) = before = pair
                line += f"\x1b[38;2;{r};{g};{b};48;2;{r2};{g2};{b2}m"
            line += "\u2580"
        lines.append(line + "\x1b[0m\x1b[K\n")
    return "\x1b[H" + "".join(lines)


@contextmanager
def _source(source: str, show: PictureOptions) -> Iterator[tuple[str, _Looks]]:
    """Return the name of a rig or recording, and the function that gives its looks; raises Failure."""
    show.check()
    path = Path(source)
    if not is_recording(path):
        if show.table != AS_IT_IS:
            raise Failure("--columns and --time-unit are for tables of text, not for a rig", WRONG_USE)
        rig = load_rig(source)
        prepared(parts_of(rig))
        yield rig.name, partial(looks, rig)
        return
    with recording_of(path, show.size, show.table, show.topic) as recording:
        if recording.facts.size is None:
            raise RecordingError("it does not contain the size of its sensor: give --size, such as 346x260")
        yield path.name, partial(_recorded_looks, recording, recording.facts.size)


def _still(name: str, seen: _Looks, file: Path, show: PictureOptions) -> tuple[int, str]:
    """Write one picture; return its number of events, and a description."""
    longest_ms = show.window_ms or _WINDOWS_MS[-1]
    at_s, light, events = next(seen(dataclasses.replace(show, seconds=0.0), longest_ms))
    counts = ((ms, np.count_nonzero(events["t"] >= _begin_us(at_s, ms))) for ms in _WINDOWS_MS)
    enough = next((ms for ms, count in counts if count >= _ENOUGH * light.size), longest_ms)
    window_ms = show.window_ms or enough
    events = events[events["t"] >= _begin_us(at_s, window_ms)]
    rgb = scaled(event_picture(light, events, dimming=show.brightness))
    save_png(file, captioned(rgb, _caption(name, at_s, window_ms)))
    place = "over the light at" if light.any() else "before"
    return len(events), f"of {_length(window_ms)} {place} {at_s:g} s"


def _movie(name: str, seen: _Looks, file: Path, show: PictureOptions) -> tuple[int, str]:
    """Write a movie; return its number of events, and a description."""
    count = pictures = 0
    white = 0.0
    window_ms = show.window_ms or 1000 * show.period_s

    def drawn() -> Iterator[Rgb]:
        nonlocal count, pictures, white
        for at_s, light, events in seen(show, window_ms):
            white = white or white_of(light)
            count += len(events)
            pictures += 1
            rgb = scaled(event_picture(light, events, white=white or None, dimming=show.brightness))
            yield captioned(rgb, _caption(name, at_s, window_ms))

    save_movie(file, drawn(), show.fps)
    return count, f"in {pictures} pictures from {show.at_s:g} s on, {show.fps} a second"


def _caption(name: str, at_s: float, window_ms: float) -> str:
    return f"{name.translate(ESCAPES)}  {at_s:.2f} s, events of {_length(window_ms)}"


def _length(window_ms: float) -> str:
    return f"{window_ms:g} ms" if window_ms < 1000 else f"{window_ms / 1000:g} s"


def _begin_us(at_s: float, window_ms: float) -> int:
    return max(0, round(at_s * 1e6) - round(window_ms * 1000))


def looks(rig: Rig, show: PictureOptions, window_ms: float) -> Iterator[Look]:
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
            while t_ns > due_ns:
                seen = seen[seen["t"] >= _begin_us(due_ns * 1e-9, window_ms)]
                yield due_ns * 1e-9, frames.last.light.copy(), seen
                due_ns += round(show.period_s * 1e9)
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
            due_us += max(1, round(show.period_s * 1e6))
        if due_us > end_us:
            return
    if start_us < 0:
        raise RecordingError("it holds no events: there is nothing to draw")
    yield at(last_us + 1)
