"""dv-processing 1.7, which carries libcaer inside."""

from __future__ import annotations

import time

import dv_processing as dv
from collecting import Collector, arguments


def main() -> None:
    collector = Collector(arguments())
    discovered = dv.io.discoverDevices()
    camera = dv.io.CameraCapture()
    resolution = camera.getEventResolution()
    while not collector.done and camera.isRunning():
        batch = camera.getNextEventBatch()
        if batch is None:
            time.sleep(0.001)
            continue
        events = batch.numpy()
        collector.add(events["timestamp"], events["x"], events["y"], events["polarity"])
    seen = {
        "version": dv.__version__,
        "discovered": discovered,
        "name": camera.getCameraName(),
        "resolution": list(resolution),
        "running": camera.isRunning(),
    }
    del camera
    collector.report(**seen)


if __name__ == "__main__":
    main()
