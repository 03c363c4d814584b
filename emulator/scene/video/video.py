"""A video as a scene: frames with times, joined in the logarithm of light.

Between two frames each pixel's light follows a straight line in log, so its rate is exact; before the first frame and
after the last it stands still, or starts again. Frames of another size than the sensor's are resampled by area in
linear light. Darkness is held `floor` above zero, because zero has no logarithm.

A video with 8 bits is a poor scene for an event sensor, which `notes` reports: from one level to the next light steps
by a ratio that is large where it is dark, and wherever that ratio is more than a threshold a pixel fires at steps that
only the file has.

Frames are read whole, of these formats:

    a folder                 its images by the numbers in their names, each of any format that pillow reads
    .npy                     an array (frames, height, width): uint8 and uint16 are levels, floats are linear light
    .gif .tif .png .webp     the frames of one file, by pillow
    .mp4 .mkv .avi .mov      by PyAV (`pip install '.[files]'`, FFmpeg), with the times that the file gives

A frame whose time is not later than that of the last one before it is left out, counted and named in `notes`.

A list of times, `timestamps.txt` or `images.csv`, lies in the folder, or beside one called imgs or images. A line has a
time, or a time and a file's name in either order; lines that begin with # or % are comments. Whole numbers that as
seconds would be more than 100 s apart are nanoseconds, or microseconds where these are less than 1 s apart; a note
gives the unit. Layouts: esim_py of vid2e (`timestamps.txt`, seconds), ESIM (`images.csv`: nanoseconds, name).

Pillow and PyAV read in a child process, see `guarded_reader`. All frames become one array, within a bound of memory.
Colours become luminance (Rec. 709). Levels are scaled to 0 to 1 and decoded by the sRGB curve, except linear ones.
"""

from __future__ import annotations

import bisect
import itertools
import math
import re
from abc import abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from decimal import Decimal
from fractions import Fraction
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
import numpy.typing as npt
from msgspec import Meta

from emulator.light import Light, SceneError
from emulator.scene.files import read_array, read_in_child, reader_errors
from emulator.scene.kind import SceneKind, SizedScene
from emulator.tables.toml_text import read_text, shortened
from emulator.tables.typed_table import NO_FILE, RigFile
from firmware_protocol.bounds import check_bounds
from firmware_protocol.events import Float32s, Floats
from transports.guarded_reader import Limits
from transports.needs import Need, package

MOST_BYTES = 1 << 31
"""Of all frames together."""

Levels = npt.NDArray[Any]


def stacked(frames: Iterator[tuple[str, Levels]]) -> Levels:
    """Return all frames as one array; raises SceneError where they differ in form, are too large, or none."""
    collected: list[Levels] = []
    room = MOST_BYTES
    for name, levels in frames:
        if collected and (levels.shape != collected[0].shape or levels.dtype != collected[0].dtype):
            raise SceneError(
                f"{name} is {levels.shape[1]} x {levels.shape[0]} {levels.dtype}, the first frame "
                f"{collected[0].shape[1]} x {collected[0].shape[0]} {collected[0].dtype}: all must be alike"
            )
        room -= levels.nbytes
        if room < 0:
            raise SceneError(f"more than {MOST_BYTES >> 30} GiB of frames; cut it or make it smaller")
        collected.append(levels)
    if not collected:
        raise SceneError("holds no frames")
    return np.stack(collected)


_LIMITS = Limits(memory_bytes=3 * MOST_BYTES, cpu_s=600)  # a video of one MiB may well hold a GiB of frames
VIDEO_SUFFIXES = (".mp4", ".mkv", ".avi", ".mov", ".webm", ".m4v")


@dataclass(frozen=True, eq=False)
class Frames:
    """Frames as they were stored.

    Attributes
    ----------
    levels : (n, height, width) uint8, uint16 or float32; floats are linear light.
    times_s : (n,) from the file, first 0, increasing; None where it gives none.
    notes : remarks on times that were used, and on frames and files that were left out.
    """

    levels: Levels
    times_s: list[float] | None = None
    notes: tuple[str, ...] = ()

    @property
    def full_scale(self) -> float:
        """The level of white."""
        return 1.0 if self.levels.dtype.kind == "f" else float(np.iinfo(self.levels.dtype).max)


