"""The page's web server: a few files, and a WebSocket for each viewer.

A viewer is a browser. A status that it does not read in time is replaced by a newer one, and a picture is joined with
the next. It reports the last message that it has shown; at most three are on their way to it. So a slow viewer or
network gets fewer pictures, and one that stops reading has at most three of them in the machine's buffers until it is
dropped.

The number of the page's TCP connections is bounded before any byte of them is read.
"""

from __future__ import annotations

import asyncio
import json
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from importlib.resources import files
from importlib.resources.abc import Traversable
from typing import Any

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect
from uvicorn.protocols.http.h11_impl import H11Protocol

from emulator.live_page.messages import MOST_COMMAND_BYTES, Access, BadMessage, Picture, encode_picture, parse_command
from transports.connections import Admission, Places, Seat
from transports.network import AllowList

MOST_VIEWERS = 16
STALLED_S = 10.0

_MOST_ON_THE_WAY = 3
_MOST_ANSWERS = 16
_MESSAGES_PER_S, _MOST_AT_ONCE = 100.0, 200.0


class Viewer:
    """One browser, with a `number`, because answers are for one viewer alone; `now_s`: a clock, s."""

    def __init__(self, number: int, now_s: Callable[[], float]) -> None:
        self.number = number
        self._now_s = now_s
        self._status: str | None = None
        self._picture: Picture | None = None
        self._answers: deque[str] = deque(maxlen=_MOST_ANSWERS)
        self._sent = self._seen = 0
        self._moved_s = self._filled_s = now_s()
        self._tokens = _MOST_AT_ONCE
        self._ready = asyncio.Event()

    @property
    def on_the_way(self) -> int:
        """Messages sent and not yet shown."""
        return self._sent - self._seen

    @property
    def stalled(self) -> bool:
        """True when it has shown none of the sent messages for so long that it is to be dropped."""
        return self.on_the_way >= _MOST_ON_THE_WAY and self._now_s() - self._moved_s > STALLED_S

    def put(self, message: str | Picture) -> None:
        """Queue a status (str), in place of one that was not sent, or a picture, joined with one that was not sent."""
        if isinstance(message, str):
            self._status = message
        else:
            self._picture = message if self._picture is None else self._picture.joined(message)
        self._look()

    def answer(self, message: str) -> None:
        """Queue an answer; the oldest is dropped when the queue is full."""
        self._answers.append(message)
        self._look()

    def has_seen(self, number: int) -> None:
        """Record the newest message that was shown, counted from 1; raises BadMessage."""
        if not self._seen <= number <= self._sent:
            raise BadMessage(f"message {number} has not been sent, or had been seen before")
        self._seen, self._moved_s = number, self._now_s()
        self._look()

    def charge(self) -> None:
        """Count a message that came; raises BadMessage when there are too many."""
        now_s = self._now_s()
        self._tokens = min(_MOST_AT_ONCE, self._tokens + (now_s - self._filled_s) * _MESSAGES_PER_S) - 1
        self._filled_s = now_s
        if self._tokens < 0:
            raise BadMessage("too many messages")

    async def next(self) -> str | Picture:
        """Wait for a message that the viewer can take, and return it."""
        while (message := self.take()) is None:
            await self._ready.wait()
        return message

    def take(self) -> str | Picture | None:
        """Return the message to be sent now; None where there is none."""
        if not self._ready.is_set():
            return None
        if not self.on_the_way:
            self._moved_s = self._now_s()
        self._sent += 1
        message: str | Picture | None
        if self._answers:
            message = self._answers.popleft()
        elif self._status is not None:
            message, self._status = self._status, None
        else:
            message, self._picture = self._picture, None
        self._look()
        return message

    def _look(self) -> None:
        waits = self._answers or self._status is not None or self._picture is not None
        if waits and self.on_the_way < _MOST_ON_THE_WAY:
            self._ready.set()
        else:
            self._ready.clear()


class Viewers:
    """All viewers, at most `MOST_VIEWERS`."""

    def __init__(self, now_s: Callable[[], float]) -> None:
        self._now_s = now_s
        self._viewers: dict[int, tuple[Viewer, Callable[[], None]]] = {}
        self._number = 0

    def __len__(self) -> int:
        return len(self._viewers)

    def enter(self, drop: Callable[[], None]) -> Viewer | None:
        """Add a viewer, whose connection `drop` ends at once; return None where there are too many."""
        if len(self._viewers) >= MOST_VIEWERS:
            return None
        self._number += 1
        viewer = Viewer(self._number, self._now_s)
        self._viewers[viewer.number] = viewer, drop
        return viewer

    def leave(self, viewer: Viewer) -> None:
        """Remove a viewer."""
        self._viewers.pop(viewer.number, None)

    def put(self, message: str | Picture) -> None:
        """Send a status or a picture to all."""
        for viewer, _ in self._viewers.values():
            viewer.put(message)

    def send_all(self, message: str) -> None:
        """Send all viewers a message that none may miss."""
        for viewer, _ in self._viewers.values():
            viewer.answer(message)

    def answer(self, number: int, message: str) -> None:
        """Send an answer to the viewer that sent the command, if it is still connected."""
        if number in self._viewers:
            self._viewers[number][0].answer(message)

    def drop_stalled(self) -> None:
        """End the connections of viewers that do not read."""
        for viewer, drop in list(self._viewers.values()):
            if viewer.stalled:
                self.leave(viewer)
                drop()


