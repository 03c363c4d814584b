"""Which connections a server keeps: a list of allowed addresses, a total, a share for each address.

    idle      connected, and has not asked for anything yet; closed when a newer one needs its place, the oldest of the
              address with the most idle connections first
    settled   uses what is served; never closed for another one

A flood from one address therefore leaves the connections of the others alone, and never touches a settled one.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from itertools import chain

from transports.network.allow import AllowList

__all__ = ["Admission", "Places", "Seat"]


@dataclass(frozen=True)
class Places:
    """Most connections at once.

    Attributes
    ----------
    total
        Of all addresses together.
    per_address
        Of one address.
    """

    total: int = 64
    per_address: int = 16


@dataclass(eq=False)
class Seat:
    """One connection that was admitted; `evict` closes it at once."""

    address: str
    evict: Callable[[], None]


class Admission:
    """The connections of one server.

    Attributes
    ----------
    counts
        Connections that were refused or closed for another one, by the words of the summary.
    """

    def __init__(self, allowed: AllowList, places: Places = Places()) -> None:
        self._allowed = allowed
        self._places = places
        self._idle: dict[Seat, None] = {}  # oldest first
        self._settled: set[Seat] = set()
        self.counts: Counter[str] = Counter()

    def __len__(self) -> int:
        return len(self._idle) + len(self._settled)

    def permits(self, address: str) -> bool:
        """Say whether an address may connect; a refusal is counted."""
        permitted = self._allowed.permits(address)
        self.counts["connections refused: address not allowed"] += not permitted
        return permitted

    def admit(self, address: str, evict: Callable[[], None]) -> Seat | None:
        """Give a newcomer a place, if need be that of an idle connection; None (counted) when there is none."""
        if not self._make_place(address):
            self.counts["connections refused: too many"] += 1
            return None
        seat = Seat(address, evict)
        self._idle[seat] = None
        return seat

    def settle(self, seat: Seat) -> None:
        """Keep a connection from now on: it uses what is served."""
        if seat in self._idle:
            del self._idle[seat]
            self._settled.add(seat)

    def leave(self, seat: Seat) -> None:
        """Forget a connection that is over."""
        self._idle.pop(seat, None)
        self._settled.discard(seat)

    def _make_place(self, address: str) -> bool:
        mine = sum(seat.address == address for seat in chain(self._idle, self._settled))
        if mine >= self._places.per_address:
            return self._evict(address)
        if len(self) < self._places.total:
            return True
        idle = Counter(seat.address for seat in self._idle)
        return bool(idle) and self._evict(idle.most_common(1)[0][0])

    def _evict(self, address: str) -> bool:
        """Close the oldest idle connection of an address; False when it has none."""
        seat = next((seat for seat in self._idle if seat.address == address), None)
        if seat is None:
            return False
        self.leave(seat)
        self.counts["idle connections closed for newer ones"] += 1
        seat.evict()
        return True
