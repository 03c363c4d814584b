"""Fields of stars before a simulated sensor, and the stars that source extraction finds in its events.

The protocol is that of the AMOS short course (README of its star files): the ON events of 5 s become a picture of
counts, Source Extractor finds sources in it, and these are matched with a catalogue. Here `sep`, the same program as a
library, finds the sources: counts less their mean, filtered by a Gaussian of 3 pixels, in at least five connected
pixels above a threshold. The threshold is not free: it is the lowest at which a picture of the same sensor in front of
the same sky without stars has at most `FALSE_SOURCES` sources. A tenth of the preset's pixels have nearly all its noise
in the dark, as their thresholds are low: those that stand out of the 5 s before, without stars, are left out.
"""

from __future__ import annotations

import dataclasses
import importlib
from dataclasses import dataclass
from typing import Any

import numpy as np

from emulator.light import MachineLacks, SceneFrames
from emulator.optics.lens import LensParameters
from emulator.rig.kinds import CAMERA_MODELS
from emulator.scene.stars.skies import DrawnField
from emulator.scene.stars.stars import StarField
from emulator.scene.stars.table import StarsParameters
from emulator.sensor.presets import SensorParameters
from emulator.sensor.sensor import Sensor
from firmware_protocol.events import Float32s, Floats, Mask
from transports.needs import install_command

SETTLE_S, SLICE_S = 5, 5
FALSE_SOURCES = 40
"""Sources in a picture without stars at the threshold.

Of the published matches 1 % lie beyond G = 11, where next to none is real. A picture has about 28 matches and, in the
mean sky, 227 stars from 11 to 12; so one of these is matched by chance with a probability of 0.28 / 227, as it is where
40 sources lie at random in the picture.
"""

_THRESHOLDS = 1.2 * 1.04 ** np.arange(90)
_MATCH_PX = 3.0
_EDGE_PX = 20.0
_HOT_SIGMAS = 5.0
_NO_STARS = DrawnField(brightest_g=14.9, faintest_g=15.0, radius_deg=0.01)

Counts = Float32s


@dataclass(frozen=True)
class Observatory:
    """A camera on its mount under a sky.

    Attributes
    ----------
    sensor : the sensor.
    lens : the lens.
    scene : the sky, with the camera's path and a drawn field.
    step_ns : time from one light frame to the next.
    chip : name of a camera model; its chip's pitch has an effect on diffraction only.
    """

    sensor: SensorParameters
    lens: LensParameters
    scene: StarsParameters
    step_ns: int
    chip: str = "imx636"

    def before(self, drawn: DrawnField) -> Observatory:
        """Return it in front of other stars."""
        return dataclasses.replace(self, scene=dataclasses.replace(self.scene, drawn=drawn))


@dataclass(frozen=True, eq=False)
class Seen:
    """Stars of one picture.

    Attributes
    ----------
    magnitudes : (n,) float64, G of the stars inside the picture.
    matched : (n,) bool, True: a source lies at the star.
    chance : share of places without a star at which a source lies, from the stars' places mirrored.
    noise_hz : mean rate of ON events of a pixel without stars.
    counts : (height, width) float32, the picture.
    """

    magnitudes: Floats
    matched: Mask
    chance: float
    noise_hz: float
    counts: Counts


def source_finder() -> Any:
    """Return the module `sep`; raise MachineLacks where it is missing."""
    try:
        return importlib.import_module("sep")
    except ImportError as error:
        raise MachineLacks(f"star limits need a source extractor:  {install_command('stars')}") from error


