"""dv-processing 1.7 with libcaer: every parameter of libcaer's davis.h and each setter while all streams run, and back.

The numbers are those of libcaer 3.3: modules (multiplexer 0, DVS 1, APS 2, IMU 3, external input 4, bias 5, chip 5 from
128, system 6, USB 9), and the host's own, which are negative. Each parameter is read, set to another value, read again
and set back.
"""

import time
from datetime import timedelta
from functools import partial

import dv_processing as dv
from changing import FAILURES, change_all
from collecting import Collector, arguments
from dv1 import EXTERNAL_INPUT, open_camera, take

CAPTURE = dv.io.CameraCapture
MUX, DVS, APS, IMU, BIAS, USB = 0, 1, 2, 3, 5, 9
HOST_USB, HOST_DATA, HOST_PACKETS, HOST_LOG = -1, -2, -3, -4
FLAGS = {
    MUX: (4, 5),
    DVS: (3, 4, 5, 31, 33, 51, 61, 62, 63),
    APS: (4, 5, 7, 101),
    IMU: (2, 3, 4),
    EXTERNAL_INPUT: (0, 1, 2, 3, 4, 11, 12, 15, 16),
    BIAS: (*range(136, 139), *range(140, 145)),
}
NUMBERS = {
    DVS: {**{k: 7 for k in range(11, 27)}, 32: 12, 34: 3, 41: 20, 42: 30, 43: 200, 44: 150, 52: 3},
    APS: {8: 20, 9: 30, 10: 200, 11: 150, 12: 2000, 13: 80_000, 102: 1},
    IMU: {5: 4, 6: 3, 7: 2, 9: 3, 10: 2},
    EXTERNAL_INPUT: {5: 20, 13: 2000, 14: 300},
    BIAS: {**{k: 400 for k in range(5)}, **{k: 0x4FFF for k in (*range(8, 28), 34)}, 35: 33796, 36: 33796}
    | {k: 1 for k in range(128, 136)},
    USB: {1: 4},
    HOST_USB: {0: 16, 1: 16384},
    HOST_DATA: {0: 128},
    HOST_PACKETS: {0: 4096, 1: 5000},
    HOST_LOG: {0: 4},
}
AUTO_EXPOSURE = 101
RUNNING = ((MUX, 0), (MUX, 1), (MUX, 3), (USB, 0))
ACTIONS = ((APS, 100), (DVS, 100))  # snapshot, learning of noisy pixels
RESET_S = 1.0  # much longer than a timestamp reset takes to come back from the camera
GETTERS = (
    *("CameraName", "DavisExposureDuration", "DavisFrameInterval", "EventResolution", "FrameResolution"),
    *("ImuRate", "PixelPitch"),
)
MS = timedelta(milliseconds=1)


def parameters():
    """(module, parameter, a value to set; None: the other state of a flag)."""
    for module, numbers in FLAGS.items():
        yield from ((module, number, None) for number in numbers)
    for module, values in NUMBERS.items():
        yield from ((module, number, value) for number, value in values.items())
    yield from ((module, number, None) for module, number in RUNNING)


def other(camera, module, number, value):
    """Set another value; raises AssertionError where it does not read back."""
    wanted = 1 - camera.deviceConfigGet(module, number) if value is None else value
    camera.deviceConfigSet(module, number, wanted)
    found = camera.deviceConfigGet(module, number)
    assert found == wanted, f"{found} was read where {wanted} was set"


def changes(camera):
    """Every parameter and setter; each is set back, but for the exposure, which is no longer automatic."""
    # While it is automatic, libcaer refuses any other exposure.
    yield "no automatic exposure", partial(camera.deviceConfigSet, APS, AUTO_EXPOSURE, 0)
    for module, number, value in parameters():
        name = f"({module}, {number})"
        try:
            before = camera.deviceConfigGet(module, number)
        except FAILURES as failure:
            yield f"{name} cannot be read", partial(_again, failure)
            continue
        yield f"{name} other than {before}", partial(other, camera, module, number, value)
        yield f"{name} = {before}", partial(camera.deviceConfigSet, module, number, before)
    yield f"({MUX}, 2) = 1", partial(reset_unread, camera)
    for module, number in ACTIONS:
        yield f"({module}, {number}) = 1", partial(camera.deviceConfigSet, module, number, 1)
    yield from setters(camera)


def reset_unread(camera):
    """Reset the timestamps and read nothing until the reset has come: see environments.py."""
    camera.deviceConfigSet(MUX, 2, 1)
    time.sleep(RESET_S)


def setters(camera):
    """The setters of the class, but for those that are a DVXplorer's: a DAVIS answers False."""
    modes = CAPTURE.DavisReadoutMode.__members__
    calls = [
        *(("setDavisColorMode", (mode,)) for mode in CAPTURE.DavisColorMode.__members__.values()),
        ("setDavisColorMode", (CAPTURE.DavisColorMode.Grayscale,)),
        *(("setDavisReadoutMode", (modes[k],)) for k in ("EventsOnly", "FramesOnly", "EventsAndFrames")),
        ("enableDavisAutoExposure", ()),
        *(("setDavisExposureDuration", (exposure,)) for exposure in (8 * MS, 4 * MS)),
        *(("setDavisFrameInterval", (interval,)) for interval in (100 * MS, 40 * MS)),
    ]
    for name, values in calls:
        yield f"{name}{values}", partial(_done, name, partial(getattr(camera, name), *values))


def getters(camera):
    """What only looks. The sizes and capabilities are no parameters: libcaer tells them itself, and refuses these."""
    for name in GETTERS:
        yield f"get{name}()", getattr(camera, f"get{name}")


def _done(name, setter):
    assert setter() is not False, f"{name} answered False"


def _again(failure):
    raise failure


def main():
    options = arguments()
    collector = Collector(options)
    camera = open_camera(options)
    outcomes = change_all(camera, take, changes(camera), getters(camera), collector)
    running = camera.isRunning()
    del camera
    collector.report(running=running, changes=outcomes, untried=[])


if __name__ == "__main__":
    main()
