"""The effect of a DVXplorer's registers on the sensor: factors on the parameters at dv-processing's default words.

    threshold_on     1 + STEP x (v_on - 9)      v_on  = ON current, 0 to 8, + 9 in the larger range (0x0B bit 1)
    threshold_off    1 + STEP x (v_off - 9)     v_off = 8 - OFF current, + 9 at the lower level (0x12 bit 1 is 0)

dv-processing writes such levels, 0 to 17, default 9 (observed), and libcaer's five presets of sensitivity fit the same
scale: very low 15 and 15, low 12 and 12, default 9 and 9, high 5 and 5, very high 2 and 2. A larger level is a higher
threshold.

No threshold in physical units is public. Basis of the model, all of it assumed: the two ranges of a current are a
factor of ten apart (5 and 50 uA, libcaer 3.3.15, dvxplorer.h) and nine steps go through one; a step is then a tenth of
a decade, and the threshold of a change detector rises with the logarithm of its current, F ln(I / I_d) with F = 0.0714
(jAER for a DAVIS, which cites IEEE 7962235). So a step is F ln(10) / 9 = 0.0183 ln units, 7.3 % of the preset's 0.25.

The period of a scan is proportional to that of the registers (`registers.scan_us`); at their power-on values the factor
is 1.

The other bias registers have no effect here: `without_effect` names them.
"""

from __future__ import annotations

from collections.abc import Callable

from firmware_protocol.device import LEAST_FACTOR, MOST_FACTOR

STEP = 0.073
_DEFAULT_LEVEL = 9
_DEFAULT_SCAN_US = 199.0  # of the registers' power-on values
_RANGE_LEVELS = 9
_MOST_CURRENT = 8

_RANGES, _LEVELS, _ON, _OFF = 0x0B, 0x12, 0x1C, 0x1E
_ON_RANGE, _OFF_LEVEL = 1 << 1, 1 << 1

_OTHERS = {
    "amplifier current": (0x18, 0xFF, 4),
    "logarithmic pixel and source follower ranges": (0x0B, 0x0D, 0x04),
    "logarithmic amplifier and digital ranges": (0x0C, 0xFF, 0x14),
    "source follower level": (0x12, 0x10, 0x10),
}
"""Register, bits and default of biases that are not modelled."""


def sensor_factors(chip: Callable[[int], int], scan_us: float) -> dict[str, float]:
    """Return the factors that are not 1, by sensor parameter.

    `chip` returns the chip's register at an address; `scan_us` is the period of a scan that the registers select.
    """
    on = min(chip(_ON), _MOST_CURRENT) + _RANGE_LEVELS * bool(chip(_RANGES) & _ON_RANGE)
    off = _MOST_CURRENT - min(chip(_OFF), _MOST_CURRENT) + _RANGE_LEVELS * (not chip(_LEVELS) & _OFF_LEVEL)
    return level_factors(on, off, scan_us)


def level_factors(on: int, off: int, scan_us: float) -> dict[str, float]:
    """Return the factors that are not 1, by sensor parameter, of ON and OFF levels (0 to 17) and a period of a scan."""
    levels = {"threshold_on": on, "threshold_off": off}
    factors = {name: 1 + STEP * (v - _DEFAULT_LEVEL) for name, v in levels.items()}
    factors["scan_us"] = min(max(scan_us / _DEFAULT_SCAN_US, LEAST_FACTOR), MOST_FACTOR)
    return {name: factor for name, factor in factors.items() if factor != 1}


def without_effect(chip: Callable[[int], int]) -> dict[str, str]:
    """Return the biases that were changed without an effect here, each with the reason."""
    changed = [name for name, (address, bits, default) in _OTHERS.items() if (chip(address) ^ default) & bits]
    return dict.fromkeys(changed, "it is not modelled: its effect is not public")
