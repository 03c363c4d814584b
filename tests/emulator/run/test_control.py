"""The control socket against clients that are silent, nested, endless, many, or gone."""

import json
import os
import socket
import threading

import pytest

from emulator.run.control import ControlSocket, send_request, sockets


@pytest.fixture
def control(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with ControlSocket("bench") as opened:
        yield opened


def client(control):
    sock = socket.socket(socket.AF_UNIX)
    sock.settimeout(120)
    sock.connect(str(control.path))
    return sock


def heard(message):
    return {"heard": message}


def asked(control, answer=heard):
    """Ask as `evstim fault` does while the session looks at its socket."""
    told = []
    asking = threading.Thread(target=lambda: told.append(send_request(control.path, {"request": "faults"})))
    asking.start()
    while asking.is_alive():
        control.poll(answer)
        asking.join(0.001)
    return told[0]


@pytest.mark.parametrize(
    "data", [b"[" * 60_000 + b"\n", b'{"a":' * 10_000 + b"\n", b"[" * 200_000, b"9" * 60_000 + b"\n"]
)
def test_what_no_parser_takes_is_answered_and_ends_nothing(control, data):
    with client(control) as sock:
        sock.setblocking(False)
        sent = 0
        while sent < len(data):
            try:
                sent += sock.send(data[sent:])
            except BlockingIOError:
                control.poll(heard)
            except OSError:  # it was sent off: its line is too long
                break
        control.poll(heard)
    assert asked(control) == {"heard": {"request": "faults"}}


def test_an_answer_that_meets_too_deep_a_table_is_an_error(control):
    def too_deep(message):
        raise RecursionError

    assert "nested" in asked(control, too_deep)["error"]


def test_silent_clients_make_way(control):
    silent = [client(control) for _ in range(100)]
    assert asked(control) == {"heard": {"request": "faults"}}
    assert len(control._clients) <= 16
    for sock in silent:
        sock.close()


def test_a_client_that_does_not_read_holds_up_nobody(control):
    with client(control) as deaf:
        deaf.sendall(b"{}\n")
        control.poll(lambda message: {"long": "x" * 900_000})
        assert asked(control) == {"heard": {"request": "faults"}}
        got = b""
        while not got.endswith(b"\n"):
            control.poll(heard)
            got += deaf.recv(1 << 20)
    assert len(json.loads(got)["long"]) == 900_000


def test_an_endless_line_is_cut(control):
    with client(control) as endless:
        endless.setblocking(False)
        for _ in range(100):
            try:
                endless.send(b"x" * 65536)
            except BlockingIOError:
                pass
            except OSError:
                break
            control.poll(heard)
        else:
            pytest.fail("it was listened to for ever")
        assert control._clients == []


def test_the_socket_of_a_dead_run_is_removed_and_that_of_a_living_one_stays(control):
    stale = control.path.with_name("bench-1.sock")
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(stale))
        dead.listen()
    assert stale.exists()
    assert sockets() == [control.path]
    assert not stale.exists()
    assert asked(control) == {"heard": {"request": "faults"}}


def test_opening_cleans_up_too(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    (tmp_path / "evstim").mkdir(mode=0o700)
    stale = tmp_path / "evstim" / "other-1.sock"
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(stale))
    with ControlSocket("bench") as control:
        assert os.listdir(tmp_path / "evstim") == [control.path.name]


def test_a_flood_of_connections_leaves_the_one_that_asks_its_answer(control):
    stop = threading.Event()

    def flood():
        while not stop.is_set():
            with socket.socket(socket.AF_UNIX) as sock:
                sock.setblocking(False)
                try:
                    sock.connect(str(control.path))
                except BlockingIOError:
                    stop.wait(0.001)

    flooding = threading.Thread(target=flood)
    flooding.start()
    try:
        for _ in range(20):
            assert asked(control) == {"heard": {"request": "faults"}}
    finally:
        stop.set()
        flooding.join()


def test_who_had_to_make_way_before_its_line_was_read_asks_again(tmp_path):
    """A flood can push a client out between its connection and its line; the command is then said once more."""
    path = tmp_path / "bench.sock"
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(path))
        server.listen()

        def turn_one_away_then_answer():
            server.accept()[0].close()
            client, _ = server.accept()
            with client:
                client.sendall(client.recv(100))

        other = threading.Thread(target=turn_one_away_then_answer)
        other.start()
        assert send_request(path, {"n": 1}) == {"n": 1}
        other.join()
