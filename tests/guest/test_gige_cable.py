"""A GigE Vision camera and its hosts on two ends of a cable: two networks of the test's own, joined by a veth pair."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from tests.guest.gige_run import HD, LOSS
from tests.guest.own_network import CAMERA, HOST
from tests.hostile.looped import Looped

EVENTS = 300_000
LINK = f'host = "{CAMERA}"\nallow = ["{HOST}"]\n'
LISTEN = [sys.executable, "-c", "from emulator.cli import main; main()", "listen", "gige", CAMERA, "--json"]

pytestmark = [pytest.mark.guest, pytest.mark.socket]


@pytest.fixture
def start(ends, start_gige):
    return lambda more="": start_gige(LINK + more, looped=Looped(500_000, 4, HD), inside=ends[0].inside)


def _listen(host, packet_size):
    command = host.inside(*LISTEN, "--packet-size", str(packet_size), "--events", str(EVENTS))
    done = subprocess.run(command, capture_output=True, text=True, timeout=500)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def test_a_host_finds_the_camera_by_broadcast(ends, start):
    start()
    found = subprocess.run(ends[1].inside("arv-tool-0.8"), capture_output=True, text=True, timeout=60)
    assert f"Lucid Vision Labs-TRT009S-E-00000346 ({CAMERA})" in found.stdout


@pytest.mark.sampled
@pytest.mark.parametrize("packet_size", [1400, 8996])
def test_every_event_crosses_the_cable(ends, start, packet_size):
    camera = start()
    told = _listen(ends[1], packet_size)
    _, delivered = camera.stop()
    assert told["events"] >= EVENTS
    assert (told["blocks_lost"], told["events"], told["last_t_us"]) == (0, len(delivered), int(delivered["t"][-1]))


def test_what_a_bad_cable_loses_is_sent_again(ends, start):
    camera = start(LOSS)
    told = _listen(ends[1], 1400)
    summary, delivered = camera.stop()
    assert told["packets_requested"] > 10
    late = summary["links"]["gige"]["faults"][0]["events_lost"]  # healed, but after the camera had given them up
    assert told["blocks_lost"] == 0
    assert len(delivered) <= told["events"] <= len(delivered) + late


@pytest.mark.long
def test_packets_that_the_cable_does_not_carry_are_counted(ends, start):
    ends[0].run("ip", "link", "set", "cable", "mtu", "1500")
    camera = start()
    command = ends[1].inside(*LISTEN, "--packet-size", "9000", "--seconds", "3")
    subprocess.run(command, capture_output=True, text=True, timeout=500)
    summary, _ = camera.stop()
    assert summary["events"]["links"]["gige"]["dropped"] > 0
    assert summary["links"]["gige"]["counts"]["packets that could not be sent"] > 0
