"""evstim's CAN link on a real kernel's CAN: vcan in the guest, with the programs of can-utils as other nodes.

Raw frames go to candump and our listener, orders come from cansend. Blocks go to the kernel's own ISO-TP by isotprecv,
telecommands come from isotpsend. One run for each serves all its tests, since Python takes its time to start on a
processor that QEMU translates; numba is told not to compile: that would take minutes there.
"""

from __future__ import annotations

import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from firmware_protocol.can_frames.dbc import Identifiers
from firmware_protocol.can_frames.frame import Frame
from firmware_protocol.can_frames.raw_stream import RawReceiver
from firmware_protocol.events import Events, empty_events
from firmware_protocol.packets.addresses import MessageKind
from firmware_protocol.packets.profile import Profile
from firmware_protocol.packets.telecommands import Ping, RequestId, Stage, Stop, Verification
from firmware_protocol.telemetry.reading import as_received, decode_block
from tests.made_events import scattered
from transports.link.deliveries import digest_of

pytestmark = [pytest.mark.guest, pytest.mark.socket, pytest.mark.timeout(1200)]

IDS = Identifiers()
CLIENT = str(Path(__file__).with_name("clients") / "can_link.py")
PYTHON = f"NUMBA_DISABLE_JIT=1 {sys.executable}"
LISTEN = f"{PYTHON} -c 'from emulator.cli import main; main()' listen can --interface socketcan --channel vcan0"
TIMEOUT_S = 900.0
SECONDS = 20
TABLES = {name: json.dumps({"carriage": name, "heartbeat_ms": 100}) for name in ("raw", "isotp")}
EARLY, LATE = 200, 50
"""Events before the order to stop, and after it."""
BURST = 100
"""Events that come at once, for blocks of more than sixteen frames."""


@dataclass(frozen=True)
class Seen:
    """What everybody saw: the link, candump, and the listener."""

    events: Events
    told: dict[str, Any]
    log: list[str]
    heard: dict[str, Any]


def stream():
    times = 500_000 + np.cumsum(np.random.default_rng(5).exponential(8000, EARLY + LATE)).astype(np.uint64)
    times[EARLY:] += 14_000_000
    return scattered(times)


@pytest.fixture(scope="module")
def vcan(guest):
    for module in ("vcan", "can-raw", "can-isotp"):
        guest.load(module)
    guest.check(["ip", "link", "add", "dev", "vcan0", "type", "vcan"])
    guest.check(["ip", "link", "set", "vcan0", "up"])
    yield "vcan0"
    guest.run(["ip", "link", "del", "vcan0"])


@pytest.fixture(scope="module")
def seen(guest, vcan):
    """Run the link for some seconds; cansend says SYNC twice, then stop. Link and listener start at the same time."""
    events = stream()
    np.save(guest.results / "events.npy", events)
    at = guest.path_in_guest
    until_done = f"until [ -e {at('done')} ]; do sleep 0.2; done; sleep 2; kill $!; wait $!; true"
    dump = guest.start(["sh", "-c", f"candump -L {vcan} > {at('log')} & {until_done}"], TIMEOUT_S)
    listening = f"{LISTEN} --json > {at('heard')} 2> {at('listening')} &"
    listener = guest.start(["sh", "-c", f"{listening} {until_done}"], TIMEOUT_S)
    run = f"{PYTHON} {CLIENT} {vcan} {at('events.npy')} {at('report')} '{TABLES['raw']}' {SECONDS} {at('begin')}"
    link = guest.start(["sh", "-c", f"{run} || {{ touch {at('failed')}; exit 1; }}"], TIMEOUT_S)
    is_open = f"until grep -q 'CAN bus\\|Error' {at('listening')}; do sleep 0.2; done; sleep 3; touch {at('begin')}"
    guest.check(["sh", "-c", is_open], TIMEOUT_S)
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


def test_candump_logs_what_the_link_says_it_sent(seen):
    ours = [line for line in seen.log if int(line.split("#")[0], 16) not in (IDS.sync, IDS.nmt)]
    assert ours == seen.told["sent"]
    receiver = RawReceiver(IDS.events, IDS.epoch)
    got = np.concatenate([receiver.push(Frame.parse(line)) for line in ours])
    assert np.array_equal(got, seen.events[:EARLY])
    assert seen.told["delivered"] == EARLY


def test_cansend_is_obeyed(seen):
    assert seen.told["syncs"] == [7, 8]
    assert 150_000 < seen.told["sync_us"][1] - seen.told["sync_us"][0] < 14_000_000
    assert seen.told["counts"]["NMT orders"] == 1
    assert seen.told["state"].endswith("stopped")
    assert seen.told["not_running"] == LATE
    assert f"{IDS.heartbeat:03X}#05" in seen.log
    assert seen.log[-1] == f"{IDS.heartbeat:03X}#04" or seen.log[-1].startswith(f"{IDS.epoch:03X}#")


