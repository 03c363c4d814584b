"""dv-processing 2.x: settings of its DVXplorer class while all streams run, and back to what they were."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

import dv_processing as dv
from changing import Change, make_changes
from collecting import Collector, arguments
from dv2 import open_camera, take

MODEL = dv.io.camera.DVXplorer
SUB_SAMPLE, FPS, FLATTEN = MODEL.SubSample, MODEL.ReadoutFPS, MODEL.Flatten
VALUES: dict[str, tuple[Any, ...]] = {
    "ContrastThresholdOn": (12, 9),
    "ContrastThresholdOff": (12, 9),
    "ReadoutFPS": (FPS.VARIABLE_2000, FPS.CONSTANT_1000, FPS.VARIABLE_15000, FPS.VARIABLE_5000),
    "SubSampleHorizontal": (SUB_SAMPLE.EVERY_SECOND, SUB_SAMPLE.BAND_OF_FOUR, SUB_SAMPLE.EVERY_PIXEL),
    "SubSampleVertical": (SUB_SAMPLE.EVERY_SECOND, SUB_SAMPLE.BAND_OF_FOUR, SUB_SAMPLE.EVERY_PIXEL),
    "CropArea": ((100, 80, 320, 240), (0, 0, 640, 480)),
    "Flatten": (FLATTEN.FLATTEN_ON, FLATTEN.ON_ONLY, FLATTEN.OFF_ONLY, FLATTEN.NONE),
    "FlipHorizontal": (True, False),
    "FlipVertical": (True, False),
    "GlobalHold": (False, True),
}


def changes(camera: Any) -> Iterator[Change]:
    for name, values in VALUES.items():
        for value in values:
            yield f"{name} = {value}", partial(getattr(camera, f"set{name}"), value)


def main() -> None:
    options = arguments()
    collector = Collector(options)
    camera = open_camera(options)
    take_some = partial(take, camera, collector, options)
    while not collector.counts["events"]:
        take_some()
    outcomes = make_changes(changes(camera), take_some, collector)
    while not collector.done and camera.isRunning():
        take_some()
    discovered = [device.serialNumber for device in dv.io.camera.discover()]
    seen = {"discovered": discovered, "running": camera.isRunning(), "changes": outcomes}
    del camera
    collector.report(**seen)


if __name__ == "__main__":
    main()
