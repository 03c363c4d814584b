"""Draw docs/pictures/external_images.png from the table in docs/renderers.md: what the layers of a renderer are worth.

The table is the output of `python -m laboratory.accuracy.image_layers`; paste a new one there, then `python
docs/external_chart.py`.
"""

from __future__ import annotations

import re
from collections import defaultdict
from pathlib import Path

from emulator.report.page import pyplot

HERE = Path(__file__).parent
ROW = re.compile(r"^\| (\d+), ([a-z ]+) \| ([\d.]+)% \| ([\d.]+) \|", re.MULTILINE)
BEST = re.compile(r"^\| our own scene \| ([\d.]+)% \| ([\d.]+) \|", re.MULTILINE)
STYLES = {
    "images alone": ("o", "#d55e00"),
    "motion": ("s", "#0072b2"),
    "motion and depth": ("^", "#56b4e9"),
    "rate": ("D", "#009e73"),
    "motion and depth and rate": ("x", "#000000"),
}


def series(page: str) -> dict[str, list[tuple[float, float, float]]]:
    """Return rate of images in Hz, wrong events in %, and t50 in ms, for each set of layers; raises ValueError."""
    found = defaultdict(list)
    for hz, layers, wrong, t50_ms in ROW.findall(page):
        found[layers].append((float(hz), float(wrong), float(t50_ms)))
    if set(found) != set(STYLES):
        raise ValueError(f"the table has the layers {sorted(found)}, not {sorted(STYLES)}")
    return dict(found)


def main() -> None:
    """Draw both panels."""
    page = (HERE / "renderers.md").read_text()
    best = BEST.search(page)
    if best is None:
        raise ValueError("the table has no row of our own scene")
    figure, axes = pyplot().subplots(1, 2, figsize=(8.6, 3.9), layout="constrained")
    for k, (panel, name) in enumerate(zip(axes, ("wrong events, %", "time error t50, ms"), strict=True)):
        for layers, rows in series(page).items():
            marker, colour = STYLES[layers]
            panel.plot(
                [row[0] for row in rows], [row[k + 1] for row in rows], marker=marker, color=colour, label=layers
            )
        panel.axhline(float(best[k + 1]), color="0.5", linestyle="--", label="our own scene")
        panel.set(xscale="log", yscale="log", xlabel="images a second", ylabel=name)
        panel.grid(True, which="both", alpha=0.25)
    axes[0].legend(fontsize=8)
    figure.savefig(HERE / "pictures" / "external_images.png", dpi=110, bbox_inches="tight")


if __name__ == "__main__":
    main()
