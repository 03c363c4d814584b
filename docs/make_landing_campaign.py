"""Write the campaign of landings into docs/landing.md, and its picture:  python docs/make_landing_campaign.py FOLDER

FOLDER is that of `evstim campaign examples/landing/campaign.toml`; some runs may be missing. The part on flights with
the vehicle's own sensors is replaced by

    python docs/make_landing_campaign.py --sensors FOLDER

with the folder of `python examples/landing/compare.py FOLDER`, and pictures/landing.gif by

    python examples/landing/fly.py --height 300 --out FLIGHT --record FLIGHT/events.npz
    python docs/make_landing_campaign.py --movie FLIGHT
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from emulator.campaign.campaign import Campaign, Row
from emulator.campaign.loading import load_source, proportion
from emulator.campaign.report import numbers, quantiles, sensitivity
from emulator.campaign.table import check_folder, read_rows, rows_folder
from emulator.report.page import pyplot

PAGE = Path(__file__).parent
FILE = PAGE.parent / "examples" / "landing" / "campaign.toml"
PICTURED = (
    ("result.vertical_m_s", 1, "speed at touchdown, m/s"),
    ("result.error_median", 100, "error of the divergence,\nmedian, %"),
)
MARKS = "<!-- campaign -->\n", "<!-- end of campaign -->\n"
TEXT = """### A hundred landings

`evstim campaign examples/landing/campaign.toml` and `python docs/make_landing_campaign.py FOLDER`: from 1400 to 1600 m,
grounds, Sun and thresholds as above; the seed draws start, errors of navigation and engine, and the camera's noise. A
success touches down below 1 m/s with a good verdict of the camera's run.

**Success: {success}**, with Wilson's interval.{missing}

{quantiles}

![Speed at touchdown and error of the divergence over each parameter](pictures/landing-campaign.png)

