"""What unmodified drivers make of faults on the cable and in the camera, and that the ledger knows what they got.

Short by default: faults that lose nothing meet each driver together, the others the driver whose answer tells most.
Each fault alone with each driver:

    EVSTIM_EVERY_FAULT=1 python -m pytest tests/guest/test_usb_faults.py
"""

import json
import os
from pathlib import Path

import numpy as np
import pytest

from emulator.run.control import send_request, sockets
from tests.guest.attachment import Attachment
from tests.guest.environments import DRIVERS
from tests.guest.running_rig import RunningRig
from tests.guest.streaming import Streaming
from tests.guest.turns import Turns, long_but, selected

pytestmark = [pytest.mark.guest, pytest.mark.socket, pytest.mark.timeout(3600)]  # the first test waits for all turns

EVENTS = 300_000  # a second of device time, longer than each fault
SECONDS = 120.0
STALE_EVENTS = 100
FAULTS = {
    "repeated_events": {"kind": "repeated_events", "count": 100},
    "empty_transfers": {"kind": "empty_transfers", "count": 3},
    "odd_bytes_missing": {"kind": "odd_bytes", "count": 3},
    "odd_bytes_extra": {"kind": "odd_bytes", "count": 3, "change": "extra"},
    "missed_wraps": {"kind": "missed_wraps"},
    "time_ahead": {"kind": "time_ahead"},
    "time_frozen": {"kind": "time_frozen", "for_s": 0.2},
    "time_back": {"kind": "time_back", "for_s": 0.2},
    "usb_stall": {"kind": "usb_stall"},
    "fifo_overflow": {"kind": "fifo_overflow", "events": 1000},
    "register_flip": {"kind": "register_flip", "parameter": 61},  # all events become OFF
    "stale_data": {"kind": "stale_data", "events": STALE_EVENTS},
}
AT_NEXT_START = {"stale_data"}
EXACT = ("repeated_events", "empty_transfers", "fifo_overflow", "register_flip")  # of what left the camera all was seen
ENDS = {("dv2", "missed_wraps"), ("dv2", "time_back"), *((driver.name, "usb_stall") for driver in DRIVERS)}
# It takes an odd byte for a word, with what happens to lie behind it: an event, another time, the end of the stream.
UNSETTLED = {("dv2", "odd_bytes_missing"), ("dv2", "odd_bytes_extra")}


def outcome(driver, seen, delivered, fault):
    """What a driver saw beside what a sound receiver must have seen."""
    if not len(seen.events):
        return {"seen": 0, "running": seen.about.get("running")}
    events = seen.events.copy()
    if driver.adds_host_time:
        events["t"] -= np.uint64(int(events["t"][0]) - int(delivered["t"][0]))
    span = delivered[delivered["t"] <= events["t"].max()]
    return {
        "seen": len(events), "delivered": len(span), "missing": int(np.count_nonzero(~np.isin(span, events))),
        "others": int(np.count_nonzero(~np.isin(events, span))), "running": seen.about.get("running"),
        "t_first": int(events["t"][0]), "t_last": int(events["t"][-1]), "lost": fault.get("events_lost"),
        "hits": fault.get("hits"),
    }  # fmt: skip


def inject(name):
    """Ask the only run to let the fault begin."""
    answer = send_request(sockets()[0], {"request": "inject", "fault": FAULTS[name]})
    assert answer.get("link") == "usbip", answer


NAMED = {driver.name: driver for driver in DRIVERS}
ALL = [(driver.name, name) for name in FAULTS for driver in DRIVERS]
TELLING = [
    ("dv2", "time_back"), ("dv2", "missed_wraps"), ("nd", "odd_bytes_extra"), ("dv1", "odd_bytes_missing"),
    ("dv1", "time_ahead"), ("nd", "time_frozen"), ("nd", "usb_stall"), ("nd", "stale_data"),
]  # fmt: skip
Exposure = tuple[str, tuple[str, ...]]
"""A driver, and the faults that begin while it streams."""
TOGETHER = [(driver.name, EXACT) for driver in DRIVERS]
SHORT = [("nd", ("usb_stall",))]
ALONE = [(who, (name,)) for who, name in (ALL if os.environ.get("EVSTIM_EVERY_FAULT") else TELLING)]


