"""evstim's CAN link on a bus without time to spare, with the programs of can-utils as the other nodes.

vcan by itself has no bit rate: a token bucket (tc) in front of it takes frames at the rate of a wire, and refuses them
with ENOBUFS when ten wait, as a CAN controller's driver does. candump logs what passed it, with the kernel's time of
each frame; here the log is read by loops written from docs/instrument.md and docs/packets.md, without our decoders.
"""

from __future__ import annotations

import json
import os
import struct
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from firmware_protocol.events import EVENT, Events
from firmware_protocol.telemetry import BlockEncoder, BlockSettings
from tests.firmware_protocol.telemetry.slow_decoder import decode
from tests.guest.machine import CACHE, Guest

pytestmark = [pytest.mark.guest, pytest.mark.socket, pytest.mark.timeout(1700)]

CLIENT = str(Path(__file__).with_name("clients") / "can_load.py")
TIMEOUT_S = 1500.0
ROOT = Path(__file__).parents[2]
ENVIRONMENT = {
    "NUMBA_CACHE_DIR": str(CACHE / "numba"),
    "NUMBA_CPU_NAME": "generic",
    "NUMBA_CPU_FEATURES": "",
}
"""Of a link that makes blocks: guest and host use code for the same processor, and the host compiles it."""
WIDTH, HEIGHT = 346, 260
MANY, FEWER, FEW = 200_000, 50_000, 4_000
"""Events: with FD frames, with classic frames (a quarter hour is too long for the guest), and in CI."""
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
    extended: bool
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


def stream(count: int) -> Events:
    """Return events, some at the same time and some after a silence longer than a frame's time can tell."""
    rng = np.random.default_rng(11)
    gaps = rng.exponential(7, count).astype(np.uint64)
    gaps[3000::5000] += 70_000
    events = np.zeros(count, EVENT)
    events["t"] = 1000 + np.cumsum(gaps)
    events["x"], events["y"] = rng.integers(0, WIDTH, count), rng.integers(0, HEIGHT, count)
    events["on"] = rng.integers(0, 2, count)
    return events


@pytest.fixture
def vcan(guest: Guest) -> Iterator[str]:
    guest.check(["modprobe", "-d", str(guest.kernel.tree), "vcan", "echo=1"])
    for module in ("can-raw", "can-isotp", "sch-tbf"):
        guest.load(module)
    guest.run(["ip", "link", "del", "vcan0"])
    guest.check(["ip", "link", "add", "dev", "vcan0", "mtu", "72", "type", "vcan"])
    guest.check(["ip", "link", "set", "vcan0", "up"])
    yield "vcan0"
    guest.run(["ip", "link", "del", "vcan0"])


def run_link(
    guest: Guest,
    events: Events,
    table: dict[str, Any],
    *,
    frames_a_second: int = 0,
    others: str = "",
    pace: str = "max",
) -> Seen:
    """Run the link on a bus of so many frames a second, while `others` runs in the guest's shell too."""
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
        f"tc qdisc replace dev vcan0 root tbf rate {size * frames_a_second}bps burst {4 * size} limit {QUEUE * size}"
        if frames_a_second
        else "true",
        "candump -d -L -r 67108864 vcan0 > log & dump=$!",
        f"stdbuf -oL isotprecv -l -s {TELECOMMAND:X} -d {TELEMETRY:X} {options} vcan0 > packets & peer=$!"
        if isotp
        else "peer=",
        "until grep -q vcan0 /proc/net/can/rcvlist_all; do sleep 0.1; done",
        f"until grep -q ' {TELEMETRY:x} ' /proc/net/can/rcvlist_sff; do sleep 0.1; done" if isotp else "true",
        f"taskset 1 sh -c '{others}' & other=$!" if others else "other=",
        f"{variables} taskset 1 {sys.executable} {CLIENT} vcan0 {at('load.npy')} report '{json.dumps(table)}' {pace}",
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


