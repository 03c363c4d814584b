"""Measure events, frames, inertial samples and edges of a DAVIS346 over USB/IP: two processes on loopback.

    python tests/transports/usb/streams_throughput.py [megabytes]

The server's camera takes batches as fast as its FIFO has room (12.5 events a microsecond, 25 frames, 1000 samples and
1000 edges a second of stream time); the host reads raw bytes. An encoder by itself makes the words of the same batches
without a camera: both byte streams must be equal. Prints MB/s (10^6 bytes) by the wall and by processor time.
"""

from __future__ import annotations

import asyncio
import multiprocessing
import os
import struct
import sys
import time
import zlib
from collections.abc import Iterator
from itertools import count
from multiprocessing.connection import Connection

import numpy as np

from firmware_protocol.davis346 import Davis346, Davis346Settings, WordEncoder
from firmware_protocol.device.items import ReadingKind
from firmware_protocol.events import EdgeKind, empty_edges
from firmware_protocol.usb.device import SetupPacket, Transfer
from laboratory.bench.streams import DavisBatch, davis_batches
from transports.usb.usbip.client import UsbipHost
from transports.usb.usbip.server import UsbipServer

EVENTS, BATCH = 500_000, 10_000
RUN = [(0, 3, 1), (9, 0, 1), (0, 1, 1), (0, 0, 1), (1, 3, 1), (2, 4, 1), (3, 2, 1), (3, 3, 1), (3, 4, 1)]
DETECT = [(4, 1, 1), (4, 2, 0), (4, 3, 0), (4, 0, 1)]


def endless_davis_batches(events: int, batch: int) -> Iterator[DavisBatch]:
    """Yield the same batches repeatedly; `events` a multiple of half a million, so that frames follow one another."""
    rounds = davis_batches(events, batch)
    span_us = rounds[-1].until_us + 1
    for number in count():
        for part in rounds:
            yield later(part, number * span_us)


def later(batch: DavisBatch, by_us: int) -> DavisBatch:
    """Return the same batch, later."""
    parts = [part.copy() for part in (batch.events, batch.marks, batch.lines, batch.samples)]
    for part in parts:
        part["t"] += np.uint64(by_us)
    return DavisBatch(*parts)


class Fed(Davis346):
    """A camera that is fed whenever it is read and has room."""

    def __init__(self) -> None:
        super().__init__(Davis346Settings(frames=True, imu_unit=2, start_delay_us=0))
        self._batches = endless_davis_batches(EVENTS, BATCH)

    def read(self, endpoint: int, max_bytes: int) -> Transfer | None:
        """Take data, of a FIFO that is never empty while the camera runs."""
        while endpoint == 2 and self._gate.events and self._input_runs and self.counters.queued < 2 * BATCH:
            batch = next(self._batches)
            self.offer_readings(ReadingKind.FRAMES, batch.lines)
            self.offer_readings(ReadingKind.IMU, batch.samples)
            edges = empty_edges(len(batch.marks))
            edges["t"], edges["kind"] = batch.marks["t"], EdgeKind.RISING
            self.offer_edges(edges)
            self.offer(batch.events)
        return super().read(endpoint, max_bytes)

    @property
    def _input_runs(self) -> bool:
        return bool(self._registers.read(4, 0))  # the last that the host writes


async def serve(control: Connection) -> None:
    server = UsbipServer({"1-1": Fed()})
    await server.start("127.0.0.1", 0)
    control.send(server.port)
    begun_s = time.process_time()
    while not control.poll():
        await asyncio.sleep(0.05)
    used_s = time.process_time() - begun_s
    await server.close()
    control.send(used_s)


def run_server(control: Connection) -> None:
    asyncio.run(serve(control))


def expected_crc(length: int) -> int:
    """Return the CRC-32 of the first `length` bytes as an encoder alone makes them."""
    encoder, crc, left = WordEncoder((346, 260)), 0, length
    for batch in endless_davis_batches(EVENTS, BATCH):
        data = encoder.encode(batch.events, 0, batch.marks, batch.blocks()).words.tobytes()[:left]
        crc, left = zlib.crc32(data, crc), left - len(data)
        if not left:
            return crc
    raise AssertionError("the batches ended")


def main() -> int:
    """Read so many megabytes, compare and print."""
    wanted = int(float(sys.argv[1] if len(sys.argv) > 1 else 100) * 1e6)
    ours, theirs = multiprocessing.Pipe()
    process = multiprocessing.get_context("spawn").Process(target=run_server, args=(theirs,))
    process.start()
    host = UsbipHost.attach(port=ours.recv(), timeout_s=60.0)
    host.configure()
    stream = host.stream(2, 131_072, 32)
    entries = [*RUN, *DETECT]
    data = b"".join(struct.pack(">BBI", *entry) for entry in entries)
    begun_s, own_s = time.monotonic(), time.process_time()
    host.control_out(SetupPacket(0x40, 0xC2, len(entries), 0, len(data)), data)
    got = crc = 0
    while got < wanted:
        data = stream.read(60.0) or b""
        got, crc = got + len(data), zlib.crc32(data, crc)
    wall_s, own_s = time.monotonic() - begun_s, time.process_time() - own_s
    ours.send("stop")
    served_s = ours.recv()
    host.close()
    process.join()
    equal = crc == expected_crc(got)
    sys.stdout.write(
        f"{got / 1e6:.0f} MB in {wall_s:.1f} s: {got / wall_s / 1e6:.1f} MB/s; server {got / served_s / 1e6:.1f} MB "
        f"a second of its processor time, host {got / own_s / 1e6:.1f}; load {os.getloadavg()[0]:.1f}; "
        f"{'all bytes equal' if equal else 'BYTES DIFFER'}\n"
    )
    return int(not equal or got / served_s < 40e6)


if __name__ == "__main__":
    sys.exit(main())
