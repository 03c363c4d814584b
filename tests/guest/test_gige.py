"""neuromorphic_drivers, unmodified, reads a GigE Vision camera on this machine: no guest, no kernel module, no root.

The driver starts only where libusb finds a USB. On a machine without one it gets an empty one, in a mount namespace of
its own. More events, larger packets and more openings than in CI:

    EVSTIM_GIGE_EVENTS=1e7 EVSTIM_GIGE_OPENINGS=100 python -m pytest tests/guest/test_gige.py
    EVSTIM_GIGE_EVENTS=6e7 EVSTIM_GIGE_GAP_US=0.025 python -m pytest -s -k exact tests/guest/test_gige.py  # 40 Mev/s
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.guest.comparison import assert_same, load_seen
from tests.guest.gige_run import HD
from tests.hostile.looped import Looped

EVENTS = int(float(os.environ.get("EVSTIM_GIGE_EVENTS", "1e6")))
OPENINGS = int(os.environ.get("EVSTIM_GIGE_OPENINGS", "5"))
GAP_US = float(os.environ.get("EVSTIM_GIGE_GAP_US", "2"))
OF_TIME = {"in real time", "steps in time"}  # rules that a busy machine breaks
CLIENT = Path(__file__).with_name("clients") / "nd_gige.py"
EMPTY_USB = (
    "mount -t tmpfs none /sys && mount -t tmpfs none /run && mkdir -p /run/usb /dev/bus/usb && touch /run/usb/none && "
    'mount --bind /run/usb /dev/bus/usb && exec "$@"'
)

pytestmark = [pytest.mark.guest, pytest.mark.socket]


def where_libusb_starts():
    """Return what prefixes a command so that libusb finds a USB, an empty one where this machine has none."""
    if Path("/sys/bus/usb/devices").is_dir() and Path("/dev/bus/usb").is_dir():
        return []
    prefix = ["unshare", "--mount", "sh", "-c", EMPTY_USB, "sh"]
    tried = subprocess.run([*prefix, "true"], capture_output=True, text=True)
    if tried.returncode != 0:
        pytest.skip(f"libusb finds no USB here, and an empty one cannot be mounted: {tried.stderr.strip()}")
    return prefix


@pytest.fixture
def run(address, start_gige):
    looped = Looped(1_000_000, 1, HD)
    looped.events["t"] = np.sort(np.random.default_rng(3).integers(0, round(1e6 * GAP_US), 1_000_000))
    return start_gige(f'host = "{address}"\nmbit_s = 20000\n', looped=looped)


def _read(python, address, count, octets, out, openings=1):
    arguments = [str(one) for one in (python, CLIENT, address, count, octets, out, openings)]
    done = subprocess.run([*where_libusb_starts(), *arguments], capture_output=True, text=True, timeout=800)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.sampled
@pytest.mark.shows("triton2", "nd", "opens", "events")
@pytest.mark.parametrize("octets", [1400, 9000])
def test_every_event_is_exact(tmp_path, run, address, driver_pythons, octets):
    told = _read(driver_pythons["nd"], address, EVENTS, octets, tmp_path / "seen.npz")
    _, delivered = run.stop()
    assert told["seen"] >= EVENTS, told
    sys.stdout.write(f"{told['seen']} events, {octets} octets: {told['seen'] / told['read_s'] / 1e6:.1f} Mev/s\n")
    assert_same(load_seen(tmp_path / "seen.npz"), delivered, offset_us=0)
    assert (told["dropped"], told["celsius"]) == (0, 35.0)


def test_the_demo_shows_the_driver_reading_every_event(tmp_path):
    """As `make demo` does it, with the driver in evstim's own environment."""
    options = ["--seconds", "2", "--report", str(tmp_path), "--json"]
    command = [sys.executable, "-m", "evstim", "demo", "stars-gige", *options]
    done = subprocess.run([*where_libusb_starts(), *command], capture_output=True, text=True, timeout=300)
    told = json.loads(done.stdout.splitlines()[-1])
    broken = {one["rule"] for one in told["rules"] if not one["good"]}
    assert broken <= OF_TIME, done.stderr
    assert done.returncode == (1 if broken else 0), done.stderr
    assert "neuromorphic_drivers, unmodified, attaches to it" in " ".join(done.stderr.split())
    comparison = told["comparison"]
    assert comparison["equal"] is True
    assert comparison["received"] > 1000


@pytest.mark.shows("triton2", "nd", "cycles")
def test_the_camera_can_be_opened_again_and_again(tmp_path, run, address, driver_pythons):
    told = _read(driver_pythons["nd"], address, 20_000, 1400, tmp_path / "seen.npz", OPENINGS)
    _, delivered = run.stop()
    assert told["openings"] == OPENINGS
    assert_same(load_seen(tmp_path / "seen.npz"), delivered, offset_us=0)
