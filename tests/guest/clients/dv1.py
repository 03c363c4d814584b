"""dv-processing 1.7, which carries libcaer inside."""

import dv_processing as dv
from collecting import Collector, arguments
from dv_streams import take, take_all

__all__ = ["EXTERNAL_INPUT", "discovered", "open_camera", "take"]

HOST_PACKETS, MAX_INTERVAL_US = -3, 1  # libcaer's CAER_HOST_CONFIG_PACKETS
EXTERNAL_INPUT = 4
DETECT = (1, 2, 3, 0)  # rising, falling, pulses, run


def discovered():
    return dv.io.discoverDevices()


def open_camera(options):
    """Open the first camera as the options ask."""
    camera = dv.io.CameraCapture()
    for parameter in DETECT if options.triggers else ():
        camera.deviceConfigSet(EXTERNAL_INPUT, parameter, 1)
    if options.packet_ms:
        camera.deviceConfigSet(HOST_PACKETS, MAX_INTERVAL_US, options.packet_ms * 1000)
    return camera


def main():
    options = arguments()
    collector = Collector(options)
    seen = {"version": dv.__version__, "discovered": discovered()}
    camera = open_camera(options)
    resolution = camera.getEventResolution()
    take_all(camera, collector, options)
    seen |= {"name": camera.getCameraName(), "resolution": list(resolution), "running": camera.isRunning()}
    del camera
    collector.report(**seen)


if __name__ == "__main__":
    main()
