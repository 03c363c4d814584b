"""What bias words of the DAVIS346 do to its pixels, as factors on the figures that the default words give.

    threshold_on          proportional to ln(I_OnBn / I_DiffBn)
    threshold_off         proportional to ln(I_DiffBn / I_OffBn)
    refractory_us         proportional to 1 / I_RefrBp
    corner_max_hz         proportional to I_PrBp       the photoreceptor in bright light
    source_follower_hz    proportional to I_PrSFBp

At the default words all factors are 1, and the figures are those of the sensor's preset or of the rig. A word that
would turn a comparator's threshold negative, or a current off, gives the end of the range of factors.

Source: jAER's formulas for DAVIS biases, which cite IEEE 7962235; the currents are those of `biases`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from firmware_protocol.davis346.biases import BIASES, CoarseFine

__all__ = ["LEAST_FACTOR", "MOST_FACTOR", "sensor_factors"]

LEAST_FACTOR, MOST_FACTOR = 0.1, 1000.0
_ADDRESSES = {bias.name: bias.address for bias in BIASES}
_DEFAULTS = {bias.address: int(bias.default) for bias in BIASES}


def sensor_factors(words: Mapping[int, int]) -> dict[str, float]:
    """Return the factors by the names of the sensor's figures, for bias words by their number in module 5."""
    now, then = _figures(words), _figures(_DEFAULTS)
    return {name: min(max(now[name] / then[name], LEAST_FACTOR), MOST_FACTOR) for name in now}


def _figures(words: Mapping[int, int]) -> dict[str, float]:
    on, off, diff = (_current_a(words, name) for name in ("OnBn", "OffBn", "DiffBn"))
    refractory = _current_a(words, "RefrBp")
    return {
        "threshold_on": _log_ratio(on, diff),
        "threshold_off": _log_ratio(diff, off),
        "refractory_us": math.inf if refractory == 0 else 1 / refractory,
        "corner_max_hz": _current_a(words, "PrBp"),
        "source_follower_hz": _current_a(words, "PrSFBp"),
    }


def _current_a(words: Mapping[int, int], name: str) -> float:
    return CoarseFine.parse(words[_ADDRESSES[name]]).current_a


def _log_ratio(above: float, below: float) -> float:
    """Return ln(above / below); without any current above, as low as can be, and as high without any below."""
    if above == 0:
        return -math.inf
    return math.inf if below == 0 else math.log(above / below)
