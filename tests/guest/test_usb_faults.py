"""What unmodified drivers make of faults on the cable and in the camera, and that the ledger knows what they got.

Short by default: faults that lose nothing meet each driver together, the others the driver whose answer tells most.
Each fault alone with each driver:

    EVSTIM_EVERY_FAULT=1 python -m pytest tests/guest/test_usb_faults.py
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from emulator.run.control import send_request, sockets
from firmware_protocol.events import Events
from tests.guest.attachment import Attachment
from tests.guest.environments import DRIVERS, Driver
from tests.guest.machine import Guest
from tests.guest.running_rig import RunningRig
from tests.guest.streaming import Seen, Streaming

pytestmark = [pytest.mark.guest, pytest.mark.socket, pytest.mark.timeout(1200)]

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


def outcome(driver: Driver, seen: Seen, delivered: Events, fault: dict[str, object]) -> dict[str, object]:
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


def inject(name: str) -> None:
    """Ask the only run to let the fault begin."""
    answer = send_request(sockets()[0], {"request": "inject", "fault": FAULTS[name]})
    assert answer.get("link") == "usbip", answer


ALL = [(driver.name, name) for name in FAULTS for driver in DRIVERS]
TELLING = [
    ("dv2", "time_back"), ("dv2", "missed_wraps"), ("nd", "odd_bytes_extra"), ("dv1", "odd_bytes_missing"),
    ("dv1", "time_ahead"), ("nd", "time_frozen"), ("nd", "usb_stall"), ("nd", "stale_data"),
]  # fmt: skip
BY_NAME = {driver.name: driver for driver in DRIVERS}


class Meeting:
    """A driver that streams while faults begin: what it saw, and what the run tells of each fault."""

    def __init__(self, guest: Guest, driver: Driver, python: Path, folder: Path, names: Sequence[str]) -> None:
        with RunningRig(folder) as rig:
            for name in AT_NEXT_START.intersection(names):
                inject(name)
            with Attachment(guest, rig.port):
                streaming = Streaming(guest, driver, python, EVENTS, timeout_s=SECONDS)
                streaming.wait_until_started()
                for name in [name for name in names if name not in AT_NEXT_START]:
                    inject(name)
                seen = streaming.wait()
        assert rig.summary["balanced"], rig.summary
        self.faults = {fault["kind"]: fault for fault in rig.summary["links"]["usbip"]["faults"]}
        assert len(self.faults) == len(names)
        assert min(fault["hits"] for fault in self.faults.values()) > 0, self.faults
        delivered = rig.delivered
        self.found = outcome(
            driver, seen, delivered.events[delivered.resets[-1] :], self.faults[FAULTS[names[0]]["kind"]]
        )


@pytest.mark.parametrize("driver", DRIVERS, ids=lambda driver: driver.name)
def test_a_driver_sees_all_that_left_the_camera_in_spite_of_faults(
    guest: Guest, driver: Driver, driver_pythons: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    meeting = Meeting(guest, driver, driver_pythons[driver.name], tmp_path, EXACT)
    found = meeting.found
    assert (found["missing"], found["others"], found["running"]) == (0, 0, True), found
    assert found["seen"] - found["delivered"] == meeting.faults["repeated_events"]["hits"], found


@pytest.mark.parametrize(("who", "name"), ALL if os.environ.get("EVSTIM_EVERY_FAULT") else TELLING)
def test_a_driver_meets_a_fault(
    guest: Guest, who: str, name: str, driver_pythons: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    found = Meeting(guest, BY_NAME[who], driver_pythons[who], tmp_path, [name]).found
    if log := os.environ.get("EVSTIM_FAULT_OUTCOMES"):
        with Path(log).open("a") as lines:
            lines.write(json.dumps({"driver": who, "fault": name, **found}) + "\n")
    if (who, name) not in UNSETTLED:
        assert found["running"] is ((who, name) not in ENDS), found
    if name in EXACT or (who, name) == ("nd", "odd_bytes_extra"):
        assert (found["missing"], found["others"]) == (0, 0), found
    if name == "stale_data":  # the drivers of iniVation wait for the reset of the timestamps
        assert (found["missing"], found["others"]) == (0, STALE_EVENTS if who == "nd" else 0), found
