"""The effect of the biases on the pixels is a set of factors on the parameters that the factory's biases give:

    threshold_on         e^(diff_on      x steps of diff_on)                             but at most e^largest_exponent
    threshold_off        e^(diff_off     x steps of diff_off); above the factory's value diff_off_above; likewise
    off_latency_us       e^(off_delay    x steps of diff_off)
    refractory_us    1 / max(1 + refr    x steps of refr, refr)
    corner_max_hz         1 + fo         x steps of fo; source_follower_hz if the sensor has a source follower, which
                                         filters its noise as well, unless that has a pole of its own
    highpass_hz      adds hpf        x steps of hpf above the factory's value, Hz

`steps` are those away from the factory's value, and the slopes are those of `BiasSlopes`: at the factory's biases all
factors are 1, and the parameters are those of the sensor's preset or of the rig. Factors end at 0.1 and 1000, the sum
at 1000 Hz. The register of refr at 0 acts as at 1, the least current: without one a pixel would never leave its reset.

No formula is public. Basis of the model:

    directions      Prophesee's page "Biases": a higher diff_on, diff_off is a higher threshold, a higher fo passes
                    faster changes, a higher refr is a shorter dead time, a higher hpf suppresses faster changes
    diff_on,        fitted to latencies that NIST measured on a camera of this family at seven pairs of biases (doi
    diff_off        10.1109/tim.2025.3623767; digitised, see `evstim validate`), by the law of the photoreceptor:
                    thresholds by latency. From diff_on 70 and diff_off 95 on they rise no more
    off_delay       the same: the latency of OFF events has a part that does not depend on light, of about 30, 190 and
                    1300 us at diff_off 47, 95 and 142: an exponential. The comparator of OFF events, whose current
                    falls as its threshold rises, explains that
    fo, refr        registers are current DACs. The corner of a follower is proportional to its current and a dead time
                    inverse, as in jAER's formulas (IEEE 7962235); so a slope is one over the factory's value, 83 and 20
                    (those in neuromorphic_drivers). Assumed: current is proportional to the register
    hpf             the same assumption for a corner frequency; the factory's register is 0, where there is no filter.
                    Prophesee publishes the direction alone. 1 Hz a step, 120 Hz at the end of the range, is a guess
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Annotated, Literal

from msgspec import Meta

from firmware_protocol.bounds import Bounded, Share
from firmware_protocol.device import LEAST_FACTOR, MOST_FACTOR

_WITHOUT_EFFECT = {
    "hpf": "the least cut-off is that of the factory's value",
    "diff": "the reference that both thresholds share is not modelled; Prophesee advises not to change it",
}


@dataclass(frozen=True)
class BiasSlopes(Bounded):
    """Effect of one step of each bias on the simulated IMX636.

    Attributes
    ----------
    diff_on, diff_off
        Of the logarithm of the ON and the OFF contrast threshold, 0 to 1; `diff_off` holds below the factory's value.
    diff_off_above : the same of the OFF contrast threshold above the factory's value.
    largest_exponent : largest logarithm of a contrast threshold over the factory's, 0 to 1.
    off_delay : of the logarithm of the delay of OFF events, a step of diff_off, where the sensor has such a delay.
    fo : of the low-pass corner frequency, as a share, 0 to 1: one over the factory's value of the register.
    refr : of the inverse of the refractory period, likewise.
    hpf : corner frequency of the high-pass, Hz a step above the factory's value, 0 to 100.
    """

    diff_on: Share = 0.0143
    diff_off: Share = 0.0208
    diff_off_above: Share = 0.0136
    largest_exponent: Share = 1.0
    off_delay: Share = 0.0445
    fo: Share = 0.012
    refr: Share = 0.05
    hpf: Annotated[float, Meta(ge=0, le=100)] = 1.0


@dataclass(frozen=True)
class BiasModel:
    """The conversion, for one sensor.

    Attributes
    ----------
    low_pass : Parameter that bias fo changes: the fixed pole after the photoreceptor, or, if the sensor has none, the
        photoreceptor's corner frequency in bright light.
    has_delay : True: the sensor delays its OFF events, by a time that diff_off changes.
    """

    slopes: BiasSlopes = field(default_factory=BiasSlopes)
    low_pass: Literal["corner_max_hz", "source_follower_hz"] = "corner_max_hz"
    has_delay: bool = False

    def factors(self, steps: Mapping[str, int]) -> dict[str, float]:
        """Return the factors that are not 1, and Hz to add to `highpass_hz`, for steps from the factory's biases."""
        slopes, off = self.slopes, steps.get("diff_off", 0)
        off_slope = slopes.diff_off if off < 0 else slopes.diff_off_above
        faster = max(1 + slopes.refr * steps.get("refr", 0), slopes.refr)
        factors = {
            "threshold_on": math.exp(min(slopes.diff_on * steps.get("diff_on", 0), slopes.largest_exponent)),
            "threshold_off": math.exp(min(off_slope * off, slopes.largest_exponent)),
            "off_latency_us": math.exp(slopes.off_delay * off) if self.has_delay else 1.0,
            "refractory_us": 1 / faster,
            self.low_pass: 1 + slopes.fo * steps.get("fo", 0),
        }
        limited = {name: min(max(factor, LEAST_FACTOR), MOST_FACTOR) for name, factor in factors.items()}
        changed = {name: factor for name, factor in limited.items() if factor != 1}
        high_hz = min(slopes.hpf * max(steps.get("hpf", 0), 0), MOST_FACTOR)
        return {**changed, "highpass_hz": high_hz} if high_hz else changed

    def without_effect(self, steps: Mapping[str, int]) -> dict[str, str]:
        """Return the biases that were changed without an effect here, each with the reason."""
        acting = {slope.name for slope in fields(self.slopes) if slope.name != "hpf" or steps.get("hpf", 0) >= 0}
        moved = sorted(name for name, offset in steps.items() if offset and name not in acting)
        return {name: _WITHOUT_EFFECT.get(name, "it is not modelled") for name in moved}
