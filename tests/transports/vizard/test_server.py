"""The socket that a simulation connects to, with ZeroMQ's own sockets as peers."""

import socket
from contextlib import contextmanager

import pytest
import zmq

from transports import vizard as module
from transports.vizard import VizardServer

pytestmark = pytest.mark.socket

LONG_MS = 120_000
LOOKS = 2400  # of 50 ms each


@contextmanager
def server(**keys):
    made = VizardServer("127.0.0.1", 0, **keys)
    try:
        yield made
    finally:
        made.close()


@contextmanager
def peer(address, kind=zmq.REQ):
    with zmq.Context() as context, context.socket(kind) as made:
        made.setsockopt(zmq.LINGER, 0)
        made.connect(address)
        yield made


def until(condition, look):
    for _ in range(LOOKS):
        look()
        if condition():
            return
    raise AssertionError("it did not come")


def received(one):
    """Return the next request; what other peers do can make a single look come back empty."""
    return next(parts for _ in range(LOOKS) if (parts := one.receive(50)) is not None)


def test_a_request_and_its_reply():
    with server() as one, peer(one.address) as simulation:
        simulation.send_multipart([b"SIM_UPDATE", b"", b"", b"data"])
        assert received(one) == [b"SIM_UPDATE", b"", b"", b"data"]
        one.send([b"a", b"", b"b"])
        assert simulation.poll(LONG_MS)
        assert simulation.recv_multipart() == [b"a", b"", b"b"]
        assert one.receive(0) is None
        assert not one.peer_gone


def test_it_knows_when_the_peer_leaves_and_can_serve_another():
    with server() as one:
        with peer(one.address) as simulation:
            simulation.send(b"PING")
            assert received(one) == [b"PING"]
        until(lambda: one.peer_gone, lambda: one.receive(50))
        one.send([b"PONG"])  # to nobody
        one.forget_peer()
        with peer(one.address) as simulation:
            simulation.send(b"PING")
            assert received(one) == [b"PING"]
            assert not one.peer_gone


def test_a_second_peer_is_not_served_and_its_leaving_means_nothing():
    with server() as one, peer(one.address) as simulation:
        simulation.send(b"PING")
        assert received(one) == [b"PING"]
        left, message = [], one._monitor_message
        one._monitor_message = lambda monitor: left.append(1) or message(monitor)
        with peer(one.address) as second:
            second.send(b"PING")
            until(lambda: one.refused, lambda: one.receive(50))
        until(lambda: left, lambda: one.receive(50))
        one.send([b"PONG"])
        assert simulation.poll(LONG_MS)
        simulation.recv()
        simulation.send(b"PING")
        assert received(one) == [b"PING"]
        assert one.refused == 1
        assert not one.peer_gone


def test_what_no_req_socket_sends_is_refused():
    with server() as one, peer(one.address, zmq.DEALER) as odd:
        odd.send(b"PING")  # without the empty part
        odd.send_multipart([b""] + [b"x"] * 20)
        until(lambda: one.refused == 2, lambda: one.receive(50))
        odd.send_multipart([b"", b"PING"])
        assert received(one) == [b"PING"]


def test_addresses_that_are_not_allowed_are_refused():
    with server(allow=["10.0.0.7"]) as one, peer(one.address) as simulation:
        simulation.send(b"PING")
        until(lambda: one.refused, lambda: one.receive(50))


def test_a_part_that_is_too_long_ends_the_connection(monkeypatch):
    monkeypatch.setattr(module, "MOST_BYTES", 1000)
    with server() as one, peer(one.address) as simulation:
        simulation.send(b"PING")
        assert received(one) == [b"PING"]
        one.send([b"PONG"])
        simulation.recv()
        simulation.send_multipart([b"SIM_UPDATE", b"", b"", bytes(1001)])
        until(lambda: one.peer_gone, lambda: one.receive(50))


def test_bytes_that_are_no_zeromq_hurt_nobody():
    with server() as one:
        host, port = one.address.removeprefix("tcp://").split(":")
        for data in (b"GET / HTTP/1.0\r\n\r\n", bytes(1000), b"\xff" * 1000):
            with socket.create_connection((host, int(port))) as plain:
                plain.sendall(data)
        with peer(one.address) as simulation:
            simulation.send(b"PING")
            until(lambda: one._peer is not None, lambda: one.receive(50))


def test_a_port_that_is_taken_is_named():
    with server() as one:
        port = int(one.address.rpartition(":")[2])
        with pytest.raises(OSError, match=f"cannot listen on 127.0.0.1 port {port}"):
            VizardServer("127.0.0.1", port)
