"""dv-processing 2.x, the vendor's library with a driver of its own."""

from datetime import timedelta

import dv_processing as dv
from collecting import Collector, arguments
from dv_streams import take, take_all

__all__ = ["discovered", "open_camera", "take"]


def discovered():
    return [device.serialNumber for device in dv.io.camera.discover()]


def open_camera(options):
    """Open the first camera as the options ask."""
    camera = dv.io.camera.open()
    if options.triggers:
        camera.setDetectorRisingEdges(True)
        camera.setDetectorFallingEdges(True)
        camera.setDetectorRunning(True)
    if options.frames:
        # It brightens until pixels saturate; dv-processing takes a signal below 4 as none, of which no record tells.
        camera.setAutoExposure(False)
    if options.packet_ms:
        camera.setTimeInterval(timedelta(milliseconds=options.packet_ms))
    return camera


def main():
    options = arguments()
    collector = Collector(options)
    seen = {"version": dv.__version__, "discovered": discovered()}
    camera = open_camera(options)
    resolution = camera.getEventResolution()
    take_all(camera, collector, options)
    seen |= {
        "name": camera.getCameraName(),
        "serial": camera.getSerialNumber(),
        "resolution": list(resolution),
        "logic": camera.getLogicVersion() if hasattr(camera, "getLogicVersion") else None,
        "speed": str(camera.getConnectionSpeed()),
        "master": camera.isMaster() if hasattr(camera, "isMaster") else None,
        "running": camera.isRunning(),
    }
    del camera
    collector.report(**seen)


if __name__ == "__main__":
    main()
