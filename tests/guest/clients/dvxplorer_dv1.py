"""dv-processing 1.7: settings of a DVXplorer while all streams run, and back to what they were."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

import dv_processing as dv
from changing import Change, make_changes
from collecting import Collector, arguments
from dv1 import open_camera, take

CAPTURE = dv.io.CameraCapture
SENSITIVITY, FPS = CAPTURE.BiasSensitivity, CAPTURE.DVXeFPS
VALUES: dict[str, tuple[Any, ...]] = {
    "DVSBiasSensitivity": (SENSITIVITY.Low, SENSITIVITY.High, SENSITIVITY.Default),
    "DVXplorerEFPS": (FPS.EFPS_VARIABLE_2000, FPS.EFPS_CONSTANT_1000, FPS.EFPS_VARIABLE_15000, FPS.EFPS_VARIABLE_5000),
    "DVSGlobalHold": (False, True),
}


def changes(camera: Any) -> Iterator[Change]:
    for name, values in VALUES.items():
        for value in values:
            yield f"{name} = {value}", partial(getattr(camera, f"set{name}"), value)


def main() -> None:
    options = arguments()
    collector = Collector(options)
    discovered = dv.io.discoverDevices()
    camera = open_camera(options)
    take_some = partial(take, camera, collector, options)
    while not collector.counts["events"]:
        take_some()
    outcomes = make_changes(changes(camera), take_some, collector)
    while not collector.done and camera.isRunning():
        take_some()
    seen = {"discovered": discovered, "running": camera.isRunning(), "changes": outcomes}
    del camera
    collector.report(**seen)


if __name__ == "__main__":
    main()
