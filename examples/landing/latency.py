"""Parts of the loop's delay in a flight in real time: `latency.json`, medians and 95 % of each part.

    python latency.py FLIGHT_FOLDER

Of each command, on CLOCK_MONOTONIC, t the time of the edge whose SYNC it answers (the end of its window of events):

    turn begins        from t until the estimate begins: SYNC, edge and events on the links, end of the last estimate
    estimate           until the command is decided
    command on bus     until the spacecraft has it
    shown by a pose    until a pose that it changed is sent: the rest of a step of the dynamics
    light              until the first event of that pose's light: from nods of one pixel before the descent, which are
                       steps at known times; median and 95 % of them
    event on the link  until that event is at the computer

`loop` is the whole of it. Apart: the estimator's window, half of which delays the estimate, the time between two
commands, and the lead: the value of the rig beside the one that its steps needed (from the camera's summary.json).
"""

from __future__ import annotations

import json
import os
import sys
import tomllib
from pathlib import Path

import numpy as np
import numpy.typing as npt

__all__ = ["latencies", "light_delays_s"]

Floats = npt.NDArray[np.float64]

_TIMES_QUIET = 5.0  # a nod's first events: so many times the events of the quiet before it, and
_LEAST_EVENTS = 20  # not fewer than so many in a bin
_LONGEST_S = 0.2  # before the next nod


def latencies(out: Path) -> dict[str, object]:
    """Return the delays for latency.json, from spacecraft.json, computer.jsonl, standing.json of a real-time flight."""
    times = json.loads((out / "spacecraft.json").read_text())
    rows = [json.loads(line) for line in (out / "computer.jsonl").read_text().splitlines()]
    parts = _parts(times, rows)
    events = _event_delays_s(rows, times["origin_ns"])
    light = light_delays_s(json.loads((out / "standing.json").read_text()), times["nods_s"])
    link_s = float(np.median(events)) if len(events) else float("nan")
    fixed_s = float(np.median(light)) + link_s if len(light) else float("nan")
    loop = sum(parts.values()) + fixed_s
    parts_ms = {name: _statistics(values) for name, values in parts.items()}
    parts_ms |= {"light": _statistics(light), "event on the link": _statistics(events), "loop": _statistics(loop)}
    windows = np.array([row["window_s"] for row in rows])
    return {
        "parts_ms": parts_ms,
        "window_s": {"median": _quantile(windows, 50), "p95": _quantile(windows, 95)},
        "period_ms": _statistics(np.diff([row["t_s"] for row in rows])),
        "nods_seen": [len(light), len(times["nods_s"])],
        "lead_us": _lead(out),
        "machine": {"cores": os.cpu_count(), "load_now": os.getloadavg()[0]},
    }


def light_delays_s(standing: dict[str, object], nods_s: list[float]) -> Floats:
    """Return the time from each detected nod to its first events, stream time, s.

    `standing` has counts of events from `from_us` on in bins of `bin_us`.
    """
    counts, bin_us = np.array(standing["counts"], float), float(standing["bin_us"])
    starts_s = (float(standing["from_us"]) + bin_us * np.arange(len(counts))) * 1e-6
    found = []
    for nod_s in nods_s:
        before = counts[(starts_s > nod_s - 0.02) & (starts_s <= nod_s)]
        after = (starts_s > nod_s) & (starts_s < nod_s + _LONGEST_S)
        if len(before):
            many = after & (counts > max(_TIMES_QUIET * float(np.median(before)), _LEAST_EVENTS))
            found += [float(starts_s[many][0]) - nod_s] if many.any() else []
    return np.array(found)


def _parts(times: dict[str, object], rows: list[dict[str, float]]) -> dict[str, Floats]:
    """Return the parts of each command that a pose showed, s."""
    origin_ns, ends = times["origin_ns"], {row["ended_ns"]: row for row in rows if row["counter"]}
    ended_ns = np.array(sorted(ends))
    names = ("turn begins", "estimate", "command on bus", "shown by a pose")
    out = []
    for command in times["commands"]:
        k = int(np.searchsorted(ended_ns, command["heard_ns"])) - 1
        while k >= 0 and ends[ended_ns[k]]["counter"] != command["counter"]:
            k -= 1  # counters restart after 240: the newest row before
        if k < 0:
            continue
        row = ends[ended_ns[k]]
        edge_ns = origin_ns + row["t_s"] * 1e9
        instants = (edge_ns, row["began_ns"], row["ended_ns"], command["heard_ns"], command["shown_ns"])
        out.append(np.diff(instants) * 1e-9)
    table = np.array(out).reshape(-1, len(names))
    return dict(zip(names, table.T, strict=True))


def _event_delays_s(rows: list[dict[str, list[list[int]]]], origin_ns: int) -> Floats:
    """Return the delay of each event, s: that of the oldest and newest of a read, for half of it each."""
    arrivals = np.array([one for row in rows for one in row["arrivals"]], np.int64).reshape(-1, 4)
    at_ns, oldest_us, newest_us, events = arrivals.T
    late = [(at_ns - origin_ns - us * 1000) * 1e-9 for us in (oldest_us, newest_us)]
    return np.repeat(np.concatenate(late), np.tile((events + 1) // 2, 2))


def _lead(out: Path) -> dict[str, object]:
    """Return the lead that is set, and the lead that the steps needed."""
    run = tomllib.loads((out / "landing.toml").read_text())["run"]
    lead: dict[str, object] = {"set": max(run["lead_us"], run["step_us"]), "step": run["step_us"]}
    summary = out / "summary.json"
    text = summary.read_text().strip() if summary.exists() else ""
    if text:
        lateness = json.loads(text.splitlines()[-1])["lateness"]
        lead["needed"] = lateness["lead_needed_us"]
        lead |= {name: lateness[name] for name in ("frames_late", "worst_gap_us", "steps_stretched")}
    return lead


def _statistics(values_s: Floats) -> dict[str, float]:
    return {"median": _quantile(values_s * 1e3, 50), "p95": _quantile(values_s * 1e3, 95), "n": len(values_s)}


def _quantile(values: Floats, percent: float) -> float | None:
    finite = values[np.isfinite(values)]
    return round(float(np.percentile(finite, percent)), 3) if len(finite) else None


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    (folder / "latency.json").write_text(json.dumps(latencies(folder), indent=1))
    print((folder / "latency.json").read_text())
