"""The biases of the DAVIS family: format of the 16-bit words in module 5, defaults, and effect on pixels.

    coarse-fine     14..12 coarse 0-7   11..4 fine 0-255   3 current level normal   2 type normal (0 = cascode)
                    1 sex N   0 enabled
    voltage DAC     8..6 current 0-7    5..0 voltage 0-63
    shifted source  15..10 reg   9..4 ref   3..2 voltage level   1..0 mode

Sources: libcaer 3.3.15 (davis.h, encodings, defaults as its driver writes them, full-scale currents); jAER agrees
within 0.5 %.

The effect of bias words on the pixels is a set of factors on the parameters that the default words give:

    threshold_on          proportional to ln(I_OnBn / I_DiffBn)
    threshold_off         proportional to ln(I_DiffBn / I_OffBn)
    refractory_us         proportional to 1 / I_RefrBp
    corner_max_hz         proportional to I_PrBp       the photoreceptor in bright light
    source_follower_hz    proportional to I_PrSFBp

At the default words all factors are 1, and the parameters are those of the sensor's preset or of the rig. A word that
would make a comparator's threshold negative, or switch a current off, gives the end of the range of factors.

Source: jAER's formulas for DAVIS biases, which cite IEEE 7962235; the currents are computed from the words above.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar

from msgspec import Meta

from firmware_protocol.bounds import Bounded
from firmware_protocol.device import LEAST_FACTOR, MOST_FACTOR

_FULL_SCALE_A = (11e-12, 94e-12, 756e-12, 6.054e-9, 48.437e-9, 387.5e-9, 3.1e-6, 24.8e-6)
_SixBits = Annotated[int, Meta(ge=0, le=63)]
_TwoBits = Annotated[int, Meta(ge=0, le=3)]


@dataclass(frozen=True)
class CoarseFine(Bounded):
    """A current source: coarse and fine value, transistor sex and type."""

    BITS: ClassVar[int] = 15

    coarse: Annotated[int, Meta(ge=0, le=7)]
    fine: Annotated[int, Meta(ge=0, le=255)]
    n_type: bool = True
    enabled: bool = True
    cascode: bool = False
    low_current: bool = False

    @classmethod
    def parse(cls, word: int) -> CoarseFine:
        """Read the 16-bit word; its top bit is not used."""
        return cls(
            coarse=word >> 12 & 7,
            fine=word >> 4 & 0xFF,
            n_type=bool(word & 2),
            enabled=bool(word & 1),
            cascode=not word & 4,
            low_current=not word & 8,
        )

    def __int__(self) -> int:
        flags = self.enabled | self.n_type << 1 | (not self.cascode) << 2 | (not self.low_current) << 3
        return self.coarse << 12 | self.fine << 4 | flags

    @property
    def current_a(self) -> float:
        """Current in ampere; zero when disabled (libcaer: full scale x fine / 255)."""
        return _FULL_SCALE_A[self.coarse] * self.fine / 255 if self.enabled else 0.0

    def __str__(self) -> str:
        sex = "N" if self.n_type else "P"
        marks = (" cascode" if self.cascode else "") + (" low" if self.low_current else "")
        state = f"{self.current_a:.3g} A" if self.enabled else "off"
        return f"{sex} {self.coarse},{self.fine}{marks} ({state})"


@dataclass(frozen=True)
class Vdac(Bounded):
    """A voltage source: level and the strength of its buffer."""

    BITS: ClassVar[int] = 9

    voltage: _SixBits
    current: Annotated[int, Meta(ge=0, le=7)]

    @classmethod
    def parse(cls, word: int) -> Vdac:
        """Read the 16-bit word; bits above 8 are not used."""
        return cls(voltage=word & 0x3F, current=word >> 6 & 7)

    def __int__(self) -> int:
        return self.current << 6 | self.voltage

    def __str__(self) -> str:
        return f"voltage {self.voltage}, current {self.current}"


@dataclass(frozen=True)
class ShiftedSource(Bounded):
    """A shifted source: `mode` 0 shifted source, 1 high impedance, 2 tied to the rail."""

    BITS: ClassVar[int] = 16

    ref: _SixBits
    reg: _SixBits
    mode: _TwoBits = 0
    level: _TwoBits = 0

    @classmethod
    def parse(cls, word: int) -> ShiftedSource:
        """Read the 16-bit word."""
        return cls(ref=word >> 4 & 0x3F, reg=word >> 10 & 0x3F, mode=word & 3, level=word >> 2 & 3)

    def __int__(self) -> int:
        return self.reg << 10 | self.ref << 4 | self.level << 2 | self.mode

    def __str__(self) -> str:
        return f"ref {self.ref}, reg {self.reg}, mode {self.mode}, level {self.level}"


BiasValue = CoarseFine | Vdac | ShiftedSource


@dataclass(frozen=True)
class BiasDefinition:
    """One bias: parameter address in module 5, name, and the value that drivers write by default."""

    address: int
    name: str
    default: BiasValue

    @property
    def bits(self) -> int:
        """Width of its register, as in the published logic's ChipBiasConfigRecords."""
        return self.default.BITS

    def parse(self, word: int) -> BiasValue:
        """Read a word as this bias's kind."""
        return self.default.parse(word)


