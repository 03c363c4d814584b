"""evstim's CAN link on a bus without time to spare, with the programs of can-utils as the other nodes.

vcan by itself has no bit rate: a token bucket (tc) in front of it takes frames at the rate of a wire, and refuses them
with ENOBUFS when ten wait, as a CAN controller's driver does. candump logs what passed it, with the kernel's time of
each frame; here the log is read by loops written from docs/instrument.md and docs/packets.md, without our decoders.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from firmware_protocol.telemetry.writing import BlockEncoder, BlockSettings
from tests.firmware_protocol.telemetry.slow_decoder import decode
from tests.guest.machine import CACHE
from tests.made_events import scattered

pytestmark = [pytest.mark.guest, pytest.mark.socket, pytest.mark.timeout(1700)]

CLIENT = str(Path(__file__).with_name("clients") / "can_link.py")
TIMEOUT_S = 1500.0
ROOT = Path(__file__).parents[2]
ENVIRONMENT = {"NUMBA_CACHE_DIR": str(CACHE / "numba"), "NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""}
"""Of a link that makes blocks: guest and host use code for the same processor, and the host compiles it."""
WIDTH, HEIGHT = 346, 260
MANY, FEWER, FEW = 200_000, 50_000, 4_000
"""Events: with FD frames, with classic frames of ISO-TP (a quarter hour is too long for the guest), and in CI."""
QUEUE = 10
SKB_BYTES = {False: 16, True: 72}
"""Octets that the kernel counts for a frame, classic and FD: can_frame and canfd_frame."""
EVENTS, EPOCH, CLOCK, TELEMETRY, TELECOMMAND = 0x1A2, 0x2A2, 0x322, 0x4A2, 0x522
LOAD = 0x7F0


@dataclass(frozen=True)
class Line:
    """A frame in candump's log: the kernel's time in us since 1970, and the frame."""

    t_us: int
    identifier: int
    data: bytes


@dataclass(frozen=True)
class Seen:
    """What candump and isotprecv saw, and what the link reports."""

    log: list[Line]
    packets: list[bytes]
    told: dict[str, Any]


@dataclass
class Read:
    """Content of raw frames: events (t, x, y, on), and what the epoch frames count."""

    events: list[tuple[int, int, int, int]] = field(default_factory=list)
    gaps: int = 0
    sent: int = 0
    dropped: int = 0


def stream(count):
    """Return events, some at the same time and some after a silence longer than a frame's time can tell."""
    gaps = np.random.default_rng(11).exponential(7, count).astype(np.uint64)
    gaps[3000::5000] += 70_000
    return scattered(1000 + np.cumsum(gaps), (WIDTH, HEIGHT))


@pytest.fixture
def vcan(guest):
    guest.check(["modprobe", "-d", str(guest.kernel.tree), "vcan", "echo=1"])
    for module in ("can-raw", "can-isotp", "sch-tbf"):
        guest.load(module)
    guest.run(["ip", "link", "del", "vcan0"])
    guest.check(["ip", "link", "add", "dev", "vcan0", "mtu", "72", "type", "vcan"])
    guest.check(["ip", "link", "set", "vcan0", "up"])
    yield "vcan0"
    guest.run(["ip", "link", "del", "vcan0"])


def run_link(guest, events, table, *, frames_a_second):
    """Run the link on a bus of so many frames a second, while another node sends too."""
    np.save(guest.results / "load.npy", events)
    at, fd = guest.path_in_guest, table.get("fd", False)
    size = SKB_BYTES[fd]
    isotp = table["carriage"] == "isotp"
    options = "-L 72:64:1" if fd else ""
    values = {"NUMBA_DISABLE_JIT": 1} if table["carriage"] == "raw" else ENVIRONMENT
    variables = " ".join(f"{name}={value}" for name, value in {"PYTHONPATH": ROOT, **values}.items())
    # Frames that leave on two processors wait in two queues of the kernel, and can be received in another order.
    lines = [
        "cd /dev/shm",
        f"tc qdisc replace dev vcan0 root tbf rate {size * frames_a_second}bps burst {4 * size} limit {QUEUE * size}",
        "candump -d -L -r 67108864 vcan0 > log & dump=$!",
        f"stdbuf -oL isotprecv -l -s {TELECOMMAND:X} -d {TELEMETRY:X} {options} vcan0 > packets & peer=$!"
        if isotp
        else "peer=",
        "until grep -q vcan0 /proc/net/can/rcvlist_all; do sleep 0.1; done",
        f"until grep -q ' {TELEMETRY:x} ' /proc/net/can/rcvlist_sff; do sleep 0.1; done" if isotp else "true",
        f"taskset 1 sh -c '{OTHER_NODE}' & other=$!",
        f"{variables} taskset 1 {sys.executable} {CLIENT} vcan0 {at('load.npy')} report '{json.dumps(table)}' 0",
        "code=$?; sleep 1; kill $other $peer; sleep 1; kill $dump; wait",
        f"touch packets; cp log packets report {at('')}; rm -f packets; exit $code",
    ]
    guest.check(["sh", "-c", "\n".join(lines)], TIMEOUT_S)
    text = (guest.results / "log").read_text()
    assert "DROPCOUNT" not in text, "candump itself was too slow"
    return Seen(
        [parsed(line) for line in text.splitlines()],
        [bytes.fromhex(line) for line in (guest.results / "packets").read_text().splitlines()],
        json.loads((guest.results / "report").read_text()),
    )


