"""Faults and edges by hand: what a running session answers to `evstim fault` and `evstim trigger`.

{"ask": "faults"}                     ->  {"rig": ..., "t_s": ..., "links": {NAME: {"kinds": [...], "injected": [...]}}}
{"ask": "inject", "fault": {table}}   ->  {"link": NAME, "after": number of its faults so far} or {"error": ...}
{"ask": "trigger", "kind": KIND}      ->  {"links": [NAME, ...]}   "link": NAME for one alone
                                          KIND: pulse, rising, falling at the camera's input; reset: its clock

For one version more, "throw" is understood for "inject", and "injected" is there as "thrown" too.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Protocol

from emulator.rig.fault_tables import convert_fault, faults_of
from emulator.rig.loading import Rig
from emulator.run.control import ControlSocket, Message
from emulator.run.outcome import RunStatus
from emulator.tables.typed_table import TableError
from firmware_protocol.edges import EdgeKind
from transports.faults.kinds import Fault

__all__ = ["FaultInjection", "fault_injection"]


_HAPPENINGS = {"pulse": EdgeKind.PULSE, "rising": EdgeKind.RISING, "falling": EdgeKind.FALLING, "reset": None}


class _Session(Protocol):
    def inject(self, fault: Fault) -> None:
        """Begin a fault on the link that it names."""

    def happen(self, link: str, kind: EdgeKind | None) -> None:
        """Let an edge come to the input of a link's camera, or its clock start anew."""


class FaultInjection:
    """Answers for one run; without a socket it does nothing.

    Attributes
    ----------
    trouble
        Why there is no socket; "" where there is one, or none is needed.
    """

    def __init__(self, rig: Rig, session: _Session, socket: ControlSocket | None, trouble: str = "") -> None:
        self._rig = rig
        self._session = session
        self._socket = socket
        self.trouble = trouble

    def serve(self, status: RunStatus) -> None:
        """Answer what has been asked since the last call."""
        if self._socket is not None:
            self._socket.poll(lambda message: self.answer(message, status))

    def answer(self, message: Message, status: RunStatus) -> Message:
        """Return the answer to one question."""
        match message:
            case {"ask": "faults"}:
                return self._faults(status)
            case {"ask": "inject" | "throw", "fault": table}:
                return self._inject(table, status)
            case {"ask": "trigger", "kind": str(kind)}:
                return self._trigger(kind, message.get("link"))
        return {"error": "known are ask = 'faults' and ask = 'inject' with a fault, ask = 'trigger' with a kind"}

    def _faults(self, status: RunStatus) -> Message:
        links: dict[str, Any] = {}
        for link in self._rig.links:
            report = status.links.get(link.name)
            injected = [] if report is None else [dataclasses.asdict(record) for record in report.faults]
            links[link.name] = {"kinds": list(faults_of(link)), "injected": injected, "thrown": injected}
            links[link.name]["state"] = "" if report is None else report.state
        return {"rig": self._rig.name, "t_s": status.sim_seconds, "links": links}

    def _inject(self, table: object, status: RunStatus) -> Message:
        try:
            fault = convert_fault(table, self._rig.links, ())
        except TableError as error:
            at = ".".join(str(part) for part in error.path)
            return {"error": f"{at}: {error}" if at else str(error)}
        report = status.links.get(fault.link)
        self._session.inject(fault)
        return {"link": fault.link, "after": 0 if report is None else len(report.faults)}

    def _trigger(self, kind: str, link: object) -> Message:
        if kind not in _HAPPENINGS:
            return {"error": f"kind {kind!r}: known are {', '.join(_HAPPENINGS)}"}
        names = [one.name for one in self._rig.links if link in (None, one.name)]
        if not names:
            return {"error": f"link {link!r}: there is {', '.join(one.name for one in self._rig.links)}"}
        for name in names:
            self._session.happen(name, _HAPPENINGS[kind])
        return {"links": names}


@contextmanager
def fault_injection(rig: Rig, session: _Session) -> Iterator[FaultInjection]:
    """Open the socket of a run that has links; if that fails, `trouble` tells why and the run goes on."""
    if not rig.links:
        yield FaultInjection(rig, session, None)
        return
    try:
        socket = ControlSocket(rig.name)
    except OSError as error:
        yield FaultInjection(rig, session, None, f"no control socket, so no `evstim fault` for this run: {error}")
        return
    with socket:
        yield FaultInjection(rig, session, socket)
