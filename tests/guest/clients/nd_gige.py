"""neuromorphic_drivers reads a GigE Vision camera: events to a file, and what it noticed, as JSON.

python nd_gige.py ADDRESS EVENTS PACKET_OCTETS OUT.npz [OPENINGS]
"""

import json
import sys
import time

import neuromorphic_drivers as nd
import numpy as np
from neuromorphic_drivers.generated.devices import lucid_triton

PATIENCE_S = 120.0
MOST_ATTEMPTS = 10
FIELDS = ("t", "x", "y", "on")


def opened(address, ring, told=None):
    """Open the camera; the driver gives up when an answer takes 25 ms, as on a busy machine, and so is asked again."""
    for attempt in range(MOST_ATTEMPTS):
        try:
            told = told or lucid_triton.Configuration()
            return nd.open(told, address=address, iterator_timeout=0.1, ring_configuration=ring)
        except RuntimeError as error:
            if attempt + 1 == MOST_ATTEMPTS:
                raise
            print(f"opening {attempt + 1}: {error}", file=sys.stderr)
            time.sleep(7.0)  # the camera forgets a host that has not closed after 6 s
    raise AssertionError


def one_opening(address, count, octets):
    """Open, read at least `count` events, close."""
    ring = lucid_triton.RingConfiguration(buffer_length=octets, ring_length=1 << 17)
    parts, seen, dropped, begun_s = [], 0, 0, 0.0
    with opened(address, ring) as camera:
        bounds = {str(name): str(value) for name, value in vars(camera.biases_bounds()).items()}
        end_s = time.monotonic() + PATIENCE_S
        for status, packet in camera:
            if packet is not None and packet.polarity_events is not None:
                begun_s = begun_s or time.monotonic()
                parts.append(packet.polarity_events)
                seen += len(parts[-1])
            dropped = getattr(status, "dropped_packets", 0) or dropped
            if seen >= count or time.monotonic() > end_s:
                break
        read_s = time.monotonic() - begun_s
        celsius = camera.temperature_celsius()
    return {"parts": parts, "seen": seen, "read_s": read_s, "dropped": dropped, "celsius": celsius, "bounds": bounds}


def main():
    address, count, octets, out = sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), sys.argv[4]
    openings = int(sys.argv[5]) if len(sys.argv) > 5 else 1
    for number in range(openings):
        told = one_opening(address, count, octets)
        parts = told.pop("parts")
        if number == openings - 1:
            events = np.concatenate(parts)
            np.savez(out, **{name: events[name] for name in FIELDS})
    print(json.dumps({**told, "openings": openings}))


if __name__ == "__main__":
    main()
