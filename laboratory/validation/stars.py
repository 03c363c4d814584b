"""Star limits: magnitudes to which two cameras with published lenses see stars.

Light is absolute from end to end: Gaia's magnitude G gives the irradiance of the aperture (see `scene.stars.skies`),
the lens its light on the chip, `reference_lux` the sensor's own unit. Then the sensor decides: a star is a pulse of
ln(1 + star / (dark current + sky)) in a pixel, which has to raise ON events above those of noise.

Stars come as a ladder, equally many in every interval of magnitude, so that the share p(G) that is found is measured
equally well everywhere. The distribution of matched stars in a real sky follows with the sky's counts n(G):

    share of matched stars brighter than G = integral of p n up to G, over all of it

and chance matches, measured at places without stars, are taken out of p. The same quotient of the published
distribution and of n(G) gives the p of the real camera, with its value at 7.5 to 8 taken as 1.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
from scipy.stats import binom

from emulator.report.page import BLUE, INK, panels, save
from emulator.rig.loading import load_rig
from emulator.scene.stars.skies import stars_per_deg2, sunlight_lux
from emulator.scene.stars.table import StarsParameters
from emulator.sensor.presets import IMX636_W_M2
from firmware_protocol.events import Floats
from laboratory.validation.findings import Datum, Findings, Source
from laboratory.validation.star_fields import FALSE_SOURCES, Observatory, Seen, observe, source_finder

AMOS_G = np.array([4.0, 5.0, 6.0, 6.5, 7.0, 7.5, 8.0, 8.5, 9.0, 9.5, 10.0, 10.5, 11.0, 11.5, 12.0])
AMOS_SHARE = np.array([
    0.0013, 0.0052, 0.0170, 0.0284, 0.0543, 0.1025, 0.1893, 0.3153, 0.4791, 0.6683, 0.8598, 0.9690, 0.9900, 0.9960, 1.0,
])  # fmt: skip
"""Share of matched stars with G at most `AMOS_G`: Gen 4, 135 mm f/2; read off the published curve, +-0.003."""

_AMOS = {10: 7.48, 50: 9.06, 90: 10.13}
_GEN3_V, _SUN_V_MINUS_G = 9.8, 0.16
_BOUND_MAG, _BOUND_SHARE = 0.3, 0.2
_BIN_MAG = 0.5
_LADDER = np.arange(5.5, 12.51, _BIN_MAG)
_PER_PICTURE = 400
_CHANCE = 0.01  # a share that chance exceeds as often is none


@dataclasses.dataclass(frozen=True, eq=False)
class Limits:
    """Stars found over magnitude.

    Attributes
    ----------
    found : (n,) float64, share of the stars that is found in each interval of `_LADDER`.
    noise_hz : ON events of a pixel without stars, Hz.
    """

    found: Floats
    noise_hz: float

    @classmethod
    def of(cls, seen: list[Seen]) -> Limits:
        """Return the limits of several pictures of one camera."""
        magnitudes = np.concatenate([one.magnitudes for one in seen])
        matched = np.concatenate([one.matched for one in seen])
        chance = float(np.mean([one.chance for one in seen]))
        number, _ = np.histogram(magnitudes, _LADDER)
        hits, _ = np.histogram(magnitudes[matched], _LADDER)
        by_chance = binom.sf(hits - 1, number, max(chance, 1 / len(magnitudes))) > _CHANCE
        share = np.where(by_chance, chance, hits / np.maximum(number, 1))
        return cls(np.clip((share - chance) / (1 - chance), 0, 1), float(np.mean([one.noise_hz for one in seen])))

    @property
    def cumulative(self) -> Floats:
        """Share of the matched stars of the mean sky brighter than each edge of `_LADDER`; all are found before it."""
        counts = stars_per_deg2(_LADDER)
        matched = np.concatenate([[counts[0]], np.diff(counts) * self.found]).cumsum()
        return np.asarray(matched / matched[-1])

    def brighter_than(self, percent: float) -> float:
        """Return the magnitude that `percent` of the matched stars are brighter than; linear in log between edges."""
        return float(np.interp(math.log(percent / 100), np.log(self.cumulative), _LADDER))

    @property
    def half_found(self) -> float:
        """Magnitude at which half of the stars are found."""
        middles = _LADDER[:-1] + _BIN_MAG / 2
        falling = np.minimum.accumulate(self.found)
        return float(np.interp(-0.5, -falling, middles)) if falling[-1] < 0.5 < falling[0] else math.nan


def stars(seed: int) -> Findings:
    """Repeat the measurements of star limits.

    Raises MachineLacks where the source extractor is not installed.
    """
    source_finder()
    measured, third = (_limits(name, seed) for name in ("stars-limit", "stars-limit-gen3"))
    return Findings(
        "stars",
        "Star limits",
        "imx636_nist",
        _PROTOCOL,
        _SOURCES,
        (*_percentiles(measured), *_completeness(measured), _third(third)),
        (*_REMARKS, f"ON events of a pixel without stars: {measured.noise_hz:.3g} Hz in the simulated sensor."),
        partial(_draw, measured),
    )


def _limits(rig_name: str, seed: int) -> Limits:
    """Return the limits of a rig's camera, before a ladder of stars."""
    rig = load_rig(rig_name)
    scene, p, lens = rig.scene, rig.camera.sensor, rig.camera.lens
    assert isinstance(scene, StarsParameters)
    assert scene.drawn is not None
    chip = "gen31" if rig.camera.model == "gen31" else "imx636"
    ladder = dataclasses.replace(
        scene.drawn, numbers="ladder", brightest_g=_LADDER[0], faintest_g=_LADDER[-1], seed=seed,
        per_deg2=_PER_PICTURE / (lens.field_of_view_deg**2 * p.height / p.width),
    )  # fmt: skip
    return Limits.of([observe(Observatory(p, lens, scene, rig.run.step_us * 1000, chip), ladder, seed)])


