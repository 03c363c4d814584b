"""The process that serves the page: draws pictures while somebody looks, and stands between viewers and session.

The session never waits for it. Whatever happens here, a flood of messages or a death, the run goes on.
"""

from __future__ import annotations

import asyncio
import json
import os
import signal
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

from emulator.live_page.address import Access
from emulator.live_page.drawing import Canvas
from emulator.live_page.messages import MOST_COMMAND_BYTES, encode_picture
from emulator.live_page.shared_view import SharedView

__all__ = ["PageProcess", "PageSetup", "serve_page"]

_PICTURE_PERIOD_S = 0.04
_MOST_WAITING = 32  # commands that the session has not heard
_STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_NICE = 5  # the run goes before the page on a busy machine


@dataclass(frozen=True)
class PageSetup:
    """All that the page's process needs to know."""

    about: dict[str, Any]
    access: Access
    view: SharedView


def serve_page(setup: PageSetup, listener: socket.socket, session: Connection) -> None:
    """Serve the page until the session closes its end; the target of the process."""
    for number in _STOP_SIGNALS:  # the session ends it
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _STOP_SIGNALS)
    with suppress(OSError):
        os.nice(_NICE)
    asyncio.run(PageProcess(setup, session).run(listener))


class PageProcess:
    """The page's process: a web server, a drawer of pictures, and the session's pipe in one loop."""

    def __init__(self, setup: PageSetup, session: Connection) -> None:
        from emulator.live_page.connections import Connections
        from emulator.live_page.server import PageServer
        from emulator.live_page.viewers import Viewers

        self._view, self._session = setup.view, session
        self._canvas = Canvas(setup.view.size)
        self.connections, self._viewers = Connections(), Viewers(time.monotonic)
        self._app = PageServer(setup.about, setup.access, self._viewers, self.connections, self._command).app()
        self._heard = 0
        self._ended = asyncio.Event()

    async def run(self, listener: socket.socket) -> None:
        """Serve until the session has gone."""
        from uvicorn import Config, Server

        class Quiet(Server):
            """A server that leaves signals to the session."""

            @contextmanager
            def capture_signals(self) -> Iterator[None]:
                yield

        config = Config(
            self._app,
            http=self.connections.protocol(),
            ws="websockets-sansio",
            ws_max_size=MOST_COMMAND_BYTES,
            ws_per_message_deflate=False,
            log_config=None,
            log_level="critical",
            lifespan="off",
            access_log=False,
            server_header=False,
            timeout_graceful_shutdown=1,
        )
        server = Quiet(config)
        loop = asyncio.get_running_loop()
        loop.add_reader(self._session.fileno(), self._hear)
        serving = asyncio.create_task(server.serve([listener]))
        drawing = asyncio.create_task(self._draw())
        ended = asyncio.create_task(self._ended.wait())
        await asyncio.wait((ended, drawing, serving), return_when=asyncio.FIRST_COMPLETED)
        if not ended.done():  # a page that stands still would look like a run that does
            raise RuntimeError("the live page has ended before its run") from (
                drawing if drawing.done() else serving
            ).exception()
        drawing.cancel()
        self._viewers.tell(json.dumps({"kind": "ended"}))
        await asyncio.sleep(0.1)  # for that to leave
        server.should_exit = True
        await asyncio.gather(serving, drawing, return_exceptions=True)

    async def _draw(self) -> None:
        """Draw 25 pictures a second while somebody looks."""
        watched = False
        while True:
            await asyncio.sleep(_PICTURE_PERIOD_S)
            self._viewers.drop_stalled()
            self._view.viewers = len(self._viewers)
            if not len(self._viewers):
                watched = False
                continue
            events, until_us = self._view.take()
            if not watched:  # what is left from the viewers before
                self._canvas.begin(until_us)
                watched = True
                continue
            self._viewers.put(encode_picture(self._canvas.draw(events, self._view.light, until_us)))

    def _hear(self) -> None:
        """Pass on what the session says."""
        try:
            while self._session.poll():
                self._pass_on(self._session.recv())
        except (EOFError, OSError):
            asyncio.get_running_loop().remove_reader(self._session.fileno())
            self._ended.set()

    def _pass_on(self, message: dict[str, Any]) -> None:
        self._heard = message.pop("heard")
        if message["kind"] == "answer":
            self._viewers.answer(message.pop("viewer"), json.dumps(message))
        elif message["kind"] == "state":
            self._viewers.tell(json.dumps(message))
        else:
            self._viewers.put(json.dumps({**message, "viewers": len(self._viewers), "page_cpu_s": _cpu_s()}))

    def _command(self, viewer: int, command: dict[str, Any]) -> bool:
        """Send a viewer's command to the session; False where too many wait."""
        if self._view.commands - self._heard >= _MOST_WAITING:
            return False
        with suppress(OSError):
            self._session.send((viewer, command))
        self._view.commands += 1
        return True


def _cpu_s() -> float:
    """Return the processor time of this process so far, s."""
    times = os.times()
    return times.user + times.system
