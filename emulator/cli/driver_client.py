"""Reader of a GigE Vision camera: neuromorphic_drivers, unmodified, in a process that `evstim demo` starts.

The driver holds the interpreter's lock while it waits for the camera, so it never shares a process with one.
"""

from __future__ import annotations

import importlib.util
import signal
import subprocess
import sys
import threading
from pathlib import Path

from firmware_protocol.events import EVENT
from firmware_protocol.recordings.part import Part
from transports.recording.record import Recorder

DRIVER = "neuromorphic_drivers"
_PACKET_OCTETS = 1400
_RING_LENGTH = 1 << 16


def driver_works() -> bool:
    """Return whether the driver is installed and can start here: it needs libusb, also for Ethernet."""
    if importlib.util.find_spec(DRIVER) is None:
        return False
    script = f"import {DRIVER} as driver; driver.list_devices()"
    return subprocess.run([sys.executable, "-P", "-c", script], capture_output=True, check=False).returncode == 0


def main(address: str, record: str) -> int:
    """Read the camera at `address` until SIGINT into a record; returns 1 where the driver cannot open it."""
    import neuromorphic_drivers as nd
    from neuromorphic_drivers.generated.devices import lucid_triton

    ring = lucid_triton.RingConfiguration(buffer_length=_PACKET_OCTETS, ring_length=_RING_LENGTH)
    try:
        camera = nd.open(lucid_triton.Configuration(), address=address, iterator_timeout=0.1, ring_configuration=ring)
    except RuntimeError as error:
        sys.stderr.write(f"{DRIVER}: {error}\n")
        return 1
    stopped = threading.Event()
    signal.signal(signal.SIGINT, lambda *_: stopped.set())
    recorder = Recorder(Path(record))
    with camera:
        for _, packet in camera:
            if packet is not None and packet.polarity_events is not None:
                recorder.append(Part(packet.polarity_events.astype(EVENT)))
            if stopped.is_set():
                break
    recorder.close()
    return 0
