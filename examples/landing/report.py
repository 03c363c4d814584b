"""Verdict of a flight, verdict.json, its page, page.html, and its delays in real time, latency.json.

The page contains the verdict and its reasons, the track, velocities and divergence beside the truth, and the last
events that the flight computer received. It needs no network and no script; charts are drawn by matplotlib.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from spacecraft import TouchDown
from vehicle import Height, matrix

from emulator.report.document import Document, Section
from emulator.report.page import BLUE, RED, image, panels, pyplot
from emulator.report.pictures import OFF_RGB, ON_RGB, image_element, palette_png

FIGURES = {
    "vertical_m_s": "speed down, m/s",
    "horizontal_m_s": "speed along the ground, m/s",
    "tilt_deg": "tilt, degrees",
    "place_m": "distance from the site, m",
}
"""Figures that are judged, and their names with the unit."""

BOUNDS = {"vertical_m_s": 1.0, "horizontal_m_s": 0.5, "tilt_deg": 5.0, "place_m": 25.0}
SITE_BOUNDS = {"slope_deg": 12.0, "rock_m": 0.4}

_STORM_1_S = 300_000  # the ground alone gives 60 000 to 100 000 events a second
_POSES = {
    "poses refused": "poses were refused: no numbers, or damaged",
    "poses stale": "poses were refused: their times went back",
    "poses too far ahead": "poses were refused: stamped too far ahead",
    "pictures with a late pose": "pictures were drawn with a pose that stood still for want of a newer one",
}
_FEET_M, _PLACES = 1.5, 9
_LEAST_M = 3.0  # nearer, the ground in view is no longer that below
COLOURS = np.array([(30, 30, 30), ON_RGB, OFF_RGB], np.uint8)
_SHAPE = 260, 346
_SHOWN_US = 30_000
_BEFORE_S = (2.0, 1.0, 0.0)  # pictures of the page, before the newest event
_MOST_1_S = 0.3  # of a divergence that is drawn: at touchdown that of the truth grows beyond bounds


Row = dict[str, Any]
"""A turn of the flight computer, from its log."""


def judgement(end: TouchDown, ground_m: Height) -> dict[str, object]:
    """Return the figures of a landing, `beyond` (names of those over their bound) and `soft` (none, and touched).

    `site_good`: slope of the plane through the ground under four feet and the highest ground above it between them are
    within their bounds. Nothing on board looks for a good site, so it is no part of `soft`.
    """
    x, y, _ = end.state.position_m.tolist()
    figures = {
        "vertical_m_s": end.vertical_m_s,
        "horizontal_m_s": end.horizontal_m_s,
        "tilt_deg": math.degrees(math.acos(min(1.0, float(matrix(end.state.attitude)[2, 2])))),
        "place_m": math.hypot(x, y),
    }
    beyond = [name for name, value in figures.items() if not value < BOUNDS[name]]
    beside_m = np.linspace(-_FEET_M, _FEET_M, _PLACES)
    heights = np.array([[ground_m(x + a, y + b) for b in beside_m.tolist()] for a in beside_m.tolist()])
    middle = _PLACES // 2
    feet = heights[-1, middle], heights[middle, -1], heights[0, middle], heights[middle, 0]
    east, north = (feet[0] - feet[2]) / (2 * _FEET_M), (feet[1] - feet[3]) / (2 * _FEET_M)
    plane = sum(feet) / 4 + beside_m[:, None] * east + beside_m * north
    slope_deg = math.degrees(math.atan(math.hypot(east, north)))
    site = {"slope_deg": slope_deg, "rock_m": float((heights - plane).max(initial=0.0))}
    site_good = all(value < SITE_BOUNDS[name] for name, value in site.items())
    return figures | site | {"site_good": site_good, "beyond": beyond, "soft": bool(end.touched and not beyond)}


def rows_of(folder: Path) -> list[Row]:
    """Return the turns of the flight computer."""
    log = folder / "computer.jsonl"
    return [json.loads(line) for line in log.read_text().splitlines()] if log.exists() else []


class Flight:
    """Files of a flight in its folder; `events` are the last ones of the flight computer."""

    def __init__(self, folder: Path) -> None:
        names, *lines = [line.split(",") for line in (folder / "truth.csv").read_text().splitlines()]
        columns = np.array(lines, np.float64).reshape(-1, len(names)).T
        self.truth = dict(zip(names, columns, strict=True))
        self.rows = rows_of(folder)
        file = folder / "last_events.npz"
        self.events = np.load(file)["events"] if file.exists() else np.zeros(0, [("t", "u8"), ("on", "?")])
        self.height_m = self.truth["z_m"] - self.truth["ground_m"]
        self.end_s = float(self.truth["t_s"].max(initial=0.0))

    def seen(self) -> tuple[np.ndarray, np.ndarray]:
        """Return times, s, and divergences, 1/s, that were accepted, (n,) each."""
        pairs = {row["at_s"]: row["down_1_s"] for row in self.rows if np.isfinite(row.get("gain", np.nan))}
        return np.array(list(pairs)), np.array(list(pairs.values()))

    def picture(self, t_s: float) -> np.ndarray:
        """Return the pixels with events in the 30 ms before a time as numbers of COLOURS, (260, 346)."""
        out = np.zeros(_SHAPE, np.uint8)
        if len(self.events):
            first, last = np.searchsorted(self.events["t"], [t_s * 1e6 - _SHOWN_US, t_s * 1e6])
            chosen = self.events[first:last]
            out[chosen["y"], chosen["x"]] = np.where(chosen["on"], 1, 2)
        return out


def divergence_errors(flight: Flight) -> dict[str, float]:
    """Return median and 90 % of the absolute relative error of the divergence, its median with its sign, and losses.

    Each accepted motion counts once; its truth is speed over height above the ground below, at its time.
    """
    (at_s, down), truth = flight.seen(), flight.truth
    height_m = np.interp(at_s, truth["t_s"], flight.height_m)
    wanted = height_m > _LEAST_M
    if not wanted.any():
        return {}
    speed_m_s = -np.interp(at_s, truth["t_s"], truth["vz_m_s"])
    error = (down * height_m / speed_m_s - 1)[wanted]
    low, high = np.percentile(np.abs(error), [50, 90])
    share = float(np.mean([row["lost"] for row in flight.rows]))
    return {"error_median": float(low), "error_p90": float(high), "bias": float(np.median(error)), "lost_share": share}


def verdict(end: TouchDown, out: Path, frames_lost: int = 0) -> dict[str, object]:
    """Return the verdict of a landing and the error of its divergence; call after the camera's end.

    `soft` is the verdict: on the ground, below 1 m/s. `why` has a sentence for each fault and error, also after a
    good landing.
    """
    soft = end.touched and end.vertical_m_s < BOUNDS["vertical_m_s"]
    found: dict[str, object] = {"soft": soft, "touched": end.touched, "t_s": end.t_s}
    found |= {"vertical_m_s": end.vertical_m_s, "horizontal_m_s": end.horizontal_m_s, "fuel_kg": end.fuel_kg}
    found["height_m"] = float(end.state.position_m[2])
    rows = rows_of(out)
    why = [*end.why, *_of_computer(rows), *_of_camera(out / "summary.json")]
    why += [f"{frames_lost} attitudes and commands were lost on the bus"] if frames_lost else []
    return found | {"why": why} | (divergence_errors(Flight(out)) if rows else {})


def reasons(judged: dict[str, Any]) -> Iterator[str]:
    """Yield why a flight is not good: a sentence for each figure beyond its bound."""
    if not judged["touched"]:
        yield f"no touchdown: {judged['height_m']:.1f} m up after {judged['t_s']:.1f} s"
        return
    for name in judged.get("beyond", [] if judged["soft"] else ["vertical_m_s"]):
        yield f"{FIGURES[name]}: {judged[name]:.2f}, beyond the bound of {BOUNDS[name]:g}"


def _of_computer(rows: list[Row]) -> Iterator[str]:
    """Yield sentences from the turns of the flight computer."""
    if not rows:
        yield "the flight computer answered no SYNC"
        return
    if lost := rows[-1].get("events_lost", 0):
        yield f"{lost} events were lost on the serial line"
    if without := sum(row["lost"] for row in rows):
        yield f"dead reckoning: no motion was seen in {without} of {len(rows)} turns"
    if without := sum(not row.get("edge", True) for row in rows):
        yield f"no edge of the SYNC came from the camera in {without} of {len(rows)} turns"


def _of_camera(file: Path) -> Iterator[str]:
    """Yield sentences from the camera's summary, where this flight started the camera."""
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


