"""Error of a star tracker's attitude over angular rate: `python measure.py [FOLDER]`.

For each rate it runs tracker.toml, cuts the events into windows in which stars move by `MOVE_PX` pixels, solves the
attitude of each, and compares it with the true one; then again with the noise of a real camera under the night sky. It
writes star-tracker.csv and the chart star-tracker.png into FOLDER, and puts the table into FOLDER/../star-tracker.md
where that page exists.
"""

from __future__ import annotations

import csv
import dataclasses
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation
from star_tracker import Solution, Tracker, hot_pixels

import evstim

__all__ = ["Measured", "errors_arcsec", "main", "measure", "recorded", "true_attitude"]

RATES_DEG_S = (0.1, 0.2, 0.5, 1.0, 2.0)
MOVE_PX = 10.0
WINDOWS = 20
SETTLE_PX = 15.0  # motion before the first window
NOISES_HZ = {"preset": None, "noise of 0.15 Hz": 0.15}
"""Noise events of a pixel, Hz: the preset's, and those of a recording under the night sky (docs/star-tracker.md)."""
MARKS = "<!-- table of measure.py -->\n", "<!-- end of table -->\n"
RIG = Path(__file__).parent / "tracker.toml"

Floats = npt.NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class Measured:
    """Windows at one rate.

    `errors` has a row for each solved window: along the motion, across it, and about the boresight, arc-seconds.
    """

    noise: str
    rate_deg_s: float
    window_ms: float
    solutions: tuple[Solution, ...]
    errors: Floats

    @property
    def solved(self) -> int:
        """Windows with an attitude."""
        return len(self.errors)

    def row(self) -> dict[str, object]:
        """Return the line of the table: root mean squares, and along the motion mean and standard deviation."""
        rms = np.sqrt(np.mean(self.errors**2, axis=0)) if self.solved else np.full(3, math.nan)
        along = self.errors[:, 0] if self.solved else np.array([math.nan])
        return {
            "noise": self.noise,
            "rate, deg/s": f"{self.rate_deg_s:g}",
            "window, ms": f"{self.window_ms:.0f}",
            "stars matched": f"{np.median([one.matched for one in self.solutions]):.0f}",
            "solved": f"{self.solved} of {len(self.solutions)}",
            "across, arcsec": f"{rms[1]:.1f}",
            "along, mean": f"{np.mean(along):+.1f}",
            "along, spread": f"{np.std(along):.1f}",
            "roll, arcsec": f"{rms[2]:.0f}",
        }


def turning(rig: evstim.Rig, rate_deg_s: float) -> evstim.Rig:
    """Return the rig with the camera turning so that the boresight sweeps at `rate_deg_s`."""
    path = rig.scene.camera
    off_pole = math.sin(math.radians(path.tilt_deg))
    camera = dataclasses.replace(path, precession_deg_s=rate_deg_s / off_pole)
    step_us = max(200, min(50_000, round(0.3e6 / (rate_deg_s * pixels_a_degree(rig)))))
    run = dataclasses.replace(rig.run, step_us=step_us)
    return dataclasses.replace(rig, scene=dataclasses.replace(rig.scene, camera=camera), run=run)


def pixels_a_degree(rig: evstim.Rig) -> float:
    """Return the focal length in pixels a degree."""
    half = math.radians(rig.camera.lens.field_of_view_deg / 2)
    return math.radians(rig.camera.sensor.width / 2 / math.tan(half))


def true_attitude(rig: evstim.Rig, t_s: float) -> Floats:
    """Return the rotation (3, 3) of the ICRS to the camera's axes: a tilt about x, then a turn about the pole."""
    path = rig.scene.camera
    turn = Rotation.from_euler("z", path.precession_deg_s * t_s, degrees=True)
    tilt = Rotation.from_euler("x", path.tilt_deg, degrees=True)
    return np.asarray((turn * tilt).as_matrix().T)


def errors_arcsec(found: Floats, true: Floats, motion_px: tuple[float, float]) -> tuple[float, float, float]:
    """Return the error of the boresight along the stars' motion and across it, and the error of roll, arc-seconds.

    Along is positive where the stars were placed ahead of their true places in the picture.
    """
    turn = Rotation.from_matrix(found @ true.T).as_rotvec() * math.degrees(1) * 3600
    moved = np.array([turn[1], -turn[0]])  # of stars near the boresight, right and down
    along = np.array(motion_px) / math.hypot(*motion_px)
    return float(moved @ along), float(moved @ np.array([-along[1], along[0]])), float(turn[2])


def recorded(rig: evstim.Rig, seconds: float) -> npt.NDArray[Any]:
    """Return the events of a run."""
    with evstim.run(rig, seconds=seconds, pace="free") as run:
        return np.concatenate([events.copy() for events in run])


