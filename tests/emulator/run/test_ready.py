"""The signal that a run is ready."""

import json
import os
import socket
from pathlib import Path

from emulator.run.control import ReadySignal


def test_the_file_names_the_links_and_is_written_once(tmp_path, monkeypatch):
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    path = tmp_path / "ready.json"
    ready = ReadySignal(path)
    ready.send({"usbip": "127.0.0.1:3240", "loopback": None})
    assert json.loads(path.read_text()) == {"pid": os.getpid(), "links": {"usbip": "127.0.0.1:3240", "loopback": None}}
    path.unlink()
    ready.send({})
    assert list(tmp_path.iterdir()) == []


def test_the_file_appears_whole_or_not_at_all(tmp_path, monkeypatch):
    path, seen, write = tmp_path / "ready.json", [], Path.write_text

    def write_in_two(self, text, **options):
        write(self, text[:10], **options)
        seen.append(path.exists())
        return write(self, text, **options)

    monkeypatch.setattr(Path, "write_text", write_in_two)
    ReadySignal(path).send({"usbip": "127.0.0.1:3240"})
    assert seen == [False]
    assert list(tmp_path.iterdir()) == [path]


def test_a_service_manager_is_told(tmp_path, monkeypatch):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.settimeout(120.0)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        ReadySignal(None).send({})
        assert manager.recv(100) == b"READY=1"


def test_a_service_manager_that_is_not_there_is_no_error(tmp_path, monkeypatch):
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "nobody"))
    ReadySignal(None).send({})
