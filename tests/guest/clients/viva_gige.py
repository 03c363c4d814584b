"""viva-genicam searches for a GigE Vision camera and reads it: viva_gige.py OCTETS OUT; what it saw, as JSON."""

from __future__ import annotations

import json
import sys
import time

import viva_genicam as viva

PATIENCE_S = 120.0


def main() -> None:
    octets, out = int(sys.argv[1]), sys.argv[2]
    found = viva.discover(2000, None, True)
    camera = viva.connect_gige(found[0])
    camera.set("BiasEventThresholdPositive", "12")
    told = {"found": [one.ip for one in found], "bias": camera.get("BiasEventThresholdPositive")}
    stream = camera.stream(packet_size=1400)
    camera.acquisition_start()
    end_s, seen, incomplete, name = time.monotonic() + PATIENCE_S, 0, 0, ""
    with open(out, "wb") as file:
        while seen < octets and time.monotonic() < end_s:
            try:
                frame = stream.next_frame(timeout_ms=500)
            except viva.GenicamError:
                continue
            if frame is not None:
                incomplete += not frame.is_complete
                name = frame.pixel_format
                seen += file.write(bytes(frame.payload()))
    lost = stream.stats().frames_lost
    stream.close()
    camera.close()
    print(json.dumps({**told, "octets": seen, "incomplete": incomplete, "lost": lost, "format": str(name)}))


main()
