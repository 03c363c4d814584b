"""dv-processing 2.x, the vendor's library with a driver of its own."""

from __future__ import annotations

import time

import dv_processing as dv
from collecting import Collector, arguments


def main() -> None:
    collector = Collector(arguments())
    discovered = [device.serialNumber for device in dv.io.camera.discover()]
    camera = dv.io.camera.open()
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
        "serial": camera.getSerialNumber(),
        "resolution": list(resolution),
        "logic": camera.getLogicVersion(),
        "speed": str(camera.getConnectionSpeed()),
        "master": camera.isMaster(),
        "running": camera.isRunning(),
    }
    del camera
    collector.report(**seen)


if __name__ == "__main__":
    main()
