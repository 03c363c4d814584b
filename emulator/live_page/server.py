"""The page's web server: three files, and a WebSocket for each viewer."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Awaitable, Callable
from contextlib import suppress
from importlib.resources import files
from typing import Any

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from emulator.live_page.address import Access
from emulator.live_page.connections import Connections
from emulator.live_page.messages import MOST_COMMAND_BYTES, BadMessage, parse_command
from emulator.live_page.viewers import Viewer, Viewers

__all__ = ["BAD_MESSAGE", "FULL", "REFUSED", "PageServer"]

BAD_MESSAGE, REFUSED, FULL = 4400, 4401, 4429
"""Codes with which a WebSocket is closed."""

_HELLO_S = 5.0
_SEND_S = 10.0
_FILES = {
    "/": ("index.html", "text/html"),
    "/page.js": ("page.js", "text/javascript"),
    "/page.css": ("page.css", "text/css"),
}
_HEADERS = {
    "Content-Security-Policy": "default-src 'self'; img-src 'self' data: blob:; frame-ancestors 'self'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-cache",
}


class PageServer:
    """Serves one run's page.

    Parameters
    ----------
    about
        What does not change during the run; sent to each viewer first.
    command
        Passes a viewer's parsed command on; False where too much waits already.
    """

    def __init__(
        self,
        about: dict[str, Any],
        access: Access,
        viewers: Viewers,
        connections: Connections,
        command: Callable[[int, dict[str, Any]], bool],
    ) -> None:
        self._about = json.dumps({"kind": "about", **about})
        self._access = access
        self._viewers = viewers
        self._connections = connections
        self._command = command

    def app(self) -> Starlette:
        """Return the ASGI application."""
        routes = [Route(path, _file(name, kind), methods=["GET"]) for path, (name, kind) in _FILES.items()]
        return Starlette(routes=[*routes, WebSocketRoute("/live", self._live)])

    async def _live(self, socket: WebSocket) -> None:
        peer = tuple(socket.scope.get("client") or ("", 0))
        try:
            await self._viewed(socket, peer)
        finally:
            self._connections.leave(peer)

    async def _viewed(self, socket: WebSocket, peer: tuple[Any, ...]) -> None:
        if not self._access.origin_permitted(socket.headers.get("origin"), socket.headers.get("host")):
            await socket.close()
            return
        await socket.accept()
        with suppress(WebSocketDisconnect, TimeoutError, RuntimeError):
            if not await self._introduced(socket):
                await socket.close(REFUSED, "the token is wrong")
                return
            viewer = self._viewers.enter(lambda: self._connections.abort(peer))
            if viewer is None:
                await socket.close(FULL, "too many viewers")
                return
            self._connections.settle(peer)
            await self._serve(socket, viewer)

    async def _introduced(self, socket: WebSocket) -> bool:
        """Wait for the first message, which brings the token."""
        try:
            hello = parse_command(await asyncio.wait_for(_text(socket), _HELLO_S))
        except (BadMessage, TimeoutError):
            return False
        return hello["do"] == "hello" and self._access.permits(hello["token"])

    async def _serve(self, socket: WebSocket, viewer: Viewer) -> None:
        viewer.answer(self._about)
        sending = asyncio.create_task(_send(socket, viewer))
        try:
            await self._listen(socket, viewer)
        except BadMessage as error:
            await socket.close(BAD_MESSAGE, str(error)[:100])
        finally:
            self._viewers.leave(viewer)
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
                raise BadMessage("hello was said before")
            elif not self._command(viewer.number, command):
                viewer.answer(json.dumps({"kind": "answer", "error": "the run is busy: try again"}))


async def _send(socket: WebSocket, viewer: Viewer) -> None:
    while True:
        message = await viewer.next()
        send = socket.send_bytes(message) if isinstance(message, bytes) else socket.send_text(message)
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


def _file(name: str, kind: str) -> Callable[[Request], Awaitable[Response]]:
    content = (files("emulator.live_page") / "static" / name).read_bytes()

    async def respond(_: Request) -> Response:
        return Response(content, media_type=kind, headers=_HEADERS)

    return respond
