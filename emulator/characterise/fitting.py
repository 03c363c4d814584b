"""Figures of `[camera.sensor]` that match the statistics of a recording of stillness best.

Where nearly all events are ON and none alternate, they are leak: its rate, and its spread from the pixels' counts.
Otherwise they are background activity (`BackgroundParameters`). With p the ON share of primaries, s the share that is
followed by a second event, S = p^2 + (1 - p)^2 and D = 1 - S:

    hot pixels      those beyond what the others' counts allow once in a hundred recordings
    s               opposite successors within `_PAIRED_S`, less those by chance, over primaries
    p               from the ON share of all, (p + s (1 - p)) / (1 + s)
    s of hot ones   from the share of opposite successors, (s + s S + (1 - s) D) / (1 + s)
    spread          from the variance of the counts beyond that of pairs at one rate
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from scipy import stats

from emulator.characterise.activity import Activity

__all__ = ["fit", "toml"]

_LEAK_ON_SHARE, _LEAK_OPPOSITE = 0.95, 0.1
_PAIRED_S = 0.05
_CHANCE = 0.01
_ROUNDS = 20
_SURELY_NOT_HOT = 0.998  # of the pixels
_LEAST_HOT = 3.0


def fit(recorded: Activity) -> dict[str, float | dict[str, float]]:
    """Return the figures by their keys; those of a table in a dictionary.

    Raises
    ------
    ValueError
        The recording has no events.
    """
    if not recorded.events:
        raise ValueError("no events to fit a sensor to")
    alternating = recorded.opposite_share if recorded.intervals_s.size else 0.0
    quiet: dict[str, float] = {"rms": 0.0}
    if recorded.on_share > _LEAK_ON_SHARE and alternating < _LEAK_OPPOSITE:
        spread = _spread(recorded.counts, 0.0)
        return {
            "leak_hz": recorded.rate_hz, "leak_spread": spread, "parasitic_hz_at_reference": 0.0, "noise": quiet,
            "background": {"hz": 0.0, "hot_share": 0.0},
        }  # fmt: skip
    return {"leak_hz": 0.0, "parasitic_hz_at_reference": 0.0, "noise": quiet, "background": _background(recorded)}


def _background(recorded: Activity) -> dict[str, float]:
    hot = recorded.counts > _most(recorded)
    ordinary = recorded.counts[~hot]
    pair, pair_s = _pairs(recorded, int(ordinary.sum()), hot)
    first_on = float(np.clip((recorded.on_share * (1 + pair) - pair) / (1 - pair), 0, 1))
    hot_events = int(recorded.counts[hot].sum())
    return {
        "hz": float(ordinary.mean() / recorded.seconds),
        "spread": _spread(ordinary, pair),
        "off_share": 1 - first_on,
        "pair_share": pair,
        "pair_us": float(np.clip(pair_s * 1e6, 1, 1e6)),
        "hot_share": float(hot.mean()),
        "hot_hz": hot_events / max(int(hot.sum()), 1) / recorded.seconds,
        "hot_pair_share": _hot_pairs(recorded.opposite_share, first_on) if hot_events else 0.0,
    }


def _most(recorded: Activity) -> float:
    """Return the largest count of a pixel that is not hot."""
    counts = np.sort(recorded.counts)
    most = float(counts[int(_SURELY_NOT_HOT * (counts.size - 1))])
    for _ in range(_ROUNDS):
        ordinary = counts[counts <= most]
        # Pairs and unequal rates widen a Poisson number: a negative binomial one with the variance found.
        mean, variance = max(float(ordinary.mean()), 1e-9), float(ordinary.var())
        size = mean**2 / max(variance - mean, 1e-6 * mean)
        bound = float(stats.nbinom.isf(_CHANCE / counts.size, size, size / (size + mean)))
        if bound <= most:
            break
        most = bound
    return max(most, _LEAST_HOT)


def _pairs(recorded: Activity, events: int, hot: npt.NDArray[np.bool_]) -> tuple[float, float]:
    """Return the share of primaries with a second event, and the mean wait for it, s, of pixels that are not hot."""
    number = np.maximum(recorded.counts - 1, 0)
    ordinary = ~np.repeat(hot, number)
    short = ordinary & recorded.opposite & (recorded.intervals_s < _PAIRED_S)
    by_chance = events * (events / max(int((~hot).sum()), 1)) * _PAIRED_S / recorded.seconds / 2
    seconds = max(float(short.sum()) - by_chance, 0.0)
    share = min(seconds / max(events - seconds, 1.0), 0.95)
    return share, float(recorded.intervals_s[short].mean()) if short.any() else 1e-3


def _hot_pairs(opposite: float, first_on: float) -> float:
    same = first_on**2 + (1 - first_on) ** 2
    other = 1 - same
    return float(np.clip((opposite - other) / max(1 + same - other - opposite, 1e-9), 0, 1))


def _spread(counts: npt.NDArray[np.int64], pair: float) -> float:
    """Return the log-normal spread of the rates that the variance of the counts tells."""
    mean = float(counts.mean())
    if mean == 0:
        return 0.0
    at_one_rate = mean * (1 + 3 * pair) / (1 + pair)
    return min(math.sqrt(math.log1p(max(float(counts.var()) - at_one_rate, 0) / mean**2)), 3.0)


def toml(figures: dict[str, float | dict[str, float]], remark: str) -> str:
    """Return the figures as tables of a rig."""
    lines = [f"# {remark}", "[camera.sensor]"]
    lines += [f"{key} = {value:.6g}" for key, value in figures.items() if not isinstance(value, dict)]
    for name, table in figures.items():
        if isinstance(table, dict):
            lines += ["", f"[camera.sensor.{name}]", *(f"{key} = {_number(value)}" for key, value in table.items())]
    return "\n".join(lines) + "\n"


def _number(value: float) -> str:
    return f"{value:.6g}"
