"""dv-processing 2.x, the vendor's library with a driver of its own."""

from __future__ import annotations

import argparse
import time
from datetime import timedelta

import dv_processing as dv
from collecting import Collector, arguments
from written_camera import written

KINDS = {
    dv.TriggerType.EXTERNAL_SIGNAL_RISING_EDGE: 2,
    dv.TriggerType.EXTERNAL_SIGNAL_FALLING_EDGE: 3,
    dv.TriggerType.EXTERNAL_SIGNAL_PULSE: 4,
}


def collect_triggers(camera: dv.io.camera.DAVIS, collector: Collector) -> None:
    for trigger in camera.getNextTriggerBatch() or ():
        if trigger.type in KINDS:
            collector.add_trigger(trigger.timestamp, KINDS[trigger.type])


def collect_imu(camera: dv.io.camera.DAVIS, collector: Collector) -> None:
    for one in camera.getNextImuBatch() or ():
        acceleration_g = one.accelerometerX, one.accelerometerY, one.accelerometerZ
        rate_deg_s = one.gyroscopeX, one.gyroscopeY, one.gyroscopeZ
        collector.add_imu(one.timestamp, *acceleration_g, one.temperature, *rate_deg_s)


def open_camera(options: argparse.Namespace) -> dv.io.camera.DAVIS:
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
    return written(camera, options)


def take(camera: dv.io.camera.DAVIS, collector: Collector, options: argparse.Namespace) -> None:
    """Take one packet of each stream that is asked for, or wait for a moment."""
    if hasattr(camera, "getNextTriggerBatch"):  # a DVXplorer Micro has no external input
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
    discovered = [device.serialNumber for device in dv.io.camera.discover()]
    camera = open_camera(options)
    resolution = camera.getEventResolution()
    while not collector.done and camera.isRunning():
        take(camera, collector, options)
    seen = {
        "version": dv.__version__,
        "discovered": discovered,
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
