"""Requests passed on to a second visualiser."""

import threading
from collections import deque

import pytest
import zmq

from firmware_protocol.vizard import NO_IMAGE, OK, PONG
from transports.vizard import ForwardingServer, Other

pytestmark = pytest.mark.socket


class Peer:
    """A simulation with a list of requests."""

    def __init__(self, *requests):
        self.requests, self.replies, self.peer_gone = deque(requests), [], False

    def receive(self, timeout_ms):
        return self.requests.popleft() if self.requests else None

    def send(self, parts):
        self.replies.append(list(parts))

    def forget_peer(self):
        self.peer_gone = False


class Visualiser:
    """A REP socket in a thread: what it is asked, and what it answers; then it closes."""

    def __init__(self, *replies):
        self._context, self.asked = zmq.Context(), []
        self._socket = self._context.socket(zmq.REP)
        self.port = self._socket.bind_to_random_port("tcp://127.0.0.1")
        self._thread = threading.Thread(target=self._serve, args=(replies,))
        self._thread.start()

    def _serve(self, replies):
        for reply in replies:
            if self._socket.poll(120_000):
                self.asked.append(self._socket.recv_multipart())
                self._socket.send_multipart(reply)
        self._socket.close(1000)

    def join(self):
        self._thread.join(120)
        self._context.term()


def test_both_are_asked_and_the_reply_is_of_the_one_that_has_it():
    other = Visualiser(PONG, OK, [b"\0\0\0\1", b"x"])
    peer = Peer([b"PING"], [b"SIM_UPDATE", b"", b"", b"data"], [b"REQUEST_IMAGE_2"])
    connection = Other("127.0.0.1", other.port)
    server = ForwardingServer(peer, connection)
    for ours in (PONG, OK, NO_IMAGE):
        assert server.receive(0) is not None
        server.send(ours)
    assert peer.replies == [PONG, OK, [b"\0\0\0\1", b"x"]]
    assert other.asked == [[b"PING"], [b"SIM_UPDATE", b"", b"", b"data"], [b"REQUEST_IMAGE_2"]]
    assert server.receive(0) is None
    connection.close()
    connection.close()
    other.join()


def test_when_the_other_leaves_the_simulation_is_told():
    other = Visualiser(PONG)
    peer = Peer([b"PING"], [b"PING"], [b"PING"])
    connection = Other("127.0.0.1", other.port)
    server = ForwardingServer(peer, connection)
    for _ in range(3):
        server.receive(0)
        server.send(PONG)
    other.join()
    assert peer.replies[0] == PONG
    assert server.lost == f"the visualiser at 127.0.0.1:{other.port} has gone"
    assert peer.replies[1:] == [[f"ERROR: {server.lost}".encode()]] * 2
    connection.close()


def test_nobody_there_is_told_at_once():
    other = Visualiser()
    other.join()
    with pytest.raises(OSError, match="refused"):
        Other("127.0.0.1", other.port)