def parsed(line: str) -> Line:
    """Read "(1700000000.123456) vcan0 1A2#0011" or "... 1A2##10011", as `candump -L` writes them."""
    time, _, frame = line.split()
    seconds, _, micros = time.strip("()").partition(".")
    identifier, _, data = frame.partition("#")
    data = data[2:] if data.startswith("#") else data
    return Line(int(seconds) * 1_000_000 + int(micros), int(identifier, 16), len(identifier) == 8, bytes.fromhex(data))


def near(low: int, bits: int, reference: int) -> int:
    """Return the number with these low bits that is nearest to a reference."""
    base = reference - (reference & (1 << bits) - 1) + low
    return min((base - (1 << bits), base, base + (1 << bits)), key=lambda n: abs(n - reference))


def read_raw(log: list[Line], *, fd: bool) -> Read:
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
            found, number, span = fd_events(line.data, reference) if fd else classic_events(word, reference)
            read.gaps += seq >= 0 and number != (seq + 1) % span
            seq, reference = number, found[-1][0]
            read.events += found
    return read


def classic_events(word: int, reference: int) -> tuple[list[tuple[int, int, int, int]], int, int]:
    t, dt = near(word & 0xFFFF, 16, reference), word >> 19 & 127
    pixels = [(t, word >> 26)] if dt == 127 else [(t, word >> 26), (t + dt, word >> 45)]
    return [(t, p & 511, p >> 9 & 511, p >> 18 & 1) for t, p in pixels], word >> 16 & 7, 8


def fd_events(data: bytes, reference: int) -> tuple[list[tuple[int, int, int, int]], int, int]:
    t, seq, n = near(int.from_bytes(data[:4], "little"), 32, reference), data[4], data[5]
    events = []
    for k in range(n):
        cell = int.from_bytes(data[7 + 3 * k : 10 + 3 * k], "little")
        if cell >> 19 == 31:
            t += cell & 0x7FFFF
            continue
        t += cell >> 19
        events.append((t, cell & 511, cell >> 9 & 511, cell >> 18 & 1))
    return events, seq, 256


def read_packets(packets: list[bytes]) -> list[tuple[int, int, int, int]]:
    """Read space packets of profile `ccsds`, each with a block of events behind 20 octets of headers."""
    events = []
    for number, packet in enumerate(packets):
        head = int.from_bytes(packet[:6], "big")
        assert (head >> 32 & 0x7FF, packet[7:9]) == (0x2A1, bytes([128, 129])), "not a packet of events"
        assert (head >> 16 & 0x3FFF, head & 0xFFFF) == (number % 0x4000, len(packet) - 7), "a packet is missing"
        events += decode(packet[20:-2])[1]
    return events


def read_cfp(log: list[Line]) -> list[tuple[int, int, int, int]]:
    """Read CSP packets in CFP frames, each with a block of events behind 15 octets of headers."""
    events, packet, count, packets = [], b"", 0, 0
    for line in log:
        if not line.extended:
            continue
        if line.identifier & 2:
            assert line.identifier >> 5 & 3 == packets % 4, "a packet is missing"
            packet, count = (line.identifier >> 13 & 0xFFFF).to_bytes(2, "big"), 0
        assert line.identifier >> 2 & 7 == count % 8, "a frame is missing"
        packet, count = packet + line.data, count + 1
        if line.identifier & 1:
            packets += 1
            assert int.from_bytes(packet[:6], "big") >> 12 & 63 == 9, "not a packet of events"
            events += decode(packet[15:-4])[1]
    return events


def in_order(events: Events | list[tuple[int, int, int, int]]) -> np.ndarray[Any, Any]:
    """Return events as rows t, x, y, on; those of one microsecond in raster order, as blocks have them."""
    rows = np.array([tuple(event) for event in events], np.int64).reshape(-1, 4)
    return rows[np.lexsort((rows[:, 2] * WIDTH + rows[:, 1], rows[:, 0]))]


