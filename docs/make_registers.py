"""Write docs/davis346_registers.txt, all registers of the DAVIS346, from the model: python docs/make_registers.py."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from firmware_protocol.davis346.biases import BIASES
from firmware_protocol.davis346.registers import Layout, registers
from firmware_protocol.fx3.registers import Module, Register, SystemInfo

__all__ = ["FILE", "text"]

FILE = Path(__file__).with_name("davis346_registers.txt")

_TITLES = {
    Module.MULTIPLEXER: "multiplexer",
    Module.DVS: "DVS",
    Module.APS: "APS",
    Module.IMU: "IMU",
    Module.EXTERNAL_INPUT: "external input",
    Module.BIAS: "biases and chip",
    Module.SYSTEM: "system information",
    Module.USB: "USB",
}

_BIASES_THAT_ACT = ("DiffBn", "OnBn", "OffBn", "PrBp", "PrSFBp", "RefrBp")

_ACTS = frozenset(
    [(0, k) for k in range(5)]
    + [(1, 3), (9, 0)]
    + [(4, k) for k in (*range(6), *range(11, 17))]
    + [(1, k) for k in (*range(11, 27), *range(31, 35), *range(41, 45), 51, 52, 61, 62, 63)]
    + [(2, k) for k in (4, 5, *range(7, 14))]
    + [(3, k) for k in (2, 3, 4, 5, 6, 7, 9, 10)]
    + [(5, bias.address) for bias in BIASES if bias.name in _BIASES_THAT_ACT]
)  # those that device.py and its parts read

_MEANINGS = {
    "RUN": "this part runs; in module 0 the gate of all words",
    "TIMESTAMP_RUN": "timestamps run",
    "TIMESTAMP_RESET": "written 1: device time is zero, and the word 0x0001 is sent",
    "RUN_CHIP": "the chip has power",
    "DROP_EXTINPUT_ON_STALL": "edges are dropped at once when the FIFO is full, not held in a queue of 8",
    "DROP_DVS_ON_STALL": "events are dropped when the FIFO is full; the model always does",
    "WAIT_ON_STALL": "wait instead of dropping",
    "EXTERNAL_AER_CONTROL": "the chip's handshake is done outside",
    "BACKGROUND_ACTIVITY_FILTER": "filter of isolated events on (cameras.md, the activity filter)",
    "BACKGROUND_ACTIVITY_TIME_250US": "its time, units of 250 us",
    "REFRACTORY_FILTER": "filter of events too soon after the last of their cell on",
    "REFRACTORY_TIME_250US": "its time, units of 250 us",
    "ROI_START_COLUMN": "region of interest: first column",
    "ROI_START_ROW": "region of interest: first row",
    "ROI_END_COLUMN": "region of interest: last column",
    "ROI_END_ROW": "region of interest: last row",
    "SKIP": "leave events out",
    "SKIP_EVERY": "how many",
    "POLARITY_FLATTEN": "all events as of one polarity",
    "POLARITY_SUPPRESS": "leave one polarity out",
    "POLARITY_SUPPRESS_TYPE": "which one",
    "SIZE_COLUMNS": "columns of the chip",
    "SIZE_ROWS": "rows of the chip",
    "ORIENTATION": "bit 2 set: rows and columns are swapped",
    "COLOUR_FILTER": "0: none",
    "GLOBAL_SHUTTER": "global, else rolling shutter",
    "EXPOSURE": "exposure of a frame",
    "FRAME_INTERVAL": "time between two frames",
    "TYPE": "which IMU",
    "RUN_ACCELEROMETER": "measure acceleration",
    "RUN_GYROSCOPE": "measure rotation",
    "RUN_TEMPERATURE": "measure temperature",
    "SAMPLE_RATE_DIVIDER": "divides the sample rate",
    "ACCELEROMETER_LOW_PASS": "filter setting",
    "ACCELEROMETER_FULL_SCALE": "range setting",
    "GYROSCOPE_LOW_PASS": "filter setting",
    "GYROSCOPE_FULL_SCALE": "range setting",
    "RUN_DETECTOR": "observe the input",
    "DETECT_RISING": "report rising edges (special 3)",
    "DETECT_FALLING": "report falling edges (special 2)",
    "DETECT_PULSES": "report pulses (special 4)",
    "PULSE_POLARITY": "pulses are high",
    "PULSE_LENGTH": "a pulse is at least so long",
    "RUN_GENERATOR": "drive the output",
    "GENERATOR_POLARITY": "its pulses are high",
    "GENERATOR_INTERVAL": "from pulse to pulse",
    "GENERATOR_LENGTH": "of a pulse",
    "INJECT_ON_RISING": "report its rising edges (special 16)",
    "INJECT_ON_FALLING": "report its falling edges (special 17)",
    "LOGIC_VERSION": "version of the FPGA's logic",
    "CHIP_IDENTIFIER": "5: DAVIS346B",
    "DEVICE_IS_MASTER": "timestamps are its own, not another camera's",
    "LOGIC_CLOCK_MHZ": "clock of the logic",
    "ADC_CLOCK_MHZ": "clock of the ADC",
    "USB_CLOCK_MHZ": "clock of the USB side",
    "CLOCK_DEVIATION_THOUSANDTHS": "true clock / nominal clock, thousandths",
    "LOGIC_PATCH": "patch level of the logic",
    "EARLY_PACKET_DELAY": "a short USB packet is sent after so long",
    "RESET_CALIB_NEURON": "chip test circuit",
    "TYPE_N_CALIB_NEURON": "chip test circuit",
    "RESET_TEST_PIXEL": "chip test circuit",
    "AER_N_AROW": "chip setting",
    "USE_AOUT": "analogue output on",
    "SELECT_GRAY_COUNTER": "ADC counter, Gray code",
    "TEST_ADC": "ADC test input",
}

_PATTERNS = {
    r"HAS_(.*)": "the logic has this part",
    r"HOT_PIXEL_\d_(ROW|COLUMN)": "a pixel to leave out",
    r"(DIGITAL|ANALOG|BIAS)_MUX_\d": "signal at a debug pin",
    r".*_(UPPER|LOWER)": "counter",
}

_BIASES = {bias.address: bias for bias in BIASES}


def _meaning(register: Register) -> str:
    if register.module is Module.BIAS and register.address in _BIASES:
        return f"bias: {register.note}"
    found = [text for pattern, text in _PATTERNS.items() if re.fullmatch(pattern, register.name)]
    meaning = _MEANINGS.get(register.name) or found[0]
    return f"{meaning} ({register.note})" if register.note else meaning


def _acts(register: Register) -> str:
    if (register.module.value, register.address) in _ACTS:
        return "yes"
    return "reported" if register.access.value == "read" else ""


def _rows() -> Iterator[tuple[str, ...]]:
    yield "n", "name", "access", "bits", "default", "acts", "meaning"
    for r in sorted(registers((346, 260), Layout.UPRIGHT, SystemInfo()), key=lambda r: (r.module, r.address)):
        access, bits = ("ro", "") if r.access.value == "read" else ("rw", str(r.bits))
        yield f"{r.module.value}.{r.address}", r.name, access, bits, str(r.default), _acts(r), _meaning(r)


def text() -> str:
    """Return the list of registers, in columns that begin at the same place in each line."""
    rows = list(_rows())
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows)
    modules = "; ".join(f"{module.value} {title}" for module, title in _TITLES.items())
    return "\n".join((f"Modules: {modules}", "", *lines)) + "\n"


if __name__ == "__main__":
    FILE.write_text(text(), encoding="utf-8")
