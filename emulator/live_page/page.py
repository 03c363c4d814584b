"""The session's end of the live page: starts its process, shows it the run, and carries out what viewers ask."""

from __future__ import annotations

import dataclasses
import logging
import multiprocessing
import socket
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from emulator.light import MachineLacks
from emulator.live_page.address import Access, Address
from emulator.live_page.orders import Orders
from emulator.live_page.outbox import Outbox
from emulator.live_page.process import PageSetup, serve_page
from emulator.live_page.shared_view import SharedView
from emulator.live_page.status_table import Rates, describe, status_table
from emulator.rig.loading import Rig
from emulator.run.outcome import RunStatus
from emulator.run.spawning import starting_a_process
from firmware_protocol.events import Events
from transports.link.edges import EdgeRing, EdgeSink, EdgeTiming
from transports.link.process import LinkSetup
from transports.needs import install_command

__all__ = ["LivePage", "check_ui", "with_trigger_button"]

_log = logging.getLogger(__name__)

_MOST_COMMANDS = 8  # in one look
_STOP_S = 2.0
_PAUSE_LOOK_S = 0.05
_TRIGGER_DELAY_US = 5000.0  # so that an edge comes to the cameras in its order, after events already computed


def check_ui() -> None:
    """Raise MachineLacks where a package that the page needs is missing."""
    try:
        import starlette  # noqa: F401
        import uvicorn  # noqa: F401
        import websockets  # noqa: F401
    except ImportError as error:
        raise MachineLacks(f"--serve needs {error.name}: {install_command('ui')}") from error


def with_trigger_button(
    setups: Sequence[LinkSetup[Any]],
) -> tuple[list[LinkSetup[Any]], EdgeSink | None]:
    """Return links that hear a button, and the button; None where an input is taken already, or there is no link."""
    if not setups or any(setup.timing.edges is not None for setup in setups):
        return list(setups), None
    rings = [EdgeRing() for _ in setups]
    sink = EdgeSink(rings, setups[0].ring, EdgeTiming(latency_us=_TRIGGER_DELAY_US))
    return [
        dataclasses.replace(setup, timing=dataclasses.replace(setup.timing, edges=ring))
        for setup, ring in zip(setups, rings, strict=True)
    ], sink


class LivePage:
    """The page of one run, in a process of its own; raises OSError where it cannot listen at `address`.

    Attributes
    ----------
    url
        What to open in a browser.
    """

    def __init__(self, rig: Rig, address: Address, orders: Orders) -> None:
        listener, access = _listener(address), Access.for_host(address.host)
        self._orders, self._rates = orders, Rates()
        self._view = SharedView(rig.camera.size)
        self._heard = 0
        self._gone = False
        self.url = _url(listener, access)
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        setup = PageSetup(describe(rig), access, self._view)
        self._process = context.Process(
            target=serve_page, args=(setup, listener, theirs), name="evstim live page", daemon=True
        )
        with starting_a_process():
            self._process.start()
        theirs.close()
        listener.close()
        self._outbox = Outbox(self._pipe)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def show(self, events: Events, light: npt.NDArray[np.float32], now_us: int) -> None:
        """Show a step, carry out what has been asked, and stand still where that was asked; after each step."""
        self._view.show(events, light, now_us)
        if self._view.commands != self._heard:
            self._hear()
        elif self._outbox.waits:
            self._flush()
        while not self._orders.steps_allowed() and not self._gone:
            self._wait()

    def renew(self, status: RunStatus) -> None:
        """Tell how the run stands, and notice when the page's process has died."""
        self._orders.status = status
        self._outbox.renew(
            {"kind": "status", **status_table(status, self._rates.renew(status)), **self._orders.state()}
        )
        self._hear()

    def close(self) -> None:
        """End the page."""
        self._pipe.close()
        self._process.join(_STOP_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()

    def _wait(self) -> None:
        with self._or_gone():
            self._pipe.poll(_PAUSE_LOOK_S)
        self._hear()

    def _hear(self) -> None:
        """Carry out some of what has been asked."""
        if self._gone:
            return
        with self._or_gone():
            for _ in range(_MOST_COMMANDS):
                if not self._pipe.poll():
                    break
                viewer, command = self._pipe.recv()
                self._heard += 1
                self._outbox.put({"kind": "answer", "viewer": viewer, **self._orders.carry_out(command)})
                if command["do"] != "inject":
                    self._outbox.put({"kind": "state", **self._orders.state()})
        self._flush()

    def _flush(self) -> None:
        """Send what the page takes."""
        if not self._gone:
            with self._or_gone():
                self._outbox.flush(self._heard)

    @contextmanager
    def _or_gone(self) -> Iterator[None]:
        """Go on without a page whose process has died; a run that it had paused goes on too."""
        try:
            yield
        except (EOFError, OSError):
            self._gone = True
            _log.warning("the live page has ended; the run goes on without it")


def _listener(address: Address) -> socket.socket:
    family = socket.AF_INET6 if ":" in address.host else socket.AF_INET
    return socket.create_server((address.host, address.port), family=family, backlog=128)


def _url(listener: socket.socket, access: Access) -> str:
    host, port = listener.getsockname()[:2]
    shown = f"[{host}]" if ":" in host else host
    with suppress(OSError):
        if host in ("0.0.0.0", "::"):
            shown = socket.gethostname()
    return f"http://{shown}:{port}/" + (f"#token={access.token}" if access.token else "")
