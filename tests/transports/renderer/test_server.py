"""The port for a renderer, with the client library and with hostile peers on the other side."""

from __future__ import annotations

import math
import os
import random
import socket
import threading
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import pytest

from evstim.renderer import Images, Renderer, RendererRefused
from firmware_protocol.renderer import HEADER_OCTETS, READY, Camera, End, Hello, Image, MessageError
from transports import renderer as module
from transports.renderer import RendererEnded, RendererError, RendererServer

pytestmark = pytest.mark.socket

_PLAIN = Images()
WANTED = Camera((6, 4), 100.0, 10_000_000, 4, 0)
LONG_S = 60.0
SHARED = pytest.mark.parametrize("shared", [False, True])


@contextmanager
def in_thread(work, *arguments):
    """Run a peer beside the block, and raise its error at the end."""
    errors = []

    def run():
        try:
            work(*arguments)
        except Exception as error:  # noqa: BLE001 - raised below
            errors.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        thread.join(LONG_S)
    assert not thread.is_alive()
    if errors:
        raise errors[0]


def draw_all(address, images=_PLAIN, shared=False, change=None, count=1 << 30):
    """Draw each image with its time, in ms, as light, until evstim ends, or END after `count` images."""
    with Renderer(f"{address[0]}:{address[1]}", images, shared=shared, name="a test") as renderer:
        for k, image in enumerate(renderer):
            if k == count:
                renderer.end()
                return
            image.light[:] = k if image.t_ns is None else image.t_ns // 1_000_000
            for plane in (image.motion, image.depth, image.rate):
                if plane is not None:
                    plane[:] = k
            if change:
                change(image)
            image.send(t_ns=None if image.t_ns is not None else 1000 * k, motion_bound_px_s=5.0)


def accepted(server, wanted=WANTED):
    connection = server.accept(wanted, LONG_S)
    assert connection is not None, server.refusals
    return connection


@SHARED
def test_images_come_in_the_order_of_their_requests(shared):
    server = RendererServer("127.0.0.1", 0)
    with in_thread(draw_all, server.address, Images(motion=True, depth=True, rate=True), shared):
        connection = accepted(server)
        assert connection.hello.name == "a test"
        for t_ms in (0, 7, 3):
            connection.request(t_ms * 1_000_000)
        assert connection.requested == 3
        for k, t_ms in enumerate((0, 7, 3)):
            drawn = connection.receive(LONG_S)
            assert drawn.head == Image(k, t_ms * 1_000_000, 5.0)
            np.testing.assert_array_equal(drawn.planes["light"], np.full((4, 6), t_ms, np.float32))
            assert drawn.planes["motion"].shape == (4, 6, 2)
            np.testing.assert_array_equal(drawn.planes["depth"], np.full((4, 6), k, np.float32))
        connection.close()


@pytest.mark.parametrize(("levels", "white"), [("uint8", 255), ("uint16", 1023)])
def test_integer_levels_come_as_they_are(levels, white):
    server = RendererServer("127.0.0.1", 0)
    with in_thread(draw_all, server.address, Images(levels, white, srgb=True)):
        connection = accepted(server)
        connection.request(200 * 1_000_000)
        light = connection.receive(LONG_S).planes["light"]
        assert light.dtype == np.dtype(levels)
        assert (light == 200).all()
        connection.close()


def test_a_request_has_the_pose_of_the_camera():
    poses = []
    server = RendererServer("127.0.0.1", 0)
    with in_thread(draw_all, server.address, Images(), False, lambda image: poses.append(image.pose)):
        connection = accepted(server)
        connection.request(0, (1.0, 2.0, 3.0, 0.0, 1.0, 0.0, 0.0))
        connection.request(1)
        for _ in range(2):
            connection.receive(LONG_S)
        connection.close()
    assert (poses[0].position_m, poses[0].q_world_from_camera) == ((1.0, 2.0, 3.0), (0.0, 1.0, 0.0, 0.0))
    assert poses[1] is None


def test_more_images_than_slots_come_through_the_shared_memory():
    server = RendererServer("127.0.0.1", 0)
    with in_thread(draw_all, server.address, Images(), True):
        connection = accepted(server)
        planes = []
        for k in range(2 * WANTED.slots):
            connection.request(k * 1_000_000)
            planes.append(connection.receive(LONG_S).planes["light"])
        connection.close()
    np.testing.assert_array_equal([plane[3, 5] for plane in planes], range(2 * WANTED.slots))


