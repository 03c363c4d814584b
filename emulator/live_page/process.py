"""The process that serves the page: it draws pictures while there are viewers, and connects viewers and session.

The session never waits for it: the run goes on also after a flood of messages or the death of this process.

Pictures contain linear light, and the pixels with events; the browser makes its colours from them. Events, the light
and the number of viewers are in memory that the session and the page's process share. Without viewers the session only
reads one number a step. Events without room in this memory are not shown; the run's own events go other ways.
"""

from __future__ import annotations

import asyncio
import json
import multiprocessing
import os
import signal
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
import numpy.typing as npt

from emulator.live_page.axis import RunHistory
from emulator.live_page.messages import MOST_COMMAND_BYTES, MOST_COUNT, NEWEST, Access, Picture, light_codes
from firmware_protocol.events import Bytes, Events, Float32s
from transports.link.rings import EventRing

_MOST_SIZE = (640, 480)
_MOST_DRAWN = 60_000  # events of a picture; of more, each second, third ... is drawn


def reduction(size: tuple[int, int]) -> int:
    """Return the number of sensor pixels, along x and y, for a pixel of the page."""
    return max(-(-side // longest) for side, longest in zip(size, _MOST_SIZE, strict=True))


class Canvas:
    """Canvas for the pictures of a sensor of `size` (width, height), one after another."""

    def __init__(self, size: tuple[int, int]) -> None:
        self._by = reduction(size)
        self._width, self._height = (-(-side // self._by) for side in size)
        self._number = 0
        self._until_us = 0

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) of the page's picture, pixels."""
        return self._height, self._width

    def draw(self, events: Events, light: Float32s, until_us: int) -> Picture:
        """Return the picture of the time since the last one.

        Parameters
        ----------
        events : (n,) EVENT, sorted by t.
        light : `shape`, float32, linear.
        until_us : the end of the interval, us.
        """
        from_us, self._until_us = self._until_us, max(until_us, self._until_us)
        every = 1 + len(events) // _MOST_DRAWN
        thinned = events[::every]
        place = (thinned["y"] // self._by).astype(np.intp) * self._width + thinned["x"] // self._by
        active, last = self._last(thinned, place, from_us)
        self._number += 1
        return Picture(
            self._number, from_us, self._until_us, len(events), every, light_codes(light),
            active, last, self._counts(thinned, place, active),
        )  # fmt: skip

    def _last(
        self, events: Events, place: npt.NDArray[np.intp], from_us: int
    ) -> tuple[npt.NDArray[np.uint32], npt.NDArray[np.int8]]:
        """Return the pixels with events, and the time and polarity of each one's last event in the interval."""
        plane = np.zeros(self._height * self._width, np.int8)
        length_us = max(self._until_us - from_us, 1)
        since_us = np.clip(events["t"].astype(np.int64) - from_us, 0, length_us)
        level = 1 + since_us * (NEWEST - 1) // length_us
        plane[place] = np.where(events["on"], level, -level)  # of several at one place the last stays
        active = np.flatnonzero(plane)
        return active.astype(np.uint32), plane[active]

    def _counts(self, events: Events, place: npt.NDArray[np.intp], active: npt.NDArray[np.uint32]) -> Bytes:
        """Return the counts of the active pixels."""
        slot = np.empty(self._height * self._width, np.intp)
        slot[active] = np.arange(len(active))
        on = events["on"]
        up, down = (
            np.minimum(np.bincount(slot[place[polarity]], minlength=len(active)), MOST_COUNT) for polarity in (on, ~on)
        )
        return np.asarray(up | down << 4, np.uint8)


_RING_EVENTS = 1 << 19
_LIGHT_PERIOD_US = 40_000  # of stream time; the page shows 25 pictures a second


class SharedView:
    """Shared memory for a sensor of `size`, (width, height); pass it to a process started by the spawn method.

    The page's process writes the number of `viewers`, and of `commands`, so that the session polls no pipe each step.
    """

    def __init__(self, size: tuple[int, int]) -> None:
        context = multiprocessing.get_context("spawn")
        self.size, self._ring = size, EventRing(_RING_EVENTS)
        self._by = reduction(size)
        self._shape = tuple(-(-side // self._by) for side in reversed(size))
        self._light = context.RawArray("f", self._shape[0] * self._shape[1])
        self.viewers, self.commands = context.RawValue("q"), context.RawValue("q")
        self._light_us = 0

    @property
    def light(self) -> Float32s:
        """The light, (height, width) of the page's picture."""
        return np.frombuffer(self._light, np.float32).reshape(self._shape)

    def show(self, events: Events, light: Float32s, now_us: int) -> None:
        """Show a step's events up to `now_us`, of too many the newest, and the light; nothing without room for them."""
        if not self.viewers.value or (len(events) > self._ring.room and self._ring.waiting):
            return
        self._ring.push(events[-self._ring.capacity :])
        self._ring.publish(now_us)
        if not 0 <= now_us - self._light_us < _LIGHT_PERIOD_US:
            self._light_us = now_us
            self.light[:] = light[:: self._by, :: self._by]

    def take(self) -> tuple[Events, int]:
        """Return the events shown since the last call, and the end of their time; for the page's process."""
        now_us = self._ring.now_us
        return self._ring.take(now_us), now_us


_PICTURE_PERIOD_S = 0.04
_MOST_WAITING = 32  # commands that the session has not received
_STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_NICE = 5  # the run goes before the page on a busy machine


@dataclass(frozen=True)
class PageSetup:
    """Parameters of the page's process."""

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
    """The page's process: a web server, the drawing of pictures, and the session's pipe in one loop."""

    def __init__(self, setup: PageSetup, session: Connection) -> None:
        from emulator.live_page.server import Connections, PageServer, Viewers

        self._view, self._session = setup.view, session
        self._canvas = Canvas(setup.view.size)
        self.connections, self._viewers = Connections(), Viewers(time.monotonic)
        self._history = RunHistory()

        def greeting() -> str:
            return json.dumps({"kind": "about", **setup.about, **self._history.as_json()})

        self._app = PageServer(greeting, setup.access, self._viewers, self.connections, self._command).app()
        self._commands_done = 0
        self._ended = asyncio.Event()

    async def run(self, listener: socket.socket) -> None:
        """Serve until the session has ended."""
        from uvicorn import Config, Server

        class Quiet(Server):
            """Server without signal handlers of its own."""

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
        loop.add_reader(self._session.fileno(), self._receive)
        serving = asyncio.create_task(server.serve([listener]))
        drawing = asyncio.create_task(self._draw())
        ended = asyncio.create_task(self._ended.wait())
        await asyncio.wait((ended, drawing, serving), return_when=asyncio.FIRST_COMPLETED)
        if not ended.done():  # a frozen page would look like a paused run
            raise RuntimeError("the live page has ended before its run") from (
                drawing if drawing.done() else serving
            ).exception()
        drawing.cancel()
        self._viewers.send_all(json.dumps({"kind": "ended"}))
        await asyncio.sleep(0.1)  # time to send it
        server.should_exit = True
        await asyncio.gather(serving, drawing, return_exceptions=True)

    async def _draw(self) -> None:
        """Draw 25 pictures a second while there are viewers."""
        watched = False
        while True:
            await asyncio.sleep(_PICTURE_PERIOD_S)
            self._viewers.drop_stalled()
            self._view.viewers.value = len(self._viewers)
            if not len(self._viewers):
                watched = False
                continue
            events, until_us = self._view.take()
            picture = self._canvas.draw(events, self._view.light, until_us)
            if watched:  # the first picture has events from before the first viewer
                self._viewers.put(picture)
            watched = True

    def _receive(self) -> None:
        """Forward the messages of the session."""
        try:
            while self._session.poll():
                self._forward(self._session.recv())
        except (EOFError, OSError):
            asyncio.get_running_loop().remove_reader(self._session.fileno())
            self._ended.set()

    def _forward(self, message: dict[str, Any]) -> None:
        self._commands_done = message.pop("commands_done")
        if message["kind"] == "answer":
            self._viewers.answer(message.pop("viewer"), json.dumps(message))
        elif message["kind"] == "state":
            self._viewers.send_all(json.dumps(message))
        else:
            if self._history.take(message["axis"]):
                self._viewers.send_all(json.dumps({"kind": "history", **self._history.as_json()}))
            self._viewers.put(json.dumps({**message, "viewers": len(self._viewers), "page_cpu_s": time.process_time()}))

    def _command(self, viewer: int, command: dict[str, Any]) -> bool:
        """Send a viewer's command to the session; False where too many wait."""
        if self._view.commands.value - self._commands_done >= _MOST_WAITING:
            return False
        with suppress(OSError):
            self._session.send((viewer, command))
        self._view.commands.value += 1
        return True
