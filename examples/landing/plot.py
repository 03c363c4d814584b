"""Pictures of a landing: a GIF of the events beside the descent, and its last picture with the whole of it.

python fly.py --height 300 --out flight --record flight/events.npz
python plot.py flight                # flight/landing.gif, flight/landing.png; needs matplotlib and pillow
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

_DARK, _ON, _OFF = 30, (230, 159, 0), (86, 180, 233)  # orange and blue, as `evstim picture` draws events
_SHAPE = 260, 346
_SHOWN_US = 30_000
_GIF_FRAMES, _GIF_MS = 40, 150


class Flight:
    """Files of a flight in its folder."""

    def __init__(self, folder: Path) -> None:
        self.truth = np.genfromtxt(folder / "truth.csv", delimiter=",", names=True)
        self.rows = [json.loads(line) for line in (folder / "computer.jsonl").read_text().splitlines()]
        file = folder / "events-events.npz"  # the record of the link "events"
        self.events = np.load(file)["events"] if file.exists() else None
        self.height_m = self.truth["z_m"] - self.truth["ground_m"]
        self.end_s = float(self.truth["t_s"][-1])

    def seen(self) -> tuple[np.ndarray, np.ndarray]:
        """Return times and divergences that were accepted."""
        pairs = {row["at_s"]: row["down_1_s"] for row in self.rows if np.isfinite(row.get("gain", np.nan))}
        return np.array(list(pairs)), np.array(list(pairs.values()))

    def picture(self, t_s: float) -> np.ndarray:
        """Return the events of 30 ms as colours, (260, 346, 3)."""
        out = np.full((*_SHAPE, 3), _DARK, np.uint8)
        if self.events is None:
            return out
        first, last = np.searchsorted(self.events["t"], [t_s * 1e6 - _SHOWN_US, t_s * 1e6])
        chosen = self.events[first:last]
        out[chosen["y"], chosen["x"]] = np.where(chosen["on"][:, None], _ON, _OFF)
        return out


def figure(flight: Flight, t_s: float) -> Figure:
    """Return events of one instant, and height, speed and divergence up to it."""
    made = Figure(figsize=(9.2, 3.9), dpi=80, layout="constrained")
    left, *right = made.subplot_mosaic([["e", "h"], ["e", "v"], ["e", "d"]], width_ratios=[1.35, 1]).values()
    left.imshow(flight.picture(t_s), interpolation="nearest")
    k = int(np.searchsorted(flight.truth["t_s"], t_s).clip(0, len(flight.truth) - 1))
    speed = -flight.truth["vz_m_s"]
    left.set_title(f"{t_s:5.1f} s   {flight.height_m[k]:6.1f} m   {speed[k]:5.2f} m/s down", family="monospace")
    left.set_axis_off()
    times = flight.truth["t_s"][: k + 1]
    for axes, values, name in zip(
        right,
        (flight.height_m, speed, speed / flight.height_m),
        ("height, m", "speed, m/s", "divergence, 1/s"),
        strict=True,
    ):
        axes.plot(times, values[: k + 1], color="k", lw=1.2, label="truth")
        axes.set(xlim=(0, flight.end_s), ylabel=name)
        axes.grid(alpha=0.3)
    right[0].set(yscale="log", ylim=(1.5, flight.height_m.max() * 1.1))
    right[1].set(ylim=(0, speed.max() * 1.1))
    at_s, down = flight.seen()
    right[2].plot(at_s[at_s <= t_s], down[at_s <= t_s], ".", ms=2.5, color="tab:orange", label="from events")
    right[2].set(ylim=(0, 0.3), xlabel="time, s")
    right[2].legend(loc="upper left", fontsize=7)
    return made


def main(folder: Path) -> None:
    """Write both files."""
    from PIL import Image

    mpl.use("agg")
    flight, frames = Flight(folder), []
    for t_s in np.linspace(0.4, flight.end_s, _GIF_FRAMES):
        made = figure(flight, float(t_s))
        made.savefig(folder / "landing.png")
        with Image.open(folder / "landing.png") as image:
            frames.append(image.convert("P", palette=Image.Palette.ADAPTIVE, colors=32))
    frames[0].save(folder / "landing.gif", save_all=True, append_images=frames[1:], duration=_GIF_MS, loop=0)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