_PLACES = Places(total=64, per_address=64)  # a token, not the address, gives access to the page
_EVERYBODY = ("0.0.0.0/0", "::/0")


class Connections:
    """All connections of one server, by the peer's address as ASGI gives it."""

    def __init__(self) -> None:
        self._admission = Admission(AllowList(_EVERYBODY), _PLACES)
        self._open: dict[Any, tuple[Seat, asyncio.Transport]] = {}

    def __len__(self) -> int:
        return len(self._open)

    def enter(self, peer: Any, transport: asyncio.Transport) -> bool:
        """Accept a connection, if need be in the place of one that has not requested the WebSocket."""
        seat = self._admission.admit(str(peer[0]), transport.abort)
        if seat is not None:
            self._open[tuple(peer[:2])] = seat, transport
        return seat is not None

    def settle(self, peer: Any) -> None:
        """Mark a connection as a viewer's, which is never replaced."""
        if tuple(peer) in self._open:
            self._admission.settle(self._open[tuple(peer)][0])

    def abort(self, peer: Any) -> None:
        """End a connection at once, with all that waits to be sent."""
        if tuple(peer) in self._open:
            self._open[tuple(peer)][1].abort()

    def leave(self, peer: Any) -> None:
        """Remove a connection that has ended."""
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


BAD_MESSAGE = 4400
REFUSED = 4401
FULL = 4429
"""Codes with which a WebSocket is closed."""

_HELLO_S = 5.0
_SEND_S = 10.0
_KINDS = {"html": "text/html", "js": "text/javascript", "css": "text/css"}
_HEADERS = {
    "Content-Security-Policy": "default-src 'self'; img-src 'self' data: blob:; frame-ancestors 'self'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-cache",
}


@dataclass
class PageServer:
    """Web server of one run's page.

    `greeting` returns the first message for a viewer. `command` forwards a viewer's parsed command; it returns False
    where too many wait already.
    """

    greeting: Callable[[], str]
    access: Access
    viewers: Viewers
    connections: Connections
    command: Callable[[int, dict[str, Any]], bool]

    def app(self) -> Starlette:
        """Return the ASGI application."""
        routes = [_route(file) for file in (files("emulator.live_page") / "static").iterdir()]
        return Starlette(routes=[*routes, WebSocketRoute("/live", self._live)])

    async def _live(self, socket: WebSocket) -> None:
        peer = tuple(socket.scope.get("client") or ("", 0))
        try:
            await self._viewed(socket, peer)
        finally:
            self.connections.leave(peer)

    async def _viewed(self, socket: WebSocket, peer: tuple[Any, ...]) -> None:
        if not self.access.origin_permitted(socket.headers.get("origin"), socket.headers.get("host")):
            await socket.close()
            return
        await socket.accept()
        with suppress(WebSocketDisconnect, TimeoutError, RuntimeError):
            if not await self._introduced(socket):
                await socket.close(REFUSED, "the token is wrong")
                return
            viewer = self.viewers.enter(lambda: self.connections.abort(peer))
            if viewer is None:
                await socket.close(FULL, "too many viewers")
                return
            self.connections.settle(peer)
            await self._serve(socket, viewer)

    async def _introduced(self, socket: WebSocket) -> bool:
        """Wait for the first message, which contains the token."""
        try:
            hello = parse_command(await asyncio.wait_for(_text(socket), _HELLO_S))
        except (BadMessage, TimeoutError):
            return False
        return hello["do"] == "hello" and self.access.permits(hello["token"])

    async def _serve(self, socket: WebSocket, viewer: Viewer) -> None:
        viewer.answer(self.greeting())
        sending = asyncio.create_task(_send(socket, viewer))
        try:
            await self._listen(socket, viewer)
        except BadMessage as error:
            await socket.close(BAD_MESSAGE, str(error)[:100])
        finally:
            self.viewers.leave(viewer)
            sending.cancel()
            await asyncio.gather(sending, return_exceptions=True)

    async def _listen(self, socket: WebSocket, viewer: Viewer) -> None:
        while True:
            text = await _text(socket)
            viewer.charge()
            command = parse_command(text)
            if command["do"] == "seen":
                viewer.has_seen(command["number"])
            elif command["do"] == "hello":
                raise BadMessage("a hello came before")
            elif not self.command(viewer.number, command):
                viewer.answer(json.dumps({"kind": "answer", "error": "the run is busy: try again"}))


async def _send(socket: WebSocket, viewer: Viewer) -> None:
    while True:
        message = await viewer.next()
        send = socket.send_text(message) if isinstance(message, str) else socket.send_bytes(encode_picture(message))
        await asyncio.wait_for(send, _SEND_S)


async def _text(socket: WebSocket) -> str:
    """Return the next text; raises WebSocketDisconnect, and BadMessage for other messages."""
    message = await socket.receive()
    if message["type"] == "websocket.disconnect":
        raise WebSocketDisconnect(message.get("code", 1006))
    text = message.get("text")
    if text is None or len(text) > MOST_COMMAND_BYTES:
        raise BadMessage("a short text is expected")
    return str(text)


def _route(file: Traversable) -> Route:
    content, kind = file.read_bytes(), _KINDS[file.name.rpartition(".")[2]]

    async def respond(_: Request) -> Response:
        return Response(content, media_type=kind, headers=_HEADERS)

    return Route("/" if file.name == "index.html" else f"/{file.name}", respond, methods=["GET"])
