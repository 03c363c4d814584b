"""The memory of a GigE Vision device: areas of octets that a host reads, registers of four octets that it writes.

area       start --- octets ------- end       READREG, READMEM
rule       at the address of a register       WRITEREG, WRITEMEM: value written -> value kept, or Refused
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Mapping

from firmware_protocol.gige.gvcp import Refused, Status

__all__ = ["LONGEST_READ", "Memory", "Rule", "between", "kept"]

LONGEST_READ = 536
"""Octets of one READMEM: the answer fits into 576 octets, which every network carries."""

Rule = Callable[[int], int]
"""What a register does with a value written to it: returns the value to keep, or raises Refused."""


def kept(value: int) -> int:
    """Return the value as it was written: the rule of a register that only remembers."""
    return value


def between(least: int, most: int) -> Rule:
    """Return the rule of a register that refuses numbers outside of these, signed where `least` is negative."""

    def rule(value: int) -> int:
        number = value - (1 << 32) if least < 0 and value >> 31 else value
        if not least <= number <= most:
            raise Refused(Status.INVALID_PARAMETER)
        return value

    return rule


class Memory:
    """Areas by the address that they begin at, and rules by the address of their register."""

    def __init__(self, areas: Mapping[int, bytes], rules: Mapping[int, Rule]) -> None:
        self._starts = sorted(areas)
        self._areas = {start: bytearray(areas[start]) for start in self._starts}
        self._rules = dict(rules)

    def read(self, address: int, count: int) -> bytes:
        """Return `count` octets; raises Refused outside of the areas, and where four do not divide both numbers."""
        if address % 4 or count % 4:
            raise Refused(Status.BAD_ALIGNMENT)
        area, offset = self._find(address, count)
        return bytes(area[offset : offset + count])

    def get(self, address: int) -> int:
        """Return a register; raises Refused where there is none."""
        return int.from_bytes(self.read(address, 4), "big")

    def set(self, address: int, value: int) -> None:
        """Change a register from the inside, without its rule."""
        area, offset = self._find(address, 4)
        area[offset : offset + 4] = (value & 0xFFFFFFFF).to_bytes(4, "big")

    def write(self, address: int, value: int) -> None:
        """Write a register as a host does; raises Refused where it cannot be written, or not with this value."""
        if address % 4:
            raise Refused(Status.BAD_ALIGNMENT)
        rule = self._rules.get(address)
        if rule is None:
            self._find(address, 4)
            raise Refused(Status.WRITE_PROTECT)
        self.set(address, rule(value))

    def _find(self, address: int, count: int) -> tuple[bytearray, int]:
        place = bisect_right(self._starts, address) - 1
        if place >= 0:
            start = self._starts[place]
            area = self._areas[start]
            if address + count <= start + len(area):
                return area, address - start
        raise Refused(Status.INVALID_ADDRESS)
