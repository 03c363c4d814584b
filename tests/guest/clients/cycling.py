"""Opens and closes the camera again and again; each time it is closed as soon as all four streams have come.

    cycling.py CLIENT CYCLES TIMEOUT_S

CLIENT is the module of a driver (dv1, dv2, nd). The last line is a JSON object: `cycles` done, the `slowest_s`, and the
open `files` of the process after the first and the last one. The program fails when a stream stays away for too long.
"""

from __future__ import annotations

import json
import sys
import time
from argparse import Namespace
from importlib import import_module
from pathlib import Path
from types import ModuleType

from collecting import Collector


def cycle(client: ModuleType, timeout_s: float) -> float:
    """Open the camera, wait for all streams, close it in the midst of them, and return how long that took, in s."""
    started = time.monotonic()
    options = Namespace(
        triggers=True, imu=True, frames=True, packet_ms=0, count=sys.maxsize, timeout=timeout_s,
        output=Path("/tmp/cycling.npz"), aedat4=None, on=False, until=None, attempts=1,
        device="inivation_davis346",
    )  # fmt: skip
    collector = Collector(options)
    camera = client.open_camera(options)
    while not all(collector.counts.values()):
        client.take(camera, collector, options)
        if collector.done:
            raise TimeoutError(f"not all streams within {timeout_s} s: {collector.counts}")
    if hasattr(camera, "close"):  # the others close when nothing refers to them
        camera.close()
    return time.monotonic() - started


def main() -> None:
    client, cycles, timeout_s = import_module(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3])
    took, files = [], []
    for _ in range(cycles):
        took.append(cycle(client, timeout_s))
        files.append(len(list(Path("/proc/self/fd").iterdir())))
        print(f"{len(took)}: {took[-1]:.1f} s", file=sys.stderr, flush=True)
    print(json.dumps({"cycles": len(took), "slowest_s": max(took), "files": [files[0], files[-1]]}))


if __name__ == "__main__":
    main()
