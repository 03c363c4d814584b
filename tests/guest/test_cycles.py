"""Unmodified drivers open a camera again and again with all its streams on, and close it in the midst of them.

A hundred times each:

    export EVSTIM_GUEST_CYCLES=100 EVSTIM_OPENEB_CLIENT=BUILD/client
    EVSTIM_MATRIX=docs/device_matrix.json python -m pytest tests/guest/test_cycles.py

docs/matrix.md has how often each was opened.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.guest import test_dvxplorer, test_evk4, test_gen31, test_genx320
from tests.guest.all_streams import STREAMS, STREAMS_240C
from tests.guest.attachment import DAVIS_FX2, DVXPLORER, EVK4, Attachment
from tests.guest.environments import DRIVERS, Driver
from tests.guest.running_rig import CHECKERBOARD_240C, RunningRig
from tests.guest.streaming import wait_for_bytes
from tests.guest.turns import Turns, long_but, selected

CYCLES = int(os.environ.get("EVSTIM_GUEST_CYCLES", "3"))
SECONDS = float(os.environ.get("EVSTIM_GUEST_CYCLES_S", "inf"))
CYCLE_S = 60.0
LEAST_CYCLES = 3
PROGRAM = str(Path(__file__).parent / "clients" / "cycling.py")
DV2, DV1, ND = DRIVERS
OPENEB = os.environ.get("EVSTIM_OPENEB_CLIENT", "")
SILENCE = "start_delay_ms = 3000.0"
EVENTS_OF_A_CYCLE = 20_000
Record = Callable[[str, object], None]

pytestmark = [
    pytest.mark.guest,
    pytest.mark.socket,
    pytest.mark.timeout(3 * (CYCLES * CYCLE_S + 900)),  # the first test waits for all drivers
]


def record_cycles(cycles, seconds, record):
    """Assert that a run had enough cycles or no more time, and record them and their time."""
    assert cycles == CYCLES or (cycles >= LEAST_CYCLES and seconds >= SECONDS)
    record("amount", f"opened {cycles} times")
    record("seconds", round(seconds))


def cycle(guest, driver, python, cycles, *more):
    """Open and close the attached camera again and again by a driver's client; `more` are options of `cycling.py`."""
    guest.prepare(python, driver.imports)
    command = [str(python), PROGRAM, driver.name, str(cycles), str(CYCLE_S), "--seconds", str(SECONDS), *more]
    return guest.run(command, cycles * CYCLE_S + 300)


def assert_cycled(ended, record):
    """Assert that the cycles were done, with as many open files after the last one as after the first; record them."""
    assert ended.ok, ended
    told = json.loads(ended.stdout.splitlines()[-1])
    record_cycles(told["cycles"], told["seconds"], record)
    assert told["files"][0] == told["files"][1]


@pytest.fixture(scope="module")
def cycled(request, guest, driver_pythons, tmp_path_factory):
    rig = RunningRig(tmp_path_factory.mktemp("cycles"), more=STREAMS)

    def take(driver):
        with Attachment(guest, rig.port):
            return cycle(guest, driver, driver_pythons[driver.name], CYCLES)

    return Turns(rig, selected(request, "driver"), take)


@pytest.mark.long
@pytest.mark.shows("davis346", "{driver.name}", "cycles")
@pytest.mark.parametrize("driver", DRIVERS, ids=lambda driver: driver.name)
def test_it_is_closed_in_the_midst_of_all_streams_again_and_again(cycled, driver, record_property):
    assert_cycled(cycled.result(driver), record_property)


def starting_sooner(rig):
    """Return a rig whose camera sends sooner: these tests do not compare the first events, which may be reordered."""
    assert rig.count(SILENCE) == 1
    return rig.replace(SILENCE, "start_delay_ms = 500.0")


@dataclass(frozen=True)
class Reopened:
    """A camera that a driver's client opens again and again: its rig, its place on the bus, and its streams.

    Attributes
    ----------
    model
        Key of docs/device_matrix.py.
    driver
        Its client.
    device
        The camera by neuromorphic_drivers' name.
    streams
        Those to wait for in each cycle.
    """

    model: str
    driver: Driver
    device: str
    streams: str

    def __str__(self):
        return f"{self.model}-{self.driver.name}"

    @property
    def usb_id(self):
        return DAVIS_FX2 if self.model == "davis240c" else EVK4 if "evk" in self.model else DVXPLORER

    def rig(self, folder):
        """Return the rig, after the recording that it plays was saved."""
        if self.model == "davis240c":
            return CHECKERBOARD_240C + STREAMS_240C
        if self.model == "dvxplorer":
            return starting_sooner(test_dvxplorer.RIG)
        if self.model == "dvxplorer_micro":
            return starting_sooner(test_dvxplorer.MICRO)
        test_evk4.looped(folder)
        return starting_sooner(test_evk4.rig_of(self.model))


