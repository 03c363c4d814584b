"""A video as a scene: frames with times, joined in the logarithm of light.

Between two frames each pixel's light follows a straight line in log, so its rate is exact; before the first frame and
after the last it stands still, or starts again. Frames of another size than the sensor's are resampled by area in
linear light. Darkness is held `floor` above zero, because zero has no logarithm.

A video with 8 bits is a poor scene for an event sensor, which `notes` reports: from one level to the next light steps
by a ratio that is large where it is dark, and wherever that ratio is more than a threshold a pixel fires at steps that
only the file has.
"""

from __future__ import annotations

import bisect
import math
from abc import abstractmethod
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import ClassVar, Literal, Self

import numpy as np
import numpy.typing as npt

from emulator.light import Light, Scene, SceneError
from emulator.scene.kind import SceneKind
from emulator.scene.video.frames import VIDEO_SUFFIXES, Frames, linear_light, read_frames
from emulator.tables.typed_table import NO_FILE, RigFile
from transports.needs import Need, package

_Float32s = npt.NDArray[np.float32]

_TYPICAL_THRESHOLD = 0.2


@dataclass(frozen=True)
class VideoParameters:
    """A video or a sequence of images.

    Attributes
    ----------
    path
        A folder of images, a .npy array, an animation or a video, beside the rig file.
    frames_per_s
        Frame rate, used where the file gives no times of its own.
    levels
        "srgb": decoded by the sRGB curve; "linear": proportional to light, as floats always are.
    light_at_white
        Light of white relative to the sensor's reference level.
    floor
        Light of black, as a share of white.
    time_scale
        Speed relative to the recording.
    loop
        True: the video starts again at its end; false: the last frame stays.
    """

    kind: ClassVar[str] = "video"
    path: RigFile = NO_FILE
    frames_per_s: float = 30.0
    levels: Literal["srgb", "linear"] = "srgb"
    light_at_white: float = 1.0
    floor: float = 1e-3
    time_scale: float = 1.0
    loop: bool = True

    def __post_init__(self) -> None:
        if not self.path:
            raise ValueError("path is missing: name a folder of images, a .npy file or a video")
        bounds = {
            "frames_per_s": (1e-3, 1e6),
            "light_at_white": (1e-9, 1e9),
            "floor": (1e-6, 1.0),
            "time_scale": (1e-6, 1e6),
        }
        for name, (low, high) in bounds.items():
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"{name} is {getattr(self, name)}: it must be {low:g} to {high:g}")


def coarsest_level(full_scale: float, floor: float, *, is_linear: bool, threshold: float) -> int:
    """Return the level below which one level is a step of more than `threshold` in log light."""
    levels = np.arange(int(full_scale) + 1)
    log_light = np.log(linear_light(levels, full_scale, is_linear=is_linear) + np.float32(floor))
    coarse = np.flatnonzero(np.diff(log_light) > threshold)
    return int(coarse[-1]) + 1 if coarse.size else 0


def _needs(parameters: VideoParameters) -> tuple[Need, ...]:
    suffix = Path(parameters.path).suffix.lower()
    return () if suffix == ".npy" else (package("av" if suffix in VIDEO_SUFFIXES else "pillow"),)


@dataclass(frozen=True, eq=False)
class Around:
    """Log light (height, width) of the frames around a time, the share of the later one, and their gap in s."""

    before: _Float32s
    after: _Float32s
    share: np.float32
    apart_s: float

    @classmethod
    def still(cls, log_light: _Float32s) -> Self:
        """Return one frame that does not change."""
        return cls(log_light, log_light, np.float32(0), 0.0)

    def light(self, out: Light) -> None:
        """Write the light."""
        np.exp((1 - self.share) * self.before + self.share * self.after, out=out)


class JoinedFrames(Scene):
    """Frames with times on a sensor of `size` = (width, height), joined by straight lines in log light."""

    def __init__(self, size: tuple[int, int]) -> None:
        self._size = size

    @abstractmethod
    def _around(self, t_ns: int) -> Around:
        """Return the frames around `t_ns`."""

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self._size

    @property
    def motion_bound_px_s(self) -> float:
        """Infinite: frames carry no motion bound."""
        return math.inf

    def light(self, t_ns: int, out: Light) -> None:
        """Write the light at `t_ns`."""
        self._around(t_ns).light(out)

    @property
    def has_rate(self) -> bool:
        """True: the light between two frames is in closed form."""
        return True

    def light_and_rate(self, t_ns: int, light: Light, rate: Light) -> None:
        """Write the light and its time derivative, both exact for a straight line in log."""
        around = self._around(t_ns)
        around.light(light)
        if around.apart_s:
            np.multiply(light, (around.after - around.before) / np.float32(around.apart_s), out=rate)
        else:
            rate.fill(0)


