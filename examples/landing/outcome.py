"""Verdict of a landing, in figures and in words: verdict.json."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from errors import divergence_errors
from mission import Bounds
from spacecraft import TouchDown

__all__ = ["FIGURES", "reasons", "verdict"]

FIGURES = {
    "vertical_m_s": "speed down, m/s",
    "horizontal_m_s": "speed along the ground, m/s",
    "tilt_deg": "tilt, degrees",
    "place_m": "distance from the site, m",
}
"""Figures that are judged, and their names with the unit."""

_SOFT_M_S = 1.0
_STORM_1_S = 300_000  # the ground alone gives 60 000 to 100 000 events a second
_POSES = {
    "poses refused": "poses were refused: no numbers, or damaged",
    "poses stale": "poses were refused: their times went back",
    "poses too far ahead": "poses were refused: stamped too far ahead",
    "pictures with a late pose": "pictures were drawn with a pose that stood still for want of a newer one",
}


def verdict(end: TouchDown, out: Path, frames_lost: int = 0) -> dict[str, object]:
    """Return the verdict of a landing and the error of its divergence; call after the camera's end.

    `soft` is the verdict: on the ground, below 1 m/s. `why` has a sentence for each fault and error, also after a
    good landing.
    """
    soft = end.touched and end.vertical_m_s < _SOFT_M_S
    found: dict[str, object] = {"soft": soft, "touched": end.touched, "t_s": end.t_s}
    found |= {"vertical_m_s": end.vertical_m_s, "horizontal_m_s": end.horizontal_m_s, "fuel_kg": end.fuel_kg}
    found["height_m"] = float(end.state.position_m[2])
    why = [*end.why, *_of_computer(out), *_of_camera(out)]
    why += [f"{frames_lost} attitudes and commands were lost on the bus"] if frames_lost else []
    return found | {"why": why} | _errors(out)


def reasons(judged: dict[str, Any]) -> Iterator[str]:
    """Yield why a flight is not good: a sentence for each figure beyond its bound."""
    if not judged["touched"]:
        yield f"no touchdown: {judged['height_m']:.1f} m up after {judged['t_s']:.1f} s"
        return
    for name in judged.get("beyond", [] if judged["soft"] else ["vertical_m_s"]):
        yield f"{FIGURES[name]}: {judged[name]:.2f}, beyond the bound of {getattr(Bounds(), name):g}"


def _errors(out: Path) -> dict[str, float]:
    log = out / "computer.jsonl"
    return divergence_errors(out) if log.exists() and log.read_text().strip() else {}


def _of_computer(out: Path) -> Iterator[str]:
    log = out / "computer.jsonl"
    rows = [json.loads(line) for line in log.read_text().splitlines()] if log.exists() else []
    if not rows:
        yield "the flight computer answered no SYNC"
        return
    if lost := rows[-1].get("events_lost", 0):
        yield f"{lost} events were lost on the serial line"
    if without := sum(row["lost"] for row in rows):
        yield f"dead reckoning: no motion was seen in {without} of {len(rows)} turns"
    if without := sum(not row.get("edge", True) for row in rows):
        yield f"no edge of the SYNC came from the camera in {without} of {len(rows)} turns"


def _of_camera(out: Path) -> Iterator[str]:
    """Yield sentences from the camera's summary, where this flight started the camera."""
    file = out / "summary.json"
    text = file.read_text().strip() if file.exists() else ""
    if not text:
        return
    found = json.loads(text.splitlines()[-1])
    for name, words in _POSES.items():
        if count := found["scene"].get(name, 0):
            yield f"{count} {words}"
    if (rate := found["events"]["read_out"] / (found["sim_seconds"] or 1.0)) > _STORM_1_S:
        yield f"a storm of events: {rate:.0f} a second"
    for link, report in found["links"].items():
        for fault in report.get("faults", []):
            lost = f": {fault['events_lost']} events lost" if fault.get("events_lost") else ""
            yield f"fault {fault['kind']} on {link} from {fault.get('began_us', 0) * 1e-6:.1f} s on{lost}"
    for rule in found["rules"]:
        if not rule["good"]:
            yield f"the camera's run was not good: {rule['rule']}: {rule['told']}"
