"""The page's process with real WebSocket clients; the test is the session."""

import asyncio
import json
import multiprocessing
import socket
import struct
import threading
import time
import urllib.request
from contextlib import ExitStack, contextmanager, suppress

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from emulator.live_page.messages import Access
from emulator.live_page.process import Canvas, PageProcess, PageSetup, SharedView
from emulator.live_page.server import BAD_MESSAGE, FULL, MOST_VIEWERS, REFUSED
from tests.emulator.live_page.pictures import decode_picture
from tests.made_events import events_at

pytestmark = pytest.mark.socket

_SIZE = (64, 48)
_OPEN = Access()
_PATIENCE_S = 120.0


@pytest.fixture(autouse=True)
def unhurried(monkeypatch):
    """A server that waits longer for its viewers than a busy machine keeps them waiting."""
    for name in ("server._HELLO_S", "server._SEND_S", "server.STALLED_S"):
        monkeypatch.setattr(f"emulator.live_page.{name}", _PATIENCE_S)


class Served:
    """A page in a thread, and the session's end of it."""

    def __init__(self, access):
        self.view = SharedView(_SIZE)
        self.pipe, theirs = multiprocessing.Pipe()
        listener = socket.create_server(("127.0.0.1", 0), backlog=128)
        self.port = listener.getsockname()[1]
        self.process = None

        def serve():
            async def run():
                self.process = PageProcess(PageSetup({"name": "test"}, access, self.view), theirs)
                await self.process.run(listener)

            asyncio.run(run())
            theirs.close()
            listener.close()

        self.thread = threading.Thread(target=serve)
        self.thread.start()

    @contextmanager
    def viewer(self, hello=None, **options):
        """Connect a client that says hello."""
        address = f"ws://127.0.0.1:{self.port}/live"
        with connect(address, compression=None, close_timeout=1, **options) as client:
            client.send(json.dumps(hello or {"do": "hello"}))
            client.count = 0
            yield client

    def until(self, is_so, timeout_s=_PATIENCE_S):
        """Show light and events, as a run would, until something is so."""
        end_s, t_us = time.monotonic() + timeout_s, self.view._ring.now_us
        while not is_so():
            assert time.monotonic() < end_s
            t_us += 10_000
            events = events_at([t_us - 1] * 5, x=np.arange(5), on=True)
            self.view.show(events, np.ones(_SIZE[::-1], np.float32), t_us)
            time.sleep(0.01)


@contextmanager
def served(access=_OPEN):
    """Serve a page, and end it."""
    page = Served(access)
    try:
        yield page
    finally:
        page.pipe.close()
        page.thread.join(60.0)
        assert not page.thread.is_alive()


def _take(client):
    """Return the next message, and say that it was seen."""
    message = client.recv(timeout=60)
    client.count += 1
    client.send(json.dumps({"do": "seen", "number": client.count}))
    return message


def _text(client):
    """Return the next message that is no picture, parsed: pictures may come between any two others."""
    while isinstance(message := _take(client), bytes):
        pass
    return json.loads(message)


def _picture(page, client):
    """Return the next picture with events."""
    found = []

    def read():
        while not found:
            message = _take(client)
            if isinstance(message, bytes) and decode_picture(message).events:
                found.append(decode_picture(message))

    reading = threading.Thread(target=read)
    reading.start()
    page.until(lambda: found)
    reading.join()
    return found[0]


def _closed_with(client):
    """Read on until the server closes; return its code, None where it just cut the connection."""
    try:
        while True:
            client.recv(timeout=60)
    except ConnectionClosed as closed:
        return closed.rcvd.code if closed.rcvd else None


def test_the_files_come_and_load_nothing_from_elsewhere():
    with served() as page:
        for path in ("", "page.js", "picture.js", "axis.js", "changes.js", "faults.js", "repeats.js", "page.css"):
            with urllib.request.urlopen(f"http://127.0.0.1:{page.port}/{path}", timeout=60) as answer:
                text = answer.read().decode()
                assert "default-src 'self'" in answer.headers["Content-Security-Policy"]
            assert "http://" not in text.replace("http://www.w3.org", "")
            assert "https://" not in text


