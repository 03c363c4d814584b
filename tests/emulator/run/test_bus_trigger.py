"""A whole run that a CAN bus drives: SYNCs of a program of its own become edges on every link, at exact times."""

import json
import socket
import threading
import time

import pytest

from emulator.cli.app import _main
from firmware_protocol.events import EdgeKind
from tests.free_ports import free_port
from tests.npz_records import load_edges

RIG = """
[scene]
kind = "checkerboard"
speed_px_s = 20.0
[camera.sensor]
width = 64
height = 48
[trigger]
source = "can"
kind = "rising"
latency_us = 3.5
[run]
pace = "lockstep"
lockstep_us = 20000
step_us = 5000
seconds = 0.2
[[links]]
kind = "can"
interface = "served"
port = {port}
channel = "can0"
[[links]]
kind = "loopback"
"""


def joined(port):
    """The bus, as socketcand's protocol lets any program join it."""
    for _ in range(6000):  # the link may have its coders to compile
        try:
            return socket.create_connection(("127.0.0.1", port), timeout=60)
        except ConnectionRefusedError:
            time.sleep(0.05)
    raise TimeoutError("nobody serves the bus")


def send_syncs(port):
    """Join, wait until the camera says something, and send a SYNC each millisecond until the bus is gone."""
    with joined(port) as bus:
        for words in (b"< open can0 >", b"< rawmode >"):
            bus.recv(1024)
            bus.sendall(words)
        while b"frame" not in (said := bus.recv(1024)):
            assert said, "the bus has gone"
        try:
            while True:
                bus.sendall(b"< send 080 0 >")
                time.sleep(0.001)
        except (ConnectionError, TimeoutError):
            return


@pytest.mark.system
@pytest.mark.socket
def test_syncs_drive_the_run_and_are_edges_on_every_link(tmp_path, capsys):
    port = free_port()
    rig, record = tmp_path / "r.toml", tmp_path / "r.npz"
    rig.write_text(RIG.format(port=port))
    bus = threading.Thread(target=send_syncs, args=(port,))
    bus.start()
    code = _main(["run", str(rig), "--json", "--record", str(record)])
    bus.join()
    summary = json.loads(capsys.readouterr().out.strip().splitlines()[-1])
    assert code == 0, json.dumps([summary["links"], summary["events"]])
    assert summary["balanced"]
    assert summary["sim_seconds"] == pytest.approx(0.2)
    assert summary["syncs"] >= 10
    expected = [3 + 20_000 * k for k in range(10)]
    for link in ("can", "loopback"):
        edges, _ = load_edges(tmp_path / f"r-{link}.npz")
        assert edges[edges["kind"] == EdgeKind.RISING]["t"].tolist() == expected
        assert summary["links"][link]["edges"]["balanced"]
        assert summary["links"][link]["edges"]["late"] == 0