def _n(
    address: int, name: str, coarse: int, fine: int, *, enabled: bool = True, cascode: bool = False
) -> BiasDefinition:
    return BiasDefinition(address, name, CoarseFine(coarse, fine, enabled=enabled, cascode=cascode))


def _p(address: int, name: str, coarse: int, fine: int) -> BiasDefinition:
    return BiasDefinition(address, name, CoarseFine(coarse, fine, n_type=False))


BIASES: tuple[BiasDefinition, ...] = (
    BiasDefinition(0, "ApsOverflowLevel", Vdac(27, 6)),
    BiasDefinition(1, "ApsCas", Vdac(21, 6)),
    BiasDefinition(2, "AdcRefHigh", Vdac(32, 7)),
    BiasDefinition(3, "AdcRefLow", Vdac(1, 7)),
    BiasDefinition(4, "AdcTestVoltage", Vdac(21, 7)),
    _n(8, "LocalBufBn", 5, 164),
    _n(9, "PadFollBn", 7, 215, enabled=False),
    _n(10, "DiffBn", 4, 39),
    _n(11, "OnBn", 5, 255),
    _n(12, "OffBn", 4, 1),
    _n(13, "PixInvBn", 6, 144),
    _p(14, "PrBp", 2, 58),
    _p(15, "PrSFBp", 1, 16),
    _p(16, "RefrBp", 4, 25),
    _p(17, "ReadoutBufBp", 6, 20),
    _n(18, "ApsROSFBn", 6, 219),
    _p(19, "AdcCompBp", 5, 20),
    _n(20, "ColSelLowBn", 0, 1),
    _p(21, "DacBufBp", 6, 60),
    _n(22, "LColTimeoutBn", 5, 49),
    _n(23, "AEPdBn", 6, 91),
    _p(24, "AEPuXBp", 4, 80),
    _p(25, "AEPuYBp", 7, 152),
    _n(26, "IFRefrBn", 5, 255),
    _n(27, "IFThrBn", 5, 255),
    _n(34, "BiasBuffer", 5, 254),
    BiasDefinition(35, "SSP", ShiftedSource(ref=1, reg=33)),
    BiasDefinition(36, "SSN", ShiftedSource(ref=1, reg=33)),
)

DAVIS240_BIASES: tuple[BiasDefinition, ...] = (
    _n(0, "DiffBn", 4, 39),
    _n(1, "OnBn", 5, 255),
    _n(2, "OffBn", 4, 0),
    _n(3, "ApsCasEpc", 5, 185, cascode=True),
    _n(4, "DiffCasBnc", 5, 115, cascode=True),
    _n(5, "ApsROSFBn", 6, 219),
    _n(6, "LocalBufBn", 5, 164),
    _n(7, "PixInvBn", 6, 144),
    _p(8, "PrBp", 2, 58),
    _p(9, "PrSFBp", 1, 16),
    _p(10, "RefrBp", 4, 25),
    _n(11, "AEPdBn", 6, 91),
    _n(12, "LColTimeoutBn", 5, 49),
    _p(13, "AEPuXBp", 4, 80),
    _p(14, "AEPuYBp", 7, 152),
    _n(15, "IFThrBn", 5, 255),
    _n(16, "IFRefrBn", 5, 255),
    _n(17, "PadFollBn", 7, 215),
    _n(18, "ApsOverflowLevelBn", 6, 253),
    _n(19, "BiasBuffer", 5, 254),
    BiasDefinition(20, "SSP", ShiftedSource(ref=1, reg=33)),
    BiasDefinition(21, "SSN", ShiftedSource(ref=1, reg=33)),
)


def sensor_factors(
    words: Mapping[int, int], biases: Sequence[BiasDefinition] = BIASES, *, least_fine: float = 0.0
) -> dict[str, float]:
    """Return the factors by sensor parameter, for bias words by their number in module 5.

    `biases`: those of the camera; `least_fine`: fine value that stands for 0.
    """
    now = _figures({bias.name: words[bias.address] for bias in biases}, least_fine)
    then = _figures({bias.name: int(bias.default) for bias in biases}, least_fine)
    return {name: min(max(now[name] / then[name], LEAST_FACTOR), MOST_FACTOR) for name in now}


def _figures(words: Mapping[str, int], least_fine: float) -> dict[str, float]:
    """Return the parameters, each but for a factor, for bias words by name."""

    def current_a(name: str) -> float:
        source = CoarseFine.parse(words[name])
        return source.current_a or source.enabled * _FULL_SCALE_A[source.coarse] * least_fine / 255

    on, off, diff = (current_a(name) for name in ("OnBn", "OffBn", "DiffBn"))
    refractory = current_a("RefrBp")
    return {
        "threshold_on": _log_ratio(on, diff),
        "threshold_off": _log_ratio(diff, off),
        "refractory_us": math.inf if refractory == 0 else 1 / refractory,
        "corner_max_hz": current_a("PrBp"),
        "source_follower_hz": current_a("PrSFBp"),
    }


def _log_ratio(above: float, below: float) -> float:
    """Return ln(above / below); the lowest value if `above` is zero, the highest if `below` is zero."""
    if above == 0:
        return -math.inf
    return math.inf if below == 0 else math.log(above / below)
