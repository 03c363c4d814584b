"""neuromorphic_drivers reads a GigE Vision camera at one set of biases after another: events of each to a file.

python nd_gige_biases.py ADDRESS SECONDS OUT.npz BIASES...    a set is JSON, such as {"diff_on": 20}

The first set is that of the opening, the others are updates. The first second of each is left out: biases take a
moment to act. Member K of the file has the events of set K.
"""

import json
import sys
import time

import neuromorphic_drivers as nd
import numpy as np
from nd_gige import opened
from neuromorphic_drivers.generated.devices import lucid_triton

SETTLING_S = 1.0
PATIENCE_S = 120.0


def read(camera, seconds):
    """Return the events of so many seconds of the camera's time, after the settling."""
    parts, begin_us = [], None
    end_s = time.monotonic() + PATIENCE_S
    for _status, packet in camera:
        assert time.monotonic() < end_s, "no events for two minutes"
        if packet is None or packet.polarity_events is None or not len(packet.polarity_events):
            continue
        events = packet.polarity_events
        begin_us = int(events["t"][0]) if begin_us is None else begin_us
        parts.append(events)
        if int(events["t"][-1]) - begin_us > (SETTLING_S + seconds) * 1e6:
            break
    together = np.concatenate(parts)
    return together[together["t"] > begin_us + SETTLING_S * 1e6]


def main():
    address, seconds, out = sys.argv[1], float(sys.argv[2]), sys.argv[3]
    sets = [lucid_triton.Biases(**json.loads(one)) for one in sys.argv[4:]]
    ring = lucid_triton.RingConfiguration(buffer_length=1400, ring_length=1 << 14)
    seen = {}
    with opened(address, ring, lucid_triton.Configuration(biases=sets[0])) as camera:
        for number, biases in enumerate(sets):
            if number:
                camera.update_configuration(lucid_triton.Configuration(biases=biases))
                camera.clear_backlog(0)
            events = read(camera, seconds)
            seen[str(number)] = np.rec.fromarrays([events[name] for name in ("t", "x", "y", "on")], names="t,x,y,on")
    np.savez(out, **seen)
    print(json.dumps({"version": nd.__version__ if hasattr(nd, "__version__") else "", "sets": len(seen)}))


main()
