"""evstim's CAN link on a real kernel's CAN: vcan in the guest, with candump, cansend and our listener as other nodes.

One run serves all tests here, since Python takes its time to start on a processor that QEMU translates. Raw frames need
nothing of what numba compiles, so it is told not to: that would take minutes there.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from firmware_protocol.can_frames.frame import Frame
from firmware_protocol.can_frames.identifiers import Identifiers
from firmware_protocol.can_frames.raw_stream import RawReceiver
from firmware_protocol.events import EVENT, Events
from tests.guest.machine import Guest
from transports.digest import digest_of

pytestmark = [pytest.mark.guest, pytest.mark.socket, pytest.mark.timeout(600), pytest.mark.xdist_group("guest")]

IDS = Identifiers()
CLIENT = str(Path(__file__).with_name("clients") / "can_link.py")
PYTHON = f"NUMBA_DISABLE_JIT=1 {sys.executable}"
LISTEN = f"{PYTHON} -c 'from emulator.cli import main; main()' listen can --interface socketcan --channel vcan0"
TIMEOUT_S = 300.0
SECONDS = 20
EARLY, LATE = 200, 50
"""Events before the order to stop, and after it."""


@dataclass(frozen=True)
class Seen:
    """What everybody saw: the link, candump, and the listener."""

    events: Events
    told: dict[str, Any]
    log: list[str]
    heard: dict[str, Any]


def stream() -> Events:
    rng = np.random.default_rng(5)
    events = np.zeros(EARLY + LATE, EVENT)
    events["t"] = 500_000 + np.cumsum(rng.exponential(8000, len(events))).astype(np.uint64)
    events["t"][EARLY:] += 14_000_000
    events["x"], events["y"] = rng.integers(0, 346, len(events)), rng.integers(0, 260, len(events))
    events["on"] = rng.integers(0, 2, len(events))
    return events


@pytest.fixture(scope="module")
def vcan(guest: Guest) -> Iterator[str]:
    for module in ("vcan", "can-raw"):
        guest.load(module)
    guest.check(["ip", "link", "add", "dev", "vcan0", "type", "vcan"])
    guest.check(["ip", "link", "set", "vcan0", "up"])
    yield "vcan0"
    guest.run(["ip", "link", "del", "vcan0"])


@pytest.fixture(scope="module")
def seen(guest: Guest, vcan: str) -> Seen:
    """Run the link for some seconds; cansend says SYNC twice, then stop."""
    events = stream()
    np.save(guest.results / "events.npy", events)
    at = guest.path_in_guest
    until_done = f"until [ -e {at('done')} ]; do sleep 0.2; done; sleep 2; kill $!; wait $!; true"
    dump = guest.start(["sh", "-c", f"candump -L {vcan} > {at('log')} & {until_done}"], TIMEOUT_S)
    listening = f"{LISTEN} --json > {at('heard')} 2> {at('listening')} &"
    listener = guest.start(["sh", "-c", f"{listening} {until_done}"], TIMEOUT_S)
    guest.check(
        ["sh", "-c", f"until grep -q 'CAN bus\\|Error' {at('listening')}; do sleep 0.2; done; sleep 3"], TIMEOUT_S
    )
    run = f"{PYTHON} {CLIENT} {vcan} {at('events.npy')} {at('report')} {SECONDS}"
    link = guest.start(["sh", "-c", f"{run} || {{ touch {at('failed')}; exit 1; }}"], TIMEOUT_S)
    lives = f"until [ -e {at('failed')} ] || candump -n 1 -T 500 {vcan},{IDS.heartbeat:X}:7FF | grep -q .; do :; done"
    # The epoch frames count the events sent.
    all_sent = f"until grep -q '{IDS.epoch:03X}#.\\{{8\\}}{EARLY:02X}00' {at('log')}; do sleep 0.2; done"
    sync, stop = f"cansend {vcan} {IDS.sync:03X}#", f"cansend {vcan} {IDS.nmt:03X}#0222"
    guest.check(["sh", "-c", f"{lives}; {sync}07; sleep 0.2; {sync}08; {all_sent}; {stop}"], TIMEOUT_S)
    finished = link.wait()
    guest.check(["touch", at("done")])
    assert finished.ok, str(finished)
    dump.wait()
    listener.wait()
    return Seen(
        events,
        json.loads((guest.results / "report").read_text()),
        (guest.results / "log").read_text().split()[2::3],
        json.loads((guest.results / "heard").read_text().splitlines()[-1]),
    )


def test_candump_logs_what_the_link_says_it_sent(seen: Seen) -> None:
    ours = [line for line in seen.log if int(line.split("#")[0], 16) not in (IDS.sync, IDS.nmt)]
    assert ours == seen.told["sent"]
    receiver = RawReceiver(IDS.events, IDS.epoch)
    got = np.concatenate([receiver.push(Frame.parse(line)) for line in ours])
    assert np.array_equal(got, seen.events[:EARLY])
    assert seen.told["delivered"] == EARLY


def test_cansend_is_obeyed(seen: Seen) -> None:
    assert seen.told["syncs"] == [7, 8]
    assert 150_000 < seen.told["sync_us"][1] - seen.told["sync_us"][0] < 3_000_000
    assert seen.told["counts"]["NMT orders"] == 1
    assert seen.told["state"].endswith("stopped")
    assert seen.told["not_running"] == LATE
    assert f"{IDS.heartbeat:03X}#05" in seen.log
    assert seen.log[-1] == f"{IDS.heartbeat:03X}#04" or seen.log[-1].startswith(f"{IDS.epoch:03X}#")


def test_our_listener_heard_every_event(seen: Seen) -> None:
    assert seen.heard["events"] == EARLY
    assert seen.heard["digest"] == digest_of(seen.events[:EARLY])
    assert seen.heard["faults"] == 0


def test_a_bus_that_is_down_is_named_with_its_cure(guest: Guest, vcan: str) -> None:
    guest.check(["ip", "link", "set", vcan, "down"])
    try:
        finished = guest.run(["sh", "-c", LISTEN], TIMEOUT_S)
    finally:
        guest.check(["ip", "link", "set", vcan, "up"])
    assert finished.code == 3
    assert f"sudo ip link set {vcan} up" in " ".join(finished.stderr.split())
