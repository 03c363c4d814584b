"""What a DAVIS346 reads beside events, for a loop: frames of random pixels and samples of a still inertial unit."""

import numpy as np

from firmware_protocol.frames import LineKind, line_record
from firmware_protocol.imu_samples import IMU_SAMPLE

SIZE = COLUMNS, ROWS = 346, 260
LINE_US = 30
# A processor that QEMU translates takes some thousand lines and samples a second beside the events.
FRAME_US = 800_000
SAMPLE_US = 4000
SCALE = 0xE5  # accelerometer, gyroscope and thermometer; 4 g, 500 deg/s
STILL = (0, -8192, 0, 0, 0, 0, 0)  # counts: held up with 1 g, y down
SIGNAL, BRIGHTNESS = (400, 500), (0, 512)  # of 1023; drivers take a reset read below 384 for white


def frames(round_us):
    """Lines of the frames of a round, (n,) of `line_record`; no two frames are alike."""
    return np.concatenate([_frame(start_us) for start_us in range(FRAME_US // 2, round_us, FRAME_US)])


def samples(round_us):
    """Samples of a round, (n,) IMU_SAMPLE, each with noise of its own."""
    told = np.zeros(round_us // SAMPLE_US, IMU_SAMPLE)
    told["t"], told["scale"] = SAMPLE_US * np.arange(len(told)) + 7, SCALE
    told["counts"] = np.random.default_rng(1).integers(-300, 300, (len(told), 7)) + STILL
    return told


def _frame(start_us):
    reads = [LineKind.RESET] * COLUMNS, [LineKind.SIGNAL] * COLUMNS
    kinds = [LineKind.START, *reads[0], LineKind.EXPOSURE_START, LineKind.EXPOSURE_END, *reads[1], LineKind.END]
    told = np.zeros(len(kinds), line_record(COLUMNS))
    told["t"], told["kind"] = start_us + LINE_US * np.arange(len(kinds)), kinds
    told["exposure"], told["global_shutter"], told["by_column"] = 120_000, True, True
    told["roi"] = 0, 0, COLUMNS - 1, ROWS - 1
    reset, signal = (told["kind"] == kind for kind in (LineKind.RESET, LineKind.SIGNAL))
    draw = np.random.default_rng(start_us)
    dark = draw.integers(*SIGNAL, (COLUMNS, ROWS))
    told["samples"][signal, :ROWS] = dark
    told["samples"][reset, :ROWS] = dark + draw.integers(*BRIGHTNESS, (COLUMNS, ROWS))
    told["length"][reset | signal] = ROWS
    return told