def test_our_listener_heard_every_event(seen):
    assert seen.heard["events"] == EARLY
    assert seen.heard["digest"] == digest_of(seen.events[:EARLY])
    assert seen.heard["faults"] == 0


@pytest.mark.long
def test_a_bus_that_is_down_is_named_with_its_cure(guest, vcan):
    guest.check(["ip", "link", "set", vcan, "down"])
    try:
        finished = guest.run(["sh", "-c", LISTEN], TIMEOUT_S)
    finally:
        guest.check(["ip", "link", "set", vcan, "up"])
    assert finished.code == 3
    assert f"sudo ip link set {vcan} up" in " ".join(finished.stderr.split())


@dataclass(frozen=True)
class SeenByKernel:
    """What came out of the kernel's ISO-TP, what the link says it sent, and which telecommands were for it."""

    events: Events
    told: dict[str, Any]
    packets: list[bytes]
    requests: list[RequestId]


def packets_in(dump):
    """Return what isotprecv has written so far: a packet a line, in hexadecimal."""
    lines = dump.read_text().splitlines(keepends=True) if dump.exists() else []
    return [bytes.fromhex(line) for line in lines if line.endswith("\n")]


def messages_in(packets):
    unwrapper = Profile("ccsds").unwrapper()
    messages = [received.message for packet in packets for received in unwrapper.push(packet)]
    assert (unwrapper.counters.packets, unwrapper.counters.missing) == (len(packets), 0)
    return messages


def events_in(packets):
    blocks = [decode_block(m.payload, m.t_us) for m in messages_in(packets) if m.kind is MessageKind.EVENTS]
    return np.concatenate([empty_events(), *(block.events for block in blocks)])


@pytest.fixture(scope="module")
def seen_by_kernel(guest, vcan):
    """Run the link for some seconds; isotpsend says ping while blocks come, and stop when all have."""
    events = stream()
    events["t"][:BURST] = events["t"][BURST] - 10 * np.arange(BURST, 0, -1, dtype=np.uint64)
    np.save(guest.results / "burst.npy", events)
    at, dump, over = guest.path_in_guest, guest.results / "packets", guest.results / "over"
    sides = f"-s {IDS.telecommand:X} -d {IDS.telemetry:X} {vcan}"
    receive = f"stdbuf -oL isotprecv -l {sides} > {at('packets')} &"
    listens = f"until grep -q ' {IDS.telemetry:x} ' /proc/net/can/rcvlist_sff; do sleep 0.1; done"
    run = f"{PYTHON} {CLIENT} {vcan} {at('burst.npy')} {at('isotp-report')} '{TABLES['isotp']}' {SECONDS}"
    link = guest.start(
        ["sh", "-c", f"{receive} {listens}; {run}; code=$?; kill $!; touch {at('over')}; exit $code"], TIMEOUT_S
    )

    def wait_for(count):
        while len(events_in(packets_in(dump))) < count:
            if over.exists():
                pytest.fail(f"{len(events_in(packets_in(dump)))} of {count} events came: {link.wait()}")
            time.sleep(0.2)

    computer, requests = Profile("ccsds"), []
    for count, command in ((1, Ping()), (EARLY, Stop())):
        wait_for(count)
        packet = computer.wrap_command(command)
        guest.check(["sh", "-c", f"echo {packet.hex(' ')} | isotpsend -b {sides}"])
        assert computer.last_request is not None
        requests.append(computer.last_request)
    finished = link.wait()
    assert finished.ok, str(finished)
    return SeenByKernel(events, json.loads((guest.results / "isotp-report").read_text()), packets_in(dump), requests)


@pytest.mark.long
def test_the_kernels_isotp_takes_every_packet_byte_for_byte(seen_by_kernel):
    packets = seen_by_kernel.packets
    assert [packet.hex() for packet in packets] == seen_by_kernel.told["packets"]
    # A block tells the events of one microsecond in raster order.
    assert np.array_equal(as_received(events_in(packets), 1), as_received(seen_by_kernel.events[:EARLY], 1))
    assert seen_by_kernel.told["delivered"] == EARLY
    assert max(map(len, packets)) > 6 + 16 * 7, "no packet so long that its frames' numbers began anew"


@pytest.mark.long
def test_telecommands_from_the_kernels_isotp_are_obeyed_and_answered(seen_by_kernel):
    messages = messages_in(seen_by_kernel.packets)
    verified = [m.payload for m in messages if m.kind is MessageKind.VERIFICATION]
    stages = (Stage.ACCEPTANCE, Stage.COMPLETION)
    assert verified == [Verification(stage, r).encode() for r in seen_by_kernel.requests for stage in stages]
    assert [m.kind for m in messages].count(MessageKind.PONG) == 1
    assert seen_by_kernel.told["state"].endswith("stopped")
    assert seen_by_kernel.told["not_running"] == LATE
