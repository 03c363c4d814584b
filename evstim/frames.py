"""Frames with times in, events out, in one call; and the log light that follows from events.

Between two frames the photocurrent of each pixel (light plus dark current) follows a straight line in its logarithm, as
in v2e and in `[scene] kind = "video"`. The time between two frames is divided into steps of `step_us`, so that the
pixel's low-pass filter sees the same light however far apart the frames are.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any, Literal, Unpack

import numpy as np
import numpy.typing as npt

from emulator.scene.video.video import linear_light, read_frames, resampled
from emulator.sensor.presets import SensorParameters
from evstim.sensor import Sensor, SensorOptions
from firmware_protocol.bounds import whole_number
from firmware_protocol.events import Events, Float32s, Floats, empty_events

_MOST_STEP_US = 1_000_000
_LEAST_INTERVAL_US, _SHORT_INTERVAL_US = 1.0, 10.0  # 1e6 and 1e5 frames a second
_BRIGHT = 20.0  # times white

Levels = Literal["linear", "srgb"]


@dataclass(frozen=True)
class _Conversion:
    """Conversion of frames to light and events; see `events_from_frames` for the fields."""

    sensor: str | SensorParameters
    levels: Levels | None
    light_at_white: float | None
    step_us: int
    seed: int

    def __post_init__(self) -> None:
        if self.levels not in (None, "linear", "srgb"):
            raise ValueError(f'levels is {self.levels!r}: "linear" or "srgb" is needed')
        whole_number("step_us", self.step_us, 1, _MOST_STEP_US)
        white = self.light_at_white
        if white is not None and not (white > 0 and np.isfinite(white)):
            raise ValueError(f"light_at_white is {white}: it must be above 0")


def events_from_frames(  # noqa: PLR0913 - one call that names all it needs
    frames: Iterable[npt.ArrayLike],
    t_us: npt.ArrayLike,
    *,
    sensor: str | SensorParameters = "davis346",
    levels: Levels | None = None,
    light_at_white: float | None = None,
    step_us: int = 1000,
    seed: int = 0,
    **parameters: Unpack[SensorOptions],
) -> Events:
    """Return the events of a sensor that sees the frames.

    Warns of frames less than 10 us apart, such as times in milliseconds, and of floats far above white, such as levels.

    Parameters
    ----------
    frames : (n, height, width), or any iterable of n such frames; the sensor has their size. Floats are linear light,
        1.0 being white; uint8 and uint16 are levels from 0 to their full scale.
    t_us : (n,) int64, time of each frame, us, growing, >= 0.
    sensor : name of a preset, or SensorParameters, whose pixels and read-out are used.
    levels : needed for integer frames: "srgb", decoded by the sRGB curve, for nearly all videos and images; "linear",
        proportional to light, for raw values of a sensor.
    light_at_white : light of 1.0, or of the full scale, relative to the sensor's reference level; left out: 1.0.
    step_us : longest step of the simulation between two frames, us.
    seed : seed of everything random.
    parameters : fields of SensorParameters, such as `threshold_on=0.2`; see `SensorOptions`.

    Returns
    -------
    (n,) EVENT: t in us, x, y, on; sorted by t.

    Raises
    ------
    ValueError, TypeError
        An argument does not fit; the message names it.
    """
    return _events(frames, _times(t_us), _Conversion(sensor, levels, light_at_white, step_us, seed), parameters)


def _events(frames: Iterable[npt.ArrayLike], rounded_ns: Floats, how: _Conversion, parameters: SensorOptions) -> Events:
    times_ns, lights = _times_ns(rounded_ns), _lights(frames, how.levels, how.light_at_white)
    first = next(lights, None)
    if first is None:
        raise ValueError("frames is empty: at least one frame is needed")
    sized: SensorOptions = {"width": first.shape[1], "height": first.shape[0], **parameters}
    simulated = Sensor(how.sensor, seed=how.seed, **sized)
    if simulated.size != first.shape[::-1]:
        raise ValueError(
            f"the frames have the shape {first.shape}, the sensor {simulated.size[::-1]}: leave width and height out, "
            "the sensor then has the frames' size"
        )
    parts = list(_exposed(simulated, chain([first], lights), times_ns, int(how.step_us) * 1000))
    return np.concatenate(parts) if parts else empty_events()


def events_from_video(  # noqa: PLR0913 - one call that names all it needs
    path: str | Path,
    *,
    frames_per_s: float = 30.0,
    sensor: str | SensorParameters = "davis346",
    levels: Levels = "srgb",
    light_at_white: float | None = None,
    step_us: int = 1000,
    seed: int = 0,
    **parameters: Unpack[SensorOptions],
) -> Events:
    """Return the events of a sensor that sees a video, a folder of images or a .npy file.

    Parameters
    ----------
    path : the file or folder; see `emulator.scene.video.video` for the formats.
    frames_per_s : frame rate of a file that has no times of its own.
    sensor, levels, light_at_white, step_us, seed : as in `events_from_frames`.
    parameters : as in `events_from_frames`; frames are resampled to `width` and `height`, by default their own size.

    Raises
    ------
    SceneError
        The file cannot be read.
    """
    if not (frames_per_s > 0 and np.isfinite(frames_per_s)):
        raise ValueError(f"frames_per_s is {frames_per_s}: it must be above 0")
    how = _Conversion(sensor, None, light_at_white, step_us, seed)
    video = read_frames(Path(path))
    for note in video.notes:
        warnings.warn(note, stacklevel=2)
    count, rows, columns = video.levels.shape
    times_s = np.arange(count) / frames_per_s if video.times_s is None else np.asarray(video.times_s)
    size = parameters.get("width", columns), parameters.get("height", rows)
    is_linear = levels == "linear" or video.levels.dtype.kind == "f"
    lights = (resampled(linear_light(f, video.full_scale, is_linear=is_linear), size) for f in video.levels)
    return _events(lights, times_s * 1e6, how, parameters)


def _times(t_us: npt.ArrayLike) -> Floats:
    """Return times of frames, us; warns of floats, which are accepted for one version."""
    times = np.asarray(t_us)
    if times.size and times.dtype.kind == "f":
        warnings.warn(
            "t_us holds floats: give whole microseconds, such as np.rint(1e6 * times_s).astype(np.int64); floats go "
            "with the next version",
            DeprecationWarning,
            stacklevel=3,
        )
    elif times.size and times.dtype.kind not in "iu":
        raise TypeError(f"t_us is an array of {times.dtype}: whole microseconds are needed, int64")
    return times.astype(np.float64)


def _times_ns(times: Floats) -> list[int]:
    if times.ndim != 1:
        raise ValueError(f"t_us has the shape {times.shape}: one time for each frame is needed, (n,)")
    if not (np.isfinite(times).all() and (times >= 0).all()):
        raise ValueError("t_us holds a time that is negative or not finite")
    whole_number("t_us", int(times.max(initial=0)))
    _check_growth(times, times)
    if times.size > 1:
        _check_interval(float(times[-1] - times[0]) / (times.size - 1))
    rounded_ns = np.rint(times * 1000).astype(np.int64)
    _check_growth(times, rounded_ns)
    return [int(t) for t in rounded_ns]


def _check_growth(times: Floats, rounded: npt.NDArray[Any]) -> None:
    stuck = np.flatnonzero(np.diff(rounded) <= 0)
    if stuck.size:
        k = int(stuck[0]) + 1
        raise ValueError(f"t_us[{k}] is {times[k]:.12g}, the one before it {times[k - 1]:.12g}: times must grow")


def _check_interval(interval_us: float) -> None:
    """Raise ValueError, or warn, for frames that are so close together that their times may be seconds."""
    message = (
        f"t_us: the frames are {interval_us:.3g} us apart, {1e6 / interval_us:.3g} frames a second. Times are in "
        "microseconds: for times in seconds write t_us = np.rint(1e6 * times_s).astype(np.int64), for milliseconds "
        "1e3 * times_ms"
    )
    if interval_us < _LEAST_INTERVAL_US:
        raise ValueError(message)
    if interval_us < _SHORT_INTERVAL_US:
        warnings.warn(message, stacklevel=5)


def _lights(frames: Iterable[npt.ArrayLike], levels: Levels | None, light_at_white: float | None) -> Iterator[Float32s]:
    """Yield each frame as linear light relative to the reference level; all have the size of the first."""
    shape: tuple[int, ...] | None = None
    warned = light_at_white is not None  # the caller has then chosen the scale
    for k, frame in enumerate(frames):
        values = _frame(frame, k, shape)
        shape = values.shape
        if values.dtype.kind == "f" and not warned:
            warned = _warn_of_levels(values, k)
        yield np.asarray(_light(values, k, levels) * (light_at_white or 1.0), np.float32)


def _frame(frame: npt.ArrayLike, k: int, shape: tuple[int, ...] | None) -> npt.NDArray[Any]:
    """Return frame `k`, (height, width); raises ValueError where it has another shape than those before it."""
    try:
        values = np.asarray(frame)
    except ValueError as error:  # rows of several lengths
        raise ValueError(f"frame {k} is no array: {error}") from error
    if values.ndim != 2 or not values.size:
        raise ValueError(f"frame {k} has the shape {values.shape}: (height, width) is needed, without colours")
    if shape is not None and values.shape != shape:
        raise ValueError(
            f"frame {k} has the shape {values.shape}, those before it {shape}: all frames must have the same "
            "(height, width); crop or resize them"
        )
    return values


def _light(values: npt.NDArray[Any], k: int, levels: Levels | None) -> npt.NDArray[Any]:
    """Return frame `k` as linear light, white 1."""
    if values.dtype.kind == "f":
        if levels == "srgb":
            raise TypeError(f'frame {k} is {values.dtype}: levels = "srgb" is for uint8 and uint16')
        return values
    if values.dtype not in (np.uint8, np.uint16):
        raise TypeError(f"frame {k} is {values.dtype}: floats (linear light), uint8 or uint16 are needed")
    if levels is None:
        raise ValueError(
            f'levels is missing, and frame {k} is {values.dtype}: write levels="srgb" for videos and images, which are '
            'coded by the sRGB curve, or levels="linear" for raw values of a sensor, which are proportional to light'
        )
    return linear_light(values, float(np.iinfo(values.dtype).max), is_linear=levels == "linear")


def _warn_of_levels(values: npt.NDArray[Any], k: int) -> bool:
    """Return True, and warn, for a frame of floats that is far brighter than white, as levels are."""
    brightest = float(values.max())
    if not brightest > _BRIGHT:
        return False
    warnings.warn(
        f"frame {k} reaches {brightest:g}: floats are linear light, 1.0 being white. For levels of 8 bits give uint8 "
        'frames and levels="srgb" or "linear"; for light, write the light of white: light_at_white=1.0',
        stacklevel=5,
    )
    return True


def _exposed(sensor: Sensor, lights: Iterator[Float32s], times_ns: list[int], step_ns: int) -> Iterator[Events]:
    """Yield the events between each two frames, and those that remain."""
    dark = np.float32(sensor.parameters.dark_current_relative)
    before: Float32s | None = None
    count = 0
    for light in lights:
        if count == len(times_ns):
            raise ValueError(f"there are more frames than t_us ({count})")
        if before is None:
            sensor.reset(light, times_ns[0])
        else:
            for t_ns, between in _between(before, light, times_ns[count - 1], times_ns[count], step_ns, dark):
                yield sensor.expose(between, t_ns)
        before, count = light, count + 1
    if count < len(times_ns):
        raise ValueError(f"there are {count} frames and {len(times_ns)} t_us")
    yield sensor.finish()


def _between(
    a: Float32s, b: Float32s, a_ns: int, b_ns: int, step_ns: int, dark: np.float32
) -> Iterator[tuple[int, Float32s]]:
    """Yield times and light on a straight line in log photocurrent, from after `a` up to and with `b`."""
    steps = -(-(b_ns - a_ns) // step_ns)
    with np.errstate(invalid="ignore", divide="ignore"):  # the sensor refuses values that are not light
        log_a, log_b = np.log(a + dark), np.log(b + dark)
    for k in range(1, steps):
        share = np.float32(k / steps)
        current = np.exp((1 - share) * log_a + share * log_b)
        yield a_ns + (b_ns - a_ns) * k // steps, np.maximum(current - dark, np.float32(0))
    yield b_ns, b


def reconstruct(
    events: Events,
    log_light: npt.ArrayLike,
    *,
    threshold_on: npt.ArrayLike,
    threshold_off: npt.ArrayLike,
    t_us: int | None = None,
) -> Floats:
    """Return the logarithm of light after the events up to `t_us`, (height, width).

    It starts with a known light and adds a threshold for each event.

    Parameters
    ----------
    events : (n,) EVENT.
    log_light : (height, width), natural logarithm of the light before the first event.
    threshold_on, threshold_off : contrast thresholds, natural-log units; one number, or (height, width).
    t_us : time up to which events count, us; None: all events.

    Raises
    ------
    ValueError
        An event lies outside the array, or a shape does not fit.
    """
    start = np.asarray(log_light, np.float64)
    if start.ndim != 2:
        raise ValueError(f"log_light has the shape {start.shape}: (height, width) is needed")
    height, width = start.shape
    if len(events) and (events["x"].max() >= width or events["y"].max() >= height):
        raise ValueError(f"there are events outside the {width} x {height} array")
    on, off = (np.broadcast_to(np.asarray(t, np.float64), start.shape).ravel() for t in (threshold_on, threshold_off))
    counted = events if t_us is None else events[events["t"] <= whole_number("t_us", t_us, 0)]
    pixel = counted["y"].astype(np.int64) * width + counted["x"]
    steps = np.where(counted["on"], on[pixel], -off[pixel])
    return start + np.bincount(pixel, steps, minlength=start.size).reshape(start.shape)
