"""The way from light to decoded events over each link that has a receiver here, a recording, the live page, a mistake.

`make smoke` runs it, in a minute: whole programs as a user starts them, on loopback addresses.
"""

import json
import re
import signal
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import numpy as np
import pytest

import evstim
from tests.free_ports import free_port
from transports.recording.record import load_record

pytestmark = [pytest.mark.system, pytest.mark.socket]

RIG = """
[scene]
kind = "checkerboard"
square_px = 40.0
speed_px_s = 4.0
[camera]
model = "{model}"
[run]
seed = 1
step_us = 16000
max_late_ms = 0
[[links]]
kind = "{kind}"
name = "link"
{more}
"""
EVENTS = 2000
WAIT_S = 300.0

LINKS = {
    "usbip": ("davis346", "port = 0", ["--usbip", "{address}"]),
    "gige": ("triton2", 'host = "127.0.0.9"', ["gige", "127.0.0.9"]),
    "serial": ("davis346", 'port = "pty"\nbaud = 3_000_000', ["serial", "{address}", "--start"]),
    "udp_packets": (
        "davis346",
        "port = {port}\ncommand_port = {other}",
        ["udp", "127.0.0.1:{port}", "--camera", "127.0.0.1:{other}", "--start"],
    ),
    "can": ("davis346", 'interface = "served"\nport = {port}\nchannel = "can0"\nbitrate = 1_000_000', ["can", "{rig}"]),
}


def evstim_process(*arguments, **options):
    """Start `evstim` with these arguments."""
    return subprocess.Popen([sys.executable, "-m", "evstim", *map(str, arguments)], text=True, **options)


def wait_for(condition, process):
    """Return the first value of the condition that is true; fail when the process has ended."""
    deadline_s = time.monotonic() + WAIT_S
    while not (value := condition()):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline_s
        time.sleep(0.05)
    return value


@pytest.mark.sampled
@pytest.mark.parametrize("kind", LINKS)
def test_events_are_received_as_they_were_sent(kind, tmp_path):
    model, more, listen = LINKS[kind]
    ports = {"port": free_port(), "other": free_port()}
    rig, ready, sent, received = (tmp_path / name for name in ("rig.toml", "ready.json", "sent.npz", "received.npz"))
    rig.write_text(RIG.format(model=model, kind=kind, more=more.format(**ports)))
    options = ["--seconds", 0, "--ready-file", ready, "--record", sent, "--json"]
    run = evstim_process("run", rig, *options, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    try:
        address = json.loads(wait_for(lambda: ready.exists() and ready.read_text(), run))["links"]["link"]
        words = [word.format(address=address, rig=rig, **ports) for word in listen]
        reader = evstim_process("listen", *words, "--events", EVENTS, "--record", received, stdout=subprocess.DEVNULL)
        assert reader.wait(WAIT_S) == 0
        run.send_signal(signal.SIGINT)
        stdout, stderr = run.communicate(timeout=WAIT_S)
    finally:
        if run.poll() is None:
            run.kill()
            run.communicate()
    summary = json.loads(stdout.splitlines()[-1])
    assert (run.returncode, summary["balanced"]) == (0, True), stderr
    arrived, (delivered, resets) = load_record(received)[0], load_record(sent)
    assert len(arrived) >= EVENTS
    delivered = delivered[resets[-1] :] if resets else delivered
    (first,) = np.flatnonzero(delivered == arrived[0])
    assert np.array_equal(arrived, delivered[first : first + len(arrived)])


@pytest.mark.long
def test_a_recording_is_read_back(tmp_path):
    rig, file = tmp_path / "rig.toml", tmp_path / "events.raw"
    rig.write_text(RIG.format(model="evk4", kind="loopback", more=""))
    assert evstim_process("record", rig, file, "--seconds", "0.1").wait(WAIT_S) == 0
    assert "1280 x 720" in evstim_process("info", file, stdout=subprocess.PIPE).communicate(timeout=WAIT_S)[0]
    assert len(evstim.read_events(file)) > EVENTS


@pytest.mark.long
def test_the_live_page_is_served(tmp_path):
    rig, log = tmp_path / "rig.toml", tmp_path / "log"
    rig.write_text(RIG.format(model="davis346", kind="loopback", more=""))
    with log.open("w") as stderr:
        run = evstim_process("run", rig, "--seconds", 0, "--serve", stdout=subprocess.DEVNULL, stderr=stderr)
    try:
        (url,) = wait_for(lambda: re.findall(r"http://[\w.:/?=-]+", log.read_text())[:1], run)
        with urllib.request.urlopen(url) as page:
            assert b"<title>" in page.read()
    finally:
        run.send_signal(signal.SIGINT)
        assert run.wait(WAIT_S) == 0, log.read_text()


def test_a_mistake_is_refused_with_its_line(tmp_path):
    rig = Path(tmp_path / "rig.toml")
    rig.write_text(RIG.format(model="davis346", kind="loopback", more="").replace("square_px", "sqare_px"))
    check = evstim_process("check", rig, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    output = check.communicate(timeout=WAIT_S)[0]
    assert check.returncode == 2
    assert "line 4" in output
    assert "square_px" in output
