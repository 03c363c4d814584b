"""A sensor's words over TCP and UDP, read by programs of others: each of a million events, exactly."""

import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from emulator.rig.loading import RigError, parse_rig
from firmware_protocol.evt.evt3 import Evt3Decoder
from tests.free_ports import free_port
from tests.transports.network_streams.stream_readers import udp_port
from tests.transports.network_streams.test_real_clients import opened
from tests.transports.word_readers import MANY, OCTETS, by_evt3, check_words, rows
from transports.link.rings import FREE_RUNNING

pytestmark = [pytest.mark.system, pytest.mark.socket]


class TcpClient:
    """A thread that reads a connection to its end."""

    def __init__(self, link):
        host, _, port = link.report.address.rpartition(":")
        self._socket = socket.create_connection((host, int(port)), timeout=120)
        self._parts = []
        self._thread = threading.Thread(target=self._read)
        self._thread.start()

    def _read(self):
        while part := self._socket.recv(1 << 20):
            self._parts.append(part)

    def data(self):
        self._thread.join(120)
        assert not self._thread.is_alive()
        self._socket.close()
        return b"".join(self._parts)


def await_clients(link, count):
    while not link.listen().state.startswith(f"{count} client"):
        time.sleep(0.01)


@pytest.mark.sampled
@pytest.mark.parametrize("form", list(OCTETS))
def test_a_million_events_over_tcp_are_read_exactly(form, tmp_path):
    events, link = rows(MANY), opened(f'kind = "tcp"\nformat = "{form}"\nport = 0')
    client = TcpClient(link)
    await_clients(link, 1)
    link.start(FREE_RUNNING)
    link.push_all(events, int(events["t"][-1]) + 1)
    report = link.stop(60.0)
    assert (report.delivered, report.dropped) == (MANY, 0)
    check_words(form, client.data(), events, tmp_path)


@pytest.mark.sampled
@pytest.mark.parametrize("form", list(OCTETS))
def test_a_million_events_in_datagrams_are_read_exactly(form, tmp_path):
    events, receiver, parts = rows(MANY), udp_port(), []
    table = f'kind = "udp"\nformat = "{form}"\nport = {receiver.getsockname()[1]}\nmbit_s = 60.0'
    is_over = threading.Event()

    def read():
        while True:
            try:
                parts.append(receiver.recv(65536))
            except TimeoutError:
                if is_over.is_set():
                    return

    reader = threading.Thread(target=read)
    reader.start()
    link = opened(table)
    link.start(FREE_RUNNING)
    link.push_all(events, int(events["t"][-1]) + 1)
    report = link.stop(60.0)
    is_over.set()
    reader.join(120)
    receiver.close()
    assert (report.delivered, report.dropped) == (MANY, 0)
    check_words(form, b"".join(parts), events, tmp_path)


def test_a_client_that_joins_late_reads_all_that_follows():
    """The time of its first word is the stream's, modulo 16.8 s."""
    events, link = rows(40_000), opened('kind = "tcp"\nformat = "evt3"\nport = 0')
    clients = [TcpClient(link)]
    await_clients(link, 1)
    link.start(FREE_RUNNING)
    half = int(np.searchsorted(events["t"], events["t"][20_000]))
    link.push_all(events[:half], int(events["t"][half - 1]))
    while link.listen().delivered < half:
        time.sleep(0.01)
    clients.append(TcpClient(link))
    await_clients(link, 2)
    link.push_all(events[half:], int(events["t"][-1]) + 1)
    assert link.stop(60.0).delivered == len(events)
    for client, expected in zip(clients, (events, events[half:]), strict=True):
        np.testing.assert_array_equal(Evt3Decoder().decode(client.data())[0], expected)


@pytest.mark.parametrize(("kind", "form"), [("tcp", "evt2"), ("udp", "evt21"), ("serial", "evt3")])
def test_a_sensor_beyond_the_words_is_refused(kind, form):
    where = "" if kind == "serial" else "port = 7000"
    sensor = "[camera.sensor]\nwidth = 2049\nheight = 20"
    with pytest.raises(RigError, match=f"{form} numbers 2048 x 2048 pixels, not 2049 x 20"):
        parse_rig(
            f'[scene]\nkind = "checkerboard"\n{sensor}\n[[links]]\nkind = "{kind}"\nformat = "{form}"\n{where}',
            "a.toml",
            "a",
        )


def printed(page, heading, language):
    """Return the first block of a language below a heading of a page."""
    section = (Path(__file__).parents[3] / "docs" / page).read_text(encoding="utf-8").partition(f"\n## {heading}\n")[2]
    return section.partition(f"```{language}\n")[2].partition("```")[0]


def test_the_program_of_the_page_reads_every_event(tmp_path):
    pytest.importorskip("faery", reason="the `files` extra is not installed")
    port, events = str(free_port()), rows(20_000)
    table, program = (
        printed("streams.md", "Words of a sensor", kind).replace("7777", port) for kind in ("toml", "python")
    )
    link = opened(table.replace("[[links]]", ""))
    shown = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True, cwd=tmp_path)
    await_clients(link, 1)
    link.start(FREE_RUNNING)
    link.push_all(events, int(events["t"][-1]) + 1)
    assert link.stop(60.0).delivered == len(events)
    assert "1" in shown.communicate(timeout=120)[0].split("]")[0].split()
    assert shown.returncode == 0
    np.testing.assert_array_equal(by_evt3(tmp_path / "camera.raw", "evt3"), events)
