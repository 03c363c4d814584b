"""The session's end of the live page: it starts the process, sends it the run, and executes the commands of viewers.

Messages to the page's process are sent when the pipe takes them, so that a page that hangs does not delay the run.
Answers and states are queued in their order, a bounded number of them; of statuses only the newest is. A status has the
tables that the page shows.
"""

from __future__ import annotations

import dataclasses
import logging
import multiprocessing
import select
import socket
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from typing import Any

from emulator.light import MachineLacks
from emulator.live_page.axis import TimeAxis
from emulator.live_page.controls import Repeats, fault_menu, totals
from emulator.live_page.messages import Access, Address, ViewerCommands
from emulator.live_page.process import PageSetup, SharedView, serve_page
from emulator.rig.kinds import IMU_UNITS, faults_of
from emulator.rig.loading import Rig
from emulator.run.link_process import starting_a_process
from emulator.run.outcome import Rates, RunStatus
from firmware_protocol.device.items import ReadingKind, Readings
from firmware_protocol.events import Events, Float32s
from transports import Closing
from transports.link.edges import EdgeRing, EdgeSink, EdgeTiming
from transports.link.process import LinkSetup
from transports.link.report import LinkReport
from transports.needs import install_command

_MOST_WAITING = 64


class Outbox:
    """Messages on their way into `pipe`, which is a socket: ready when most of its buffer is free."""

    def __init__(self, pipe: Connection) -> None:
        self._pipe = pipe
        self._queued: deque[dict[str, Any]] = deque(maxlen=_MOST_WAITING)
        self._status: dict[str, Any] | None = None
        self._writable = select.poll()
        self._writable.register(pipe.fileno(), select.POLLOUT)

    @property
    def waits(self) -> bool:
        """True while a message has not been sent."""
        return bool(self._queued) or self._status is not None

    def put(self, message: dict[str, Any]) -> None:
        """Queue a message; the oldest is dropped when the queue is full."""
        self._queued.append(message)

    def renew(self, status: dict[str, Any]) -> None:
        """Queue a status, in place of an older one that was not sent."""
        self._status = status

    def flush(self, commands_done: int) -> None:
        """Send messages while the pipe takes them, with the number of executed commands; raises OSError."""
        while self.waits and self._writable.poll(0):
            self._pipe.send({**self._next(), "commands_done": commands_done})

    def _next(self) -> dict[str, Any]:
        if self._queued:
            return self._queued.popleft()
        assert self._status is not None
        status, self._status = self._status, None
        return status


def describe(rig: Rig) -> dict[str, Any]:
    """Return the constant data of a run."""
    width, height = rig.camera.size
    return {
        "name": rig.name,
        "title": rig.title,
        "seed": rig.run.seed,
        "camera": rig.camera.model,
        "size": [width, height],
        "pace": rig.run.pace,
        "limits": {"late_ms": rig.run.max_late_ms, "late_share": rig.run.max_late_share},
        "links": {link.name: {"kind": link.kind, "faults": fault_menu(faults_of(link))} for link in rig.links},
    }


def status_table(status: RunStatus, rates: dict[str, float]) -> dict[str, Any]:
    """Return the changing data of a run."""
    return {
        "t_s": status.sim_seconds,
        "wall_s": status.wall_seconds,
        "frames": status.frames,
        **rates,
        "lateness": status.lateness.as_json(),
        "ledger": ledger_table(status),
        "links": {name: _link(report) for name, report in status.links.items()},
        "totals": totals(status),
    }


def ledger_table(status: RunStatus) -> dict[str, Any]:
    """Return the fates of all events so far; in each table the parts add up to its whole.

    An event that has no fate yet is `pending` in the sensor, or `on_the_way` to a link or in it. A negative number
    there would be an event with two fates.
    """
    accounted = status.lost_in_pixel + status.lost_at_readout + status.read_out
    return {
        "whole": status.raised,
        "parts": {
            "read_out": status.read_out,
            "pending": status.raised - accounted,
            "lost_at_readout": status.lost_at_readout,
            "lost_in_pixel": status.lost_in_pixel,
        },
        "links": {name: _fates(report, status.read_out) for name, report in status.links.items()},
    }


def _fates(report: LinkReport, read_out: int) -> dict[str, Any]:
    no_host = 0 if report.camera is None else report.camera.not_running
    parts = {
        "delivered": report.delivered,
        "on_the_way": read_out - report.delivered - report.dropped - report.dropped_in_device,
        "no_host": no_host,
        "dropped_in_device": report.dropped_in_device - no_host,
        "dropped": report.dropped,
    }
    return {"whole": read_out, "parts": parts}


def _link(report: LinkReport) -> dict[str, Any]:
    latency = report.latency
    return {
        "state": report.state,
        "address": report.address,
        "attach_command": report.attach_command,
        "error": report.error,
        "latency_us": [latency.p50, latency.p99, latency.max],
        "edges": report.edges.taken,
        "faults": len(report.faults),
        "events_lost_by_faults": sum(fault.events_lost for fault in report.faults),
    }


_log = logging.getLogger(__name__)

_MOST_COMMANDS = 8  # in one poll
_STOP_S = 2.0
_PAUSE_POLL_S = 0.05
_TRIGGER_DELAY_US = 5000.0  # so that an edge comes to the cameras in its order, after events already computed


