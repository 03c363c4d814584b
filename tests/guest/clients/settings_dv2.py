"""dv-processing 2.x: every setter of its DAVIS class while all streams run, and back to what it was."""

import inspect
from datetime import timedelta
from functools import partial

import dv_processing as dv
from changing import change_all
from collecting import Collector, arguments
from dv2 import open_camera, take

DAVIS = dv.io.camera.DAVIS
IMU = dv.io.camera.imu
HALF_MS, MS = timedelta(microseconds=500), timedelta(milliseconds=1)
REGION, WHOLE = (20, 30, 200, 150), (0, 0, 346, 260)
FLAGS_ON = (
    *("EventsRunning", "FramesRunning", "ImuRunningAccelerometer", "ImuRunningGyroscope", "ImuRunningTemperature"),
    *("DetectorRisingEdges", "DetectorFallingEdges", "DetectorRunning"),
)
FLAGS_OFF = (
    *("AutoExposure", "FlipHorizontal", "FlipVertical", "FlipHorizontalEvents", "FlipVerticalEvents"),
    *("FlipHorizontalFrames", "FlipVerticalFrames", "IMUFlipX", "IMUFlipY", "IMUFlipZ"),
    *("GeneratorInjectTriggerOnFallingEdge", "GeneratorInjectTriggerOnRisingEdge", "GeneratorRunning"),
)
VALUES = {
    "ExposureDuration": (4 * MS, 20 * MS),
    "FrameInterval": (100 * MS, 0 * MS),
    "ColorMode": tuple(DAVIS.ColorMode.__members__[k] for k in ("GRAYSCALE", "ORIGINAL", "ORIGINAL_SPLIT", "DEFAULT")),
    "ImuAccelRange": tuple(IMU.InvensenseAccelRange.__members__[f"RANGE_{k}G"] for k in (2, 8, 16, 4)),
    "ImuGyroRange": tuple(IMU.InvensenseGyroRange.__members__[f"RANGE_{k}DPS"] for k in (250, 1000, 2000, 500)),
    "GeneratorHighTime": (2 * MS, 1 * MS),
    "GeneratorLowTime": (3 * MS, 1 * MS),
    "BackgroundActivityFilter": (8, 0),
    "RefractoryPeriodFilter": (2, 0),
    "SkipFilter": (3, 0),
    "Flatten": tuple(DAVIS.Flatten.__members__[k] for k in ("FLATTEN_ON", "ON_ONLY", "OFF_ONLY", "NONE")),
    "CropArea": (REGION, WHOLE),
    "CropAreaEvents": (REGION, WHOLE),
    "CropAreaFrames": (REGION, WHOLE),
    "TimeInterval": (5 * MS, 10 * MS),
    "USBEarlyPacketDelay": (HALF_MS, MS),
    "LogLevel": tuple(dv.io.camera.USBDevice.LogLevel.__members__[f"LVL_{k}"] for k in ("DEBUG", "WARNING")),
}  # fmt: skip
NEVER_RETURNS = ("getGeneratorLowTime",)  # see environments.py
LOSE_DATA = {"setTransfersNumber", "setTransfersSize"}  # and may end the stream: see environments.py
OF_OTHER_MODELS = ("Davis240", "CDavis")


def changes(camera):
    """Every setter, with the values of the tables above; the last one is the driver's default."""
    yield from setters(camera, dict.fromkeys(FLAGS_OFF, (True, False)) | VALUES)  # first what moves the exposure
    for name, bias in DAVIS.Davis346BiasCF.__members__.items():
        yield from bias_changes(camera, name, bias)
    for name, bias in DAVIS.Davis346BiasVDAC.__members__.items():
        voltage = camera.getDavis346BiasVoltage(bias)
        for value in ((voltage + 1) % 64, voltage):
            yield f"setDavis346BiasVoltage({name}, {value})", partial(camera.setDavis346BiasVoltage, bias, value)
    yield "snapshot()", camera.snapshot
    stop_events = {"ExternalAERControl": (True, False)}  # as the snapshot stops frames; the flags start them again
    yield from setters(camera, stop_events | dict.fromkeys(FLAGS_ON, (False, True)))


def setters(camera, values):
    for name, wanted in values.items():
        for value in wanted:
            yield f"set{name}({value})", partial(getattr(camera, f"set{name}"), value)


def bias_changes(camera, name, bias):
    coarse, fine = camera.getDavis346BiasCoarseFine(bias)
    for value in (coarse, fine - 1 if fine > 1 else fine + 1), (coarse, fine):
        yield f"setDavis346BiasCoarseFine({name}, {value})", partial(camera.setDavis346BiasCoarseFine, bias, *value)


def getters(camera):
    """Everything that takes no argument and only looks."""
    for name, method in inspect.getmembers(camera, callable):
        looks = name.startswith(("get", "is")) and not name.startswith("getNext")
        if looks and "Bias" not in name and name not in ("getEventColor", "isStreamAvailable", *NEVER_RETURNS):
            yield f"{name}()", method


def untried(camera, tried):
    """The setters that no change has called, but for those of other models and those that lose data."""
    setters = {name for name in dir(camera) if name.startswith("set") and not name[3:].startswith(OF_OTHER_MODELS)}
    return sorted(setters - LOSE_DATA - {name.split("(")[0] for name in tried})


def main():
    options = arguments()
    collector = Collector(options)
    camera = open_camera(options)
    planned = list(changes(camera))
    outcomes = change_all(camera, take, planned, getters(camera), collector)
    seen = {"running": camera.isRunning(), "untried": untried(camera, [name for name, _ in planned])}
    del camera, planned
    collector.report(changes=outcomes, **seen)


if __name__ == "__main__":
    main()
