"""Charts as SVG elements of a page: axes with ticks and units, steps, marks in lanes, stacked bars, quantiles.

The elements need no library and no script. Colours are classes of `report_page.css`, so that they follow a light or
dark screen and print in light colours. The text of a chart grows on narrow screens, so margins have room for it. Every
chart has its description as a label for screen readers.
"""

from __future__ import annotations

import html
import math
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.floating]
Numbers = npt.NDArray[np.floating] | npt.NDArray[np.integer]

_WIDTH = 720.0
_LEFT = 78.0
_RIGHT = 14.0
_TOP = 12.0
_BELOW = 58.0  # ticks and label of the x axis
_LANE = 46.0
_KEY_WIDTH = 15.0  # of a letter in a bar
_LABEL_GAP = 38.0  # between the starts of two labels of marks
_MOST_MARKS = 400  # drawn in a lane
_MOST_PLAIN = 1e4  # with a fraction, and at the ticks of a logarithmic axis
_MOST_WHOLE = 1e15
_RAISED = str.maketrans("-0123456789", "\u207b\u2070\u00b9\u00b2\u00b3\u2074\u2075\u2076\u2077\u2078\u2079")
_TICKS = (1.0, 2.0, 2.5, 5.0, 10.0)


def number_text(value: float) -> str:
    """Return a number with four digits, or as a whole one with narrow spaces between thousands."""
    if float(value).is_integer() or _MOST_PLAIN <= abs(value) < _MOST_WHOLE:
        value = round(value)
    if float(value).is_integer() and abs(value) < _MOST_WHOLE:
        return f"{int(value):,}".replace(",", "\u202f")
    return f"{value:.4g}"


@dataclass(frozen=True)
class Axis:
    """One axis: its label with the unit, its ends, and whether it is logarithmic (then both ends are above 0)."""

    label: str
    low: float
    high: float
    log: bool = False

    def share(self, value: float) -> float:
        """Return the place of a value, 0 at the low end and 1 at the high one; outside values are at the ends."""
        low, high = self.low, self.high
        if self.log:
            value = math.log10(max(value, low))
            low, high = math.log10(low), math.log10(high)
        return min(max((value - low) / (high - low), 0.0), 1.0) if high > low else 0.0

    @property
    def ticks(self) -> list[float]:
        """Values of the ticks: powers of ten, or about five round numbers."""
        if self.log:
            first, last = math.ceil(math.log10(self.low) - 1e-9), math.floor(math.log10(self.high) + 1e-9)
            return [10.0**power for power in range(first, last + 1)]
        rough = (self.high - self.low) / 5 or 1.0
        power = 10.0 ** math.floor(math.log10(rough))
        step = next(step * power for step in _TICKS if step * power >= rough * (1 - 1e-9))
        first = math.ceil(self.low / step - 1e-9)
        return [k * step for k in range(first, math.floor(self.high / step + 1e-9) + 1)]


@dataclass(frozen=True)
class Mark:
    """A mark of a timeline: an instant, or a span of time, with a short label such as "F1"."""

    t_s: float
    until_s: float | None = None
    label: str = ""


@dataclass(frozen=True)
class Lane:
    """A row of marks below a timeline; `kind` is a class of `report_page.css`."""

    name: str
    kind: str
    marks: Sequence[Mark]


