"""Traces of the picture rate in event times: what a sensor that looks at continuous light would not show.

middle share    share of the events in the middle twentieth of their step: 0.05 where the step leaves no trace
second half     events in the second half of their step over those in the first, less 1
line            strongest line of the spectrum of event counts at the picture rate and its multiples, over the
                median power of the spectrum
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

__all__ = ["Comb", "comb_of"]

_BINS_A_STEP = 64
_HARMONICS = 8


@dataclass(frozen=True, slots=True)
class Comb:
    """Traces of the picture rate; the module's first lines define each. NaN: too few events."""

    middle_share: float
    second_half: float
    line: float


def comb_of(t_us: npt.ArrayLike, step_us: float) -> Comb:
    """Return the traces that steps of `step_us`, the first at 0, leave in event times, (n,) us."""
    times = np.asarray(t_us, np.float64)
    if times.size < 2:
        return Comb(np.nan, np.nan, np.nan)
    phase = (times / step_us) % 1.0
    middle = float(np.mean(np.abs(phase - 0.5) < 0.025))
    first = int(np.count_nonzero(phase < 0.5))
    second_half = (times.size - first) / first - 1 if first else np.inf
    return Comb(middle, float(second_half), _line(times, step_us))


def _line(times_us: npt.NDArray[np.float64], step_us: float) -> float:
    """Return the strongest power at multiples of the picture rate over the median power."""
    steps = int(np.ceil(times_us.max() / step_us))
    counts, _ = np.histogram(times_us, steps * _BINS_A_STEP, (0.0, steps * step_us))
    # A window keeps the slow change of the event rate out of the other lines.
    power = np.abs(np.fft.rfft((counts - counts.mean()) * np.hanning(counts.size))) ** 2
    median = float(np.median(power[1:]))
    lines = power[steps : steps * (_HARMONICS + 1) : steps]
    return float(lines.max() / median) if median > 0 and lines.size else float("nan")
