"""`evstim listen` on a real USB bus: pyusb and libusb in the guest's kernel, no driver of anybody."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from tests.guest.attachment import Attachment
from tests.guest.comparison import assert_same
from tests.guest.machine import Guest
from tests.guest.running_rig import RunningRig
from transports.recording.record import load_record

pytestmark = [pytest.mark.guest, pytest.mark.long, pytest.mark.socket, pytest.mark.timeout(1200)]

EVENTS = 200_000
EVSTIM = [sys.executable, "-c", "from emulator.cli import main; main()"]
TIMEOUT_S = 300.0


def listen(guest: Guest, *arguments: str) -> dict[str, object]:
    said = guest.run([*EVSTIM, "listen", *arguments, "--json"], TIMEOUT_S)
    told: dict[str, object] = json.loads(said.stdout.splitlines()[-1])
    return told


def test_it_reads_every_event_that_was_delivered(guest: Guest, tmp_path: Path) -> None:
    with RunningRig(tmp_path) as rig, Attachment(guest, rig.port):
        told = listen(guest, "--events", str(EVENTS), "--record", guest.path_in_guest("listen.npz"))
    assert "error" not in told
    seen, _ = load_record(guest.results / "listen.npz")
    delivered = rig.delivered
    assert told["faults"] == 0
    assert told["events"] == len(seen) >= EVENTS
    assert_same(seen, delivered.last, offset_us=0)


def test_without_a_camera_it_says_what_to_do(guest: Guest) -> None:
    told = listen(guest)
    assert told["exit_code"] == 3
    assert "usbip attach" in str(told["error"])