Of ground, Sun, threshold and height, the [influence](campaigns.md#parameters) (PAWN index) that is above its bound in
95 % of samples without any: {influence}.

A run took {wall_s[0]:.0f} s (median; {wall_s[1]:.0f} to {wall_s[2]:.0f}), two at a time on two busy cores.
"""

MOVIE_PICTURES, MOVIE_MS, MOST_1_S = 40, 150, 0.3

SENSORS_MARKS = "<!-- sensors -->\n", "<!-- end of sensors -->\n"
SENSORS = """### A hundred flights with sensors

`python examples/landing/compare.py FOLDER` and `python docs/make_landing_campaign.py --sensors FOLDER`: from
{height_m:g} m, in lockstep, over four grounds with slopes of 3 degrees and boulders on 3 % of them, the Sun 20 to 35
degrees high, thresholds of 0.283 +- 0.03. One seed is one start and one set of errors for each navigation; all have IMU
and star tracker, "events" has no altimeter. Interval of Clopper and Pearson; median / 90 % / most of the flights that
touched down.

{table}

A flight with events takes 50 to 200 s, the others 3 s. [Rows](landing_sensors.jsonl) copied to `FOLDER/rows.jsonl` are
not flown again. Without the camera nothing on board measures the speed along the ground; a Doppler radar or a
velocimeter, which would, is not compared.
"""


def markdown(rows: Sequence[Row]) -> str:
    """Return rows of equal keys as a table."""
    lines = [list(rows[0]), ["---"] * len(rows[0]), *([_cell(value) for value in row.values()] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _cell(value: object) -> str:
    if not isinstance(value, float):
        return str(value)
    return "" if np.isnan(value) else f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def influence(made: Campaign, rows: Sequence[Row]) -> str:
    """Return the influences of a parameter on a column that chance does not explain: PAWN index and its bound."""
    labels = made.settings.report.labels
    return "; ".join(
        f"{labels[row['parameter']]} on {labels.get(column, column)} {_cell(row['PAWN'])} ({_cell(bound)})"
        for column in made.settings.report.columns
        for row in sensitivity(rows, made.settings.parameters, column, 0).rows
        if row["PAWN"] > (bound := row["PAWN, 95 % of chance"])
    )


def part(made: Campaign, rows: Sequence[Row]) -> str:
    """Return the page's part on the campaign."""
    shown, wall_s = made.settings.report, numbers(rows, "machine.wall_s")
    missing = made.runs - len(rows)
    return TEXT.format(
        success=proportion(sum(bool(row["success"]) for row in rows), len(rows)),
        missing=f" {missing} of {made.runs} runs are missing." if missing else "",
        quantiles=markdown([{"column": shown.labels[name], **quantiles(rows, name)} for name in shown.columns]),
        influence=influence(made, rows),
        wall_s=(np.median(wall_s), wall_s.min(), wall_s.max()),
    )


def replace_part(marks: tuple[str, str], made: str) -> None:
    """Put text between two marks of the page."""
    text = PAGE / "landing.md"
    before, rest = text.read_text().split(marks[0])
    text.write_text(f"{before}{marks[0]}\n{made}\n{marks[1]}{rest.split(marks[1])[1]}")


def draw(made: Campaign, rows: Sequence[Row], path: Path) -> None:
    """Draw the columns of PICTURED over each parameter, a point for each run."""
    laws, labels = made.settings.parameters, made.settings.report.labels
    figure, axes = pyplot().subplots(
        len(PICTURED), len(laws), figsize=(11, 5), sharex="col", sharey="row", layout="constrained"
    )
    good = numbers(rows, "success") > 0
    for row, (column, scale, label) in zip(axes, PICTURED, strict=True):
        for panel, law in zip(row, laws, strict=True):
            x, y = numbers(rows, law.key), scale * numbers(rows, column)
            panel.plot(x[good], y[good], ".", color="#0072b2", alpha=0.7)
            panel.plot(x[~good], y[~good], "x", color="#d55e00")
            panel.set(ylim=(0, None))
            if law.kind == "list":
                panel.set_xticks(np.unique(x))
        row[0].set_ylabel(label)
    for panel, law in zip(axes[-1], laws, strict=True):
        panel.set_xlabel(labels[law.key])
    figure.savefig(path, dpi=90)
    pyplot().close(figure)


def main(folder: Path) -> None:
    """Write the part on the campaign, and its picture."""
    made = Campaign(load_source(FILE))
    check_folder(made, folder)
    rows = read_rows(rows_folder(folder))
    replace_part(MARKS, part(made, rows))
    draw(made, rows, PAGE / "pictures" / "landing-campaign.png")


def write_sensors(folder: Path) -> None:
    """Replace the part on flights with the vehicle's own sensors."""
    from compare import table

    lines = (folder / "rows.jsonl").read_text()
    (PAGE / "landing_sensors.jsonl").write_text(lines)
    rows = [json.loads(line) for line in lines.splitlines()]
    height_m = max(row["height_m"] for row in rows)
    made = SENSORS.format(height_m=height_m, table=table([row for row in rows if row["height_m"] == height_m]))
    replace_part(SENSORS_MARKS, made)


def write_movie(folder: Path) -> None:
    """Write the GIF of a flight: its events beside height, speed and divergence."""
    from PIL import Image
    from report import Flight

    flight, pictures = Flight(folder), []
    flight.events = np.load(folder / "events-events.npz")["events"]  # the record of the link "events"
    for t_s in np.linspace(0.4, flight.end_s, MOVIE_PICTURES):
        figure = figure_at(flight, float(t_s))
        figure.canvas.draw()
        picture = Image.fromarray(np.asarray(figure.canvas.buffer_rgba())[..., :3])
        pictures.append(picture.convert("P", palette=Image.Palette.ADAPTIVE, colors=32))
        pyplot().close(figure)
    file = PAGE / "pictures" / "landing.gif"
    pictures[0].save(file, save_all=True, append_images=pictures[1:], duration=MOVIE_MS, loop=0)


def figure_at(flight: Any, t_s: float) -> Any:
    """Return a figure of the events of one instant, and of height, speed and divergence up to it."""
    from report import COLOURS

    figure = pyplot().figure(figsize=(9.2, 3.9), dpi=80, layout="constrained")
    left, *right = figure.subplot_mosaic([["e", "h"], ["e", "v"], ["e", "d"]], width_ratios=[1.35, 1]).values()
    left.imshow(COLOURS[flight.picture(t_s)], interpolation="nearest")
    k = int(np.searchsorted(flight.truth["t_s"], t_s).clip(0, len(flight.height_m) - 1))
    speed = -flight.truth["vz_m_s"]
    left.set_title(f"{t_s:5.1f} s   {flight.height_m[k]:6.1f} m   {speed[k]:5.2f} m/s down", family="monospace")
    left.set_axis_off()
    times = flight.truth["t_s"][: k + 1]
    shown = (flight.height_m, "height, m"), (speed, "speed, m/s"), (speed / flight.height_m, "divergence, 1/s")
    for axes, (values, name) in zip(right, shown, strict=True):
        axes.plot(times, values[: k + 1], color="k", lw=1.2, label="truth")
        axes.set(xlim=(0, flight.end_s), ylabel=name)
        axes.grid(alpha=0.3)
    right[0].set(yscale="log", ylim=(1.5, flight.height_m.max() * 1.1))
    right[1].set(ylim=(0, speed.max() * 1.1))
    at_s, down = flight.seen()
    right[2].plot(at_s[at_s <= t_s], down[at_s <= t_s], ".", ms=2.5, color="tab:orange", label="from events")
    right[2].set(ylim=(0, MOST_1_S), xlabel="time, s")
    right[2].legend(loc="upper left", fontsize=7)
    return figure


if __name__ == "__main__":
    sys.path.insert(0, str(FILE.parent))
    make = {"--sensors": write_sensors, "--movie": write_movie}.get(sys.argv[1], main)
    make(Path(sys.argv[-1]))
