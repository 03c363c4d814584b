"""dv-processing 1.7: settings of a DVXplorer while all streams run, and back to what they were."""

from __future__ import annotations

from typing import Any

import dv1
import dv_processing as dv
from changing import change_values

CAPTURE = dv.io.CameraCapture
SENSITIVITY, FPS = CAPTURE.BiasSensitivity, CAPTURE.DVXeFPS
VALUES: dict[str, tuple[Any, ...]] = {
    "DVSBiasSensitivity": (SENSITIVITY.Low, SENSITIVITY.High, SENSITIVITY.Default),
    "DVXplorerEFPS": (FPS.EFPS_VARIABLE_2000, FPS.EFPS_CONSTANT_1000, FPS.EFPS_VARIABLE_15000, FPS.EFPS_VARIABLE_5000),
    "DVSGlobalHold": (False, True),
}

if __name__ == "__main__":
    change_values(dv1, VALUES)