class Chart:
    """One chart: axes, then what is drawn in them.

    Parameters
    ----------
    x, y : axes.
    description : text in place of the chart, for people who do not see it.
    height : of the area between the axes; the area is 628 wide.
    lanes : rows of marks below the x axis.
    """

    def __init__(self, x: Axis, y: Axis, description: str, height: float = 170.0, lanes: Sequence[Lane] = ()) -> None:
        self._x = x
        self._y = y
        self._description = description
        self._bottom = _TOP + height
        self._height = self._bottom + _BELOW + _LANE * len(lanes)
        self._parts = [*self._ticks_x(), *self._ticks_y()]
        for number, lane in enumerate(lanes):
            self._parts += self._lane(lane, self._bottom + _BELOW + _LANE * number)

    def steps(self, edges: Floats, values: Numbers, kind: str) -> Self:
        """Draw values (n,) between edges (n + 1,) as steps."""
        points: list[str] = []
        for k, value in enumerate(values):
            y = self._at_y(float(value))
            points += [f"{self._at_x(float(edges[k])):.1f},{y:.1f}", f"{self._at_x(float(edges[k + 1])):.1f},{y:.1f}"]
        if points:
            self._parts.append(f'<polyline class="line {kind}" points="{" ".join(points)}"/>')
        return self

    def svg(self) -> str:
        """Return the element."""
        return _svg(self._height, self._description, self._parts)

    def _at_x(self, value: float) -> float:
        return _LEFT + self._x.share(value) * (_WIDTH - _LEFT - _RIGHT)

    def _at_y(self, value: float) -> float:
        return self._bottom - self._y.share(value) * (self._bottom - _TOP)

    def _ticks_x(self) -> list[str]:
        parts = []
        for value in self._x.ticks:
            x = self._at_x(value)
            parts.append(_line(x, _TOP, x, self._bottom, "grid"))
            parts.append(_text(x, self._bottom + 20, _tick_text(value, self._x), "middle"))
        middle = (_LEFT + _WIDTH - _RIGHT) / 2
        axis = _line(_LEFT, self._bottom, _WIDTH - _RIGHT, self._bottom, "axis")
        return [*parts, axis, _text(middle, self._bottom + 44, self._x.label, "middle")]

    def _ticks_y(self) -> list[str]:
        parts = []
        for value in self._y.ticks:
            y = self._at_y(value)
            parts.append(_line(_LEFT, y, _WIDTH - _RIGHT, y, "grid"))
            parts.append(_text(_LEFT - 6, y + 4, _tick_text(value, self._y), "end"))
        middle = (_TOP + self._bottom) / 2
        label = f'<text x="16" y="{middle:.1f}" text-anchor="middle" transform="rotate(-90 16 {middle:.1f})">'
        return [*parts, _line(_LEFT, _TOP, _LEFT, self._bottom, "axis"), f"{label}{escaped(self._y.label)}</text>"]

    def _lane(self, lane: Lane, top: float) -> list[str]:
        """Return one lane: its name over a line, on which the marks are."""
        base = top + 34
        parts = [_text(0, top + 14, lane.name, "start"), _line(_LEFT, base, _WIDTH - _RIGHT, base, "grid")]
        free_from = 9.5 * len(lane.name)  # labels begin behind the lane's name
        for mark in lane.marks[:: max(1, math.ceil(len(lane.marks) / _MOST_MARKS))]:
            x = self._at_x(mark.t_s)
            end = x if mark.until_s is None else self._at_x(mark.until_s)
            parts.append(_rect(x - 1.5, base - 10, max(end - x, 0.0) + 3, 14, lane.kind))
            if mark.label and x >= free_from:
                parts.append(_text(x, top + 14, mark.label, "start" if x < _WIDTH - 60 else "end"))
                free_from = x + _LABEL_GAP
        return parts


def _tick_text(value: float, axis: Axis) -> str:
    if axis.log and not 1e-2 <= axis.low < axis.high <= _MOST_PLAIN:
        return f"10{str(round(math.log10(value))).translate(_RAISED)}"
    return number_text(round(value, 10))


@dataclass(frozen=True)
class Share:
    """A part of a bar: its key, a letter that stands in it where there is room, its amount, and a class for colour."""

    key: str
    amount: float
    kind: str


def share_bar(shares: Sequence[Share], description: str) -> str:
    """Return one stacked bar of the whole width; a part that is not zero is at least 3 wide."""
    total = sum(share.amount for share in shares)
    parts = []
    x = 0.0
    for share in shares:
        width = max(3.0, _WIDTH * share.amount / total) if share.amount and total else 0.0
        if not width:
            continue
        width = min(width, max(_WIDTH - x, 3.0))
        parts.append(_rect(min(x, _WIDTH - 3.0), 2, width, 28, f"part {share.kind}"))
        if width > _KEY_WIDTH:
            parts.append(_text(x + width / 2, 22, share.key, "middle", f"key {share.kind}"))
        x += width
    outline = _rect(0.5, 2, _WIDTH - 1, 28, "outline")
    return _svg(32, description, [*parts, outline])


@dataclass(frozen=True)
class Quantiles:
    """A row of `quantile_chart`: values of one quantity by name, and its bound where there is one."""

    name: str
    values: Sequence[tuple[str, float]]
    bound: float | None = None
    bound_name: str = ""