def test_a_renderer_cannot_change_the_size_of_the_shared_memory():
    server = RendererServer("127.0.0.1", 0)

    def attack(address):
        with socket.create_connection(address) as peer:
            peer.sendall(Hello(shared=True).pack())
            path = Path(Camera.parse(peer.recv(4096)[HEADER_OCTETS:]).path)
            for attempt in (lambda: path.open("wb"), lambda: os.truncate(path, 0), lambda: os.truncate(path, 1 << 20)):
                with pytest.raises(PermissionError):
                    attempt()
            with path.open("r+b") as memory:
                memory.write(np.full(24, 5, np.float32))
            peer.sendall(READY + Image(0, 7).pack())
            peer.recv(4096)

    with in_thread(attack, server.address):
        connection = accepted(server)
        connection.request(7)
        np.testing.assert_array_equal(connection.receive(LONG_S).planes["light"], np.full((4, 6), 5, np.float32))
        connection.close()


def test_an_image_that_was_sent_is_read_only():
    server = RendererServer("127.0.0.1", 0)

    def sends_twice(address):
        with Renderer(f"{address[0]}:{address[1]}", Images(depth=True), shared=True) as renderer:
            for image in renderer:
                image.light[:] = image.depth[:] = 1
                image.send()
                for plane in (image.light, image.depth):
                    with pytest.raises(ValueError, match="read-only"):
                        plane[:] = math.nan

    with in_thread(sends_twice, server.address):
        connection = accepted(server)
        for _ in range(2 * WANTED.slots):
            connection.request(0)
            assert (connection.receive(LONG_S).planes["light"] == 1).all()
        connection.close()


def test_a_path_that_leads_to_another_file_is_an_error_with_advice(tmp_path):
    """In a container of its own, /proc/PID/fd/NUMBER of evstim may be a file of another program."""
    other = tmp_path / "other"
    other.write_bytes(bytes(1000))
    camera = Camera((6, 4), 100.0, 10_000_000, 4, 128, path=str(other))
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def camera_of_another_container():
            peer, _ = listener.accept()
            with peer:
                peer.sendall(camera.pack())
                peer.recv(4096)

        with in_thread(camera_of_another_container), pytest.raises(OSError, match=r"another container.*shared=False"):
            Renderer(f"127.0.0.1:{listener.getsockname()[1]}", shared=True)


def test_the_shared_memory_has_no_name_in_a_folder():
    before = set(Path("/dev/shm").glob("evstim-renderer-*"))
    server = RendererServer("127.0.0.1", 0)
    with in_thread(draw_all, server.address, Images(), True):
        connection = accepted(server)
        assert set(Path("/dev/shm").glob("evstim-renderer-*")) == before
        connection.close()


