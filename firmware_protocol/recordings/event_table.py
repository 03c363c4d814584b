"""Tables of events as text: a line for each event, columns by a header or by their order.

    t,x@346,y@260,on       evstim's and faery's header, with the size of the sensor; t in us
    timestamp;x;y;polarity  a header with other names; `t_ns`, `time [s]` give the unit too
    240 180                the size of the sensor, where the lines after it have four columns and more
    0.003811 33 39 1       no header: t, x, y, polarity

Separators are `;`, else `,`, else blanks and tabs. Empty lines and those that begin with `#` are passed over. A
polarity is 0 or 1, -1 or 1, False or True. Times without a unit are seconds where they have fractions, else
microseconds; an assumption is a remark, which the caller shows. Whole numbers may be written as 10.0 or 1e1.
"""

from __future__ import annotations

import re
import warnings
from bisect import bisect_left
from dataclasses import dataclass
from itertools import islice
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from firmware_protocol.events import Events, empty_events, make_events

TimeUnit = Literal["", "s", "ms", "us", "ns"]


@dataclass(frozen=True)
class TableForm:
    """Columns and times of a table of text; what is empty follows from its first lines.

    Attributes
    ----------
    columns
        Names of a table's columns in their order, such as t,y,x,p; any other name is passed over. For tables of text.
    time_unit
        Unit of a table's times: s, ms, us or ns. For tables of text.
    """

    columns: str = ""
    time_unit: TimeUnit = ""


_NAMES = {
    "t": {"t", "ts", "time", "times", "timestamp", "timestamps"},
    "x": {"x", "xs", "col", "column"},
    "y": {"y", "ys", "row"},
    "p": {"p", "ps", "pol", "polarity", "polarities", "on", "sign"},
}
_NAME = re.compile(r"(\w+?)(?:(?:_| *[\[(]| )(ns|us|ms|s|px)[\])]?)?(?:@(\d{1,5}))?")
_FACTORS = {"s": 10**6, "ms": 1000, "us": 1, "ns": 1}
_WORDS = {"true": 1.0, "false": 0.0}
# Types of t, of x and y, and of p, which are tried in this order: the first one is exact and fast.
_TYPES = ("i8", "i8", "i8"), ("f8", "i8", "i8"), ("f8", "f8", "f8"), ("i8", "i8", "U6"), ("f8", "f8", "U6")
_MOST_LINE = 1 << 16
_MOST_US = 1 << 62
_NANOSECONDS = 10**17  # in us 3169 years: times that are larger have another unit
_RIGHT = {
    "t": "a time from 0 on", "x": "a whole number from 0 to 65535", "y": "a whole number from 0 to 65535",
    "p": "one of 0 and 1, -1 and 1, False and True",
}  # fmt: skip
_ADVICE = "give the columns in their order, as in --columns x,y,p,t"


