"""Plot the truth beside the events of a rig: `python plot_truth.py [RIG] [SECONDS] [PICTURE]`.

It runs the rig (rendezvous by default), writes its truth to truth.h5, and plots light, depth, optical flow,
labels, and the events by cause. With RIG = a file that ends in .h5, that file is plotted.
"""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from matplotlib.colors import ListedColormap, hsv_to_rgb
from matplotlib.figure import Figure

import evstim

__all__ = ["main"]

COLOURS = {  # safe for colour-blind readers
    "signal": "#e69f00", "leak": "#009e73", "noise": "#56b4e9", "background": "#0072b2", "particle": "#cc79a7",
    "unknown": "#999999",
}  # fmt: skip
WINDOW_US = 40_000


def flow_picture(flow: Any) -> tuple[Any, float]:
    """Return an RGB picture, hue by direction and brightness by speed, and the speed of full brightness, px/s."""
    speed, angle = np.hypot(flow[..., 0], flow[..., 1]), np.arctan2(flow[..., 1], flow[..., 0])
    most = max(float(np.quantile(speed, 0.999)), 1e-9)
    hue, bright = angle / (2 * np.pi) % 1, np.clip(speed / most, 0, 1)
    return hsv_to_rgb(np.stack([hue, np.ones_like(hue), bright], axis=-1)), most


def events_near(group: Any, t_us: float) -> slice:
    """Return which events lie around a time."""
    return slice(*np.searchsorted(group["t"][:], [t_us - WINDOW_US / 2, t_us + WINDOW_US / 2]))


def plot_events(axes: Any, file: Any, t_us: float) -> None:
    """Plot the events around a time by their origin."""
    events, names = file["events"], h5py.check_enum_dtype(file["events/origin"].dtype)
    near = events_near(events, t_us)
    x, y, origin = (events[name][near] for name in ("x", "y", "origin"))
    axes.set_facecolor("black")
    for name, code in names.items():
        chosen = origin == code
        if chosen.any():
            axes.plot(x[chosen], y[chosen], ",", color=COLOURS[name], label=f"{name}: {chosen.sum()}")
    handles = axes.legend(loc="upper right", fontsize=7, facecolor="black", labelcolor="white").legend_handles
    for handle in handles:
        handle.set(marker="o", markersize=4)


def plot_clean(axes: Any, file: Any, t_us: float) -> None:
    """Plot the events of the ideal sensor: ON white, OFF blue."""
    events = file["clean_events"]
    near = events_near(events, t_us)
    x, y, on = (events[name][near] for name in ("x", "y", "p"))
    axes.set_facecolor("black")
    axes.plot(x[on > 0], y[on > 0], ",", color="white")
    axes.plot(x[on == 0], y[on == 0], ",", color="#56b4e9")


def plot(path: Path, picture: Path) -> None:
    """Plot one picture of a truth file and the events around it."""
    with h5py.File(path) as file:
        k = len(file["pictures/t"]) * 2 // 3
        t_us = float(file["pictures/t"][k])
        names = [name.decode() for name in file["labels/name"]]
        height, width = file["pictures/light"].shape[1:]
        figure = Figure(figsize=(13, 6.6), layout="constrained")
        figure.suptitle(f"{file.attrs['title']}, t = {t_us * 1e-6:.3f} s")
        panels = iter(figure.subplots(2, 3).flat)

        axes = next(panels)
        light = file["pictures/light"][k]
        axes.imshow(np.sqrt(light / max(np.quantile(light, 0.999), 1e-9)), cmap="gray", vmin=0, vmax=1)
        axes.set_title("light (square root)")

        axes = next(panels)
        axes.set_title("depth along the boresight, m (logarithm); white: sky")
        if "depth" in file["pictures"]:
            depth = file["pictures/depth"][k]
            shown = axes.imshow(np.where(np.isfinite(depth), np.log10(depth), np.nan), cmap="viridis_r")
            figure.colorbar(shown, ax=axes, label="log10 m", shrink=0.7)

        axes = next(panels)
        colours, most = flow_picture(file["pictures/flow"][k])
        axes.imshow(colours)
        axes.set_title(f"optical flow: hue is direction, brightest {most:.1f} px/s")

        axes = next(panels)
        palette = ListedColormap(["black", *(hsv_to_rgb([j * 0.618 % 1, 0.6, 0.95]) for j in range(len(names) - 1))])
        axes.imshow(file["pictures/labels"][k], cmap=palette, vmin=-0.5, vmax=len(names) - 0.5, interpolation="nearest")
        axes.set_title("labels: " + ", ".join(names[1:]), fontsize=8, wrap=True)

        axes = next(panels)
        plot_events(axes, file, t_us)
        axes.set_title(f"events of {WINDOW_US / 1000:g} ms by what raised them")

        axes = next(panels)
        plot_clean(axes, file, t_us)
        axes.set_title("events of an ideal sensor (ON white, OFF blue)")

        for axes in figure.axes[:6]:
            axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal", xticks=[], yticks=[])
        figure.savefig(picture, dpi=100)


def main(rig: str = "rendezvous", seconds: str = "1.0", picture: str = "truth.png") -> int:
    """Run, write and plot; return the number of events in the file."""
    path = Path(rig)
    if path.suffix != ".h5":
        path = Path("truth.h5")
        alone = dataclasses.replace(evstim.load_rig(rig), links=())  # no other program receives the events
        with evstim.run(alone, seconds=float(seconds), pace="free", truth=path) as run:
            run.wait()
        if run.truth_trouble:
            raise SystemExit(run.truth_trouble)
    plot(path, Path(picture))
    with h5py.File(path) as file:
        count = len(file["events/t"])
    print(f"{count} events; {picture} shows their causes")
    return count


if __name__ == "__main__":
    main(*sys.argv[1:])
