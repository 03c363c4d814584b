"""Aravis and viva-genicam, unmodified, find the GigE Vision camera by broadcast, read its features and its stream.

Both run with the camera in a network of their own, so that no search leaves it.
"""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest

from firmware_protocol.evt.evt3 import Evt3Decoder
from firmware_protocol.imx636.triton2_registers import PERIOD_US
from tests.guest.comparison import assert_same
from tests.guest.conftest import cannot
from tests.guest.environments import Driver
from tests.guest.gige_run import LOSS
from tests.guest.image import GuestUnavailable
from tests.guest.machine import CACHE
from tests.guest.own_network import OwnNetwork

CLIENTS = Path(__file__).with_name("clients")
OCTETS = 1_000_000
LIMIT = 5  # events a period that the rate control lets by, of 20 on average
VIVA = Driver("viva", ("viva-genicam==0.10.0", "numpy"), adds_host_time=False)
KEYS = "block_us = 10000\n"  # viva-genicam's queue loses small blocks that come fast

pytestmark = [pytest.mark.guest, pytest.mark.socket]


@pytest.fixture
def network():
    with OwnNetwork() as network:
        yield network


@pytest.fixture
def camera(network, start_gige, request):
    return start_gige(KEYS + getattr(request, "param", ""), inside=network.inside)


def _run(network, *command):
    done = subprocess.run(network.inside(*map(str, command)), capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    return done.stdout


def _decoded(path):
    events, _ = Evt3Decoder().decode(path.read_bytes())
    return events


@pytest.mark.shows("triton2", "aravis", "opens", "events")
def test_aravis_finds_reads_and_writes(network, camera, tmp_path):
    assert "Lucid Vision Labs-TRT009S-E-00000346 (127.0.0.1)" in _run(network, "arv-tool-0.8")
    seen = tmp_path / "seen"
    told = json.loads(_run(network, "/usr/bin/python3", CLIENTS / "aravis_gige.py", "127.0.0.1", OCTETS, seen))
    assert (told["model"], told["bias"], told["celsius"], told["format"]) == ("TRT009S-E", 30, 35.0, "EVT3_0")
    assert told["time_ns"] > 0
    assert (told["bad"], told["octets"] >= OCTETS) == (0, True), told
    _, delivered = camera.stop()
    assert_same(_decoded(seen), delivered, offset_us=0)


@pytest.mark.long
def test_the_rate_control_that_aravis_sets_acts(network, camera, tmp_path):
    for feature in (f"ErcEventsPerPeriod={LIMIT}", "ErcEnable=true"):
        _run(network, "arv-tool-0.8", "-n", "127.0.0.1", "control", feature)
    seen = tmp_path / "seen"
    _run(network, "/usr/bin/python3", CLIENTS / "aravis_gige.py", "127.0.0.1", OCTETS // 10, seen)
    _, delivered = camera.stop()
    events = _decoded(seen)
    assert_same(events, delivered, offset_us=0)
    counts = np.bincount(events["t"].astype(np.int64) // PERIOD_US)
    assert (counts.max(), np.median(counts[counts > 0])) == (LIMIT, LIMIT)


@pytest.mark.long
@pytest.mark.parametrize("camera", [LOSS], indirect=True)
def test_aravis_has_lost_packets_sent_again(network, camera, tmp_path):
    seen = tmp_path / "seen"
    told = json.loads(_run(network, "/usr/bin/python3", CLIENTS / "aravis_gige.py", "127.0.0.1", OCTETS, seen))
    _, delivered = camera.stop()
    assert told["resent"] > 2
    assert told["bad"] < told["resent"]  # it cannot have the trailer of a short block again
    events = _decoded(seen)
    if not told["bad"]:
        assert_same(events, delivered, offset_us=0)
    assert len(np.setdiff1d(events, delivered)) == 0


@pytest.mark.long  # the Aravis of this file shows the same in a fifth of the time
@pytest.mark.shows("triton2", "viva", "opens", "events", "triggers")
def test_viva_genicam_finds_reads_and_writes(network, camera, tmp_path):
    try:
        python = VIVA.python(CACHE)
    except GuestUnavailable as reason:
        cannot(reason)
        raise
    seen = tmp_path / "seen"
    told = json.loads(_run(network, python, CLIENTS / "viva_gige.py", OCTETS, seen))
    assert (told["found"], int(told["bias"]), told["format"]) == (["127.0.0.1"], 12, "EVT3_0")
    assert (told["incomplete"], told["lost"], told["octets"] >= OCTETS) == (0, 0, True), told
    _, delivered = camera.stop()
    events, edges = Evt3Decoder().decode(seen.read_bytes())
    assert_same(events, delivered, offset_us=0)
    first_ns = 1000 * int(edges["t"][0])
    with_data = {"data": "", "second": 0x9000, "second_data": "00000004"}
    assert told["edge"] == {"acks": 1, "event": 0x9000, "event_ns": first_ns, **with_data}