def _percentiles(measured: Limits) -> Iterator[Datum]:
    for percent, real in _AMOS.items():
        what = f"{percent} % of the matched stars are brighter than"
        yield Datum(what, real, measured.brighter_than(percent), "mag G", "difference", _BOUND_MAG, True)


def amos_found() -> Floats:
    """Return the share of stars that the real camera finds in each interval of `AMOS_G`, relative to that at 7.5 to 8.

    Quotient of the published distribution and of the mean sky's counts.
    """
    quotient = np.diff(AMOS_SHARE) / np.diff(stars_per_deg2(AMOS_G))
    return np.asarray(quotient / quotient[np.searchsorted(AMOS_G, 7.5)])


def _completeness(measured: Limits) -> Iterator[Datum]:
    remark = "the real value is a quotient with the mean sky's counts, and 1 at 7.5 to 8 by definition"
    first = np.searchsorted(AMOS_G, 8.0)
    for low, real in zip(AMOS_G[first:-3], amos_found()[first:-2], strict=True):
        ours = float(measured.found[np.searchsorted(_LADDER, low)])
        what = f"share of stars found, {low:g} to {low + _BIN_MAG:g}"
        yield Datum(what, float(real), ours, "", "difference", _BOUND_SHARE, True, remark=remark)


def _third(measured: Limits) -> Datum:
    remark = "a detection limit of V 9.8 (G 9.64 for stars like the Sun) whose definition we have not read"
    return Datum(
        "Gen 3, 85 mm f/1.4: half of the stars found at", _GEN3_V - _SUN_V_MINUS_G, measured.half_found, "mag G",
        "difference", _BOUND_MAG, False, remark=remark,
    )  # fmt: skip


_PROTOCOL = (
    "Stars drift over the picture of a camera at rest on the Earth by (-1.86, 0.55) px/s, as in a recording there. "
    "Real: the ON events of 5 s become a picture, Source Extractor finds sources in it, and these are matched "
    "with Gaia DR2; given is the distribution of magnitudes of the matched stars. Ours: the rig `stars-limit` (lens "
    "135 mm f/2, transmission 0.75 with the air, blur 0.7 px, sky of 21.5 mag a square arc-second; "
    f"none of these but the lens is stated there; light 1 is {IMX636_W_M2} W/m2 at 680 nm, "
    f"{sunlight_lux(IMX636_W_M2):.1f} lx of sunlight) in front of a ladder of stars, the same picture, `sep`, matches "
    "within 3 px; the distribution is that of the mean sky's counts times the share found. The threshold of the "
    f"extraction is the lowest with at most {FALSE_SOURCES} sources in a picture without stars."
)

_SOURCES = (
    Source(
        "AMOS short course, data of the Monet group: distribution of matched stars, Gen 4 EVK, 135 mm f/2",
        "https://github.com/gcohen/AMOS-Short-Course",
        "The repository has no licence file: only numbers are used.",
        "read off the published curve",
    ),
    Source(
        "McMahon-Crabtree and Monet 2021, Applied Optics 60, G144",
        "https://doi.org/10.1364/AO.425623",
        "Only a number is used.",
        "from the abstract",
    ),
)

_REMARKS = (
    "Not stated for the real camera: biases, temperature, sky, transmission, focus, settings of the extraction.",
    "The real recording is noisy: its file of 55 MB holds about 80 s, which at five bytes an event is some 0.15 Hz a "
    "pixel.",
    "The temperature of the real chip is not known. The rig has 15 degrees, one number that was fitted to this "
    "measurement, 30 K below what NIST's camera is taken to have; dark current, the bandwidth of noise in the dark and "
    "leak follow it. At -12, 8 and 20 degrees half of the matched stars are brighter than 11.2, 9.7 and 8.6. The Gen 3 "
    "rig has -12 degrees, because the noise of its preset is that of another chip: at 8 degrees it would find 6.9.",
    "The limit is too sharp: of the stars somewhat brighter than it nearly all are found, where the real share falls "
    "slowly from 8 to 10.5. Bright stars are all found while the real camera misses some: this is not explained; "
    "nights and fields differ.",
    "Counts of the mean sky stand for those of the nights' fields, which are not stated.",
)


def _draw(measured: Limits, stem: Path) -> list[Path]:
    """Draw the distribution of matched stars, and the share found."""
    figure, ((left,), (right,)) = panels(2, 2, 5.5, 4)
    middles = _LADDER[:-1] + _BIN_MAG / 2
    left.plot(AMOS_G, AMOS_SHARE, "o-", color=INK, label="real camera")
    right.step(AMOS_G[:-1] + np.diff(AMOS_G) / 2, amos_found(), where="mid", color=INK)
    left.plot(_LADDER, measured.cumulative, color=BLUE, label="evstim")
    right.plot(middles, measured.found, color=BLUE)
    left.set(xlabel="G", ylabel="share of matched stars brighter than G", xlim=(5.5, 12.5))
    right.set(xlabel="G", ylabel="share of stars found", xlim=(5.5, 12.5), ylim=(0, 1.1))
    left.legend(frameon=False, fontsize=8)
    return save(figure, stem)
