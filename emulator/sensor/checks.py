"""Range checks of a sensor's parameters; a message reads `name = value: must be ...`, so that the key is found."""

from __future__ import annotations

import math
from dataclasses import fields
from typing import Any

__all__ = ["check", "check_finite"]


def check(owner: Any, name: str, low: float, high: float = math.inf, *, above: bool = False) -> None:
    """Raise ValueError unless low <= owner.name <= high (low < with `above`); NaN is always refused."""
    value = getattr(owner, name)
    good = low < value <= high if above else low <= value <= high
    if not good:
        least = "above" if above else "at least"
        most = "" if math.isinf(high) else f" and at most {high:g}"
        raise ValueError(f"{name} = {value!r}: must be {least} {low:g}{most}")


def check_finite(owner: Any, unbounded: tuple[str, ...] = ()) -> None:
    """Raise ValueError if a field other than those in `unbounded` is infinite."""
    for one in fields(owner):
        value = getattr(owner, one.name)
        if isinstance(value, float) and math.isinf(value) and one.name not in unbounded:
            raise ValueError(f"{one.name} = {value!r}: must be finite")
