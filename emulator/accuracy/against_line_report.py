"""The page, chart and table of the map "hermite against line"."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from emulator.accuracy.against_line import BLURS_PX, SPEEDS_PX, Difference, reading_against_line
from emulator.report.figures import pyplot, save
from emulator.report.html import inline, sentences, table, write_csv, write_page

__all__ = ["write_against_line"]

_PANELS: tuple[tuple[str, Callable[[Difference], float], float], ...] = (
    ("right sequences, points", lambda c: 100 * (c.right_hermite - c.right_line), 1.0),
    ("wrong events, points", lambda c: 100 * (c.wrong_hermite - c.wrong_line), -1.0),
)
_LIMIT = 20.0  # points, where the colours end
_DARK = 0.6  # of the limit: from there on cells are dark
_COLUMNS = 3


def write_against_line(cells: Sequence[Difference], out: Path) -> list[Path]:
    """Write the map into folder `out`; return the files, the page first."""
    rows = [cell.row() for cell in cells]
    drawn = _draw(cells, out / "against_line")
    sections = [sentences(reading_against_line(cells)), inline(drawn[0]), table(rows)]
    page = write_page("hermite against line", sections, out / "against_line.html")
    return [page, write_csv(rows, out / "against_line.csv"), *drawn]


def _draw(cells: Sequence[Difference], stem: Path) -> list[Path]:
    """Draw one map a scene and quantity: blue where hermite is better, red where it is worse."""
    plt = pyplot()
    names = list(dict.fromkeys(cell.scene for cell in cells))
    columns, rows = min(_COLUMNS, len(names)), 2 * -(-len(names) // _COLUMNS)
    size = 3.2 * columns, 2.6 * rows
    figure, grid = plt.subplots(rows, columns, figsize=size, squeeze=False, layout="constrained")
    for axes in grid.flat:
        axes.set_visible(False)
    for place, name in enumerate(names):
        own = {(cell.blur_px, cell.speed_px): cell for cell in cells if cell.scene == name}
        row, column = 2 * (place // _COLUMNS), place % _COLUMNS
        for axes, (label, value, sign) in zip(grid[row : row + 2, column], _PANELS, strict=True):
            _map(axes, [[value(own[blur, speed]) for speed in SPEEDS_PX] for blur in BLURS_PX], sign)
            axes.set_title(f"{name}\n{label}", fontsize=9)
            axes.set_xlabel("px a step", fontsize=8)
            axes.set_ylabel("blur, px" if column == 0 else "", fontsize=8)
    return save(figure, stem)


def _map(axes: Any, values: list[list[float]], sign: float) -> None:
    axes.set_visible(True)
    axes.imshow([[sign * v for v in row] for row in values], cmap="RdBu", vmin=-_LIMIT, vmax=_LIMIT, aspect="auto")
    for i, row in enumerate(values):
        for k, v in enumerate(row):
            colour = "white" if abs(v) > _DARK * _LIMIT else "black"
            axes.text(k, i, f"{v:+.1f}", ha="center", va="center", fontsize=8, color=colour)
    axes.set_xticks(range(len(SPEEDS_PX)), [f"{v:g}" for v in SPEEDS_PX], fontsize=7)
    axes.set_yticks(range(len(BLURS_PX)), [f"{v:g}" for v in BLURS_PX], fontsize=7)
