"""dv-processing 1.7, which carries libcaer inside."""

from __future__ import annotations

import argparse
import time

import dv_processing as dv
from collecting import Collector, arguments
from written_camera import written

HOST_PACKETS, MAX_INTERVAL_US = -3, 1  # libcaer's CAER_HOST_CONFIG_PACKETS
EXTERNAL_INPUT = 4
DETECT = (1, 2, 3, 0)  # rising, falling, pulses, run
KINDS = {
    dv.TriggerType.EXTERNAL_SIGNAL_RISING_EDGE: 2,
    dv.TriggerType.EXTERNAL_SIGNAL_FALLING_EDGE: 3,
    dv.TriggerType.EXTERNAL_SIGNAL_PULSE: 4,
}


def collect_triggers(camera: dv.io.CameraCapture, collector: Collector) -> None:
    for trigger in camera.getNextTriggerBatch() or ():
        if trigger.type in KINDS:
            collector.add_trigger(trigger.timestamp, KINDS[trigger.type])


def collect_imu(camera: dv.io.CameraCapture, collector: Collector) -> None:
    for one in camera.getNextImuBatch() or ():
        acceleration_g = one.accelerometerX, one.accelerometerY, one.accelerometerZ
        rate_deg_s = one.gyroscopeX, one.gyroscopeY, one.gyroscopeZ
        collector.add_imu(one.timestamp, *acceleration_g, one.temperature, *rate_deg_s)


def open_camera(options: argparse.Namespace) -> dv.io.CameraCapture:
    """Open the first camera as the options ask."""
    camera = dv.io.CameraCapture()
    for parameter in DETECT if options.triggers else ():
        camera.deviceConfigSet(EXTERNAL_INPUT, parameter, 1)
    if options.packet_ms:
        camera.deviceConfigSet(HOST_PACKETS, MAX_INTERVAL_US, options.packet_ms * 1000)
    return written(camera, options)


def take(camera: dv.io.CameraCapture, collector: Collector, options: argparse.Namespace) -> None:
    """Take one packet of each stream that is asked for, or wait for a moment."""
    collect_triggers(camera, collector)
    if options.imu:
        collect_imu(camera, collector)
    if options.frames and (frame := camera.getNextFrame()) is not None:
        collector.add_frame(frame.timestamp, frame.image)
    batch = camera.getNextEventBatch()
    if batch is None:
        time.sleep(0.001)
        return
    events = batch.numpy()
    collector.add(events["timestamp"], events["x"], events["y"], events["polarity"])


def main() -> None:
    options = arguments()
    collector = Collector(options)
    discovered = dv.io.discoverDevices()
    camera = open_camera(options)
    resolution = camera.getEventResolution()
    while not collector.done and camera.isRunning():
        take(camera, collector, options)
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
