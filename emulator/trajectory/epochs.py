"""Epochs of CCSDS files as nanoseconds of one continuous time scale.

    UTC                 leap seconds are counted: 23:59:60 is an instant, and a file may cross one
    TAI, TT (TDT), GPS  TAI = TT - 32.184 s = GPS + 19 s
    TDB                 taken as TT, from which it never differs by more than 2 ms
    others              (UT1, MET, MRT, SCLK, TCB, TCG, GMST) have no fixed relation to these: they are only compared
                        with themselves

Source of the leap seconds: IERS Bulletin C; the last one was at the end of 2016. Before 1972 UTC is taken as TAI less
10 s.
"""

from __future__ import annotations

import re
from bisect import bisect_right
from datetime import date, datetime, timedelta
from fractions import Fraction

__all__ = ["epoch_ns", "scale_of"]

_EPOCH = re.compile(r"(\d{4})-(?:(\d{3})|(\d{2})-(\d{2}))T(\d{2}):(\d{2}):(\d{2})(\.\d+)?Z?$")
_ORIGIN = datetime(2000, 1, 1)
_BEHIND_TAI_NS = {"TAI": 0, "TT": -32_184_000_000, "TDT": -32_184_000_000, "TDB": -32_184_000_000, "GPS": 19 * 10**9}
_FIRST_OFFSET_S = 10
_LEAPS = [
    date(year, month, 1)
    for year, month in (
        (1972, 7), (1973, 1), (1974, 1), (1975, 1), (1976, 1), (1977, 1), (1978, 1), (1979, 1), (1980, 1), (1981, 7),
        (1982, 7), (1983, 7), (1985, 7), (1988, 1), (1990, 1), (1991, 1), (1992, 7), (1993, 7), (1994, 7), (1996, 1),
        (1997, 7), (1999, 1), (2006, 1), (2009, 1), (2012, 7), (2015, 7), (2017, 1),
    )
]  # fmt: skip
"""Days that a leap second comes just before."""


def scale_of(time_system: str) -> str:
    """Return the scale that a TIME_SYSTEM is counted on here: TAI where it can be turned into that, else its name."""
    return "TAI" if time_system == "UTC" or time_system in _BEHIND_TAI_NS else time_system


def epoch_ns(text: str, time_system: str = "UTC") -> int:
    """Return an epoch on the scale of its time system, ns since 2000-01-01T00:00:00 of that; raises ValueError."""
    found = _EPOCH.match(text)
    if not found:
        raise ValueError(f"epoch {text!r}: expected yyyy-mm-ddThh:mm:ss or yyyy-dddThh:mm:ss")
    year, day_of_year, month, day, hour, minute, second, fraction = found.groups()
    start = datetime(int(year), int(month or 1), int(day or 1), int(hour), int(minute))
    if day_of_year:
        start += timedelta(days=int(day_of_year) - 1)
    if int(second) >= 60:
        _require_leap_second(text, start, int(second), time_system)
    whole = (start - _ORIGIN) // timedelta(seconds=1) + int(second)
    ns = whole * 10**9 + int(Fraction(fraction or "0") * 10**9)
    if time_system == "UTC":
        return ns + (_FIRST_OFFSET_S + bisect_right(_LEAPS, start.date())) * 10**9
    return ns + _BEHIND_TAI_NS.get(time_system, 0)


def _require_leap_second(text: str, minute: datetime, second: int, time_system: str) -> None:
    after = minute + timedelta(minutes=1)
    is_last_minute = (minute.hour, minute.minute) == (23, 59)
    if time_system != "UTC" or second > 60 or not is_last_minute or after.date() not in _LEAPS:
        raise ValueError(f"epoch {text!r}: there was no leap second in {time_system}")