CARRIAGES = {
    "raw": {"carriage": "raw"},
    "raw-fd": {"carriage": "raw", "fd": True},
    "isotp": {"carriage": "isotp"},
    "isotp-fd": {"carriage": "isotp", "fd": True},
    "cfp": {"carriage": "cfp"},
}

OTHER_NODE = f"exec cangen -g 40 -I {LOAD:X} -L 8 -D r -p 1000 vcan0"
"""It leaves room for ISO-TP's flow control, which the kernel does not send again when the bus refuses it."""


@pytest.fixture
def compiled() -> None:
    """Compile the encoder of blocks here; it would take minutes in the guest."""
    program = "from tests.guest.test_can_load import compile_blocks; compile_blocks()"
    subprocess.run([sys.executable, "-c", program], env=os.environ | ENVIRONMENT, cwd=ROOT, check=True)


def compile_blocks() -> None:
    BlockEncoder((WIDTH, HEIGHT), BlockSettings()).encode(stream(2))


def check_all_came(seen: Seen, got: list[tuple[int, int, int, int]], events: Events) -> None:
    assert np.array_equal(in_order(got), in_order(events))
    assert (seen.told["delivered"], sum(seen.told["lost"].values())) == (len(events), 0)
    assert seen.told["counts"].get("bus had no room", 0) > 0, "the bus was never full"


@pytest.mark.parametrize(("count", "rate"), [(FEW, 40), pytest.param(MANY, 100, marks=pytest.mark.long)])
def test_a_full_fd_bus_with_another_sender_loses_no_event(guest: Guest, vcan: str, count: int, rate: int) -> None:
    events = stream(count)
    seen = run_link(guest, events, CARRIAGES["raw-fd"], frames_a_second=rate, others=OTHER_NODE)
    read = read_raw(seen.log, fd=True)
    check_all_came(seen, read.events, events)
    assert (read.gaps, read.dropped) == (0, 0)
    assert any(line.identifier == LOAD for line in seen.log)


@pytest.mark.long
def test_a_full_classic_bus_loses_no_event(guest: Guest, vcan: str) -> None:
    events = stream(FEWER)
    seen = run_link(guest, events, CARRIAGES["raw"], frames_a_second=150, others=OTHER_NODE)
    read = read_raw(seen.log, fd=False)
    check_all_came(seen, read.events, events)
    assert (read.gaps, read.dropped) == (0, 0)


@pytest.mark.long
@pytest.mark.parametrize("carriage", ["isotp", "isotp-fd", "cfp"])
def test_blocks_on_a_full_bus_lose_no_event(guest: Guest, vcan: str, compiled: None, carriage: str) -> None:
    events = stream(MANY if carriage == "isotp-fd" else FEWER)
    seen = run_link(guest, events, CARRIAGES[carriage], frames_a_second=100, others=OTHER_NODE)
    got = read_cfp(seen.log) if carriage == "cfp" else read_packets(seen.packets)
    check_all_came(seen, got, events)


SYNC, FOLLOW_UP, SCET, EDGES, HEARTBEAT = 0x080, 0x101, 0x180, 0x422, 0x722
FIRST_OF_PEER = 100
"""The peer's SYNCs count from here; those of the camera begin at 1 and do not come so far."""
MASTER_S = 100_000
ROUNDING_US = 3
"""Of candump's times, the camera's and SCET's, each cut to a microsecond or less."""


