"""A camera that changes its address while unmodified programs use it: they lose it, and find it at the new one."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.guest.comparison import assert_same, load_seen
from tests.guest.own_network import OwnNetwork
from tests.guest.test_gige import where_libusb_starts

CLIENTS = Path(__file__).with_name("clients")
EVENTS = 100_000
FOR_EVER = 1 << 40
AWAY_S = "0.2"

pytestmark = [pytest.mark.guest, pytest.mark.socket]


@pytest.fixture
def start(tmp_path, monkeypatch, start_gige):
    """Starts a run whose control socket is the test's own."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    return start_gige


def _move(address):
    asked = ["fault", "ip_change", "--set", f"address={address}", "--for-s", AWAY_S, "--json"]
    done = subprocess.run([sys.executable, "-m", "evstim", *asked], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])["fault"]


@pytest.mark.shows("triton2", "aravis", "plugged again")
def test_aravis_searches_and_finds_it_at_the_new_address(start):
    with OwnNetwork() as network:
        start(inside=network.inside)
        found = []
        for address in ("127.0.0.9", "127.0.0.1", None):
            done = subprocess.run(network.inside("arv-tool-0.8"), capture_output=True, text=True, timeout=60)
            found.append(done.stdout.strip().rpartition("(")[2])
            if address is not None:
                assert _move(address)["hits"] == 1
    assert found == ["127.0.0.1)", "127.0.0.9)", "127.0.0.1)"]


def _reader(python, address, count, out):
    arguments = [str(one) for one in (python, CLIENTS / "nd_gige.py", address, count, 1400, out)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen([*where_libusb_starts(), *arguments], **pipes)


@pytest.mark.long
@pytest.mark.shows("triton2", "nd", "unplugged", "plugged again")
def test_neuromorphic_drivers_loses_it_and_opens_it_again(tmp_path, address, start, driver_pythons):
    here, there = address, address.rpartition(".")[0] + ".253"
    run = start(f'host = "{here}"\n')
    with _reader(driver_pythons["nd"], here, EVENTS, tmp_path / "before.npz") as before:
        assert before.wait(200) == 0
    with _reader(driver_pythons["nd"], here, FOR_EVER, tmp_path / "never.npz") as cut:
        _wait_for_stream(tmp_path)
        assert _move(there)["hits"] == 1
        _, said = cut.communicate(timeout=200)
    assert cut.returncode != 0
    assert "RuntimeError" in said, said
    with _reader(driver_pythons["nd"], there, EVENTS, tmp_path / "seen.npz") as again:
        _, said = again.communicate(timeout=200)
    assert again.returncode == 0, said
    _, delivered = run.stop()
    assert_same(load_seen(tmp_path / "seen.npz"), delivered, offset_us=0)


def _wait_for_stream(folder):
    """Return when the camera streams to a host."""
    for _ in range(200):
        asked = [sys.executable, "-m", "evstim", "fault", "--json"]
        done = subprocess.run(asked, capture_output=True, text=True, timeout=60)
        if "streaming" in done.stdout:
            return
    raise AssertionError(f"no stream in {folder}")