REOPENED = (
    Reopened("dvxplorer", ND, "inivation_dvxplorer", "events,triggers,imu"),
    Reopened("evk4", ND, "prophesee_evk4", "events"),
    Reopened("dvxplorer", DV2, "", "events,triggers,imu"),
    Reopened("dvxplorer", DV1, "", "events,triggers,imu"),
    Reopened("dvxplorer_micro", DV2, "", "events,imu"),
    Reopened("evk3_hd", ND, "prophesee_evk3_hd", "events"),
    Reopened("davis240c", DV2, "", "events,triggers,imu,frames"),
    Reopened("davis240c", DV1, "", "events,triggers,imu,frames"),
)


@pytest.mark.long
@pytest.mark.shows("{one.model}", "{one.driver.name}", "cycles")
@pytest.mark.parametrize("one", REOPENED, ids=str)
def test_another_camera_is_closed_in_the_midst_of_its_streams_again_and_again(
    guest, driver_pythons, tmp_path, one, record_property
):
    with RunningRig(tmp_path, text=one.rig(tmp_path)) as rig, Attachment(guest, rig.port, model=one.usb_id):
        more = ("--streams", one.streams, *(("--device", one.device) if one.driver is ND else ()))
        ended = cycle(guest, one.driver, driver_pythons[one.driver.name], CYCLES, *more)
    assert_cycled(ended, record_property)


SIZES = {"evk4": test_evk4.HD, "evk3_vga": test_gen31.VGA, "genx320": test_genx320.SIZE}


def openeb_rig(folder, model):
    """Return a rig of OpenEB's tests, after the recording that it plays was saved."""
    test_evk4.looped(folder, SIZES[model])
    return starting_sooner(test_evk4.rig_of(model))


def opened_once(guest):
    """Return how many events a process of OpenEB saw; its HAL keeps a camera open as long as the process lives."""
    command = [OPENEB, str(EVENTS_OF_A_CYCLE), str(CYCLE_S), guest.path_in_guest("cycle.bin")]
    return json.loads(guest.check(command, 2 * CYCLE_S).splitlines()[-1])["events"]


@pytest.mark.shows("{model}", "openeb", "cycles")
@test_evk4.needs_openeb
@pytest.mark.parametrize("model", long_but(["evk4", "genx320"], ["evk4", "evk3_vga", "genx320"]))
def test_openeb_opens_a_camera_again_and_again(guest, tmp_path, model, record_property):
    with RunningRig(tmp_path, text=openeb_rig(tmp_path, model)) as rig, Attachment(guest, rig.port, model=EVK4):
        started_s = time.monotonic()
        seen = []
        while len(seen) < CYCLES and time.monotonic() - started_s < SECONDS:
            seen.append(opened_once(guest))
    record_cycles(len(seen), time.monotonic() - started_s, record_property)
    assert min(seen) >= EVENTS_OF_A_CYCLE, seen


@pytest.mark.shows("{model}", "openeb", "unplugged", "plugged again")
@test_evk4.needs_openeb
@pytest.mark.parametrize("model", long_but(["evk4", "genx320"], ["evk4", "evk3_vga", "genx320"]))
def test_openeb_reports_a_pulled_cable_and_opens_the_camera_again(guest, tmp_path, model):
    seen = guest.results / f"cut-{model}.bin"
    with RunningRig(tmp_path, text=openeb_rig(tmp_path, model)) as rig:
        with Attachment(guest, rig.port, model=EVK4):
            command = [OPENEB, str(sys.maxsize), str(CYCLE_S), guest.path_in_guest(seen.name)]
            job = guest.start(command, 3 * CYCLE_S)
            wait_for_bytes(seen, CYCLE_S)
        cut = job.wait()
        with Attachment(guest, rig.port, model=EVK4):
            again = opened_once(guest)
    assert cut.code == 1
    assert "LIBUSB_ERROR_NO_DEVICE" in cut.stderr
    assert again >= EVENTS_OF_A_CYCLE