_MOST_NAME = 32  # characters
_SHAPES = ("circle", "square", "diamond", "triangle")


def quantile_chart(rows: Sequence[Quantiles], unit: str) -> str:
    """Return rows of quantiles on one logarithmic axis, each with its bound as a dashed line; "" without values."""
    every = [value for row in rows for _, value in row.values] + [row.bound for row in rows if row.bound]
    positive = [value for value in every if value > 0]
    if not positive:
        return ""
    low = 10.0 ** math.floor(math.log10(min(positive)))
    high = 10.0 ** max(math.ceil(math.log10(max(positive)) + 0.05), round(math.log10(low)) + 1)
    axis = Axis(unit, low, high, log=True)
    bottom = _TOP + 62.0 * len(rows)
    parts = []
    for value in axis.ticks:
        x = _quantile_x(axis, value)
        parts += [_line(x, _TOP, x, bottom, "grid"), _text(x, bottom + 20, _tick_text(value, axis), "middle")]
    parts.append(_text(_WIDTH / 2, bottom + 44, axis.label, "middle"))
    for number, row in enumerate(rows):
        parts += _quantile_row(row, axis, _TOP + 62.0 * number)
    described = "; ".join(_described(row) for row in rows)
    return _svg(bottom + _BELOW, f"{unit}, logarithmic axis. {described}", parts)


def _quantile_x(axis: Axis, value: float) -> float:
    return 24.0 + axis.share(value) * (_WIDTH - 60.0)


def _quantile_row(row: Quantiles, axis: Axis, top: float) -> list[str]:
    """Return a name, a line from the least to the largest value with a mark for each, and the bound."""
    y, xs = top + 44, [_quantile_x(axis, value) for _, value in row.values]
    name = row.name if len(row.name) <= _MOST_NAME else f"{row.name[:_MOST_NAME]}\u2026"
    parts = [_text(2, top + 18, name, "start")]
    if row.bound:
        x = _quantile_x(axis, row.bound)
        parts.append(_line(x, top + 26, x, y + 14, "bound"))
        bound = f"{row.bound_name} {number_text(row.bound)}"
        parts.append(_text(_WIDTH - 4, top + 18, bound, "end", "bound-text"))
    if xs:
        parts.append(_line(min(xs), y, max(xs), y, "range"))
    parts += [_shape(shape, x, y) for shape, x in zip(_SHAPES, xs, strict=False)]
    return parts


def _shape(shape: str, x: float, y: float) -> str:
    if shape == "circle":
        return f'<circle class="dot" cx="{x:.1f}" cy="{y:.1f}" r="6"/>'
    corners = {
        "square": ((-6, -6), (6, -6), (6, 6), (-6, 6)),
        "diamond": ((0, -8), (8, 0), (0, 8), (-8, 0)),
        "triangle": ((0, -8), (8, 7), (-8, 7)),
    }[shape]
    return f'<polygon class="dot" points="{" ".join(f"{x + dx:.1f},{y + dy:.1f}" for dx, dy in corners)}"/>'


def _described(row: Quantiles) -> str:
    values = ", ".join(f"{name} {number_text(value)}" for name, value in row.values) or "nothing measured"
    return f"{row.name}: {values}" + (f", {row.bound_name} {number_text(row.bound)}" if row.bound else "")


def _svg(height: float, description: str, parts: Sequence[str]) -> str:
    label = escaped(description)
    return f'<svg viewBox="0 0 {_WIDTH:g} {height:g}" role="img" aria-label="{label}">{"".join(parts)}</svg>'


def _line(x1: float, y1: float, x2: float, y2: float, kind: str) -> str:
    return f'<line class="{kind}" x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}"/>'


def _rect(x: float, y: float, width: float, height: float, kind: str) -> str:
    return f'<rect class="{kind}" x="{x:.1f}" y="{y:.1f}" width="{width:.1f}" height="{height:.1f}"/>'


def _text(x: float, y: float, text: str, anchor: str, kind: str = "") -> str:
    name = f' class="{kind}"' if kind else ""
    return f'<text{name} x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escaped(text)}</text>'


def printable(text: str) -> str:
    """Return a text with spaces in the place of control, format and surrogate characters."""
    return "".join(" " if unicodedata.category(c).startswith("C") else c for c in text)


def escaped(text: str) -> str:
    """Return a printable text for an element or an attribute."""
    return html.escape(printable(text))
