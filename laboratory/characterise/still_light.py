"""Still light of a recording's frames: pixels that see no motion, their light, and the simulated sensor under it.

A pixel is still where averages over three successive frames and 3 x 3 pixels stay close together, over the whole
recording, in all of its neighbourhood; of these, the stiller half counts. Events have no part in the choice. The frames
of the simulated sensor run as those of the recording, so that their reads disturb its events alike.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass

import numpy as np
import numpy.typing as npt
from scipy.ndimage import maximum_filter, uniform_filter

from emulator.light import LightFrame
from emulator.sensor.frames import FrameSource
from emulator.sensor.parameters import FrameParameters
from emulator.sensor.presets import SensorParameters
from emulator.sensor.sensor import Sensor
from firmware_protocol.events import Events
from firmware_protocol.frames import FrameSettings
from firmware_protocol.recordings.part import Frame, ten_bits

REFERENCE_DN = 80.0
"""Level of a frame, of 255, that counts as light 1."""

_AVERAGED = 3  # frames
_BOX, _NEIGHBOURHOOD = 3, 9  # pixels
_LEAST_FRAMES = 12
_LEAST_DN = 0.5
_TEN_BITS = 4.0
_STEP_NS = 10_000_000
_LINES_US = 260 * 35.25  # before the exposure of a whole DAVIS346


@dataclass(frozen=True)
class StillLight:
    """Still pixels of a recording and the light on them.

    Attributes
    ----------
    level : (height, width) float32, mean of the frames, of 255.
    still : (height, width) bool, the pixels that see no motion.
    first_us : start of the first frame, from the first event on.
    interval_us, exposure_us : of the frames.
    """

    level: npt.NDArray[np.float32]
    still: npt.NDArray[np.bool_]
    first_us: int
    interval_us: int
    exposure_us: int

    @property
    def light(self) -> npt.NDArray[np.float32]:
        """Light relative to the sensor's reference, (height, width)."""
        return (np.maximum(self.level, _LEAST_DN) / REFERENCE_DN).astype(np.float32)


def still_light(frames: Sequence[Frame], begin_us: int) -> StillLight | None:
    """Return the still light of frames, of a recording whose first event lies at `begin_us`; None for too few frames.

    Frames are taken for those of a global shutter, whose exposure begins when all lines have been reset.
    """
    if len(frames) < _LEAST_FRAMES:
        return None
    levels = np.stack([ten_bits(frame) for frame in frames]).astype(np.float32) / np.float32(_TEN_BITS)
    averages = [
        uniform_filter(levels[k : k + _AVERAGED].mean(axis=0), _BOX) for k in range(len(levels) - _AVERAGED + 1)
    ]
    motion = maximum_filter(np.max(averages, axis=0) - np.min(averages, axis=0), _NEIGHBOURHOOD)
    begins = np.array([frame.exposure_begin_us for frame in frames], np.int64)
    interval_us = round(float(np.median(np.diff(begins))))
    exposure_us = frames[0].exposure_end_us - frames[0].exposure_begin_us
    first_us = (int(begins[0]) - round(_LINES_US) - begin_us) % interval_us
    return StillLight(levels.mean(axis=0), motion <= np.median(motion), first_us, interval_us, exposure_us)


def still_events(p: SensorParameters, seen: StillLight, seconds: float, seed: int = 1) -> Events:
    """Return the events of a sensor under still light, (n,) EVENT, while its frames run as those of the recording.

    Raises ValueError where the light does not have the sensor's size.
    """
    if seen.level.shape != (p.height, p.width):
        raise ValueError(f"the recording has {seen.level.shape[::-1]} pixels, the sensor {(p.width, p.height)}")
    sensor, parameters, light = Sensor(p, seed), FrameParameters(), seen.light
    frames = FrameSource(parameters, seed, (p.width, p.height), sensor.with_kicks(parameters.kicks))
    on = FrameSettings(
        run=True, exposure_ns=seen.exposure_us * 1000, interval_ns=seen.interval_us * 1000,
        last_column=p.width - 1, last_row=p.height - 1,
    )  # fmt: skip
    settings = [tuple(int(value) for value in astuple(one)) for one in (FrameSettings(), on)]
    sensor.reset(LightFrame(0, light))
    frames.reset(LightFrame(0, light))
    parts = []
    for t_ns in _step_ends_ns(seen.first_us * 1000, round(seconds * 1e9)):
        frames.read(LightFrame(t_ns, light), settings[t_ns >= seen.first_us * 1000])
        parts.append(sensor.expose(LightFrame(t_ns, light)).copy())
    return np.concatenate([*parts, sensor.finish()])


def _step_ends_ns(first_ns: int, end_ns: int) -> list[int]:
    """Return the ends of steps, one of which is the start of the first frame."""
    ends = {k * _STEP_NS for k in range(1, math.ceil(end_ns / _STEP_NS))} | {first_ns, end_ns}
    return sorted(t_ns for t_ns in ends if 0 < t_ns <= end_ns)
