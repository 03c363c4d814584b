"""dv-processing 2.x: settings of its DVXplorer class while all streams run, and back to what they were."""

from __future__ import annotations

from typing import Any

import dv2
import dv_processing as dv
from changing import change_values

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

if __name__ == "__main__":
    change_values(dv2, VALUES)
