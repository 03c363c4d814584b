"""Measure what the USB/IP server and the user-space host carry: two processes on the loopback interface.

    python tests/transports/usb/throughput.py [seconds]

The server's device hands out the same preallocated bytes again and again, so the figure is that of the link alone.
Prints MB/s (10^6 bytes) and URB/s for each size, and the share of a core that each process used.
"""

from __future__ import annotations

import asyncio
import multiprocessing
import resource
import sys
import time
from multiprocessing.connection import Connection

from firmware_protocol.usb.descriptors import Speed
from firmware_protocol.usb.device import Identity, SetupPacket, Stall, Transfer, UsbDevice
from transports.usb.usbip.client import UsbipHost
from transports.usb.usbip.server import UsbipServer

SIZES = {131_072: 32, 8_192: 32, 512: 32}


class Spring(UsbDevice):
    """A device that always has data."""

    def __init__(self) -> None:
        self._transfers = {size: Transfer(data=bytes(size)) for size in SIZES}

    @property
    def identity(self) -> Identity:
        return Identity(0x152A, 0x841A, 0x0206, Speed.SUPER)

    def attached(self) -> None:
        pass

    def detached(self) -> None:
        pass

    def control(self, setup: SetupPacket, data: bytes) -> bytes:
        raise Stall

    def read(self, endpoint: int, max_bytes: int) -> Transfer | None:
        return self._transfers[max_bytes]

    def sent(self, transfer: Transfer) -> None:
        pass

    def lost(self, transfer: Transfer) -> None:
        pass


async def serve(control: Connection) -> None:
    server = UsbipServer({"1-1": Spring()})
    await server.start("127.0.0.1", 0)
    control.send(server.port)
    while not control.poll():
        await asyncio.sleep(0.05)
    await server.close()
    control.send(cpu_s())


def run_server(control: Connection) -> None:
    asyncio.run(serve(control))


def cpu_s() -> float:
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


def measure(size: int, transfers: int, seconds: float) -> str:
    ours, theirs = multiprocessing.Pipe()
    process = multiprocessing.get_context("spawn").Process(target=run_server, args=(theirs,))
    process.start()
    host = UsbipHost.attach(port=ours.recv())
    stream = host.stream(2, size, transfers)
    start, cpu, n = time.monotonic(), cpu_s(), 0
    while time.monotonic() - start < seconds:
        n += len(stream.read(1.0) or b"")
    wall = time.monotonic() - start
    cpu = cpu_s() - cpu
    host.close()
    ours.send("stop")
    served = ours.recv()
    process.join()
    return (
        f"{size:7d} B x {transfers}: {n / wall / 1e6:8.1f} MB/s {n / size / wall:9.0f} URB/s"
        f"   core: host {cpu / wall:.2f}, server {served / wall:.2f} (with its start)"
    )


if __name__ == "__main__":
    for size, transfers in SIZES.items():
        sys.stdout.write(measure(size, transfers, float(sys.argv[1]) if len(sys.argv) > 1 else 2.0) + "\n")