def test_viewers_see_the_events_and_the_light():
    with served() as page, page.viewer() as one, page.viewer() as other:
        assert _text(one) == {"kind": "about", "name": "test", "points": [], "frames_read": []}
        for client in (one, other):
            picture = _picture(page, client)
            assert picture.light.shape == _SIZE[::-1]
            assert list(picture.place) == [0, 1, 2, 3, 4]
            assert (picture.last > 0).all()
        page.pipe.send({"kind": "status", "t_s": 1.5, "commands_done": 0, "axis": {"points": [], "frames_read": []}})
        for client in (one, other):
            while (message := _text(client))["kind"] != "status":
                pass
            assert message["viewers"] == 2


def test_a_viewer_that_comes_later_sees_the_run_since_its_start(monkeypatch):
    monkeypatch.setattr("emulator.live_page.axis._BATCH", 4)
    points = [{"t_s": k / 10, "rate": k, "edges": 1, "imu_hz": 0, "imu": None} for k in range(9)]
    with served() as page, page.viewer() as early:
        assert _text(early)["points"] == []
        for point in points:
            page.pipe.send({"kind": "status", "commands_done": 0, "axis": {"points": [point], "frames_read": []}})
        while (history := _text(early))["kind"] != "history":  # older points have been joined
            pass
        assert [point["t_s"] for point in history["points"]] == [0.3, 0.4, 0.5, 0.6, 0.7]
        page.until(lambda: page.process._history.as_json()["points"][-1]["t_s"] == 0.8)
        with page.viewer() as late:
            about = _text(late)
    assert about["points"] == [{**points[3], "rate": 1.5, "edges": 4}, *points[4:]]


def test_a_command_reaches_the_session_and_its_answer_the_one_who_asked():
    with served() as page, page.viewer() as one, page.viewer() as other:
        other.send(json.dumps({"do": "adjust", "name": "leak_hz", "value": 2}))
        assert page.pipe.poll(_PATIENCE_S)
        viewer, command = page.pipe.recv()
        assert command == {"do": "adjust", "name": "leak_hz", "value": 2.0}
        page.pipe.send({"kind": "answer", "viewer": viewer, "did": "so", "commands_done": 1})
        page.pipe.send({"kind": "state", "paused": False, "commands_done": 1})
        assert [_text(one)["kind"] for _ in range(2)] == ["about", "state"]
        assert [_text(other)["kind"] for _ in range(3)] == ["about", "answer", "state"]


def test_a_session_that_hears_nothing_is_not_flooded_with_commands():
    with served() as page, page.viewer() as client:
        for _ in range(60):
            client.send('{"do": "pause"}')
        while "busy" not in str(_take(client)):
            pass
        waiting = 0
        while page.pipe.poll():  # the first that was refused came after them
            page.pipe.recv()
            waiting += 1
        assert waiting == 32


@pytest.mark.parametrize(
    "hello", [{"do": "hello", "token": "wrong"}, {"do": "hello"}, {"do": "pause"}, {"do": "hello", "token": ["a"]}]
)
def test_a_wrong_token_is_refused(hello):
    with served(Access("right")) as page:
        with page.viewer(hello) as client:
            assert _closed_with(client) == REFUSED
        with page.viewer({"do": "hello", "token": "right"}) as client:
            assert _text(client)["kind"] == "about"
        assert not page.pipe.poll()


def test_a_page_of_somebody_else_cannot_open_the_socket():
    with served() as page, pytest.raises(InvalidStatus), page.viewer(origin="http://evil.example"):
        pass


@pytest.mark.parametrize("garbage", ["{", "[]", '{"do": "fly"}', b"\0\1\2", '{"do": "seen", "number": 99}', "x" * 4000])
def test_garbage_ends_the_connection_and_nothing_else(garbage):
    with served() as page, page.viewer() as other:
        with page.viewer() as client:
            client.send(garbage)
            assert _closed_with(client) == BAD_MESSAGE
        assert _picture(page, other).events


def test_a_message_that_is_too_large_ends_the_connection():
    with served() as page, page.viewer() as client:
        client.send("x" * 1_000_000)
        assert _closed_with(client) in (1009, BAD_MESSAGE, None)


