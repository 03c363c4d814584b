"""The page's TCP connections, bounded before any byte of them is read."""

from __future__ import annotations

import asyncio
from typing import Any

from uvicorn.protocols.http.h11_impl import H11Protocol

from transports.network.admission import Admission, Places, Seat
from transports.network.allow import AllowList

__all__ = ["Connections"]

_PLACES = Places(total=64, per_address=64)  # a token, not the address, says who may use the page
_EVERYBODY = ("0.0.0.0/0", "::/0")


class Connections:
    """All connections of one server, by the peer's address as ASGI gives it."""

    def __init__(self) -> None:
        self._admission = Admission(AllowList(_EVERYBODY), _PLACES)
        self._open: dict[Any, tuple[Seat, asyncio.Transport]] = {}

    def __len__(self) -> int:
        return len(self._open)

    def enter(self, peer: Any, transport: asyncio.Transport) -> bool:
        """Let a connection in, if need be in the place of one that has not asked for the WebSocket."""
        seat = self._admission.admit(str(peer[0]), transport.abort)
        if seat is not None:
            self._open[tuple(peer[:2])] = seat, transport
        return seat is not None

    def settle(self, peer: Any) -> None:
        """Keep a connection: it is a viewer's."""
        if tuple(peer) in self._open:
            self._admission.settle(self._open[tuple(peer)][0])

    def abort(self, peer: Any) -> None:
        """End a connection at once, with all that waits to be sent."""
        if tuple(peer) in self._open:
            self._open[tuple(peer)][1].abort()

    def leave(self, peer: Any) -> None:
        """Forget a connection that is over."""
        seat, _ = self._open.pop(tuple(peer[:2]), (None, None))
        if seat is not None:
            self._admission.leave(seat)

    def protocol(self) -> type[H11Protocol]:
        """Return uvicorn's protocol, with these bounds."""
        connections = self

        class Bounded(H11Protocol):
            """HTTP on a connection that has a place."""

            def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
                super().connection_made(transport)
                peer = transport.get_extra_info("peername")
                if peer is None or not connections.enter(peer, transport):
                    transport.abort()

            def connection_lost(self, exc: Exception | None) -> None:
                super().connection_lost(exc)
                peer = self.transport.get_extra_info("peername")
                if peer is not None:
                    connections.leave(peer)

        return Bounded
