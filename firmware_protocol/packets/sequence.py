"""Sequence counts: given out by a sender, followed by a receiver that says how many packets never came."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Hashable

__all__ = ["SequenceCounts", "SequenceFollower"]


class SequenceCounts:
    """One running number for each key, modulo `modulus`."""

    def __init__(self, modulus: int) -> None:
        self._modulus = modulus
        self._next: defaultdict[Hashable, int] = defaultdict(int)

    def take(self, key: Hashable) -> int:
        """Return the next number of `key`."""
        number = self._next[key]
        self._next[key] = (number + 1) % self._modulus
        return number


class SequenceFollower:
    """Compares the numbers that come with those that should.

    A number less than half a turn ahead means that those between are missing; one behind (a repeat, packets out of
    order, a sender that began anew) is counted in `disordered`, and counting goes on from it.

    Attributes
    ----------
    missing
        Packets that never came.
    disordered
        Packets whose number was behind the one expected.
    """

    def __init__(self, modulus: int) -> None:
        self._modulus = modulus
        self._expected: dict[Hashable, int] = {}
        self.missing = 0
        self.disordered = 0

    def follow(self, key: Hashable, number: int) -> int:
        """Take the number of a packet of `key`; return how many are missing before it."""
        ahead = (number - self._expected.get(key, number)) % self._modulus
        self._expected[key] = (number + 1) % self._modulus
        if ahead >= self._modulus // 2:
            self.disordered += 1
            return 0
        self.missing += ahead
        return ahead
