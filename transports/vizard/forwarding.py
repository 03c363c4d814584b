"""Every request of a simulation passed on to a second visualiser: another evstim with its own camera, or Vizard.

    Basilisk --request--> this one --the same request--> the other
             <--reply----          <--reply-------------

Both work at the same time; the reply waits for both. `merged` says whose is taken.
"""

from __future__ import annotations

import socket
from collections.abc import Sequence
from typing import Any, Protocol

from firmware_protocol.vizard.requests import merged, refusal

__all__ = ["ForwardingServer", "Other"]

_LOOK_MS = 50
_REACH_S = 5.0


class _Server(Protocol):
    @property
    def peer_gone(self) -> bool: ...

    def receive(self, timeout_ms: int) -> list[bytes] | None: ...

    def send(self, parts: Sequence[bytes]) -> None: ...

    def forget_peer(self) -> None: ...


class Other:
    """A connection to a visualiser that listens on `host` and `port`; raises OSError where nobody does.

    Attributes
    ----------
    address : where it is.
    gone : whether it has closed the connection.
    """

    def __init__(self, host: str, port: int) -> None:
        import zmq
        from zmq.utils.monitor import recv_monitor_message

        socket.create_connection((host, port), _REACH_S).close()  # ZeroMQ would try for ever, and say nothing
        self.address = f"{host}:{port}"
        self.gone = False
        self._zmq, self._monitor_message = zmq, recv_monitor_message
        self._context: Any = zmq.Context()
        self._socket = self._context.socket(zmq.DEALER)
        self._monitor = self._socket.get_monitor_socket(zmq.EVENT_DISCONNECTED)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.IPV6, int(":" in host))
        self._socket.connect(f"tcp://[{host}]:{port}" if ":" in host else f"tcp://{host}:{port}")

    def send(self, parts: Sequence[bytes]) -> None:
        """Ask what Basilisk asked."""
        self._socket.send_multipart([b"", *parts])

    def receive(self) -> list[bytes] | None:
        """Return the reply, however long it takes; None when there will be none, because it has gone."""
        while not self._socket.poll(_LOOK_MS):
            while self._monitor.poll(0):
                self._monitor_message(self._monitor)
                self.gone = True
            if self.gone:
                return None
        return list(self._socket.recv_multipart()[1:])

    def close(self) -> None:
        """Leave; the other one's run ends then. A second call does nothing."""
        if not self._socket.closed:
            self._socket.disable_monitor()
            self._monitor.close(0)
            self._socket.close()
            self._context.term()


class ForwardingServer:
    """A server whose requests go to another visualiser too; the owner closes both.

    Attributes
    ----------
    lost : why the other one did not answer any more; empty: it did.
    """

    def __init__(self, server: _Server, other: Other) -> None:
        self._server, self._other = server, other
        self.lost = ""

    @property
    def peer_gone(self) -> bool:
        """Whether the simulation has closed its connection."""
        return self._server.peer_gone

    def receive(self, timeout_ms: int) -> list[bytes] | None:
        """Return the parts of the next request, which the other one now has too; None when none came in time."""
        parts = self._server.receive(timeout_ms)
        if parts is not None and not self._other.gone:
            self._other.send(parts)
        return parts

    def send(self, parts: Sequence[bytes]) -> None:
        """Answer the simulation as soon as the other one has answered."""
        theirs = None if self._other.gone else self._other.receive()
        if theirs is None:
            self.lost = f"the visualiser at {self._other.address} has gone"
            self._server.send(refusal(self.lost))
        else:
            self._server.send(merged(list(parts), theirs))

    def forget_peer(self) -> None:
        """Serve whoever comes next."""
        self._server.forget_peer()
