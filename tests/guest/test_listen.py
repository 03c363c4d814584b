"""`evstim listen` on a real USB bus: pyusb and libusb in the guest's kernel, no driver of anybody."""

import json
import sys

import pytest

from tests.guest.attachment import Attachment
from tests.guest.comparison import assert_same
from tests.guest.running_rig import RunningRig
from transports.recording.record import load_record

pytestmark = [pytest.mark.guest, pytest.mark.long, pytest.mark.socket, pytest.mark.timeout(1200)]

EVENTS = 200_000
EVSTIM = [sys.executable, "-c", "from emulator.cli import main; main()"]
TIMEOUT_S = 300.0


def listen(guest, *arguments):
    said = guest.run([*EVSTIM, "listen", *arguments, "--json"], TIMEOUT_S)
    return json.loads(said.stdout.splitlines()[-1])


def test_it_reads_every_event_that_was_delivered(guest, tmp_path):
    with RunningRig(tmp_path) as rig, Attachment(guest, rig.port):
        told = listen(guest, "--events", str(EVENTS), "--record", guest.path_in_guest("listen.npz"))
    assert "error" not in told
    seen, _ = load_record(guest.results / "listen.npz")
    delivered = rig.delivered
    assert told["faults"] == 0
    assert told["events"] == len(seen) >= EVENTS
    assert_same(seen, delivered.last, offset_us=0)


def test_without_a_camera_it_says_what_to_do(guest):
    told = listen(guest)
    assert told["exit_code"] == 3
    assert "usbip attach" in str(told["error"])
