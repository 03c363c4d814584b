"""Sensors on V4L2: the messages beside the C compiler's layout, and settings beside the events that then leave."""

import contextlib
import errno
import re
import struct
import subprocess

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import firmware_protocol.c
from evstim.testing.link_contract import event_stream
from firmware_protocol.genx320 import registers as genx320
from firmware_protocol.genx320 import selection as genx320_selection
from firmware_protocol.imx636 import evk4
from firmware_protocol.imx636 import registers as imx636
from firmware_protocol.prophesee.v4l2 import REQUEST_BYTES, NodeSettings, Request, answer

MODULE = firmware_protocol.c.FOLDER / "v4l2" / "evstim_v4l2.h"
CHIPS = {
    "genx320": (genx320.V4L2_SENSOR, genx320.Registers, genx320_selection.Selection),
    "imx636": (imx636.V4L2_SENSOR, imx636.Registers, evk4.Selection),
}
DIFF_ON = {"genx320": 0x1104, "imx636": 0x1010}
USER = 0x980900


class Chip:
    """A sensor's registers, the selection of its events, and its settings on V4L2."""

    def __init__(self, name):
        self.sensor, registers, selection = CHIPS[name]
        self.registers = registers()
        self.selection = selection(self.registers)
        self.settings = NodeSettings(self.sensor, self)
        self._ids = {control.name: control.id for control in self.sensor.controls}

    def read_register(self, address):
        return self.registers.read(address)

    def write_register(self, address, value):
        self.registers.write(address, value)
        self.selection.written(address)

    def set(self, control, value=0, values=()):
        self.settings.apply(Request(3, self._ids[control], value, (*values, *[0] * (74 - len(values)))))

    def selected(self, events):
        return self.selection.apply(events, 0).events

    def events(self, count=20_000):
        return event_stream(count, 0, self.sensor.size)


def test_the_layouts_are_those_of_the_module(tmp_path):
    """The structures in the module's text, measured by a compiler."""
    text = MODULE.read_text()
    structures = "".join(re.findall(r"^struct evstim_\w+ \{\n.*?^\};\n", text, re.MULTILINE | re.DOTALL))
    limits = "".join(re.findall(r"^#define MOST_\w+ .*\n", text, re.MULTILINE))
    print_sizes = (
        'printf("%zu %zu %zu %zu", sizeof(struct evstim_sensor), sizeof(struct evstim_control), '
        "sizeof(struct evstim_request), offsetof(struct evstim_sensor, control));"
    )
    program = f"#include <stdio.h>\n#include <stddef.h>\n#include <linux/types.h>\n{limits}{structures}"
    (tmp_path / "sizes.c").write_text(f"{program}int main(void) {{ {print_sizes} }}\n")
    subprocess.run(["cc", tmp_path / "sizes.c", "-o", tmp_path / "sizes"], check=True)
    sizes = subprocess.run([tmp_path / "sizes"], check=True, capture_output=True, text=True).stdout
    sensor, control, request, controls_at = map(int, sizes.split())
    for one, *_ in CHIPS.values():
        assert len(one.description("serial", 65536)) == 4 + sensor
        assert len(bytes(one.controls[0])) == control
        # The last control stands where the compiler puts it.
        last = controls_at + (len(one.controls) - 1) * control
        assert one.description("serial", 65536)[4 + last :][:control] == bytes(one.controls[-1])
    assert request == REQUEST_BYTES


@pytest.mark.parametrize("size", [0, REQUEST_BYTES - 1, REQUEST_BYTES + 1])
def test_a_request_of_another_size_is_refused(size):
    with pytest.raises(ValueError, match="a request has 312 bytes"):
        Request.parse(bytes(size))


def test_an_answer_has_a_negative_errno():
    assert answer(errno.EINVAL) == struct.pack("=Ii", 3, -errno.EINVAL)


@pytest.mark.parametrize(("name", "initial"), [("genx320", 25), ("imx636", 0x66)])
def test_a_bias_is_a_number_of_steps_in_the_sensor(name, initial):
    chip = Chip(name)
    flags = chip.read_register(DIFF_ON[name]) & 0xFFFF_FF00
    chip.set("bias_diff_on", initial + 5)
    assert chip.read_register(DIFF_ON[name]) == flags | initial + 5
    assert {bias: steps for bias, steps in chip.registers.bias_steps.items() if steps} == {"diff_on": 5}
    with pytest.raises(OSError, match="bias_diff_on is"):
        chip.set("bias_diff_on", 256)
    assert chip.registers.bias_steps["diff_on"] == 5


@pytest.mark.parametrize(("name", "period_us"), [("genx320", 100), ("imx636", 200)])
def test_rate_control_lets_pass_what_a_period_may_have(name, period_us):
    chip, events = Chip(name), Chip(name).events()
    chip.set("erc_rate", 100_000)
    assert len(chip.selected(events)) == len(events)
    chip.set("erc_enable", 1)
    in_periods = np.bincount(chip.selected(events)["t"].astype(np.int64) // period_us)
    assert in_periods.max() == 100_000 * period_us // 1_000_000
    chip.set("erc_enable", 0)
    assert len(chip.selected(events)) == len(events)


def test_windows_select_inside_or_outside_and_none_is_all():
    chip = Chip("genx320")
    chip.set("roi_set", values=(2, 10, 20, 100, 50, 200, 220, 30, 40))
    events = chip.events()
    x, y = events["x"].astype(int), events["y"].astype(int)
    inside = ((x >= 10) & (x < 110) & (y >= 20) & (y < 70)) | ((x >= 200) & (x < 230) & (y >= 220) & (y < 260))
    assert 0 < inside.sum() < len(events)
    assert np.array_equal(chip.selected(events), events[inside])
    chip.set("roi_roni", 1)
    assert np.array_equal(chip.selected(events), events[~inside])
    chip.set("roi_reset")
    assert np.array_equal(chip.selected(events), events)
    with pytest.raises(OSError, match="is not on 320x320 pixels"):
        chip.set("roi_set", values=(1, 10, 20, 311, 50))
    with pytest.raises(OSError, match="19 windows, at most 18"):
        chip.set("roi_set", values=(19,))


def test_the_crop_selects():
    chip = Chip("imx636")
    chip.settings.apply(Request(4, 0, 0, (30, 40, 500, 300, *[0] * 70)))
    events = chip.events()
    x, y = events["x"].astype(int), events["y"].astype(int)
    inside = (x >= 30) & (x < 530) & (y >= 40) & (y < 340)
    assert 0 < inside.sum() < len(events)
    assert np.array_equal(chip.selected(events), events[inside])


@given(
    name=st.sampled_from(sorted(CHIPS)),
    data=st.lists(st.binary(min_size=REQUEST_BYTES, max_size=REQUEST_BYTES), max_size=3),
    keys=st.lists(st.sampled_from([0x1001, 0x1002, 0x3000, 0x3005, 0x4001, 0x4004, 0x4006]), max_size=8),
    values=st.lists(st.integers(0, 400), min_size=74, max_size=74),
)
def test_any_request_is_executed_or_refused(name, data, keys, values):
    chip = Chip(name)
    requests = [Request.parse(octets) for octets in data]
    requests += [Request(3, USER | key, values[k], tuple(values[k:] + values[:k])) for k, key in enumerate(keys)]
    for request in requests:
        with contextlib.suppress(OSError):
            chip.settings.apply(request)
    if name == "genx320":
        chip.set("erc_enable", 0)
        chip.set("roi_reset")
        assert len(chip.selected(chip.events(100))) == 100
    assert chip.registers.bias_steps.keys() == chip.registers.currents.keys()