def test_a_scene_that_ends_is_no_error_and_a_renderer_with_a_reason_is():
    server = RendererServer("127.0.0.1", 0)
    with in_thread(draw_all, server.address, Images(), False, None, 1):
        connection = accepted(server)
        connection.request(0)
        connection.request(1)
        connection.receive(LONG_S)
        with pytest.raises(RendererEnded):
            connection.receive(LONG_S)
        connection.close()

    def fails(address):
        with pytest.raises(ZeroDivisionError):
            draw_all(address, change=lambda _: 1 // 0)

    server = RendererServer("127.0.0.1", 0)
    with in_thread(fails, server.address):
        connection = accepted(server)
        connection.request(0)
        with pytest.raises(RendererError, match="ZeroDivisionError"):
            connection.receive(LONG_S)
        connection.close()


def test_the_reason_of_a_refusal_reaches_the_renderer():
    server = RendererServer("127.0.0.1", 0)

    def refused(address):
        with pytest.raises(RendererRefused, match="light is NaN"):
            draw_all(address)

    with in_thread(refused, server.address):
        connection = accepted(server)
        connection.request(0)
        connection.receive(LONG_S)
        connection.close("light is NaN")


def peer_of(address, *octets):
    """Send octets, and the end of the stream at None; then read until the connection is closed."""
    with socket.create_connection(address) as peer:
        peer.settimeout(LONG_S)
        try:
            for part in octets:
                if part is None:
                    peer.shutdown(socket.SHUT_WR)
                else:
                    peer.sendall(part)
            while peer.recv(4096):
                pass
        except TimeoutError:
            raise
        except OSError:  # the server may close before the last part
            return


def test_a_peer_that_is_no_renderer_is_refused_and_the_next_one_served(monkeypatch):
    monkeypatch.setattr(module, "_GREETING_S", 0.2)
    server = RendererServer("127.0.0.1", 0)

    def peers(address):
        peer_of(address, b"GET / HTTP/1.1\r\n\r\n")
        peer_of(address, b"")  # silent
        peer_of(address, Hello().pack()[:30])
        peer_of(address, Hello().pack(), End("no").pack())
        draw_all(address)

    with in_thread(peers, server.address):
        connection = accepted(server)
        connection.close()
    assert len(server.refusals) == 4
    assert "no renderer of evstim's" in server.refusals[0]
    assert "it ended: no" in server.refusals[3]


def test_silent_peers_keep_no_renderer_out(monkeypatch):
    """More than may wait, and each would be waited for twice as long as the test has."""
    monkeypatch.setattr(module, "_GREETING_S", 2 * LONG_S)
    server = RendererServer("127.0.0.1", 0)
    with ExitStack() as silent:
        peers = [silent.enter_context(socket.create_connection(server.address)) for _ in range(100)]
        for k, peer in enumerate(peers[50:]):
            peer.sendall(Hello().pack()[:k])
        with in_thread(draw_all, server.address):
            accepted(server).close()
        assert b"before many others" in peers[0].recv(1000)


def test_a_peer_of_an_address_that_is_not_allowed_is_refused():
    server = RendererServer("127.0.0.1", 0, ["10.1.1.1"])
    with in_thread(peer_of, server.address, Hello().pack()):
        assert server.accept(WANTED, 1.0) is None
    assert "not allowed" in server.refusals[0]


PIXELS = bytes(128)  # 6 x 4 float32, filled to a multiple of 64


@pytest.mark.parametrize(
    ("answer", "error", "text"),
    [
        (Image(1, 5).pack(128) + PIXELS, MessageError, "image 1 of 5 ns came for request 0 of 5"),
        (Image(0, 6).pack(128) + PIXELS, MessageError, "image 0 of 6 ns came"),
        (Image(0, 5).pack(64) + PIXELS, MessageError, "64 octets of pixels, not 128"),
        (Image(0, 5).pack(1 << 60), MessageError, "at most 152"),
        (READY, MessageError, "READY came instead of IMAGE"),
        (b"EVSR" + bytes(12), MessageError, "version 0"),
        (Image(0, 5).pack(128) + PIXELS[:90], RendererError, "closed the connection"),
        (b"", RendererError, "closed the connection"),
    ],
)
def test_answers_that_are_wrong_are_errors(answer, error, text):
    server = RendererServer("127.0.0.1", 0)

    with in_thread(peer_of, server.address, Hello().pack() + READY + answer, None):
        connection = accepted(server)
        connection.request(5)
        with pytest.raises(error, match=text):
            connection.receive(LONG_S)
        connection.close()


def test_a_renderer_that_stalls_is_an_error():
    server = RendererServer("127.0.0.1", 0)
    with in_thread(peer_of, server.address, Hello().pack() + READY):
        connection = accepted(server)
        connection.request(5)
        with pytest.raises(RendererError, match="nothing more came in time"):
            connection.receive(0.05)
        connection.close()


def test_damaged_answers_give_nothing_but_the_errors_of_a_renderer():
    whole = Hello().pack() + READY + Image(0, 5).pack(128) + PIXELS + Image(1, 5).pack(128) + PIXELS
    chance = random.Random(1)
    outcomes = set()
    for _ in range(150):
        octets = bytearray(whole)
        for _ in range(chance.randint(1, 4)):
            octets[chance.randrange(112 if chance.random() < 0.3 else len(octets))] = chance.randrange(256)
        server = RendererServer("127.0.0.1", 0)
        outcomes.add(outcome_of(server, bytes(octets[: chance.choice([len(octets), chance.randrange(len(octets))])])))
    assert {"refused", "served", "RendererError"} <= outcomes


def outcome_of(server, octets):
    """Return what one connection with these octets comes to."""
    with socket.create_connection(server.address) as peer:
        peer.sendall(octets)
        peer.shutdown(socket.SHUT_WR)
        connection = server.accept(WANTED, 0.01)
        if connection is None:
            return "refused"
        try:
            for _ in range(2):
                connection.request(5)
                connection.receive(1.0)
        except (RendererError, MessageError) as error:
            return type(error).__name__
        finally:
            connection.close()
        return "served"