def read_frames(path: Path) -> Frames:
    """Read all frames; raises SceneError with the file and, where it is known, the frame."""
    if path.suffix == ".npy" and path.is_file():
        return Frames(_array(path))
    is_video = path.is_file() and path.suffix.lower() in VIDEO_SUFFIXES
    reader = "read_video" if is_video else "read_images"
    arrays = read_in_child(f"{__name__}:{reader}", path, _LIMITS)
    times_s = arrays["times_s"].tolist() if arrays["times_s"].size else None
    return Frames(arrays["levels"], times_s, tuple(map(str, arrays["notes"])))


def linear_light(levels: Levels, full_scale: float, *, is_linear: bool) -> Float32s:
    """Return linear light of levels, white 1."""
    share = np.asarray(levels, np.float32) / np.float32(full_scale)
    if is_linear:
        return share
    low, high = share / np.float32(12.92), ((share + np.float32(0.055)) / np.float32(1.055)) ** np.float32(2.4)
    return np.where(share <= 0.04045, low, high)


def _array(path: Path) -> Levels:
    levels = read_array(path)
    if levels.ndim != 3 or not levels.size:
        raise SceneError(f"{path}: has the shape {levels.shape}; (frames, height, width) is needed")
    if levels.dtype.kind == "f":
        with np.errstate(invalid="ignore", over="ignore"):  # values that are not finite then are refused
            levels = levels.astype(np.float32)
        bad = np.flatnonzero(~(np.isfinite(levels) & (levels >= 0)).all(axis=(1, 2)))
        if bad.size:
            raise SceneError(f"{path}: frame {bad[0]} holds light that is negative or not finite")
    elif levels.dtype not in (np.uint8, np.uint16):
        raise SceneError(f"{path}: is {levels.dtype}; uint8, uint16 or floats are needed")
    return np.asarray(levels)


def read_images(path: Path) -> dict[str, Any]:
    """Return `levels` (n, height, width) of a file or of a folder's images, `times_s` (n,) or none, and `notes`."""
    if not path.is_dir():
        return {"levels": stacked(_frames([path])), "times_s": np.zeros(0), "notes": []}
    images, no_images = _files_of(path)
    inner = [other for other in no_images if other.is_dir() and other.name in _INNER]
    if inner and not images:
        return read_images(inner[0])
    times_s, notes = np.zeros(0), list[str]()
    folders = [path, path.parent] if path.name in _INNER else [path]
    listed = next((file for folder in folders for name in _LISTS if (file := folder / name).is_file()), None)
    if listed:
        with reader_errors(listed.name):
            times_s, images, notes = _timed(listed, images)
    levels = stacked(_frames(images))
    if listed and len(times_s) != len(levels):
        raise SceneError(f"{listed.name} has {len(times_s)} times for {len(levels)} frames: an image has several")
    names = ", ".join(other.name for other in no_images[:_MOST_NAMED]) + ", ..." * (len(no_images) > _MOST_NAMED)
    notes += [f"{len(no_images)} files of the folder are no images and are left out: {names}"] if no_images else []
    return {"levels": levels, "times_s": times_s, "notes": notes}


_INNER = ("imgs", "images")  # folders of images beside their times
_LISTS = ("timestamps.txt", "images.csv")
_MOST_NAMED = 5
_LONGEST_NAME = 255
_MOST_LIST_BYTES = 1 << 26
_LONGEST_S, _SHORTEST_US = 100, 1_000_000  # from image to image
_MOST_S = 1e9
_NUMBER = re.compile(r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]{1,2})?")