_PARTS = "turn begins", "estimate", "command on bus", "shown by a pose"


def latencies(
    origin_ns: int, commands: Sequence[tuple[int, int, int]], rows: Sequence[dict[str, Any]]
) -> dict[str, object]:
    """Return the parts of the loop's delay for latency.json, of a flight's spacecraft and the log of its computer.

    Of each command, on CLOCK_MONOTONIC, t the time of the edge whose SYNC it answers (the end of its window of events):

        turn begins        from t until the estimate begins: SYNC, edge and events on the links, end of the last one
        estimate           until the command is decided
        command on bus     until the spacecraft has it
        shown by a pose    until a pose that it changed is sent: the rest of a step of the dynamics
        event on the link  from an event's time until it is at the computer: that of the oldest or the newest of a
                           read, for half of its events each

    Apart: the estimator's window, half of which delays the estimate.
    """
    instants = []
    for counter, received_ns, shown_ns in commands:
        ended = [row for row in rows if row["counter"] == counter and row["ended_ns"] < received_ns]
        for row in ended[-1:]:  # counters restart after 240: the newest of them
            edge_ns = origin_ns + row["t_s"] * 1e9
            instants.append((edge_ns, row["began_ns"], row["ended_ns"], received_ns, shown_ns))
    parts_ns = dict(zip(_PARTS, np.diff(np.reshape(instants, (-1, len(_PARTS) + 1))).T, strict=True))
    arrivals = np.array([arrival for row in rows for arrival in row["arrivals"]], np.int64).reshape(-1, 4)
    at_ns, oldest_us, newest_us, events = arrivals.T
    late_ns = [at_ns - origin_ns - us * 1000 for us in (oldest_us, newest_us)]
    parts_ns["event on the link"] = np.repeat(np.concatenate(late_ns), np.tile((events + 1) // 2, 2))
    parts_ms = {name: _statistics(values_ns * 1e-6) for name, values_ns in parts_ns.items()}
    return {"parts_ms": parts_ms, "window_s": _statistics(np.array([row["window_s"] for row in rows]))}


def _statistics(values: np.ndarray) -> dict[str, float | None]:
    low, high = np.percentile(values, [50, 95]).round(3).tolist() if len(values) else (None, None)
    return {"median": low, "p95": high, "n": len(values)}


def write_page(folder: Path) -> Path:
    """Write page.html beside verdict.json; return its path. Raises ChartsLacking where matplotlib is not installed."""
    judged = json.loads((folder / "verdict.json").read_text())
    flight = Flight(folder)
    law = judged.get("guidance") or ("the example's law" if judged["navigation"] != "given" else "given attitude")
    words = "landed within the bounds" if judged["soft"] else "not a landing within the bounds"
    kind = "good" if judged["soft"] else "bad"
    page = Document("A landing guided by events", f"{law}; navigation: {judged['navigation']}; {folder}", kind, words)
    page.add(Section("Reasons").listed([*reasons(judged), *judged["why"]] or ["Nothing went wrong."]))
    names = FIGURES | {"t_s": "time, s", "height_m": "height of the camera, m", "fuel_kg": "propellant, kg"}
    figures = [
        {"figure": text, "at the end": judged.get(name), "bound": BOUNDS.get(name)} for name, text in names.items()
    ]
    page.add(Section("Figures").records(figures, "Touchdown, or the end of the flight"))
    if len(flight.height_m):
        page.add(Section("Track, velocities and divergence").chart(*_charts(flight)))
    events = Section("Last events")
    if not (len(flight.events) and len(flight.height_m)):
        return page.add(events.text("No events came.")).write(folder / "page.html")
    end_s = min(flight.end_s + 1.0, float(flight.events["t"][-1]) * 1e-6)
    pictures = ""
    for at_s in end_s - np.array(_BEFORE_S):
        up_m = np.interp(at_s, flight.truth["t_s"], flight.height_m)
        text = f"events of 30 ms at {at_s:.2f} s, {up_m:.1f} m above the ground; ON orange, OFF blue"
        element = image_element(palette_png(flight.picture(at_s), COLOURS), text, _SHAPE[1])
        pictures += f"<figure>{element}<figcaption>{text}</figcaption></figure>"
    return page.add(events.element(f'<div class="maps">{pictures}</div>')).write(folder / "page.html")


def _charts(flight: Flight) -> tuple[str, str]:
    """Return the charts of a flight as an element, and the text below it."""
    truth, known = flight.truth, [row for row in flight.rows if "velocity_m_s" in row]
    figure, axes = panels(6, 3, 3.6, 2.6)
    (plan,), (height,), (divergence,), *speeds = axes
    at_s = np.array([row["estimate_s"] for row in known])
    places = np.array([row["position_m"] for row in known]).reshape(-1, 3)
    plan.plot(truth["x_m"], truth["y_m"], color=BLUE)
    plan.plot(places[:, 0], places[:, 1], color=RED, lw=0.8)
    plan.add_patch(pyplot().Circle((0, 0), BOUNDS["place_m"], fill=False, ls=":"))
    plan.set(xlabel="east, m", ylabel="north, m", aspect="equal", title="track; dots: bound of the place")
    plan.margins(0.1)
    height.plot(truth["t_s"], truth["z_m"], color=BLUE, label="truth")
    height.plot(at_s, places[:, 2], color=RED, lw=0.8, label="navigation")
    height.set(xlabel="time, s", title="height above the site, m", yscale="log")
    height.legend(fontsize=7)
    divergence.plot(truth["t_s"], -truth["vz_m_s"] / flight.height_m, color=BLUE)
    divergence.plot(*flight.seen(), ".", ms=2.5, color=RED)
    divergence.set(xlabel="time, s", title="divergence, 1/s; dots: from events", ylim=(0, _MOST_1_S))
    velocities = np.array([row["velocity_m_s"] for row in known]).reshape(-1, 3)
    for k, ((axis,), name, key) in enumerate(zip(speeds, ("east", "north", "up"), ("vx", "vy", "vz"), strict=True)):
        axis.plot(truth["t_s"], truth[f"{key}_m_s"], color=BLUE)
        axis.plot(at_s, velocities[:, k], color=RED, lw=0.8)
        axis.set(xlabel="time, s", title=f"velocity {name}, m/s")
    for (axis,) in axes:
        axis.grid(alpha=0.3)
    return image(figure, "track, height, divergence and velocities"), "Blue: truth; red: navigation, or from events."
