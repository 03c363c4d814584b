"""libcaer, used directly, opens cameras of iniVation that are not there, and sees every event, edge and sample.

Short by default; at length:

    EVSTIM_LIBCAER_EVENTS=5e6 EVSTIM_LIBCAER_CLIENT=BUILD/client python -m pytest tests/guest/test_libcaer.py

The library that dv-processing 1.7.9 has inside cannot open a DVXplorer Micro; by itself it opens one with firmware 9.
"""

from __future__ import annotations

import json
import os
import sys
from dataclasses import dataclass

import numpy as np
import pytest

from firmware_protocol.events import EVENT, EdgeKind, make_edges
from tests.guest.all_streams import COLUMNS, STREAMS, STREAMS_240C
from tests.guest.attachment import DAVIS_FX2, DAVIS_FX3, DVXPLORER, Attachment
from tests.guest.comparison import assert_same
from tests.guest.running_rig import CHECKERBOARD, CHECKERBOARD_240C, RunningRig
from tests.guest.streaming import wait_for_bytes
from tests.guest.test_dvxplorer import MICRO, RIG

EVENTS = round(float(os.environ.get("EVSTIM_LIBCAER_EVENTS", "3e5")))
TIMEOUT_S = 240 + EVENTS // 5000
CLIENT = os.environ.get("EVSTIM_LIBCAER_CLIENT", "")
TRIGGER = np.dtype([("t", "<u8"), ("kind", "u1")])
SAMPLE = np.dtype([("t", "<u8"), ("values", "<f4", 7)])

pytestmark = [
    pytest.mark.guest,
    pytest.mark.socket,
    pytest.mark.timeout(2 * TIMEOUT_S + 960),
    pytest.mark.skipif(
        not CLIENT, reason="EVSTIM_LIBCAER_CLIENT names no program; tests/guest/libcaer/Makefile builds it"
    ),
]


@dataclass(frozen=True)
class Opened:
    """A camera that libcaer opens.

    Attributes
    ----------
    model
        Key of docs/device_matrix.py.
    kind
        The class of device, as the client names it.
    rig
        Its text.
    usb_id
        Vendor and product.
    firmware
        Version that the library prints.
    """

    model: str
    kind: str
    rig: str
    usb_id: tuple[str, str]
    firmware: int

    def __str__(self):
        return self.model


DAVIS = Opened("davis346", "davis", CHECKERBOARD + STREAMS, DAVIS_FX3, 6)
DAVIS_240C = Opened("davis240c", "davis", CHECKERBOARD_240C + STREAMS_240C, DAVIS_FX2, 4)
FX3 = Opened("dvxplorer", "dvxplorer", RIG, DVXPLORER, 9)
CX3 = Opened(
    "dvxplorer_micro_firmware9",
    "dvxplorer",
    MICRO.replace("dvxplorer_micro", "dvxplorer_micro_firmware9"),
    DVXPLORER,
    9,
)


def seen_edges(path):
    read = np.fromfile(path, TRIGGER)
    return make_edges(read["t"], read["kind"])


def assert_same_edges(seen, delivered):
    edges = delivered.edges[delivered.edge_resets[-1] :]
    assert len(seen) >= 50
    edges = edges[np.searchsorted(edges["t"], seen["t"][0]) :][: len(seen)]
    assert seen["t"].tolist() == edges["t"].tolist()
    assert seen["kind"].tolist() == edges["kind"].tolist()
    assert set(seen["kind"].tolist()) == set(EdgeKind)


def assert_same_samples(seen, delivered):
    imu = delivered.imu[delivered.imu_resets[-1] :]
    assert len(seen) >= 100
    imu = imu[np.searchsorted(imu["t"], seen["t"][0]) :][: len(seen)]
    assert seen["t"].tolist() == imu["t"].tolist()
    values = np.column_stack([imu[name] for name in COLUMNS]).astype(np.float64)
    np.testing.assert_allclose(seen["values"], values, rtol=4e-7, atol=1e-9)


def assert_same_frames(path, delivered):
    frames = delivered.frames[delivered.frame_resets[-1] :]
    pixels = frames["pixels"].astype(np.uint16) << 6
    seen = np.fromfile(path, np.dtype([("t", "<u8"), ("pixels", "<u2", pixels.shape[1:])]))
    assert len(seen) >= 3
    first = int(np.searchsorted(frames["t"], seen["t"][0]))
    assert seen["t"].tolist() == frames["t"][first : first + len(seen)].tolist()
    np.testing.assert_array_equal(seen["pixels"], pixels[first : first + len(seen)])
    assert len(np.unique(seen["pixels"])) > 50


def started(guest, one, count, out):
    command = [CLIENT, one.kind, str(count), str(TIMEOUT_S), guest.path_in_guest(out)]
    return guest.start(command, 2 * TIMEOUT_S)


def about(ended):
    """Return what the client printed of the camera; raises AssertionError when it printed nothing."""
    assert ended.stdout, ended
    return json.loads(ended.stdout.splitlines()[-1])


def delivered_and_seen(guest, folder, one):
    """Stream until the cable is pulled, then open again; assert that the events of the second stream are as delivered.

    Returns what was delivered, and the name of the client's files without their endings.
    """
    out = f"libcaer-{one}"
    with RunningRig(folder, text=one.rig) as rig:
        with Attachment(guest, rig.port, model=one.usb_id):
            job = started(guest, one, sys.maxsize, f"{out}-cut")
            wait_for_bytes(guest.results / f"{out}-cut.events", TIMEOUT_S)
        cut = about(job.wait())
        with Attachment(guest, rig.port, model=one.usb_id):
            ended = started(guest, one, EVENTS, out).wait()
    assert cut["running"] is False
    assert cut["events"] > 0
    assert ended.ok, ended
    assert about(ended)["firmware"] == one.firmware
    assert about(ended)["running"] is True
    seen = np.fromfile(guest.results / f"{out}.events", EVENT)
    assert len(seen) >= EVENTS
    delivered = rig.delivered
    assert_same(seen, delivered.last, offset_us=0)
    return delivered, guest.results / out


@pytest.mark.long
@pytest.mark.shows(
    "{one.model}", "libcaer", "opens", "events", "frames", "imu", "triggers", "unplugged", "plugged again"
)
@pytest.mark.parametrize("one", [DAVIS_240C], ids=str)
def test_libcaer_sees_every_stream_and_frame_as_it_was_delivered(guest, tmp_path, one):
    delivered, out = delivered_and_seen(guest, tmp_path, one)
    assert_same_edges(seen_edges(out.with_suffix(".triggers")), delivered)
    assert_same_samples(np.fromfile(out.with_suffix(".imu"), SAMPLE), delivered)
    assert_same_frames(out.with_suffix(".frames"), delivered)


@pytest.mark.sampled
@pytest.mark.shows("{one.model}", "libcaer", "opens", "events", "imu", "triggers", "unplugged", "plugged again")
@pytest.mark.parametrize("one", [DAVIS, FX3], ids=str)
def test_libcaer_sees_every_stream_as_it_was_delivered(guest, tmp_path, one):
    delivered, out = delivered_and_seen(guest, tmp_path, one)
    assert_same_edges(seen_edges(out.with_suffix(".triggers")), delivered)
    assert_same_samples(np.fromfile(out.with_suffix(".imu"), SAMPLE), delivered)


@pytest.mark.long
@pytest.mark.shows("dvxplorer_micro_firmware9", "libcaer", "opens", "events", "unplugged", "plugged again")
def test_libcaer_sees_every_event_of_a_micro(guest, tmp_path):
    delivered_and_seen(guest, tmp_path, CX3)