class Exposed:
    """Drivers that stream on one run while faults begin, one driver after another."""

    def __init__(self, guest, pythons, rig, exposures):
        self._guest, self._pythons, self._rig = guest, pythons, rig
        self._injected = 0
        self._faults = {}
        self._turns = Turns(rig, exposures, self._expose)

    def faults(self, exposure):
        """Return what the run reports of each fault, by kind."""
        reported = self._rig.summary["links"]["usbip"]["faults"][self._faults[exposure]]
        faults = {fault["kind"]: fault for fault in reported}
        assert [fault["kind"] for fault in reported] == [FAULTS[name]["kind"] for name in exposure[1]]
        assert min(fault["hits"] for fault in reported) > 0, faults
        return faults

    def outcome(self, exposure):
        """Return what the driver saw beside what it must have seen; see `outcome`."""
        who, names = exposure
        seen, fault = self._turns.result(exposure), self.faults(exposure)[FAULTS[names[0]]["kind"]]
        return outcome(NAMED[who], seen, self._turns.delivered(exposure).events, fault)

    def _expose(self, exposure):
        who, names = exposure
        self._faults[exposure] = slice(self._injected, self._injected + len(names))
        self._inject(name for name in names if name in AT_NEXT_START)
        with Attachment(self._guest, self._rig.port):
            streaming = Streaming(self._guest, NAMED[who], self._pythons[who], EVENTS, timeout_s=SECONDS)
            streaming.wait_until_started()
            self._inject(name for name in names if name not in AT_NEXT_START)
            return streaming.wait()

    def _inject(self, names):
        for name in names:
            inject(name)
            self._injected += 1


@pytest.fixture(scope="module")
def exposed(request, guest, driver_pythons, tmp_path_factory):
    folder = tmp_path_factory.mktemp("faults")
    with pytest.MonkeyPatch.context() as environment:
        environment.setenv("XDG_RUNTIME_DIR", str(folder))
        return Exposed(guest, driver_pythons, RunningRig(folder), selected(request, "exposure"))


def name_of(exposure):
    who, names = exposure
    return who if len(names) > 1 else f"{who}-{names[0]}"


@pytest.mark.long
@pytest.mark.sampled
@pytest.mark.parametrize("exposure", TOGETHER, ids=name_of)
def test_a_driver_sees_all_that_left_the_camera_in_spite_of_faults(exposed, exposure):
    found = exposed.outcome(exposure)
    assert (found["missing"], found["others"], found["running"]) == (0, 0, True), found
    assert found["seen"] - found["delivered"] == exposed.faults(exposure)["repeated_events"]["hits"], found


@pytest.mark.long
@pytest.mark.parametrize("exposure", long_but(SHORT, ALONE), ids=name_of)
def test_a_driver_meets_a_fault(exposed, exposure):
    who, (name,) = exposure
    found = exposed.outcome(exposure)
    if log := os.environ.get("EVSTIM_FAULT_OUTCOMES"):
        with Path(log).open("a") as lines:
            lines.write(json.dumps({"driver": who, "fault": name, **found}) + "\n")
    if (who, name) not in UNSETTLED:
        assert found["running"] is ((who, name) not in ENDS), found
    if name in EXACT or (who, name) == ("nd", "odd_bytes_extra"):
        assert (found["missing"], found["others"]) == (0, 0), found
    if name == "stale_data":  # the drivers of iniVation wait for the reset of the timestamps
        assert (found["missing"], found["others"]) == (0, STALE_EVENTS if who == "nd" else 0), found