def noisy(rig: evstim.Rig, hz: float | None) -> evstim.Rig:
    """Return the rig with `hz` noise events a second in each pixel, half of them ON; None: with its own noise."""
    if hz is None:
        return rig
    background = dataclasses.replace(rig.camera.sensor.background, hz=hz, off_share=0.5)
    sensor = dataclasses.replace(rig.camera.sensor, background=background)
    return dataclasses.replace(rig, camera=dataclasses.replace(rig.camera, sensor=sensor))


def measure(
    rig: evstim.Rig, tracker: Tracker, rate_deg_s: float, windows: int = WINDOWS, noise: str = "preset"
) -> Measured:
    """Run at one rate and solve `windows` windows."""
    rig = turning(noisy(rig, NOISES_HZ[noise]), rate_deg_s)
    speed_px_s = rate_deg_s * pixels_a_degree(rig)
    window_us, settle_us = MOVE_PX / speed_px_s * 1e6, SETTLE_PX / speed_px_s * 1e6
    events = recorded(rig, (settle_us + window_us * windows) * 1e-6)
    size = rig.camera.sensor.width, rig.camera.sensor.height
    events = events[~hot_pixels(events, size)[events["y"], events["x"]]]
    solutions, errors = [], []
    for k in range(windows):
        middle_us = settle_us + (k + 0.5) * window_us
        near = events[np.abs(events["t"] - middle_us) <= window_us / 2]
        solution = tracker.solve(near, middle_us)
        solutions.append(solution)
        if solution.camera_from_world is not None and solution.motion is not None:
            way = solution.motion.right_px_s, solution.motion.down_px_s
            errors.append(errors_arcsec(solution.camera_from_world, true_attitude(rig, middle_us * 1e-6), way))
    return Measured(noise, rate_deg_s, window_us * 1e-3, tuple(solutions), np.array(errors).reshape(-1, 3))


def table(measured: Sequence[Measured]) -> str:
    """Return the rows as Markdown."""
    rows = [one.row() for one in measured]
    lines = [list(rows[0]), ["---"] * len(rows[0]), *(list(row.values()) for row in rows)]
    return "".join(f"| {' | '.join(map(str, line))} |\n" for line in lines)


def draw(measured: Sequence[Measured], path: Path) -> None:
    """Draw errors and the share of solved windows over the rate."""
    figure = Figure(figsize=(10, 4), layout="constrained")
    errors, solved = figure.subplots(1, 2)
    for noise, style in zip(NOISES_HZ, ("-", "--"), strict=True):
        some = [one for one in measured if one.noise == noise]
        rates = [one.rate_deg_s for one in some]
        for k, (name, colour) in enumerate((("along", "#d55e00"), ("across", "#0072b2"), ("roll", "#999999"))):
            rms = [np.sqrt(np.mean(one.errors[:, k] ** 2)) if one.solved else math.nan for one in some]
            errors.plot(rates, rms, style, marker="o", ms=3, color=colour, label=f"{name}, {noise}")
        solved.plot(rates, [one.solved / len(one.solutions) for one in some], f"k{style}", marker="o", label=noise)
    errors.set(xscale="log", yscale="log", xlabel="rate, deg/s", ylabel="error, arc-seconds (root mean square)")
    solved.set(xscale="log", xlabel="rate, deg/s", ylabel="share of windows solved", ylim=(0, 1.05))
    for axes in (errors, solved):
        axes.legend(frameon=False, fontsize=8)
    figure.savefig(path, dpi=110)


def main(folder: str = ".") -> list[Measured]:
    """Measure at all rates; write table and chart into `folder`."""
    rig, out = evstim.load_rig(str(RIG)), Path(folder)
    out.mkdir(parents=True, exist_ok=True)
    tracker = Tracker((rig.camera.sensor.width, rig.camera.sensor.height), rig.camera.lens.field_of_view_deg)
    measured = []
    for noise in NOISES_HZ:
        for rate in RATES_DEG_S:
            measured.append(measure(rig, tracker, rate, noise=noise))
            print(measured[-1].row())
    with (out / "star-tracker.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, measured[0].row())
        writer.writeheader()
        writer.writerows(one.row() for one in measured)
    draw(measured, out / "star-tracker.png")
    page = out.parent / "star-tracker.md"
    if page.exists():
        before, rest = page.read_text().split(MARKS[0])
        page.write_text(before + MARKS[0] + table(measured) + MARKS[1] + rest.split(MARKS[1])[1])
    return measured


if __name__ == "__main__":
    main(*sys.argv[1:])
