"""Programs of others that read the streams: dv_processing, faery, aestream, PyAV, and numpy."""

import os
import socket
import subprocess
import sys
import threading
import time
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from evstim.testing.link_contract import event_stream
from tests.free_ports import free_port
from tests.transports.network_streams.stream_readers import DvReader
from tests.transports.opened_links import opened
from transports.link.rings import FREE_RUNNING

pytestmark = [pytest.mark.system, pytest.mark.socket]

FAERY = """
import faery, os, sys
import numpy as np
address = "127.0.0.1", int(sys.argv[1])
stream = faery.events_stream_from_udp(dimensions=(346, 260), address=address, format=sys.argv[2])
have = []
print("ready", flush=True)
for events in stream:
    have.append(events.copy())
    if sum(len(part) for part in have) >= int(sys.argv[3]):
        break
np.save(sys.argv[4], np.concatenate(have))
os._exit(0)
"""

AESTREAM = """
import aestream, sys, time
import numpy as np
with aestream.UDPInput((346, 260), device="cpu", port=int(sys.argv[1])) as stream:
    print("ready", flush=True)
    picture, until = np.zeros((346, 260)), time.monotonic() + 120
    while picture.sum() < int(sys.argv[2]) and time.monotonic() < until:
        picture += np.asarray(stream.read())
        time.sleep(0.01)
np.save(sys.argv[3], picture)
"""


def started(script, port, *arguments, python=sys.executable):
    """Start a client, and wait until it has opened its port, which it does when it is first asked."""
    client = subprocess.Popen([python, "-c", script, *map(str, (port, *arguments))], stdout=subprocess.PIPE, text=True)
    assert client.stdout.readline() == "ready\n"
    until = time.monotonic() + 120
    while not is_bound(port):
        assert client.poll() is None
        assert time.monotonic() < until
        time.sleep(0.01)
    return client


def is_bound(port):
    """Return whether a UDP socket of this machine has the port."""
    files = [path for name in ("udp", "udp6") if (path := Path("/proc/net", name)).exists()]
    rows = [row.split() for path in files for row in path.read_text().splitlines()[1:]]
    return any(int(row[1].rpartition(":")[2], 16) == port for row in rows)


def sent(table, events):
    """Send all events, and return the link's last report."""
    link = opened(table)
    link.start(FREE_RUNNING)
    link.push_all(events, int(events["t"][-1]) + 1)
    report = link.stop(60.0)
    assert (report.delivered, report.dropped) == (len(events), 0)
    return report


@pytest.mark.parametrize("form", ["t64_x16_y16_on8", "t32_x16_y15_on1"])
def test_faery_reads_its_datagrams(form, tmp_path):
    pytest.importorskip("faery", reason="the `files` extra is not installed")
    events, port = event_stream(5000), free_port()
    with started(FAERY, port, form, len(events), tmp_path / "have.npy") as client:
        sent(f'kind = "udp"\nformat = "{form}"\nport = {port}\nmbit_s = 8.0', events)
        assert client.wait(300) == 0
    have = np.load(tmp_path / "have.npy")
    assert all((have[name] == events[name]).all() for name in ("t", "x", "y", "on"))


def test_aestream_counts_each_event_at_its_place(tmp_path):
    python = os.environ.get("EVSTIM_AESTREAM_PYTHON", sys.executable)
    if subprocess.run([python, "-c", "import aestream"], capture_output=True).returncode:
        pytest.skip("aestream is not installed here, nor below EVSTIM_AESTREAM_PYTHON")
    events, port = event_stream(5000), free_port()
    with started(AESTREAM, port, len(events), tmp_path / "picture.npy", python=python) as client:
        sent(f'kind = "udp"\nformat = "spif"\nport = {port}\nmbit_s = 2.0', events)
        assert client.wait(300) == 0
    expected = np.zeros((346, 260))
    np.add.at(expected, (events["x"], events["y"]), 1)
    np.testing.assert_array_equal(np.load(tmp_path / "picture.npy"), expected)


def test_dv_processing_is_told_the_size_and_the_name():
    link = opened('kind = "tcp"\nport = 0\ncamera = "A <camera> & more"')
    with closing(DvReader(link)) as reader:
        assert reader.client.getEventResolution() == (346, 260)
        assert reader.client.getCameraName() == "A <camera> & more"
    link.stop(0.0)


def test_numpy_reads_event_images():
    events = event_stream(20_000)
    pictures = '[links.pictures]\nchannels = ["on", "off", "level", "filtered"]\nfilter_ms = 0.1'
    link = opened(f'kind = "tcp"\nformat = "event_image"\nport = 0\nframe_ms = 5.0\nbuffer_mib = 64.0\n{pictures}')
    host, _, port = link.report.address.rpartition(":")
    with socket.create_connection((host, int(port)), timeout=120) as client:
        while "waiting" in link.listen().state:
            time.sleep(0.01)
        link.start(FREE_RUNNING)
        link.push_all(events, 65_000)
        stream, images = client.makefile("rb", 0), []
        while len(images) < 13:
            images.append(np.lib.format.read_array(stream)[0])
        assert link.stop(10.0).delivered == len(events)
    assert [int(one["t_us"]) for one in images] == list(range(5000, 70_000, 5000))
    assert sum(one["image"][0].sum() for one in images) == events["on"].sum()
    assert sum(one["image"][1].sum() for one in images) == (~events["on"]).sum()
    level, filtered = images[-1]["image"][2:]  # the last event was 5 ms before, fifty time constants
    np.testing.assert_allclose(filtered, level, atol=1e-6)


def test_pyav_shows_the_display():
    av = pytest.importorskip("av", reason="the `files` extra is not installed")
    events = event_stream(20_000)
    link = opened('kind = "tcp"\nformat = "display"\nport = 0\nframe_ms = 10.0')
    pictures = []

    def look(address):
        with av.open(f"tcp://{address}", format="ppm_pipe", options={"probesize": "32"}) as film:
            pictures.extend(frame.to_ndarray(format="rgb24") for frame in film.decode(video=0))

    viewer = threading.Thread(target=look, args=(link.report.address,))
    viewer.start()
    while "waiting" in link.listen().state:
        time.sleep(0.01)
    link.start(FREE_RUNNING)
    link.push_all(events, 60_000)
    assert link.stop(10.0).delivered == len(events)
    viewer.join()
    assert len(pictures) >= 6
    first = events[events["t"] < 10_000]
    level = np.zeros((260, 346), int)
    np.add.at(level, (first["y"], first["x"]), np.where(first["on"], 1, -1))
    np.testing.assert_array_equal((pictures[0] == (0, 255, 0)).all(axis=2), level > 0)
    np.testing.assert_array_equal((pictures[0] == (255, 0, 0)).all(axis=2), level < 0)