def parsed(line):
    """Read "(1700000000.123456) vcan0 1A2#0011" or "... 1A2##10011", as `candump -L` writes them."""
    time, _, frame = line.split()
    seconds, _, micros = time.strip("()").partition(".")
    identifier, _, data = frame.partition("#")
    data = data[2:] if data.startswith("#") else data
    return Line(int(seconds) * 1_000_000 + int(micros), int(identifier, 16), bytes.fromhex(data))


def near(low, bits, reference):
    """Return the number with these low bits that is nearest to a reference."""
    base = reference - (reference & (1 << bits) - 1) + low
    return min((base - (1 << bits), base, base + (1 << bits)), key=lambda n: abs(n - reference))


def read_raw(log):
    """Read events, epoch and clock frames; a tick is 1 us here."""
    read, reference, seq = Read(), 0, -1
    for line in log:
        word = int.from_bytes(line.data[:8], "little")
        if line.identifier == CLOCK:
            reference = word
        elif line.identifier == EPOCH:
            assert word >> 30 & 3 == 0, "the tick is not 1 us"
            reference = near(word & 0x3FFF_FFFF, 30, reference)
            read.sent, read.dropped = word >> 32 & 0xFFFF, word >> 48
        elif line.identifier == EVENTS:
            found, number = fd_events(line.data, reference)
            read.gaps += seq >= 0 and number != (seq + 1) % 256
            seq, reference = number, found[-1][0]
            read.events += found
    return read


def fd_events(data, reference):
    t, seq, n = near(int.from_bytes(data[:4], "little"), 32, reference), data[4], data[5]
    events = []
    for k in range(n):
        cell = int.from_bytes(data[7 + 3 * k : 10 + 3 * k], "little")
        if cell >> 19 == 31:
            t += cell & 0x7FFFF
            continue
        t += cell >> 19
        events.append((t, cell & 511, cell >> 9 & 511, cell >> 18 & 1))
    return events, seq


def read_packets(packets):
    """Read space packets of profile `ccsds`, each with a block of events behind 20 octets of headers."""
    events = []
    for number, packet in enumerate(packets):
        head = int.from_bytes(packet[:6], "big")
        assert (head >> 32 & 0x7FF, packet[7:9]) == (0x2A1, bytes([128, 129])), "not a packet of events"
        assert (head >> 16 & 0x3FFF, head & 0xFFFF) == (number % 0x4000, len(packet) - 7), "a packet is missing"
        events += decode(packet[20:-2])[1]
    return events


def in_order(events):
    """Return events as rows t, x, y, on; those of one microsecond in raster order, as blocks have them."""
    rows = np.array([tuple(event) for event in events], np.int64).reshape(-1, 4)
    return rows[np.lexsort((rows[:, 2] * WIDTH + rows[:, 1], rows[:, 0]))]


CARRIAGES = {
    "raw-fd": {"carriage": "raw", "fd": True},
    "isotp": {"carriage": "isotp"},
    "isotp-fd": {"carriage": "isotp", "fd": True},
}

OTHER_NODE = f"exec cangen -g 40 -I {LOAD:X} -L 8 -D r -p 1000 vcan0"
"""It leaves room for ISO-TP's flow control, which the kernel does not send again when the bus refuses it."""


@pytest.fixture
def compiled():
    """Compile the encoder of blocks here; it would take minutes in the guest."""
    program = "from tests.guest.test_can_load import compile_blocks; compile_blocks()"
    subprocess.run([sys.executable, "-c", program], env=os.environ | ENVIRONMENT, cwd=ROOT, check=True)


def compile_blocks():
    BlockEncoder((WIDTH, HEIGHT), BlockSettings()).encode(stream(2))


def check_all_came(seen, got, events):
    assert np.array_equal(in_order(got), in_order(events))
    assert (seen.told["delivered"], sum(seen.told["lost"].values())) == (len(events), 0)
    assert seen.told["counts"].get("bus had no room", 0) > 0, "the bus was never full"


@pytest.mark.parametrize(("count", "rate"), [(FEW, 40), pytest.param(MANY, 100, marks=pytest.mark.long)])
def test_a_full_fd_bus_with_another_sender_loses_no_event(guest, vcan, count, rate):
    events = stream(count)
    seen = run_link(guest, events, CARRIAGES["raw-fd"], frames_a_second=rate)
    read = read_raw(seen.log)
    check_all_came(seen, read.events, events)
    assert (read.gaps, read.dropped) == (0, 0)
    assert any(line.identifier == LOAD for line in seen.log)


@pytest.mark.long
@pytest.mark.parametrize("carriage", ["isotp", "isotp-fd"])
def test_blocks_on_a_full_bus_lose_no_event(guest, vcan, compiled, carriage):
    events = stream(MANY if carriage == "isotp-fd" else FEWER)
    seen = run_link(guest, events, CARRIAGES[carriage], frames_a_second=100)
    check_all_came(seen, read_packets(seen.packets), events)