def check_ui() -> None:
    """Raise MachineLacks where a package that the page needs is missing."""
    try:
        import starlette  # noqa: F401
        import uvicorn  # noqa: F401
        import websockets  # noqa: F401
    except ImportError as error:
        raise MachineLacks(f"--serve needs {error.name}: {install_command('ui')}") from error


def with_trigger_button(setups: Sequence[LinkSetup[Any]]) -> tuple[list[LinkSetup[Any]], EdgeSink | None]:
    """Return links connected to a button, and the button; None where an input is in use, or there is no link."""
    if not setups or any(setup.timing.edges is not None for setup in setups):
        return list(setups), None
    rings = [EdgeRing() for _ in setups]
    sink = EdgeSink(rings, setups[0].ring, EdgeTiming(latency_us=_TRIGGER_DELAY_US))
    return [
        dataclasses.replace(setup, timing=dataclasses.replace(setup.timing, edges=ring))
        for setup, ring in zip(setups, rings, strict=True)
    ], sink


class LivePage(Closing):
    """The page of one run, in a process of its own; raises OSError where it cannot listen at `address`.

    `url` is the address to open in a browser; the page of a run that was started again keeps it.
    """

    def __init__(self, rig: Rig, address: Address, commands: ViewerCommands, repeats: Repeats | None = None) -> None:
        repeats = repeats or Repeats()
        listener, access = _place(address, repeats)
        self._commands, self._rates = commands, Rates()
        self._view = SharedView(rig.camera.size)
        imu = rig.camera.imu
        self._axis = TimeAxis(None if imu is None else IMU_UNITS[imu.unit], has_frames=rig.camera.frames is not None)
        self._commands_done = 0
        self._gone = False
        self.url = _url(listener, access)
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        setup = PageSetup({**describe(rig), "before": repeats.before, "run": repeats.count}, access, self._view)
        self._process = context.Process(
            target=serve_page, args=(setup, listener, theirs), name="evstim live page", daemon=True
        )
        with starting_a_process():
            self._process.start()
        theirs.close()
        listener.close()
        self._outbox = Outbox(self._pipe)

    def show(
        self,
        events: Events,
        light: Float32s,
        now_us: int,
        readings: Sequence[tuple[ReadingKind, Readings]] = (),
    ) -> None:
        """Show a step, execute commands, and wait while the run is paused; to be called after each step."""
        self._view.show(events, light, now_us)
        self._axis.take(readings)
        if self._view.commands.value != self._commands_done:
            self._execute_commands()
        elif self._outbox.waits:
            self._flush()
        while not self._commands.steps_allowed() and not self._gone:
            with self._or_gone():
                self._pipe.poll(_PAUSE_POLL_S)
            self._execute_commands()

    def renew(self, status: RunStatus) -> None:
        """Send the status of the run, and detect the death of the page's process."""
        self._commands.status = status
        table = status_table(status, self._rates.renew(status))
        self._outbox.renew({"kind": "status", **table, **self._commands.state(), "axis": self._axis.renew(status)})
        self._execute_commands()

    def close(self) -> None:
        """End the page."""
        self._pipe.close()
        self._process.join(_STOP_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()

    def _execute_commands(self) -> None:
        """Execute some of the commands that have come."""
        if self._gone:
            return
        with self._or_gone():
            for _ in range(_MOST_COMMANDS):
                if not self._pipe.poll():
                    break
                viewer, command = self._pipe.recv()
                self._commands_done += 1
                self._outbox.put({"kind": "answer", "viewer": viewer, **self._commands.carry_out(command)})
                if command["do"] not in ("inject", "pixel"):
                    self._outbox.put({"kind": "state", **self._commands.state()})
        self._flush()

    def _flush(self) -> None:
        """Send the messages that the page's process takes."""
        if not self._gone:
            with self._or_gone():
                self._outbox.flush(self._commands_done)

    @contextmanager
    def _or_gone(self) -> Iterator[None]:
        """Continue without a page whose process has died; a run that it had paused goes on too."""
        try:
            yield
        except (EOFError, OSError):
            self._gone = True
            _log.warning("the live page has ended; the run goes on without it")


def _listener(address: Address) -> socket.socket:
    family = socket.AF_INET6 if ":" in address.host else socket.AF_INET
    return socket.create_server((address.host, address.port), family=family, backlog=128)


def _place(address: Address, repeats: Repeats) -> tuple[socket.socket, Access]:
    """Return listener and access: those of the run before where there was one, so that its viewers come back."""
    if repeats.place is None:
        listener, access = _listener(address), Access.for_host(address.host)
        repeats.place = listener.getsockname()[1], access.token
        return listener, access
    port, token = repeats.place
    return _listener(dataclasses.replace(address, port=port)), Access(token)


def _url(listener: socket.socket, access: Access) -> str:
    host, port = listener.getsockname()[:2]
    shown = f"[{host}]" if ":" in host else host
    with suppress(OSError):
        if host in ("0.0.0.0", "::"):
            shown = socket.gethostname()
    return f"http://{shown}:{port}/" + (f"#token={access.token}" if access.token else "")
