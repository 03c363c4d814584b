"""A sensor on the guest's V4L2 that is not there: v4l2-ctl and OpenEB, unmodified, set it and read every event.

Short by default; at length:

    export EVSTIM_V4L2_EVENTS=1e7 EVSTIM_V4L2_MESSAGES=1e6 EVSTIM_OPENEB_CLIENT=BUILD/client
    python -m pytest tests/guest/test_v4l2.py
"""

import json
import os
import re
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

import firmware_protocol.c
from firmware_protocol.events import EVENT
from firmware_protocol.evt.evt2 import Evt2Decoder
from firmware_protocol.evt.evt3 import Evt3Decoder
from tests.guest.comparison import assert_same
from tests.guest.conftest import cannot
from tests.guest.image import GuestUnavailable
from tests.guest.kernel_module import built_module
from tests.guest.machine import CACHE, HOST_ADDRESS
from tests.guest.running_rig import RunningRig
from tests.guest.test_evk4 import needs_openeb, rig_of
from tests.hostile.looped import Looped

EVENTS = round(float(os.environ.get("EVSTIM_V4L2_EVENTS", "3e4")))
GAP_US = 16
"""Between events: OpenEB drops a buffer where 28 wait for its decoder, which is slow in the guest."""
TIMEOUT_S = 240.0 + 4.0 * EVENTS * GAP_US * 1e-6
OPENEB = os.environ.get("EVSTIM_OPENEB_CLIENT", "")
SIZES = {"evk4": (1280, 720), "genx320": (320, 320)}
VIDEO, SUBDEVICE = "/dev/video0", "/dev/v4l-subdev0"
BUFFERS = 40
ROOT = Path(__file__).parents[2]
WORDS = str(Path(__file__).with_name("clients") / "v4l2_words.py")
EVSTIM = str(Path(__file__).with_name("clients") / "evstim_program.py")
IMPORTED = ["emulator.cli.app", "emulator.cli.v4l2", "firmware_protocol.genx320.registers"]
MESSAGES = round(float(os.environ.get("EVSTIM_V4L2_MESSAGES", "3e3")))
MESSAGES_S = 240.0 + 5e-3 * MESSAGES
KILLS = max(1, MESSAGES // 50_000)

pytestmark = [pytest.mark.guest, pytest.mark.socket, pytest.mark.timeout(2 * TIMEOUT_S + MESSAGES_S + 1200)]


@pytest.fixture(scope="module")
def module(guest):
    """The kernel module in the guest, which reports no error of its own until it is removed again."""
    try:
        built = built_module(firmware_protocol.c.FOLDER / "v4l2", guest.kernel, CACHE)
    except GuestUnavailable as reason:
        cannot(reason)
        raise
    for name in ("videodev", "videobuf2-v4l2", "videobuf2-vmalloc"):
        guest.load(name)
    guest.check(["insmod", str(built)])
    guest.prepare(Path(sys.executable), IMPORTED, str(ROOT))
    yield
    guest.check(["rmmod", "evstim_v4l2"])
    assert not re.search(r"WARNING:|BUG:|Oops", guest.check(["dmesg"]))


@contextmanager
def words(guest, name):
    """A sensor that a small program feeds, until the block ends."""
    pid = guest.path_in_guest("words.pid")
    guest.start([sys.executable, WORDS, name, pid], TIMEOUT_S)
    wait_for(guest, f"[ -e {SUBDEVICE} ]")
    try:
        yield
    finally:
        guest.check(["sh", "-c", f"kill -KILL $(cat {pid})"])
        wait_for(guest, f"[ ! -e {SUBDEVICE} ]")


@pytest.mark.parametrize("name", ["imx636", pytest.param("genx320", marks=pytest.mark.long)])
def test_v4l2_compliance_finds_no_fault(guest, module, name):
    """The checker of V4L2's own developers: of the topology, of both devices, and of streams."""
    with words(guest, name):
        for arguments in (["-m", "/dev/media0"], ["-d", VIDEO, "-s", "5"]):
            report = guest.check(["v4l2-compliance", *arguments], TIMEOUT_S)
            totals = [line for line in report.splitlines() if line.startswith(("Total", "Grand Total"))]
            assert totals
            assert all(line.endswith("Failed: 0, Warnings: 0") for line in totals), report


@pytest.mark.long
def test_a_program_that_is_killed_amid_a_stream_leaves_nothing(guest, module):
    for number in range(KILLS):
        out = guest.path_in_guest(f"v4l2-killed-{number}.raw")
        with words(guest, "genx320"):
            client = guest.start(["v4l2-ctl", "-d", VIDEO, "--stream-mmap", "--stream-to", out], TIMEOUT_S)
            wait_for(guest, f"[ -s {out} ]")
        ended = client.wait()  # the device is gone: no client waits for ever
        assert ended.code is not None


def test_the_module_survives_any_messages(guest, module):
    told = guest.check([sys.executable, WORDS, "imx636", str(MESSAGES)], MESSAGES_S)
    assert MESSAGES // 20 < int(told) < MESSAGES  # some are valid, some are refused
    with words(guest, "imx636"):
        assert "bias_diff_on" in guest.check(["v4l2-ctl", "-d", SUBDEVICE, "-l"])


@contextmanager
def sensor(guest, tmp_path, model):
    """A rig whose camera is a sensor in the guest; the camera's own record is there afterwards."""
    Looped(1_000_000, GAP_US, SIZES[model]).save(tmp_path / "looped.npz")
    with RunningRig(tmp_path, text=rig_of(model).replace("step_us = 1000\n", "step_us = 10000\n")) as rig:
        pid, camera = guest.path_in_guest("evstim.pid"), f"{HOST_ADDRESS}:{rig.port}"
        node = guest.start([sys.executable, EVSTIM, pid, "v4l2", "--usbip", camera, "--json"], 4 * TIMEOUT_S)
        try:
            wait_for(guest, f"[ -e {SUBDEVICE} ]")
            yield rig
        finally:
            guest.check(["sh", "-c", f"kill -INT $(cat {pid})"])
        ended = node.wait()
        assert ended.code == 0, ended
        rig.forwarded = json.loads(ended.stdout.splitlines()[-1])
        assert not guest.run(["test", "-e", VIDEO]).ok


def wait_for(guest, condition, within_s=240.0):
    """Wait until a condition of the shell holds: a program of the guest waits, without a connection for each look."""
    looks = f"for i in $(seq {2 * within_s:.0f}); do {condition} && exit 0; sleep 0.5; done; exit 1"
    guest.check(["sh", "-c", looks], 2 * within_s)


@pytest.mark.shows("{model}_v4l2", "v4l2ctl", "opens", "events", "settings")
@pytest.mark.parametrize(
    ("model", "letters"),
    [
        ("genx320", "PSE2"),
        pytest.param("genx320", "PSEE", marks=pytest.mark.long),
        pytest.param("evk4", "PSE3", marks=pytest.mark.long),
    ],
)
def test_v4l2_ctl_sets_a_sensor_and_reads_every_event(guest, module, tmp_path, model, letters):
    """Its list of controls, a format, a bias, rate control, and the words of its buffers."""
    out = f"v4l2-{model}-{letters}.raw"
    with sensor(guest, tmp_path, model) as rig:
        listed = guest.check(["v4l2-ctl", "-d", SUBDEVICE, "-l"])
        initial = int(re.search(r"bias_diff_on .*value=(\d+)", listed)[1])
        guest.check(["v4l2-ctl", "-d", SUBDEVICE, "-c", f"bias_diff_on={initial + 5}"])
        guest.check(["v4l2-ctl", "-d", SUBDEVICE, "-c", "erc_rate=20000", "-c", "erc_enable=1"])
        assert guest.check(["v4l2-ctl", "-d", SUBDEVICE, "-C", "bias_diff_on"]).split()[-1] == str(initial + 5)
        refused = guest.run(["v4l2-ctl", "-d", SUBDEVICE, "-c", "bias_diff_on=1000"])
        assert refused.code or str(initial + 5) not in guest.check(["v4l2-ctl", "-d", SUBDEVICE, "-C", "bias_diff_on"])
        guest.check(["v4l2-ctl", "-d", VIDEO, "-v", f"pixelformat={letters}"])
        stream = ["--stream-mmap=8", f"--stream-count={BUFFERS}", "--stream-to", guest.path_in_guest(out)]
        guest.check(["v4l2-ctl", "-d", VIDEO, *stream], TIMEOUT_S)
    words = (guest.results / out).read_bytes()
    decoder = {"PSE3": Evt3Decoder, "PSE2": lambda: Evt2Decoder("evt21"), "PSEE": lambda: Evt2Decoder("evt2")}[
        letters
    ]()
    seen, _ = decoder.decode(words)
    assert len(seen) >= 1000
    assert_same(seen, rig.delivered.last, offset_us=0)
    period_us, most = (200, 4) if model == "evk4" else (100, 2)
    assert np.bincount(seen["t"].astype(np.int64) // period_us).max() == most
    assert rig.forwarded["streams"] == 1


@needs_openeb
@pytest.mark.shows("{model}_v4l2", "openeb_v4l2", "opens", "events", "settings")
@pytest.mark.parametrize(
    ("model", "letters"),
    [("genx320", "PSE3"), ("genx320", "PSE2"), ("genx320", "PSEE"), ("evk4", "PSE3"), ("evk4", "PSE1")],
)
def test_openeb_opens_a_sensor_and_sees_every_event(guest, module, tmp_path, record_property, model, letters):
    """Its discovery on V4L2, bias, window and rate control, changed while they stream, its stream and its decoder."""
    out, client = f"openeb-v4l2-{model}-{letters}.bin", str(Path(OPENEB).with_name("v4l2_client"))
    with sensor(guest, tmp_path, model) as rig:
        guest.check(["v4l2-ctl", "-d", VIDEO, "-v", f"pixelformat={letters}"])
        command = [client, str(EVENTS), str(TIMEOUT_S), guest.path_in_guest(out)]
        begun_s = time.monotonic()
        about = json.loads(guest.check(command, 2 * TIMEOUT_S).splitlines()[-1])
        seconds = time.monotonic() - begun_s
    name = {"PSE3": "EVT3", "PSEE": "EVT2"}.get(letters, "EVT21")
    assert (about["serial"], about["integrator"]) == ("0BADCAFE", "evstim")
    assert about["sensor"] == {"evk4": "IMX636", "genx320": "GenX320"}[model]
    assert about["format"].startswith(name)
    assert about["bias_after"] == about["bias_before"] + 5
    assert about["is_limited"] is True
    seen = np.fromfile(guest.results / out, EVENT)
    assert len(seen) >= EVENTS
    assert_same(seen, rig.delivered.last, offset_us=0)
    record_property("amount", f"{len(seen)} events")
    record_property("seconds", round(seconds))
    width, height = SIZES[model]
    assert (seen["x"].min(), seen["x"].max()) == (10, width - 11)
    assert (seen["y"].min(), seen["y"].max()) == (20, height - 21)
    period_us, most = (200, 4) if model == "evk4" else (100, 2)
    late = seen[seen["t"] > seen["t"][-1] - 500_000]
    assert (late["x"].min(), late["x"].max(), late["y"].min(), late["y"].max()) == (
        20,
        19 + width // 2,
        30,
        29 + height // 2,
    )
    assert np.bincount(late["t"].astype(np.int64) // period_us).max() == most