class EventTable:
    """Decoder of a table, from the first bytes of its file; raises ValueError if they do not give its columns.

    Attributes
    ----------
    start : offset of the first event.
    size : (width, height) of the sensor, where the table gives it.
    remarks : assumptions about its content.
    damage : place and fault of the first line that is no event; "" before it.
    rest : octets of a line that is not complete.
    """

    def __init__(self, head: bytes, form: TableForm | None = None) -> None:
        form = form or TableForm()
        self.size: tuple[int, int] | None = None
        self.remarks: tuple[str, ...] = ()
        self.damage = ""
        self.rest = b""
        self._types = 0
        self._off: int | None = None
        names, sample = self._begin(head)
        if not sample and not names:
            raise ValueError("it has no line of an event")
        self._places, self._count = self._columns_of(form.columns, names, sample)
        self._unit = self._unit_of(form.time_unit, names, sample)
        self._used = sorted(self._places, key=self._places.__getitem__)
        self._usecols = sorted(self._places.values()) if self._count > len(_NAMES) else None

    def _begin(self, head: bytes) -> tuple[list[str], list[list[str]]]:
        """Find the first event; return the names of a header, and the fields of the first lines."""
        if b"\0" in head:
            raise ValueError("it is no text")
        self.start = 3 if head.startswith(b"\xef\xbb\xbf") else 0
        self._line = 0
        lines = head[self.start :].decode("latin-1").split("\n")
        self._separator = None
        names: list[str] = []
        while lines:
            text = lines[0].strip()
            bare = re.sub(r"\s+(?=[\[(])", "", text.lstrip("# "))  # "time [ns]" is a name
            self._separator = next((mark for mark in ";," if mark in bare), None)
            fields = [field.strip(" \r\t\"'") for field in bare.split(self._separator)]
            is_header = len(fields) > 1 and not any(map(_is_number, fields))
            if is_header and (not text.startswith("#") or len(_places(fields)) == len(_NAMES)):
                names = fields
            elif self.size is None and re.fullmatch(r"[1-9]\d{0,4}[ \t]+[1-9]\d{0,4}", text) and len(lines) > 1:
                self.size = int(fields[0]), int(fields[1])
            elif bare and not text.startswith("#"):
                break
            self.start += len(lines.pop(0)) + 1
            self._line += 1
        rows = (line.split(self._separator) for line in lines[: max(1, len(lines) - 1)] if line.strip())
        return names, [[field.strip() for field in row] for row in rows]

    def _columns_of(self, order: str, names: list[str], sample: list[list[str]]) -> tuple[dict[str, int], int]:
        """Return the places of t, x, y and p, and the number of columns."""
        if order:
            names = [name.strip() for name in order.split(",")]
            if sample and len(sample[0]) != len(names):
                raise ValueError(f"--columns has {len(names)} names, and its first line {len(sample[0])} columns")
        if names:
            places = _places(names)
            if len(places) != len(_NAMES):
                has = "--columns" if order else "its header"
                raise ValueError(f"{has} names {', '.join(names)}: t, x, y and p are needed, each once; {_ADVICE}")
            sizes = {name: _NAME.fullmatch(names[place])[3] for name, place in places.items()}  # type: ignore[index]
            if sizes["x"] and sizes["y"]:
                self.size = int(sizes["x"]), int(sizes["y"])
            return places, len(names)
        if len(sample[0]) != 4:
            raise ValueError(f"it has no header and {len(sample[0])} columns: {_ADVICE}")
        for k, name in enumerate("txyp"):
            wrong = [row[k] for row in sample if len(row) == 4 and not _is_right(name, row[k])]
            if 2 * len(wrong) > len(sample):
                raise ValueError(f"it has no header, and column {k + 1} has {wrong[0]}, which is no {name}: {_ADVICE}")
        self.remarks += ("it has no header: its columns are taken as t,x,y,p (--columns)",)
        return {name: k for k, name in enumerate("txyp")}, 4

    def _unit_of(self, unit: str, names: list[str], sample: list[list[str]]) -> str:
        """Return the unit of the times."""
        self._is_unit_assumed = False
        if unit:
            if unit not in _FACTORS:
                raise ValueError(f"the unit of time must be one of {', '.join(_FACTORS)}, got {unit!r}")
            return unit
        place = self._places["t"]
        is_named = _NAME.fullmatch(names[place].lower()) if len(names) == self._count else None
        if is_named and is_named[2] in _FACTORS:
            return is_named[2]
        self._is_unit_assumed = True
        times = [float(row[place]) for row in sample if len(row) > place and _is_number(row[place])]
        if sum(t >= _NANOSECONDS for t in times) * 2 > len(times):
            raise ValueError("its times are too large for microseconds: give their unit, as in --time-unit ns")
        fractions = sum(t % 1 > 0 for t in times if abs(t) < np.inf)
        unit = "s" if fractions and 2 * fractions >= len(times) else "us"
        if not any("@" in name for name in names):
            self.remarks += (f"it has no unit of time: its times are taken as {unit} (--time-unit)",)
        return unit

    def decode(self, data: bytes) -> Events:
        """Return (n,) EVENT of the lines that any next bytes complete, from `start` on; none after `damage`.

        Without bytes, at the end of the file, the last line needs no end.
        """
        if self.damage:
            return empty_events()
        data = self.rest + (data or b"\n")
        end = data.rfind(b"\n") + 1
        self.rest = data[end:]
        lines = data[:end].decode("latin-1").split("\n")
        rows = list(filter(str.strip, lines))
        if b"#" in data:
            rows = [line for line in rows if line[0] != "#"]
        events, count = self._events(rows)
        if count < len(rows):
            numbered = ((k, line) for k, line in enumerate(lines, self._line + 1) if line.strip() and line[0] != "#")
            number, line = next(islice(numbered, count, None))
            self.damage = f"line {number}: {line[:60].strip()!r}: {self._fault(line)}"
        elif len(self.rest) > _MOST_LINE:
            self.damage = f"line {self._line + len(lines)}: it has more than {_MOST_LINE} octets"
            self.rest = b""
        self._line += len(lines) - 1
        return events

    def _events(self, rows: list[str]) -> tuple[Events, int]:
        """Return the events of the lines before the first that is none, and their number."""
        if not rows:
            return empty_events(), 0
        table = self._table(rows)
        if table is None:
            sound = bisect_left(range(1, len(rows) + 1), True, key=lambda k: self._table(rows[:k]) is None)
            return self._events(rows[:sound])
        t, x, y, p = (table[name] for name in "txyp")
        if p.dtype.kind == "U":
            texts, places = np.unique(p, return_inverse=True)
            p = np.array([_polarity(text) for text in texts])[places]
        factor = _FACTORS[self._unit]
        with np.errstate(invalid="ignore"):
            is_right = (t >= 0) & (t < _MOST_US // factor)
            for place in (x, y):
                is_right &= (place >= 0) & (place <= 65535) & (place % 1 == 0)
            if self._is_unit_assumed and self._unit == "us":
                is_right &= t % 1 == 0
        is_off = (p == 0) | (p == -1)
        if self._off is None and is_off.any():
            self._off = int(p[is_off.argmax()])
        is_right &= (p == 1) | (is_off & (p == self._off))
        count = len(rows) if is_right.all() else int(is_right.argmin())
        t, x, y, p = (values[:count] for values in (t, x, y, p))
        t = np.rint(t * factor) if t.dtype.kind == "f" else t * factor
        return make_events(t if self._unit != "ns" else (t + 500) // 1000, x, y, p == 1), count

    def _table(self, rows: list[str]) -> npt.NDArray[Any] | None:
        """Return the columns of lines, (n,) with fields t, x, y and p; None if one of them is no number."""
        if self._usecols is not None and any(len(row.split(self._separator)) != self._count for row in rows):
            return None
        for k in range(self._types, len(_TYPES)):
            t, place, p = _TYPES[k]
            dtype = np.dtype([(name, {"t": t, "p": p}.get(name, place)) for name in self._used])
            try:
                with warnings.catch_warnings(action="error"):  # of a float that is no whole number
                    table = np.loadtxt(
                        rows, dtype, comments=None, delimiter=self._separator, usecols=self._usecols, ndmin=1,
                        encoding=None,
                    )  # fmt: skip
            except (ValueError, DeprecationWarning):
                continue
            self._types = k
            return table
        return None

    def _fault(self, line: str) -> str:
        """Return what is wrong with a line."""
        fields = [field.strip() for field in line.split(self._separator)]
        if len(fields) != self._count:
            return f"it has {len(fields)} columns, not {self._count}"
        values = {name: fields[place] for name, place in self._places.items()}
        for name, value in values.items():
            if not _is_right(name, value):
                return f"{name} is {value[:30]!r}, not {_RIGHT[name]}"
        if self._off is not None and _polarity(values["p"]) not in (1, self._off):
            return f"p is {values['p']}, and {self._off} in lines before it"
        advice = "give the unit, as in --time-unit s"
        return f"t is {values['t']}, which is no whole number of microseconds up to 2^62: {advice}"


def _polarity(text: str) -> float:
    """Return the number of a polarity; NaN for another text."""
    value = _WORDS.get(text.strip().lower(), np.nan)
    return float(text) if np.isnan(value) and _is_number(text) else value


def _places(names: list[str]) -> dict[str, int]:
    """Return the places of t, x, y and p that are named once."""
    bare = [match[1] if (match := _NAME.fullmatch(name.lower())) else "" for name in names]
    places = {name: [k for k, text in enumerate(bare) if text in words] for name, words in _NAMES.items()}
    return {name: at[0] for name, at in places.items() if len(at) == 1}


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return "_" not in text


def _is_right(name: str, text: str) -> bool:
    """Return whether a field can be that of column t, x, y or p."""
    if not _is_number(text):
        return name == "p" and text.lower() in _WORDS
    value = float(text)
    if name == "t":
        return 0 <= value < _MOST_US
    return value in (-1, 0, 1) if name == "p" else 0 <= value <= 65535 and value % 1 == 0


def is_table(head: bytes) -> bool:
    """Return whether the first bytes of a file are those of a table of events, or begin with four numbers or more."""
    try:
        EventTable(head)
    except ValueError:
        fields = re.split(rb"[;,\s]+", head.partition(b"\n")[0].strip())
        return len(fields) >= 4 and all(_is_number(field.decode("latin-1")) for field in fields)
    return True
