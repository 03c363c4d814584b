"""ZeroMQ server for one simulation: its REQ socket connects here, sends a request, and waits for the reply.

The socket is a ROUTER, which distinguishes peers (a REP would mix their requests). The first peer is served until it
disconnects; requests of others stay unanswered and are counted. The file descriptor of its connection shows that the
peer has disconnected: ZeroMQ itself would wait for it to return. For peers on other machines TCP's keep-alive shows it.

No peer is authenticated. A part of a message is at most `MOST_BYTES` long; ZeroMQ does not limit the number of parts of
one message, so only trusted programs should be able to connect.

`ForwardingServer` passes every request of a simulation on to a second visualiser: another evstim with its own camera,
or Vizard.

    Basilisk --request--> this one --the same request--> the other
             <--reply----          <--reply-------------

Both work at the same time; the reply waits for both. `merged` selects the reply.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Sequence
from typing import Any

from firmware_protocol.vizard import merged, refusal
from transports.network import AllowList

MOST_BYTES = 1 << 24
_MOST_PARTS = 16
_KEEP_ALIVE = {"TCP_KEEPALIVE": 1, "TCP_KEEPALIVE_IDLE": 10, "TCP_KEEPALIVE_INTVL": 5, "TCP_KEEPALIVE_CNT": 3}
_LINGER_MS = 500  # time for the last reply to be sent


class _Watched:
    """Socket of ZeroMQ of a type, such as "ROUTER", with a monitor of the connections that end."""

    def __init__(self, socket_type: str) -> None:
        import zmq
        from zmq.utils.monitor import recv_monitor_message

        self._zmq, self._monitor_message = zmq, recv_monitor_message
        self._context: Any = zmq.Context()
        self._socket = self._context.socket(getattr(zmq, socket_type))
        self._monitor = self._socket.get_monitor_socket(zmq.EVENT_DISCONNECTED)

    def close(self) -> None:
        """Send what waits, for its time to linger at most, and disconnect; a second call does nothing."""
        if not self._socket.closed:
            self._socket.disable_monitor()
            self._monitor.close(0)
            self._socket.close()
            self._context.term()


class VizardServer(_Watched):
    """Server on `host` and `port` (0: any free one) for the peers of `allow`, empty: those of this machine.

    Raises ImportError if pyzmq is not installed, OSError if the port cannot be opened.

    Attributes
    ----------
    peer_gone : True when the peer has closed its connection.
    refused : requests of second peers, of addresses not allowed, and messages that no REQ socket sends.
    """

    def __init__(self, host: str, port: int, allow: Sequence[str] = ()) -> None:
        super().__init__("ROUTER")
        self._allow = AllowList(allow)
        for name, value in {"MAXMSGSIZE": MOST_BYTES, "LINGER": _LINGER_MS, **_KEEP_ALIVE}.items():
            self._socket.setsockopt(getattr(self._zmq, name), value)
        self._poller = self._zmq.Poller()
        for source in (self._socket, self._monitor):
            self._poller.register(source, self._zmq.POLLIN)
        self._peer: bytes | None = None
        self._peer_fd = -1
        self.peer_gone = False
        self.refused = 0
        self._bind(host, port)

    @property
    def address(self) -> str:
        """Address to which a simulation connects, as ZeroMQ writes it."""
        return str(self._socket.getsockopt_string(self._zmq.LAST_ENDPOINT))

    def receive(self, timeout_ms: int) -> list[bytes] | None:
        """Return the parts of the peer's next request; None when none arrived in time, or another event occurred."""
        if not self._poller.poll(timeout_ms):
            return None
        try:
            frames = self._socket.recv_multipart(self._zmq.NOBLOCK, copy=False)
        except self._zmq.Again:  # so the monitor has an event, and no data of the peer are left to read
            while self._monitor.poll(0):
                left = self._monitor_message(self._monitor)["value"]
                self.peer_gone = self.peer_gone or (self._peer is not None and left == self._peer_fd)
            return None
        return self._admitted(frames)

    def send(self, parts: Sequence[bytes]) -> None:
        """Answer the peer's request; a reply that the peer no longer reads is dropped."""
        assert self._peer is not None
        self._socket.send_multipart([self._peer, b"", *parts])

    def forget_peer(self) -> None:
        """Serve the next peer that connects."""
        self._peer, self.peer_gone = None, False

    def _bind(self, host: str, port: int) -> None:
        at = f"[{host}]" if ":" in host else host
        self._socket.setsockopt(self._zmq.IPV6, int(":" in host))
        try:
            self._socket.bind(f"tcp://{at}:{port or '*'}")
        except self._zmq.ZMQError as error:
            self.close()
            number = error.errno or 0
            raise OSError(number, f"cannot listen on {host} port {port}: {os.strerror(number)}") from error

    def _admitted(self, frames: Sequence[Any]) -> list[bytes] | None:
        """Return the parts after the sender and the empty part of a REQ socket, if the sender is admitted."""
        if not 3 <= len(frames) <= _MOST_PARTS or frames[1].bytes:
            self.refused += 1
            return None
        sender, last = frames[0].bytes, frames[-1]
        if self._peer is None and self._allow.permits(last.get("Peer-Address")):
            self._peer, self._peer_fd = sender, last.get(self._zmq.SRCFD)
        if sender != self._peer:
            self.refused += 1
            return None
        return [frame.bytes for frame in frames[2:]]