VIDEO = SceneKind(VideoParameters, "emulator.scene.video.video:Video", needs=_needs)


class Video(JoinedFrames):
    """The video of `parameters` on a sensor of `size` = (width, height); raises SceneError."""

    def __init__(self, parameters: VideoParameters, size: tuple[int, int]) -> None:
        super().__init__(size)
        self._p = parameters
        self._frames = read_frames(Path(parameters.path))
        self._times_ns = _times_ns(self._frames, parameters)
        self._round_ns = _round_ns(self._times_ns)
        self._is_linear = parameters.levels == "linear" or self._frames.levels.dtype.kind == "f"
        self._kept: dict[int, _Float32s] = {}

    @property
    def notes(self) -> tuple[str, ...]:
        """Remarks for the user on false events from the bit depth of the frames."""
        levels = self._frames.levels
        if levels.dtype.kind == "f":
            return ()
        scale = self._frames.full_scale
        coarse = coarsest_level(scale, self._p.floor, is_linear=self._is_linear, threshold=_TYPICAL_THRESHOLD)
        share = float((levels[0] < coarse).mean())
        if not share:
            return ()
        return (
            f"{levels.dtype.itemsize * 8}-bit frames: below level {coarse} of {scale:.0f} ({share:.0%} of the first "
            f"frame's pixels) one level is a step of more than {_TYPICAL_THRESHOLD} in log light, and fires events "
            "that are not in the scene",
        )

    def close(self) -> None:
        """Let go of the frames that are decoded."""
        self._kept.clear()

    def _around(self, t_ns: int) -> Around:
        t_ns = int(t_ns) % self._round_ns if self._p.loop else int(t_ns)
        times = self._times_ns
        k = bisect.bisect_right(times, t_ns) - 1
        if k < 0 or k >= len(times) - 1:
            return Around.still(self._log_light(max(k, 0)))
        apart_ns = times[k + 1] - times[k]
        share = np.float32((t_ns - times[k]) / apart_ns)
        return Around(self._log_light(k), self._log_light(k + 1), share, apart_ns * 1e-9)

    def _log_light(self, k: int) -> _Float32s:
        """Return frame k in log light; the last few stay decoded."""
        if k not in self._kept:
            while len(self._kept) >= 3:
                del self._kept[next(iter(self._kept))]
            light = linear_light(self._frames.levels[k], self._frames.full_scale, is_linear=self._is_linear)
            light = resampled(light, self._size)
            self._kept[k] = np.log((light + np.float32(self._p.floor)) * np.float32(self._p.light_at_white))
        return self._kept[k]


def _times_ns(frames: Frames, p: VideoParameters) -> list[int]:
    """Return the stream time at which each frame is shown."""
    scale = Fraction(repr(float(p.time_scale)))
    if frames.times_s is not None:
        return [int(Fraction(t) * 10**9 / scale) for t in frames.times_s]
    period = 10**9 / (Fraction(repr(float(p.frames_per_s))) * scale)
    return [int(k * period) for k in range(len(frames.levels))]


def _round_ns(times_ns: list[int]) -> int:
    """Return the time of one round: the last frame is shown for as long as the mean one."""
    return times_ns[-1] + max(1, times_ns[-1] // max(1, len(times_ns) - 1)) if len(times_ns) > 1 else 1


def resampled(light: _Float32s, size: tuple[int, int]) -> _Float32s:
    """Return `light` (height, width) at another size: means over areas."""
    if light.shape == size[::-1]:
        return light
    down, across = _shares(light.shape[0], size[1]), _shares(light.shape[1], size[0])
    return np.asarray(down @ light @ across.T, np.float32)


def _shares(source: int, target: int) -> _Float32s:
    """Return the share of each of `target` equal stretches that each of `source` equal ones fills, (target, source)."""
    if source < 1:
        raise SceneError("a frame has no pixels")
    edges = np.arange(target + 1) * (source / target)
    overlap = np.minimum(edges[1:, None], np.arange(1, source + 1)) - np.maximum(edges[:-1, None], np.arange(source))
    return np.asarray(np.clip(overlap, 0, None) * (target / source), np.float32)