def test_a_flood_of_messages_ends_the_connection_and_nothing_else():
    with served() as page, page.viewer() as other:
        with page.viewer() as client:
            with suppress(ConnectionClosed):
                for _ in range(20_000):
                    client.send('{"do": "seen", "number": 0}')
            assert _closed_with(client) in (BAD_MESSAGE, None)
        assert _picture(page, other).events


def test_one_that_never_reads_is_dropped_and_holds_nothing_up(monkeypatch):
    with served() as page, page.viewer() as other, page.viewer() as client:
        assert _picture(page, other).events
        monkeypatch.setattr("emulator.live_page.server.STALLED_S", 0.5)
        page.until(lambda: len(page.process._viewers) == 0)  # neither reads any more
        assert _closed_with(client) is None  # cut off, not asked to go


def test_there_is_a_most_of_viewers_and_a_place_again_when_one_leaves():
    with served() as page, ExitStack() as stack:
        first = stack.enter_context(ExitStack())
        _take(first.enter_context(page.viewer()))
        for _ in range(MOST_VIEWERS - 1):
            _take(stack.enter_context(page.viewer()))
        with page.viewer() as late:
            assert _closed_with(late) == FULL
        first.close()
        page.until(lambda: len(page.process._viewers) < MOST_VIEWERS)  # the server has seen that it left
        with page.viewer() as again:
            assert _text(again)["kind"] == "about"


class Crowd:
    """Connections that send nothing; those that the server has closed are let go, for both ends need descriptors."""

    def __init__(self, port):
        self._port, self._held = port, []

    def __enter__(self):
        return self

    def __exit__(self, *_):
        for connection in self._held:
            _reset(connection)

    def come(self):
        """Connect once more."""
        self._held.append(socket.create_connection(("127.0.0.1", self._port), timeout=_PATIENCE_S))
        self._held[-1].setblocking(False)
        if len(self._held) > 300:
            _ = self.open

    @property
    def open(self):
        """How many the server has not closed, of which it may not have accepted some yet."""
        closed = [connection for connection in self._held if not _is_open(connection)]
        self._held = [connection for connection in self._held if connection not in closed]
        for connection in closed:
            _reset(connection)
        return len(self._held)


def _reset(connection):
    """Close a connection so that nothing of it lingers."""
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    connection.close()


def _is_open(connection):
    try:
        return bool(connection.recv(1, socket.MSG_PEEK))
    except BlockingIOError:
        return True
    except ConnectionError:
        return False


def test_a_thousand_connections_are_bounded_and_a_viewer_stays():
    """When no more than 63 of them are open all have been accepted: the server closes one only for a newer one."""
    with served() as page, page.viewer() as viewer, Crowd(page.port) as crowd:
        _take(viewer)
        for _ in range(1000):
            crowd.come()
        page.until(lambda: crowd.open <= 63)
        assert crowd.open == 63
        assert len(page.process.connections) == 64
        assert _picture(page, viewer).events


def test_the_end_of_the_run_is_told():
    with served() as page, page.viewer() as client:
        _take(client)
        page.pipe.close()
        assert _text(client) == {"kind": "ended"}


def test_a_page_that_cannot_draw_ends_with_the_reason(monkeypatch):
    def fail(*_):
        raise ZeroDivisionError("no picture")

    monkeypatch.setattr(Canvas, "draw", fail)
    view, (ours, theirs) = SharedView(_SIZE), multiprocessing.Pipe()
    listener = socket.create_server(("127.0.0.1", 0))

    async def run():
        async with asyncio.timeout(60):
            await PageProcess(PageSetup({"name": "test"}, _OPEN, view), theirs).run(listener)

    def look():
        with connect(f"ws://127.0.0.1:{listener.getsockname()[1]}/live", compression=None, close_timeout=1) as client:
            client.send(json.dumps({"do": "hello"}))
            with suppress(ConnectionClosed):
                while True:
                    client.recv(timeout=60)

    with ours, theirs, listener:
        viewer = threading.Thread(target=look)
        viewer.start()
        with pytest.raises(RuntimeError, match="ended before its run") as raised:
            asyncio.run(run())
        viewer.join()
    assert isinstance(raised.value.__cause__, ZeroDivisionError)