def observe(camera: Observatory, field: DrawnField, seed: int) -> Seen:
    """Return the stars of `field` that are found in one slice of events.

    Raises MachineLacks where `sep` is not installed.
    """
    (before, dark), *_ = _pictures(camera.before(_NO_STARS), seed)
    finder = _Finder(before, dark)
    (_, counts), places, magnitudes = _pictures(camera.before(field), seed)
    found = finder.places(counts)
    width, height = camera.sensor.width, camera.sensor.height
    x, y = places.T
    inside = (x > _EDGE_PX) & (x < width - _EDGE_PX) & (y > _EDGE_PX) & (y < height - _EDGE_PX)
    mirrored = np.column_stack([width - x, y])[inside]
    chance = float(_near(mirrored, found).mean()) if len(mirrored) else 0.0
    return Seen(magnitudes[inside], _near(places[inside], found), chance, finder.mean / SLICE_S, counts)


def _pictures(camera: Observatory, seed: int) -> tuple[Counts, Floats, Floats]:
    """Return ON events a pixel in two slices, (2, height, width), and stars in the middle of the second.

    Stars are places, (n, 2), and magnitudes. Pixels have the thresholds that `seed` gives them.
    """
    size = camera.sensor.width, camera.sensor.height
    counts = np.zeros((2, *size[::-1]), np.float32)
    first_us, last_ns = SETTLE_S * 1_000_000, (SETTLE_S + 2 * SLICE_S) * 1_000_000_000
    with StarField(camera.scene, size, camera.lens, CAMERA_MODELS[camera.chip].chip) as sky:
        frames, sensor = SceneFrames(sky, with_rate=True), Sensor(camera.sensor, seed)
        sensor.reset(frames.draw(0))
        for t_ns in range(camera.step_ns, last_ns + 1, camera.step_ns):
            events = sensor.expose(frames.draw(t_ns))
            events = events[events["on"] & (events["t"] >= first_us)]
            second = (events["t"] - first_us >= SLICE_S * 1_000_000).astype(np.intp)
            np.add.at(counts, (second, events["y"], events["x"]), 1)
        return counts, *sky.stars_at(last_ns - SLICE_S * 500_000_000)


def _near(places: Floats, found: Floats) -> Mask:
    """Return at which places, (n, 2), a found one, (m, 2), lies within the radius of a match."""
    if not len(found):
        return np.zeros(len(places), np.bool_)
    apart = np.hypot(places[:, None, 0] - found[None, :, 0], places[:, None, 1] - found[None, :, 1])
    return np.asarray(apart.min(axis=1) < _MATCH_PX)


def _noisy(counts: Counts) -> Mask:
    """Return the pixels that stand out of a picture without stars, and of what is left without them, and so on."""
    noisy = np.zeros(counts.shape, np.bool_)
    while True:
        mean = float(counts[~noisy].mean())
        more = noisy | (counts > mean + _HOT_SIGMAS * np.sqrt(mean) + 1)
        if (more == noisy).all():
            return noisy
        noisy = more


class _Finder:
    """Source extraction with the noisy pixels of one picture without stars, and the threshold of the next."""

    def __init__(self, before: Counts, dark: Counts) -> None:
        self._sep = source_finder()
        self._hot = _noisy(before)
        self.mean = float(dark[~self._hot].mean())
        self._sigma = float(np.sqrt(max(self.mean, 1e-4)))
        self._threshold = _THRESHOLDS[-1]
        for threshold in _THRESHOLDS:
            self._threshold = threshold
            if len(self.places(dark)) <= FALSE_SOURCES:
                break

    def places(self, counts: Counts) -> Floats:
        """Return the middles of the sources, (n, 2) columns and rows in pixels."""
        above = np.where(self._hot, 0, counts - np.float32(self.mean)).astype(np.float32)
        x = np.arange(-2, 3)
        gauss = np.exp(-4 * np.log(2) * (x[:, None] ** 2 + x**2) / 3.0**2)
        self._sep.set_extract_pixstack(max(300_000, counts.size))
        found = self._sep.extract(above, self._threshold, err=self._sigma, minarea=5, filter_kernel=gauss)
        return np.column_stack([found["x"] + 0.5, found["y"] + 0.5])
