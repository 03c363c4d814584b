"""Frame sequences of the closed-form scenes as files, and the events of ideal pixels beside them.

A folder of sequences contains:

    sequences.json          format, thresholds (ln units); of each sequence the scene, size, images a second and frames
    SCENE-IMAGES.npz        t_ns (n,) int64 since the first frame; light (n, height, width) float32, linear, above 0, at
                            most 1; rate, its time derivative, a second; IMAGES is the number of images a second
    busy-IMAGES.npz         sequences for timing on 346 x 260 pixels
    quiet-1000.npz          the same with few active pixels
    whole-1000.npz          as quiet, for the time of simulators with all that they model turned on
    truth/SCENE.npz         t_us float64, x, y, on: the events of ideal pixels

The pixel has contrast thresholds and nothing else: no mismatch, noise, leak, refractory period or low-pass. The first
frame sets its reference. Every pixel starts a share of a threshold below its light (`scenes.Faded`), over 40 ms.

All light lies within 13 : 1, so that in 8 bits it stays in the logarithmic range of simulators whose response is linear
below 20 of 255. A row of the scene's 240 pixels becomes a frame of 20 x 12 pixels, line by line, so that exchanged
coordinates appear.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from laboratory.accuracy.scenes import (
    BlurredCheckerboard,
    ClosedLight,
    Faded,
    MovingEdge,
    SineGrating,
    SlowRamp,
    ThinLine,
    TurningBody,
)
from laboratory.accuracy.scores import Stream
from laboratory.accuracy.truth import ideal_events

FORMAT = 1
THRESHOLD = 0.2
"""Both thresholds, ln units."""

IMAGES_PER_S = (100, 1000, 10000)
"""Frame rates of the table."""

_WIDTH, _HEIGHT = 20, 12
_PIXELS = _WIDTH * _HEIGHT
_TIMING_SIZE = 346, 260
_TIMING_IMAGES_PER_S = 1000  # of those that are not at every frame rate


@dataclass(frozen=True)
class TimedScene:
    """Light, its length in s, and a few words on it."""

    light: ClosedLight
    duration_s: float
    description: str


def _faded(scene: ClosedLight) -> Faded:
    return Faded(scene.pixels, scene, THRESHOLD)


SCENES = {
    "edge": TimedScene(_faded(MovingEdge(_PIXELS)), 0.4, "edge of 0.5 px, 10 : 1, 100 px/s"),
    "grating": TimedScene(
        _faded(SineGrating(_PIXELS, mean=1 / 1.7)), 0.4, "sine grating, 5.7 : 1, 20 Hz, all pixels always active"
    ),
    "ramp": TimedScene(_faded(SlowRamp(_PIXELS)), 0.75, "slow ramps, 0.3 to 3 ln units a second"),
    "line": TimedScene(_faded(ThinLine(_PIXELS, "blurred")), 0.35, "line of 1 px, 0.6 px blur, 100 px/s"),
    "body": TimedScene(_faded(TurningBody(_PIXELS)), 0.6, "turning textured body with kinked edges, 6 : 1, 100 px/s"),
    "checkerboard": TimedScene(_faded(BlurredCheckerboard(_PIXELS)), 0.4, "checkerboard, 0.5 px blur, 100 px/s"),
}
"""Scenes of the table."""

_QUIET = TimedScene(
    MovingEdge(_TIMING_SIZE[0], speed_px_s=1000.0, duration_s=0.04, half_width_px=_TIMING_SIZE[0] / 2),
    0.04,
    "an edge that crosses 40 of 346 columns",
)

TIMING = {
    "busy": TimedScene(SineGrating(_TIMING_SIZE[0], mean=1 / 1.7), 0.04, "sine grating on all pixels"),
    "quiet": _QUIET,
    "whole": _QUIET,
}
"""Scenes for timing."""


def light_of(scene: str) -> ClosedLight:
    """Return the light of a scene by its name; pixel k of a frame, line by line, is pixel k modulo `pixels` of it."""
    return (SCENES.get(scene) or TIMING[scene]).light


@dataclass(frozen=True)
class FrameSequence:
    """A sequence as `sequences.json` lists it: scene, size, images a second, frames, and `Settings.whole`."""

    scene: str
    width: int
    height: int
    images_per_s: float
    frames: int
    whole: bool = False


class FolderError(Exception):
    """A folder is not one of sequences, or its files are damaged; the message contains its name."""


@dataclass(frozen=True)
class SequenceFolder:
    """A folder of sequences, opened.

    Attributes
    ----------
    path : the folder.
    threshold_on, threshold_off : thresholds of its truth, ln units.
    sequences : sequences by name.
    """

    path: Path
    threshold_on: float
    threshold_off: float
    sequences: dict[str, FrameSequence]

    def scored(self) -> dict[str, FrameSequence]:
        """Return the sequences that have a truth."""
        return {name: one for name, one in self.sequences.items() if one.scene not in TIMING}

    def truth(self, name: str) -> Stream:
        """Return the events of ideal pixels under a sequence.

        Raises FolderError where its file is missing or damaged.
        """
        one = self.sequences[name]
        file = self.path / "truth" / f"{one.scene}.npz"
        try:
            with np.load(file) as stored:
                pixel = stored["y"].astype(np.int64) * one.width + stored["x"]
                return Stream.of(stored["t_us"], pixel, stored["on"], one.width * one.height)
        except (OSError, KeyError, ValueError) as error:
            raise FolderError(f"{file}: {error}") from error


def open_folder(path: Path) -> SequenceFolder:
    """Return a folder that `export` wrote.

    Raises FolderError where it contains no sequences, or those of another format.
    """
    file = path / "sequences.json"
    try:
        stored = json.loads(file.read_text())
        if stored["format"] != FORMAT:
            raise FolderError(f"{file}: format {stored['format']}; this version reads {FORMAT}: export the folder anew")
        sequences = {name: FrameSequence(**one) for name, one in stored["sequences"].items()}
        return SequenceFolder(path, stored["threshold_on"], stored["threshold_off"], sequences)
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise FolderError(f"{path}: no sequences; `evstim accuracy export` writes them ({error})") from error


def timing_sequences(images_per_s: Sequence[int]) -> dict[str, FrameSequence]:
    """Return the sequences for timing by name: "busy" at every frame rate, the others at one."""
    rates = [("busy", rate) for rate in images_per_s] + [(name, _TIMING_IMAGES_PER_S) for name in ("quiet", "whole")]
    # Fewer frames where each has many events, and none after the edge has crossed.
    return {
        f"{scene}-{rate}": FrameSequence(scene, *_TIMING_SIZE, rate, 40 if rate >= 1000 else 12, scene == "whole")
        for scene, rate in rates
    }


def export(path: Path, images_per_s: Sequence[int], scenes: Sequence[str] = tuple(SCENES)) -> Iterator[str]:
    """Write a folder of sequences, created where missing; yield the name of each sequence after it is written.

    Parameters
    ----------
    images_per_s : frame rates, that divide 10^9; sequences of whole milliseconds suit all that are multiples of 20.
    scenes : names of `SCENES`.

    Raises OSError where the folder cannot be written.
    """
    (path / "truth").mkdir(parents=True, exist_ok=True)
    sequences: dict[str, FrameSequence] = {}
    for scene in scenes:
        timed = SCENES[scene]
        events = ideal_events(timed.light, THRESHOLD, THRESHOLD, timed.duration_s)
        y, x = np.divmod(events.pixel, _WIDTH)
        np.savez(path / "truth" / f"{scene}.npz", t_us=events.t_us, x=x, y=y, on=events.on)
        for rate in images_per_s:
            frames = round(timed.duration_s * rate) + 1
            sequences[f"{scene}-{rate}"] = FrameSequence(scene, _WIDTH, _HEIGHT, rate, frames)
    sequences |= timing_sequences(images_per_s)
    for name, sequence in sequences.items():
        _write(sequence, path / f"{name}.npz")
        yield name
    listed = {name: asdict(sequence) for name, sequence in sequences.items()}
    whole = {"format": FORMAT, "threshold_on": THRESHOLD, "threshold_off": THRESHOLD, "sequences": listed}
    (path / "sequences.json").write_text(json.dumps(whole, indent=1) + "\n")


def _write(one: FrameSequence, file: Path) -> None:
    light, h_ns = light_of(one.scene), round(1e9 / one.images_per_s)
    t_ns = np.arange(one.frames, dtype=np.int64) * h_ns
    tiled = [_tiled(rows, one) for rows in light.light_and_rate(t_ns * 1e-9)]
    np.savez(file, t_ns=t_ns, light=tiled[0], rate=tiled[1])


def _tiled(rows: npt.NDArray[np.float64], one: FrameSequence) -> npt.NDArray[np.float32]:
    """Return rows of pixels (n, pixels) as frames (n, height, width); a shorter row is repeated."""
    flat = np.arange(one.width * one.height) % rows.shape[1]
    return rows.astype(np.float32)[:, flat].reshape(-1, one.height, one.width)