_LOOK_MS = 50
_REACH_S = 5.0


class Other(_Watched):
    """Connection to a visualiser that listens on `host` and `port`; raises OSError if none listens.

    `address`: address of the visualiser; `gone`: True when it has closed the connection. `close` ends its run.
    """

    def __init__(self, host: str, port: int) -> None:
        socket.create_connection((host, port), _REACH_S).close()  # ZeroMQ would try for ever, without an error
        super().__init__("DEALER")
        self.address = f"{host}:{port}"
        self.gone = False
        self._socket.setsockopt(self._zmq.LINGER, 0)
        self._socket.setsockopt(self._zmq.IPV6, int(":" in host))
        self._socket.connect(f"tcp://[{host}]:{port}" if ":" in host else f"tcp://{host}:{port}")

    def send(self, parts: Sequence[bytes]) -> None:
        """Send Basilisk's request."""
        self._socket.send_multipart([b"", *parts])

    def receive(self) -> list[bytes] | None:
        """Wait for the reply and return it; None if it has closed the connection."""
        while not self._socket.poll(_LOOK_MS):
            while self._monitor.poll(0):
                self._monitor_message(self._monitor)
                self.gone = True
            if self.gone:
                return None
        return list(self._socket.recv_multipart()[1:])


class ForwardingServer:
    """Server whose requests go to another visualiser too; the owner closes both. `lost`: why that has no replies."""

    def __init__(self, server: VizardServer, other: Other) -> None:
        self._server, self._other = server, other
        self.lost = ""

    @property
    def peer_gone(self) -> bool:
        """True when the simulation has closed its connection."""
        return self._server.peer_gone

    def receive(self, timeout_ms: int) -> list[bytes] | None:
        """Return the parts of the next request, after sending it to the other one; None when none arrived in time."""
        parts = self._server.receive(timeout_ms)
        if parts is not None and not self._other.gone:
            self._other.send(parts)
        return parts

    def send(self, parts: Sequence[bytes]) -> None:
        """Answer the simulation when the other one has answered."""
        theirs = None if self._other.gone else self._other.receive()
        if theirs is None:
            self.lost = f"the visualiser at {self._other.address} has gone"
            self._server.send(refusal(self.lost))
        else:
            self._server.send(merged(list(parts), theirs))

    def forget_peer(self) -> None:
        """Serve the next peer that connects."""
        self._server.forget_peer()


Server = VizardServer | ForwardingServer
"""Socket of one simulation."""
