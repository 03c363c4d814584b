"""Bounds of the numbers of a dataclass, each in the annotation of its field: `Annotated[float, Meta(ge=0, le=1)]`.

They stand there once: `check_bounds` holds a dataclass to them wherever it is made; the schema, the reference of rigs
and the live page show them. `whole_number` is for the arguments of functions.
"""

from __future__ import annotations

import operator
import typing
from collections.abc import Callable, Collection, Mapping
from dataclasses import fields
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


@cache
def whole_fields(target: type) -> Collection[str]:
    """Return the fields of a dataclass that are whole numbers."""
    return {name for name, of in typing.get_type_hints(target).items() if of is int}


def range_text(bounds: Meta) -> str:
    """Return bounds in words, such as "0 to 1"."""
    named = {"above": bounds.gt, "at least": bounds.ge, "at most": bounds.le}
    words = {name: str(n) if isinstance(n, int) else f"{n:.10g}" for name, n in named.items() if n is not None}
    is_range = [*words] == ["at least", "at most"]
    return " to ".join(words.values()) if is_range else ", ".join(map(" ".join, words.items()))


def check_bounds(owner: Any) -> None:
    """Raise ValueError where a number of a dataclass lies outside the bounds of its field, is NaN, or should be whole.

    Lists and arrays in it become tuples, which the program that made it cannot change afterwards.
    """
    for field in fields(owner):
        object.__setattr__(owner, field.name, unshared(getattr(owner, field.name)))
    for name, bounds in bounds_of(owner.__class__).items():
        value = getattr(owner, name)
        if name in whole_fields(owner.__class__) and type(value) is not int:
            raise ValueError(f"{name} must be a whole number, got {value!r}")
        above = value > bounds.gt if bounds.gt is not None else bounds.ge is None or value >= bounds.ge
        if not (above and (bounds.le is None or value <= bounds.le)):
            raise ValueError(f"{name} must be {range_text(bounds)}, got {value!r}")


class Bounded:
    """Base of a dataclass that is held to the bounds of its fields when it is made; see `check_bounds`."""

    def __post_init__(self) -> None:
        check_bounds(self)


def unshared(value: Any, of_array: Callable[[Any], Any] = lambda array: unshared(array.tolist())) -> Any:
    """Return a value that its giver cannot change: tuples for lists, copies of mappings, and what `of_array` returns.

    By default arrays become tuples too. Numbers of NumPy become those of Python.
    """
    if getattr(value, "ndim", 0):  # NumPy is not imported for it: the answering process of GigE Vision starts without
        return of_array(value)
    if hasattr(value, "tolist"):
        return unshared(value.tolist(), of_array)
    if isinstance(value, Mapping):
        return {key: unshared(item, of_array) for key, item in value.items()}
    return tuple(unshared(item, of_array) for item in value) if type(value) in (list, tuple) else value


class NotWhole(TypeError, ValueError):
    """A number that is not whole, or is none: both a wrong type and a wrong value."""


LAST_US, LAST_NS = (1 << 52) - 1, (1 << 62) - 1  # 140 years
_UNITS = {"us": "whole microseconds (1 s is 1000000) are", "ns": "whole nanoseconds are"}


def whole_number(name: str, value: Any, lowest: int = -LAST_US, highest: int = LAST_US) -> int:
    """Return the argument `name` as an int; raises NotWhole, and ValueError outside its bounds.

    The end of the name gives the unit, as in `t_us`.
    """
    bounds = f"{lowest} to {highest if highest & (highest + 1) else f'2^{highest.bit_length()} - 1'}"
    if isinstance(value, bool) or not hasattr(value, "__index__"):
        raise NotWhole(f"{name} is {value!r}: {_UNITS.get(name[-2:], 'a whole number is')} needed, {bounds}")
    number = operator.index(value)
    if not lowest <= number <= highest:
        remedy = "; if it is in nanoseconds, divide it by 1000" if name.endswith("us") and number > highest else ""
        raise ValueError(f"{name} is {number}: it must be {bounds}{remedy}")
    return number
