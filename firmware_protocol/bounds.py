"""Bounds of the numbers of a dataclass, each in the annotation of its field: `Annotated[float, Meta(ge=0, le=1)]`.

They stand there once: `check_bounds` holds a dataclass to them wherever it is made; the schema, the reference of rigs
and the live page show them.
"""

from __future__ import annotations

import typing
from collections.abc import Mapping
from functools import cache
from typing import Annotated, Any

from msgspec import Meta

Share = Annotated[float, Meta(ge=0, le=1)]
"""A part of a whole."""


@cache
def bounds_of(target: type) -> Mapping[str, Meta]:
    """Return the bounds of a dataclass's numbers, by field."""
    hints = typing.get_type_hints(target, include_extras=True)
    return {name: of.__metadata__[0] for name, of in hints.items() if typing.get_origin(of) is Annotated}


def range_text(bounds: Meta) -> str:
    """Return bounds in words, such as "0 to 1"."""
    named = {"above": bounds.gt, "at least": bounds.ge, "at most": bounds.le}
    words = {name: str(n) if isinstance(n, int) else f"{n:.10g}" for name, n in named.items() if n is not None}
    is_range = [*words] == ["at least", "at most"]
    return " to ".join(words.values()) if is_range else ", ".join(map(" ".join, words.items()))


def check_bounds(owner: Any) -> None:
    """Raise ValueError where a number of a dataclass lies outside the bounds of its field, or is NaN."""
    for name, bounds in bounds_of(owner.__class__).items():
        value = getattr(owner, name)
        above = value > bounds.gt if bounds.gt is not None else bounds.ge is None or value >= bounds.ge
        if not (above and (bounds.le is None or value <= bounds.le)):
            raise ValueError(f"{name} must be {range_text(bounds)}, got {value!r}")