@pytest.mark.long
def test_sync_and_time_agree_with_the_peers_clock_under_load(guest: Guest, vcan: str) -> None:
    """The kernel's times of frames bound the camera's clock: no bound depends on how busy the machine is."""
    events = stream(MANY)
    events["t"] *= 40  # three events a millisecond: Python in the guest cannot send them all
    syncs = " ".join(f"{counter:02X}" for counter in range(FIRST_OF_PEER, FIRST_OF_PEER + 20))
    peer = (
        f"candump -n 1 vcan0,{HEARTBEAT:X}:7FF > live; ({OTHER_NODE}) & load=$!; "
        f"for n in {syncs}; do cansend vcan0 {SYNC:03X}#$n; sleep 0.1; done; sleep 2; "
        f"cansend vcan0 {SCET:03X}#{MASTER_S:08X}000000; sleep 3; kill $load; cansend vcan0 000#0222"
    )
    table = {"carriage": "raw", "sync_ms": 200, "time_ms": 200, "follow_time": True}
    seen = run_link(guest, events, table, others=peer, pace="real")
    log = seen.log
    set_at = next(i for i, f in enumerate(log) if f.identifier == SCET and int.from_bytes(f.data[:4]) == MASTER_S)
    # The camera's clock is the kernel's less an offset, which each pair of SYNC and follow-up bounds.
    least_us, most_us = offset_bounds(log)
    assert least_us <= most_us + ROUNDING_US
    # The mark of each of the peer's SYNCs has the kernel's time of that SYNC.
    sent = {f.data[0]: f.t_us for f in log if f.identifier == SYNC and f.data[0] >= FIRST_OF_PEER}
    marks = [struct.unpack("<IBBH", f.data) for f in log[:set_at] if f.identifier == EDGES]
    offsets = [sent[seq] - t_us for t_us, _, _, seq in marks if seq >= FIRST_OF_PEER]
    assert len(offsets) == len(sent) == 20
    assert least_us - ROUNDING_US <= min(offsets)
    assert max(offsets) <= most_us + ROUNDING_US
    # TIME: from then on the camera's times are the master's; each SCET of its own lies between the frame before and it.
    shift_us = MASTER_S * 1_000_000 - log[set_at].t_us
    before_us, times = log[set_at].t_us, 0
    for frame in log[set_at + 1 :]:
        if frame.identifier == SCET:
            seconds, fraction = int.from_bytes(frame.data[:4]), int.from_bytes(frame.data[4:])
            own_us = seconds * 1_000_000 + fraction * 1_000_000 / 2**24
            assert own_us <= frame.t_us + shift_us + ROUNDING_US
            if seconds >= MASTER_S:
                assert before_us + shift_us <= own_us + ROUNDING_US
                times += 1
        elif frame.identifier in (EVENTS, EPOCH):
            before_us = frame.t_us
    assert times >= 5
    # Every event is in the log or in the link's counts, with its time to the microsecond.
    read = read_raw(log, fd=False)
    assert len(read.events) == seen.told["delivered"]
    assert seen.told["delivered"] + sum(seen.told["lost"].values()) == len(events)
    assert seen.told["lost"]["dropped_late"] > 0, "the bus was never full"
    known = set(map(tuple, in_order(events).tolist()))
    late = [event for event in read.events if event[0] >= MASTER_S * 1_000_000]
    assert late
    assert known.issuperset(read.events[: -len(late)])
    candidates = range(shift_us + least_us - ROUNDING_US, shift_us + most_us + ROUNDING_US + 1)
    assert any(known.issuperset((t - shift, x, y, on) for t, x, y, on in late) for shift in candidates)


def offset_bounds(log: list[Line]) -> tuple[int, int]:
    """Return the bounds of the kernel's clock less the camera's, us, which is the same at all times.

    The camera reads its clock after its SYNC is on the bus, and before the follow-up with that time is.
    """
    least_us, most_us, synced = -(2**62), 2**62, {}
    for frame in log:
        if frame.identifier == SYNC and frame.data[0] < FIRST_OF_PEER:
            synced[frame.data[0]] = frame.t_us
        elif frame.identifier == FOLLOW_UP:
            own_us = int.from_bytes(frame.data[1:], "little") // 1000
            least_us = max(least_us, synced[frame.data[0]] - own_us)
            most_us = min(most_us, frame.t_us - own_us)
    return least_us, most_us