def _files_of(folder: Path) -> tuple[list[Path], list[Path]]:
    """Return a folder's images, frame10 behind frame2, and what else it holds, but hidden files."""
    from PIL import Image

    suffixes = {suffix for suffix, form in Image.registered_extensions().items() if form in Image.OPEN}
    images, no_images = list[Path](), list[Path]()
    by_name = sorted(folder.iterdir())
    for path in sorted(by_name, key=lambda p: re.sub("[0-9]+", lambda digits: digits[0].zfill(_LONGEST_NAME), p.name)):
        if not path.name.startswith(".") and path.name not in _LISTS:
            (images if path.is_file() and path.suffix.lower() in suffixes else no_images).append(path)
    return images, no_images


def _timed(listed: Path, images: list[Path]) -> tuple[Floats, list[Path], list[str]]:
    """Return the times of a list, s, the images that have them, and notes; raises ValueError with the line."""
    stamps, named = list[Decimal](), list[Path]()
    for number, line in enumerate(read_text(listed, _MOST_LIST_BYTES).splitlines(), 1):
        words = re.split(r"\s*[,;]\s*|\s+", line.strip())
        numbers = [word for word in words if _NUMBER.fullmatch(word)]
        if words[0][:1] in ("", "#", "%") or not (numbers or stamps):  # nothing, a comment, the names of columns
            continue
        if len(words) > 2 or len(numbers) != 1:
            raise ValueError(f"line {number}: {line.strip()[:60]!r} is not a time, nor a time and a file's name")
        stamps.append(Decimal(numbers[0]))
        if len(words) == 2:
            words.remove(numbers[0])
            named.append(listed.parent / words[0])
            if ".." in words[0].split("/") or not (named[-1].is_relative_to(listed.parent) and named[-1].is_file()):
                raise ValueError(f"line {number}: there is no file {words[0][:60]!r} in its folder")
    shown = named or images
    if not stamps or len(stamps) != len(shown):
        raise ValueError(f"has {len(stamps)} times for {len(shown)} images: a line for each is needed")
    times_s, unit = _seconds(stamps)
    kept, notes = _later(times_s)
    unnamed = len(set(images) - set(shown))
    notes += [f"{unnamed} images of the folder are not in {listed.name} and are left out"] if unnamed else []
    notes.insert(0, f"the times of {len(shown)} images are those of {listed.name}, read as {unit}")
    return times_s[kept] - times_s[kept[0]], [shown[k] for k in kept], notes


