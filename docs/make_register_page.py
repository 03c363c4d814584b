"""Write the tables of registers in docs/cameras.md from the model: python docs/make_register_page.py."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from firmware_protocol.davis346.biases import BIASES
from firmware_protocol.davis346.registers import Layout, registers
from firmware_protocol.fx3.registers import Module, Register, SystemInfo

__all__ = ["PAGE", "page"]

PAGE = Path(__file__).with_name("cameras.md")

MARKERS = [f"<!-- docs/make_register_page.py: {place} -->" for place in ("begin", "end")]

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
    "RUN": "this part runs",
    "TIMESTAMP_RUN": "timestamps run",
    "TIMESTAMP_RESET": "written 1: device time is zero, and the word 0x0001 is sent",
    "RUN_CHIP": "the chip has power",
    "DROP_EXTINPUT_ON_STALL": "edges are dropped at once when the FIFO is full, not held in a queue of 8",
    "DROP_DVS_ON_STALL": "events are dropped when the FIFO is full; the model always does",
    "WAIT_ON_STALL": "wait instead of dropping",
    "EXTERNAL_AER_CONTROL": "the chip's handshake is done outside",
    "BACKGROUND_ACTIVITY_FILTER": "filter of isolated events on ([the rule](#the-activity-filter))",
    "BACKGROUND_ACTIVITY_TIME_250US": "its time, units of 250 us",
    "REFRACTORY_FILTER": "filter of events too soon after the last of their cell on",
    "REFRACTORY_TIME_250US": "its time, units of 250 us",
    "ROI_START_COLUMN": "region of interest",
    "ROI_START_ROW": "region of interest",
    "ROI_END_COLUMN": "region of interest",
    "ROI_END_ROW": "region of interest",
    "SKIP": "leave events out",
    "SKIP_EVERY": "how many",
    "POLARITY_FLATTEN": "all events as of one polarity",
    "POLARITY_SUPPRESS": "leave one polarity out; which one",
    "POLARITY_SUPPRESS_TYPE": "leave one polarity out; which one",
    "SIZE_COLUMNS": "size of the chip",
    "SIZE_ROWS": "size of the chip",
    "ORIENTATION": "bit 2 set: rows and columns are swapped",
    "COLOUR_FILTER": "0: none",
    "GLOBAL_SHUTTER": "global, else rolling shutter",
    "EXPOSURE": "exposure of a frame",
    "FRAME_INTERVAL": "time between two frames",
    "TYPE": "which IMU",
    "RUN_ACCELEROMETER": "what is measured",
    "RUN_GYROSCOPE": "what is measured",
    "RUN_TEMPERATURE": "what is measured",
    "SAMPLE_RATE_DIVIDER": "divides the sample rate",
    "ACCELEROMETER_LOW_PASS": "filter setting",
    "ACCELEROMETER_FULL_SCALE": "range setting",
    "GYROSCOPE_LOW_PASS": "filter setting",
    "GYROSCOPE_FULL_SCALE": "range setting",
    "RUN_DETECTOR": "observe the input",
    "DETECT_RISING": "report these edges (special 3, 2, 4)",
    "DETECT_FALLING": "report these edges (special 3, 2, 4)",
    "DETECT_PULSES": "report these edges (special 3, 2, 4)",
    "PULSE_POLARITY": "pulses are high",
    "PULSE_LENGTH": "a pulse is at least so long",
    "RUN_GENERATOR": "drive the output",
    "GENERATOR_POLARITY": "its pulses are high",
    "GENERATOR_INTERVAL": "from pulse to pulse; of a pulse",
    "GENERATOR_LENGTH": "from pulse to pulse; of a pulse",
    "INJECT_ON_RISING": "report its edges (special 16, 17)",
    "INJECT_ON_FALLING": "report its edges (special 16, 17)",
    "LOGIC_VERSION": "version of the FPGA's logic",
    "CHIP_IDENTIFIER": "5: DAVIS346B",
    "DEVICE_IS_MASTER": "timestamps are its own, not another camera's",
    "LOGIC_CLOCK_MHZ": "clocks of the parts",
    "ADC_CLOCK_MHZ": "clocks of the parts",
    "USB_CLOCK_MHZ": "clocks of the parts",
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
    r"HOT_PIXEL_\d_(ROW|COLUMN)": "pixels to leave out",
    r"(DIGITAL|ANALOG|BIAS)_MUX_\d": "signals at debug pins",
    r".*_(UPPER|LOWER)": "halves of 64-bit counters",
}

_UNITS = {Module.EXTERNAL_INPUT: "Times are in cycles of the logic's clock."}

_NOTES_ABOVE = ("chip's frame; orientation bit 2: turned", "half of a 64-bit counter")
"""Said in the text above the tables, or by the names."""

_BIASES = {bias.address: bias for bias in BIASES}


def _meaning(register: Register) -> str:
    if register.module is Module.BIAS and register.address in _BIASES:
        name = _BIASES[register.address].name
        return register.note if name in _BIASES_THAT_ACT else _kind(register)
    found = [text for pattern, text in _PATTERNS.items() if re.fullmatch(pattern, register.name)]
    meaning = _MEANINGS.get(register.name) or found[0]
    note = "" if register.module in _UNITS or register.note in _NOTES_ABOVE else register.note
    return f"{meaning} ({note})" if note else meaning


def _kind(register: Register) -> str:
    words = {"voltage": "voltage", "ref": "shifted source"}
    return words.get(register.note.split()[0], "current")


def _bits_and_effect(register: Register) -> tuple[str, str]:
    if register.access.value == "read":
        return "ro", ""
    return str(register.bits), "yes" if (register.module.value, register.address) in _ACTS else ""


def _row(alike: Sequence[Register]) -> str:
    """Return a row of registers that follow each other and differ in name and default at most."""
    first, last = alike[0].address, alike[-1].address
    addresses = str(first) if first == last else f"{first} to {last}"
    names = ", ".join(register.name for register in alike)
    defaults = [str(register.default) for register in alike]
    cells = [addresses, names, *_bits_and_effect(alike[0])]
    cells.insert(3, ", ".join(defaults if len(set(defaults)) > 1 else defaults[:1]))
    return f"| {' | '.join(cells)} | {_meaning(alike[0])} |"


def _lines() -> Iterator[str]:
    known = sorted(registers((346, 260), Layout.UPRIGHT, SystemInfo()), key=lambda r: (r.module, r.address))
    for module, title in _TITLES.items():
        yield f"#### Module {module.value}: {title}\n"
        if module in _UNITS:
            yield f"{_UNITS[module]}\n"
        yield "| n | name | bits | default | acts | meaning |\n|---|---|---|---|---|---|"
        alike: list[Register] = []
        for register in (register for register in known if register.module is module):
            if alike and not (register.address == alike[-1].address + 1 and _are_alike(register, alike[-1])):
                yield _row(alike)
                alike = []
            alike.append(register)
        yield _row(alike)
        yield ""


def _are_alike(register: Register, other: Register) -> bool:
    return (_meaning(register), _bits_and_effect(register)) == (_meaning(other), _bits_and_effect(other))


def page() -> str:
    """Return the page with the tables between its markers."""
    begin, end = MARKERS
    before, rest = PAGE.read_text(encoding="utf-8").split(begin)
    return "\n".join((before + begin, "", *_lines(), end + rest.split(end)[1]))


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
