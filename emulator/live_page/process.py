"""The process that serves the page: draws pictures while somebody looks, and stands between viewers and session.

The session never waits for it. Whatever happens here, a flood of messages or a death, the run goes on.

Float32s of events and light for the page: small planes of bytes, from which the browser makes its colours.

What the session shows the page's process, in shared memory: events, the light, and whether anybody looks.

While nobody looks the session does nothing for the page but read one number a step. Events that find no room are not
shown; the run's own events go other ways.
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

from emulator.live_page.messages import MOST_COMMAND_BYTES, Access, Picture, encode_picture
from firmware_protocol.events import Events
from transports.link.rings import EventRing

__all__ = ["Canvas", "PageProcess", "PageSetup", "SharedView", "reduction", "serve_page"]


_MOST_SIZE = (640, 480)
_MOST_DRAWN = 60_000  # events of a picture; of more, each second, third ... is drawn
_NEWEST = 127
_MOST_COUNT = 15
_BRIGHT_SHARE = 0.99  # of the lit pixels are darker than what is drawn white
_WHITE_EVERY = 25  # pictures between two looks at what white is


def reduction(size: tuple[int, int]) -> int:
    """Return how many pixels of a sensor, along x and y, share a pixel of the page."""
    return max(-(-side // most) for side, most in zip(size, _MOST_SIZE, strict=True))


class Canvas:
    """Draws the pictures of a sensor of `size` (width, height), one after another."""

    def __init__(self, size: tuple[int, int]) -> None:
        self._by = reduction(size)
        self._width, self._height = (-(-side // self._by) for side in size)
        self._number = 0
        self._until_us = 0
        self._white = 0.0

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) of the page's picture, pixels."""
        return self._height, self._width

    def begin(self, at_us: int) -> None:
        """Let the next picture's interval begin at `at_us`: nobody looked before."""
        self._until_us = at_us

    def draw(self, events: Events, light: npt.NDArray[np.float32], until_us: int) -> Picture:
        """Return the picture of the time since the last one.

        Parameters
        ----------
        events : (n,) EVENT, sorted by t.
        light : `shape`, float32, linear.
        until_us : the end of the interval, us.
        """
        from_us, self._until_us = self._until_us, max(until_us, self._until_us)
        every = 1 + len(events) // _MOST_DRAWN
        drawn = events[::every]
        place = (drawn["y"] // self._by).astype(np.intp) * self._width + drawn["x"] // self._by
        self._number += 1
        return Picture(
            self._number, from_us, self._until_us, len(events), every, self._screen(light),
            self._last(drawn, place, from_us), self._counts(drawn, place),
        )  # fmt: skip

    def _last(self, events: Events, place: npt.NDArray[np.intp], from_us: int) -> npt.NDArray[np.int8]:
        """Return when in the interval each pixel had its last event, and which."""
        plane = np.zeros(self._height * self._width, np.int8)
        length_us = max(self._until_us - from_us, 1)
        since_us = np.clip(events["t"].astype(np.int64) - from_us, 0, length_us)
        level = 1 + since_us * (_NEWEST - 1) // length_us
        plane[place] = np.where(events["on"], level, -level)  # of several at one place the last stays
        return plane.reshape(self.shape)

    def _counts(self, events: Events, place: npt.NDArray[np.intp]) -> npt.NDArray[np.uint8]:
        on = events["on"]
        up, down = (
            np.minimum(np.bincount(place[which], minlength=self._height * self._width), _MOST_COUNT)
            for which in (on, ~on)
        )
        return np.asarray((up | down << 4).reshape(self.shape), np.uint8)

    def _screen(self, light: npt.NDArray[np.float32]) -> npt.NDArray[np.uint8]:
        """Return light as levels of a screen, roughly as sRGB has them (a square root); not finite is dark."""
        if self._number % _WHITE_EVERY == 1:
            self._white = _white_of(light)
        if not self._white > 0:
            return np.zeros(self.shape, np.uint8)
        with np.errstate(invalid="ignore", over="ignore"):
            level = np.sqrt(np.clip(light * np.float32(1 / self._white), 0, 1)) * np.float32(255)
        return np.asarray(np.nan_to_num(level, copy=False, nan=0.0), np.uint8)


def _white_of(light: npt.NDArray[np.float32]) -> float:
    sample = light[::4, ::4]
    lit = sample[np.isfinite(sample) & (sample > 0)]
    return float(np.quantile(lit, _BRIGHT_SHARE)) if lit.size else 0.0


_VIEWERS, _COMMANDS, _CELLS = range(3)
_RING_EVENTS = 1 << 19
_LIGHT_PERIOD_US = 40_000  # of stream time; the page shows 25 pictures a second


class SharedView:
    """Shared memory for a sensor of `size`, (width, height); pass it to a process started by the spawn method."""

    def __init__(self, size: tuple[int, int]) -> None:
        context = multiprocessing.get_context("spawn")
        self._size, self._ring = size, EventRing(_RING_EVENTS)
        self._by = reduction(size)
        shape = tuple(-(-side // self._by) for side in reversed(size))
        self._memory = context.RawArray("f", shape[0] * shape[1]), context.RawArray("q", _CELLS), shape
        self._light_us = 0
        self._map()

    def _map(self) -> None:
        light, cells, shape = self._memory
        self.light: npt.NDArray[np.float32] = np.frombuffer(light, np.float32).reshape(shape)
        self._cells = np.frombuffer(cells, np.int64)

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name not in ("light", "_cells")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._map()

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the sensor, pixels."""
        return self._size

    @property
    def viewers(self) -> int:
        """How many look; the page's process writes it."""
        return int(self._cells[_VIEWERS])

    @viewers.setter
    def viewers(self, count: int) -> None:
        self._cells[_VIEWERS] = count

    @property
    def commands(self) -> int:
        """Commands sent so far; the page's process writes it, so that the session need not ask the pipe each step."""
        return int(self._cells[_COMMANDS])

    @commands.setter
    def commands(self, count: int) -> None:
        self._cells[_COMMANDS] = count

    def show(self, events: Events, light: npt.NDArray[np.float32], now_us: int) -> None:
        """Show the events of a step, up to `now_us`, and the light at its end."""
        if not self._cells[_VIEWERS]:
            return
        self._ring.push(events)
        self._ring.publish(now_us)
        if not 0 <= now_us - self._light_us < _LIGHT_PERIOD_US:
            self._light_us = now_us
            self.light[:] = light[:: self._by, :: self._by]

    def take(self) -> tuple[Events, int]:
        """Return the events shown since the last call, and the time up to which; for the page's process."""
        now_us = self._ring.now_us
        return self._ring.take(1 << 62), now_us


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
        from emulator.live_page.server import Connections, PageServer, Viewers

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
