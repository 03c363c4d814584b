"""What the three clients share: their arguments, and the events they collect.

    client.py --count N --timeout S --output FILE.npz [--triggers] [--imu] [--frames] [--packet-ms MS]

Each client prints what it saw as one JSON object on its last line, and saves the events as the arrays t (int64,
microseconds), x, y (uint16) and on (bool). At its first events it makes the empty file FILE.started.

With --on it reads on after N events, until the camera is gone, and makes the file FILE.started only then.

With --until FILE it also stops when this file is there.

With --device NAME the client of neuromorphic_drivers opens another camera than a DAVIS346.

With --attempts the client of neuromorphic_drivers opens again where the driver finds no camera.

With --triggers it asks the external input for rising and falling edges and pulses, and saves what the driver tells of
them as trigger_t (int64, microseconds) and trigger_kind (uint8: 2 rising, 3 falling, 4 pulse).

With --imu it takes samples of the inertial unit, and saves what the driver makes of them as imu_t (int64, microseconds)
and imu (float64, one row each: acceleration x, y, z in g, temperature in degrees Celsius, rate x, y, z in deg/s).

With --frames it saves frames as frame_t (int64, microseconds) and frames (n, height, width), as the driver gives them.

With --packet-ms the drivers of iniVation hand events over after so much device time, instead of 10 ms: where a camera
runs a thousand times faster than real time, their queues of packets would overflow.
"""

import argparse
import json
import time
from pathlib import Path

import numpy as np


def parser():
    """The arguments that all clients have."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--count", type=int, required=True, help="stop after this many events")
    parser.add_argument("--timeout", type=float, required=True, help="stop after this many seconds")
    parser.add_argument("--on", action="store_true", help="go on until the camera is gone")
    parser.add_argument("--attempts", type=int, default=1, help="open the camera so often, a second apart")
    parser.add_argument("--until", type=Path, help="stop when this file is there")
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--triggers", action="store_true", help="listen to the external input")
    parser.add_argument("--imu", action="store_true", help="take samples of the inertial unit")
    parser.add_argument("--frames", action="store_true", help="keep frames")
    parser.add_argument("--packet-ms", type=int, default=0, help="device time between packets; 0: the driver's own")
    parser.add_argument("--device", default="inivation_davis346", help="camera, by neuromorphic_drivers' name")
    return parser


def arguments(asked=None):
    return (asked or parser()).parse_args()


class Collector:
    """Keeps every event until there are enough or time is up."""

    def __init__(self, options):
        self._count = options.count
        self._on, self._until = options.on, options.until
        self._output = options.output
        self._deadline = time.monotonic() + options.timeout
        self._columns = []
        self._triggers = []
        self._imu = []
        self._frames = []
        self._collected = 0
        self._started = None
        self._announced = False

    @property
    def done(self):
        enough = self._collected >= self._count and not self._on
        stopped = self._until is not None and self._until.exists()
        return enough or stopped or time.monotonic() > self._deadline

    @property
    def counts(self):
        """How much of each stream has come."""
        return {
            "events": self._collected, "triggers": len(self._triggers), "imu": len(self._imu),
            "frames": len(self._frames),
        }  # fmt: skip

    @property
    def last_t(self):
        """Time of the last event, in microseconds; 0 before the first."""
        return int(self._columns[-1][0][-1]) if self._columns else 0

    def restart(self):
        """Forget what was collected."""
        self._columns, self._triggers, self._imu, self._frames = [], [], [], []
        self._collected = 0

    def add(self, t, x, y, on):
        if self._started is None:
            self._started = time.monotonic()
        self._columns.append((t.astype(np.int64), x.astype(np.uint16), y.astype(np.uint16), on.astype(bool)))
        self._collected += len(t)
        if not self._announced and self._collected >= (self._count if self._on else 1):
            self._output.with_suffix(".started").touch()
            self._announced = True

    def add_trigger(self, t, kind):
        self._triggers.append((t, kind))

    def add_imu(self, t, *values):
        self._imu.append((t, *values))

    def add_frame(self, t, pixels):
        self._frames.append((t, np.array(pixels)))

    def report(self, **seen):
        """Save the events and triggers and print what was seen."""
        columns = [np.concatenate(column) for column in zip(*self._columns, strict=True)] or [np.empty(0)] * 4
        triggers = {
            "trigger_t": np.array([t for t, _ in self._triggers], np.int64),
            "trigger_kind": np.array([kind for _, kind in self._triggers], np.uint8),
        }
        imu = np.array(self._imu, np.float64).reshape(-1, 8)
        triggers |= {"imu_t": imu[:, 0].astype(np.int64), "imu": imu[:, 1:]}
        triggers |= {"frame_t": np.array([t for t, _ in self._frames], np.int64)}
        triggers |= {"frames": np.array([pixels for _, pixels in self._frames])}
        np.savez(self._output, **dict(zip(("t", "x", "y", "on"), columns, strict=True)), **triggers)
        streamed_s = time.monotonic() - (self._started or time.monotonic())
        print(json.dumps({"events": self._collected, "streamed_s": round(streamed_s, 3), **seen}), flush=True)