def _seconds(stamps: list[Decimal]) -> tuple[Floats, str]:
    """Return times in s, from the first, and the unit that they were taken to have, with the reason."""
    gaps = sorted(abs(after - before) for before, after in itertools.pairwise(stamps))
    usual = gaps[len(gaps) // 2] if gaps else Decimal(0)
    per_s, unit = 1, "seconds"
    if usual > _LONGEST_S and all(stamp == stamp.to_integral_value() for stamp in stamps):
        per_s, unit = (10**9, "nanoseconds") if usual >= _SHORTEST_US else (10**6, "microseconds")
        unit += f", because seconds would put {usual:.4g} s between two images (else set time_scale)"
    times_s = np.array([float((stamp - stamps[0]) / per_s) for stamp in stamps])
    if not np.ptp(times_s) < _MOST_S:
        raise ValueError(f"its times span {np.ptp(times_s):.4g} s, more than {_MOST_S:g} s")
    return times_s, unit


def _later(times_s: Floats) -> tuple[npt.NDArray[np.intp], list[str]]:
    """Return the frames that are later than all before them, and a note on the others; SceneError: these are most."""
    last_s = np.fmax.accumulate([-math.inf, *times_s])[:-1]
    kept, left = np.flatnonzero(times_s > last_s), np.flatnonzero(~(times_s > last_s))
    if not left.size:
        return kept, []
    faults = {"at the same time": times_s == last_s, "earlier": times_s < last_s, "without a time": np.isnan(times_s)}
    counts = ", ".join(f"{at.sum()} {fault}" for fault, at in faults.items() if at.any())
    first = f"the first is frame {left[0]}, at {times_s[left[0]]:.6g} s after {last_s[left[0]]:.6g} s"
    note = f"{left.size} of {len(times_s)} frames are not later than the one before ({counts}; {first})"
    if kept.size < left.size:
        raise SceneError(f"{note}: times that increase are needed")
    return kept, [f"{note}: left out"]


def _frames(paths: list[Path]) -> Iterator[tuple[str, Levels]]:
    """Yield name and levels of every frame of every file."""
    from PIL import Image, ImageSequence

    for path in paths:
        with reader_errors(f"{path.name}: cannot be read as an image"), Image.open(path) as image:
            for k, frame in enumerate(ImageSequence.Iterator(image)):
                yield f"{path.name}, frame {k}", _grey(frame)


def _grey(frame: Any) -> Levels:
    """Return the luminance of a pillow image, in its own depth."""
    if frame.mode in ("I;16", "I;16L", "I;16B"):
        return np.asarray(frame).astype(np.uint16)
    if frame.mode == "F":
        return np.asarray(frame, np.float32)
    if frame.mode == "L":
        return np.asarray(frame, np.uint8)
    rgb = np.asarray(frame.convert("RGB"), np.float32)
    return np.rint(rgb @ np.array([0.2126, 0.7152, 0.0722], np.float32)).astype(np.uint8)


def read_video(path: Path) -> dict[str, Any]:
    """Return `levels` (n, height, width), `times_s` (n,) from 0, empty where the file gives none, and `notes`."""
    import av

    times: list[float] = []

    def frames() -> Iterator[tuple[str, Levels]]:
        with av.open(str(path)) as container:
            for k, frame in enumerate(container.decode(video=0)):
                times.append(float(frame.time) if frame.time is not None else float("nan"))
                yield f"frame {k}", frame.to_ndarray(format="gray")

    try:
        levels = stacked(frames())
    except (MemoryError, SceneError):
        raise
    except Exception as error:  # FFmpeg's own errors, and those of PyAV
        raise SceneError(f"frame {len(times)} cannot be read: {shortened(error)}") from error
    times_s = np.array(times)
    if np.isnan(times_s).all():
        return {"levels": levels, "times_s": np.zeros(0), "notes": ["the file gives no times: frames_per_s holds"]}
    kept, notes = _later(times_s - np.nanmin(times_s))
    return {"levels": levels[kept] if notes else levels, "times_s": times_s[kept] - times_s[kept[0]], "notes": notes}


_TYPICAL_THRESHOLD = 0.2


@dataclass(frozen=True)
class VideoParameters:
    """A video or a sequence of images.

    Attributes
    ----------
    path : a folder of images, a .npy array, an animation or a video, beside the rig file.
    frames_per_s : frame rate, used where the file gives no times of its own.
    levels
        "srgb": decoded by the sRGB curve; "linear": proportional to light, as floats always are.
    light_at_white : light of white relative to the sensor's reference level.
    floor : light of black, as a share of white.
    time_scale : speed relative to the recording.
    loop : True: the video starts again at its end; false: the last frame stays.
    """

    kind: ClassVar[str] = "video"
    path: RigFile = NO_FILE
    frames_per_s: Annotated[float, Meta(ge=1e-3, le=1e6)] = 30.0
    levels: Literal["srgb", "linear"] = "srgb"
    light_at_white: Annotated[float, Meta(ge=1e-9, le=1e9)] = 1.0
    floor: Annotated[float, Meta(ge=1e-6, le=1)] = 1e-3
    time_scale: Annotated[float, Meta(ge=1e-6, le=1e6)] = 1.0
    loop: bool = True

    def __post_init__(self) -> None:
        if not self.path:
            raise ValueError("path is missing: name a folder of images, a .npy file or a video")
        check_bounds(self)


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

    before: Float32s
    after: Float32s
    share: np.float32
    apart_s: float

    @classmethod
    def still(cls, log_light: Float32s) -> Self:
        """Return one frame that does not change."""
        return cls(log_light, log_light, np.float32(0), 0.0)


class JoinedFrames(SizedScene):
    """Frames with times on a sensor of `size` = (width, height), joined by straight lines in log light."""

    motion_bound_px_s = math.inf

    @abstractmethod
    def _around(self, t_ns: int) -> Around:
        """Return the frames around `t_ns`."""

    def light_and_rate(self, t_ns: int, light: Light, rate: Light) -> None:
        """Write the light and its time derivative, both exact for a straight line in log."""
        around = self._around(t_ns)
        np.exp((1 - around.share) * around.before + around.share * around.after, out=light)
        if around.apart_s and rate.size:
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
        last_ns, gaps = self._times_ns[-1], len(self._times_ns) - 1
        self._round_ns = last_ns + max(1, last_ns // gaps) if gaps else 1  # the last frame is shown as long as the mean
        self._is_linear = parameters.levels == "linear" or self._frames.levels.dtype.kind == "f"
        self._log_light = lru_cache(3)(self._decoded)

    @property
    def notes(self) -> tuple[str, ...]:
        """Remarks for the user on times, on what was left out, and on false events from the bit depth of the frames."""
        levels, notes = self._frames.levels, self._frames.notes
        if self._frames.times_s is not None and self._p.frames_per_s != VideoParameters.frames_per_s:
            notes += (f"frames_per_s = {self._p.frames_per_s:g} is not used: the frames have times of their own",)
        if levels.dtype.kind == "f":
            return notes
        scale = self._frames.full_scale
        coarse = coarsest_level(scale, self._p.floor, is_linear=self._is_linear, threshold=_TYPICAL_THRESHOLD)
        if share := float((levels[0] < coarse).mean()):
            notes += (
                f"{levels.dtype.itemsize * 8}-bit frames: below level {coarse} of {scale:.0f} ({share:.0%} of the "
                f"first frame's pixels) one level is a step of more than {_TYPICAL_THRESHOLD} in log light, and fires "
                "events that are not in the scene",
            )
        return notes

    def close(self) -> None:
        """Let go of the frames that are decoded."""
        self._log_light.cache_clear()

    def _around(self, t_ns: int) -> Around:
        t_ns = int(t_ns) % self._round_ns if self._p.loop else int(t_ns)
        times = self._times_ns
        k = bisect.bisect_right(times, t_ns) - 1
        if k < 0 or k >= len(times) - 1:
            return Around.still(self._log_light(max(k, 0)))
        apart_ns = times[k + 1] - times[k]
        share = np.float32((t_ns - times[k]) / apart_ns)
        return Around(self._log_light(k), self._log_light(k + 1), share, apart_ns * 1e-9)

    def _decoded(self, k: int) -> Float32s:
        """Return frame k in log light."""
        light = linear_light(self._frames.levels[k], self._frames.full_scale, is_linear=self._is_linear)
        light = resampled(light, self.size)
        return np.asarray(np.log((light + np.float32(self._p.floor)) * np.float32(self._p.light_at_white)))


def _times_ns(frames: Frames, p: VideoParameters) -> list[int]:
    """Return the stream time at which each frame is shown."""
    scale = Fraction(repr(float(p.time_scale)))
    if frames.times_s is not None:
        return [int(Fraction(t) * 10**9 / scale) for t in frames.times_s]
    period = 10**9 / (Fraction(repr(float(p.frames_per_s))) * scale)
    return [int(k * period) for k in range(len(frames.levels))]


def resampled(light: Float32s, size: tuple[int, int]) -> Float32s:
    """Return `light` (height, width) at another size: means over areas."""
    if light.shape == size[::-1]:
        return light
    down, across = _shares(light.shape[0], size[1]), _shares(light.shape[1], size[0])
    return np.asarray(down @ light @ across.T, np.float32)


def _shares(source: int, target: int) -> Float32s:
    """Return the share of each of `target` equal stretches that each of `source` equal ones fills, (target, source)."""
    if source < 1:
        raise SceneError("a frame has no pixels")
    edges = np.arange(target + 1) * (source / target)
    overlap = np.minimum(edges[1:, None], np.arange(1, source + 1)) - np.maximum(edges[:-1, None], np.arange(source))
    return np.asarray(np.clip(overlap, 0, None) * (target / source), np.float32)
