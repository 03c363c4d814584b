"""Opens and closes a camera again and again; each time it is closed as soon as all its streams have come.

    cycling.py CLIENT CYCLES TIMEOUT_S [--streams events,triggers,imu,frames] [--device NAME] [--seconds S]

CLIENT is the module of a driver (dv1, dv2, nd), NAME a camera by neuromorphic_drivers' name. The last line is a JSON
object: `cycles` done, the `seconds` that they took, the `slowest_s`, and the open `files` of the process after the
first and the last one. The program fails when a stream stays away for too long. After --seconds it begins no other
cycle.
"""

import json
import sys
import time
from argparse import ArgumentParser, Namespace
from importlib import import_module
from pathlib import Path

from collecting import Collector


def arguments():
    """Return the options, as far as the clients have them too by the clients' names."""
    parser = ArgumentParser()
    parser.add_argument("client")
    parser.add_argument("cycles", type=int)
    parser.add_argument("timeout", type=float)
    parser.add_argument(
        "--streams", type=lambda names: names.split(","), default=["events", "triggers", "imu", "frames"]
    )
    parser.add_argument("--device", default="inivation_davis346")
    parser.add_argument("--seconds", type=float, default=float("inf"))
    options = parser.parse_args()
    for stream in ("triggers", "imu", "frames"):
        setattr(options, stream, stream in options.streams)
    return options


def cycle(client, asked):
    """Open the camera, wait for its streams, close it in the midst of them, and return how long that took, in s."""
    started = time.monotonic()
    options = Namespace(
        packet_ms=0, count=sys.maxsize, output=Path("/tmp/cycling.npz"), on=False, until=None, attempts=1,
        **vars(asked),
    )  # fmt: skip
    collector = Collector(options)
    camera = client.open_camera(options)
    while not all(collector.counts[stream] for stream in asked.streams):
        client.take(camera, collector, options)
        if collector.done:
            raise TimeoutError(f"not all streams within {asked.timeout} s: {collector.counts}")
    if hasattr(camera, "close"):  # the others close when nothing refers to them
        camera.close()
    return time.monotonic() - started


def main():
    asked = arguments()
    client = import_module(asked.client)
    took, files = [], []
    while len(took) < asked.cycles and sum(took) < asked.seconds:
        took.append(cycle(client, asked))
        files.append(len(list(Path("/proc/self/fd").iterdir())))
        print(f"{len(took)}: {took[-1]:.1f} s", file=sys.stderr, flush=True)
    took_s = {"seconds": round(sum(took)), "slowest_s": max(took)}
    print(json.dumps({"cycles": len(took), **took_s, "files": [files[0], files[-1]]}))


if __name__ == "__main__":
    main()
