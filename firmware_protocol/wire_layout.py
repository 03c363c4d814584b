"""Layouts of packets: fields of whole bits in a row, most significant bit first, with their units and meanings.

A layout packs and unpacks, and the definitions for ground systems (`firmware_protocol.ground`) are generated from it.
So these definitions agree with the packets that the code sends.

    HEADER = Layout(
        Field("version", 4, fixed=1), Field("mode", 4, choices=choices_of(Mode)), Field("t_base", 32, unit="us")
    )
    HEADER.pack(mode=Mode.ROWS, t_base=1_500_000)
    HEADER.unpack(octets)["t_base"]
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from functools import cached_property

import numpy as np


class WrongLength(Exception):
    """The number of octets is not that of the layout."""


@dataclass(frozen=True)
class Field:
    """One number of a layout.

    Attributes
    ----------
    bits : its width, 1 to 64.
    meaning : meaning of the number, for people.
    unit : unit of the value, after `scale`; "" for none.
    scale : value of one step in `unit`.
    signed : True for a number in two's complement.
    fixed : its only value; None if it varies.
    choices : name of each value that it can have, if these are a list.
    lowest, highest : range of the number on the wire; None: all values of the bits.
    """

    name: str
    bits: int
    meaning: str = ""
    unit: str = ""
    scale: float = 1.0
    signed: bool = False
    fixed: int | None = None
    choices: Mapping[int, str] = field(default_factory=dict)
    lowest: int | None = None
    highest: int | None = None

    @cached_property
    def range(self) -> tuple[int, int]:
        """Least and greatest number on the wire."""
        half = 1 << self.bits - 1
        low, high = (-half, half - 1) if self.signed else (0, 2 * half - 1)
        return low if self.lowest is None else self.lowest, high if self.highest is None else self.highest

    def check(self, value: int) -> None:
        """Raise ValueError for a value that it cannot have."""
        low, high = self.range
        if not low <= value <= high:
            wrong = f"is not in {low}..{high}"
        elif self.choices and value not in self.choices:
            wrong = f"is none of {', '.join(map(str, self.choices))}"
        elif self.fixed not in (None, value):
            wrong = f"is not {self.fixed}"
        else:
            return
        raise ValueError(f"{self.name.replace('_', ' ')} {value} {wrong}")


def choices_of(names: type[IntEnum]) -> dict[int, str]:
    """Return the name of each value of an enumeration."""
    return {choice.value: choice.name for choice in names}


class Layout:
    """Fields in a row, together whole octets."""

    def __init__(self, *fields: Field) -> None:
        self.fields = fields
        self.bits = sum(member.bits for member in fields)
        if self.bits % 8:
            raise ValueError(f"a layout has whole octets, not {self.bits} bits")
        ends = [sum(member.bits for member in fields[: n + 1]) for n in range(len(fields))]
        self._packing = [
            (member, member.name, member.fixed, *member.range, member.bits, (1 << member.bits) - 1) for member in fields
        ]
        self._places = [
            (member.name, self.bits - end, (1 << member.bits) - 1) for member, end in zip(fields, ends, strict=True)
        ]
        self._signs = [(member.name, member.bits) for member in fields if member.signed]
        if len(self.by_name) != len(fields):
            raise ValueError(f"a name is used twice: {', '.join(member.name for member in fields)}")

    def __add__(self, other: Layout) -> Layout:
        return Layout(*self.fields, *other.fields)

    @cached_property
    def octets(self) -> int:
        """Length."""
        return self.bits // 8

    @cached_property
    def by_name(self) -> Mapping[str, Field]:
        """The fields by name."""
        return {member.name: member for member in self.fields}

    def pack(self, **values: int) -> bytes:
        """Return the octets; fixed fields need no value. Raises ValueError for a value that does not fit."""
        if not values.keys() <= self.by_name.keys():
            raise TypeError(f"no field {', '.join(sorted(values.keys() - self.by_name.keys()))}")
        number = 0
        for member, name, fixed, low, high, bits, mask in self._packing:
            value = values.get(name, fixed)
            if value is None:
                raise TypeError(f"no value for {name}")
            if fixed is not None or member.choices or not low <= value <= high:
                member.check(value)
            number = number << bits | value & mask
        return number.to_bytes(self.octets, "big")

    def unpack(self, octets: bytes) -> dict[str, int]:
        """Return the values, valid or not. Raises WrongLength."""
        if len(octets) != self.octets:
            raise WrongLength(f"{len(octets)} octets, not {self.octets}")
        number = int.from_bytes(octets, "big")
        values = {name: number >> low & mask for name, low, mask in self._places}
        for name, bits in self._signs:
            values[name] -= values[name] >> bits - 1 << bits
        return values

    def holds(self, values: Mapping[str, int]) -> bool:
        """Return true if every field has a value that it can have; other names are ignored."""
        try:
            for member in self.fields:
                member.check(values[member.name])
        except ValueError:
            return False
        return True

    @cached_property
    def dtype(self) -> np.dtype[np.void]:
        """The same as a numpy record; only for fields of 8, 16, 32 or 64 bits."""
        return np.dtype(
            [(member.name, f">{'i' if member.signed else 'u'}{member.bits // 8}") for member in self.fields]
        )
