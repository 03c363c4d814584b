"""Masks and rate control: which of all pixels' events pass."""

import numpy as np
import pytest

from firmware_protocol.events import EVENT
from firmware_protocol.imx636.evk4 import Selection
from firmware_protocol.imx636.registers import Registers
from tests.made_events import events_at

ON, KEEP_INSIDE, TAKE_OVER = 0x2, 0x40, 0x20


class Sensor:
    """A register file and the selection that follows it."""

    def __init__(self):
        self.registers = Registers()
        self.selection = Selection(self.registers)

    def write(self, *entries):
        for address, value in entries:
            self.registers.write(address, value)
            self.selection.written(address)

    def mask(self, columns=(), rows=()):
        """Write masks, a bit for each column and row that is masked."""
        for base, words, masked in ((0x2000, 40, columns), (0x4000, 23, rows)):
            bits = sum(1 << k for k in masked)
            self.write(*((base + 4 * k, bits >> 32 * k & 0xFFFF_FFFF) for k in range(words)))

    def passing(self):
        """Return the picture of the pixels whose events pass, (720, 1280) bool."""
        events = np.zeros(720 * 1280, EVENT)
        events["y"], events["x"] = np.divmod(np.arange(len(events)), 1280)
        selected = self.selection.apply(events, 0)
        assert len(selected.events) + selected.outside + selected.beyond_rate == len(events)
        picture = np.zeros((720, 1280), bool)
        picture[selected.events["y"], selected.events["x"]] = True
        return picture


@pytest.fixture
def sensor():
    return Sensor()


def test_a_pixel_is_masked_by_its_row_or_its_column(sensor):
    sensor.mask(columns=(0, 700, 1279), rows=(1, 719))
    sensor.write((0x0004, ON | KEEP_INSIDE | TAKE_OVER))
    expected = np.ones((720, 1280), bool)
    expected[:, [0, 700, 1279]] = False
    expected[[1, 719], :] = False
    assert np.array_equal(sensor.passing(), expected)


def test_a_pixel_is_masked_where_both_cross(sensor):
    sensor.mask(columns=(5, 40), rows=(33,))
    sensor.write((0x0004, ON | TAKE_OVER))
    assert np.argwhere(~sensor.passing()).tolist() == [[33, 5], [33, 40]]


def test_masks_hold_when_they_are_taken_over_and_on(sensor):
    sensor.mask(columns=(3,))
    sensor.write((0x0004, ON | KEEP_INSIDE))
    assert sensor.passing().all()
    sensor.write((0x0004, KEEP_INSIDE | TAKE_OVER))
    assert sensor.passing().all()
    sensor.write((0x0004, ON | KEEP_INSIDE))
    assert not sensor.passing()[:, 3].any()
    sensor.mask()
    assert not sensor.passing()[:, 3].any()
    sensor.write((0x0004, ON | KEEP_INSIDE | TAKE_OVER))
    assert sensor.passing().all()


def test_single_pixels_are_masked_at_once(sensor):
    sensor.write(
        (0x9100, 1 << 31 | 300 << 16 | 640), (0x9100 + 4 * 63, 1 << 31 | 719 << 16 | 1279), (0x9104, 7 << 16 | 7)
    )
    assert np.argwhere(~sensor.passing()).tolist() == [[300, 640], [719, 1279]]
    sensor.write((0x9100, 0))
    assert np.argwhere(~sensor.passing()).tolist() == [[719, 1279]]


def test_a_window_writes_the_masks(sensor):
    sensor.write((0x0038, 100 << 16 | 200), (0x003C, 300 << 16 | 600), (0x0034, 1))
    assert sensor.registers.read(0x0034) & 2
    sensor.write((0x0004, ON | KEEP_INSIDE | TAKE_OVER))
    expected = np.zeros((720, 1280), bool)
    expected[100:300, 200:600] = True
    assert np.array_equal(sensor.passing(), expected)


def test_the_rate_control_lets_the_first_of_each_period_by(sensor):
    sensor.write((0x6008, 200), (0x600C, 3), (0x6028, 3), (0x6050, 1))
    events = events_at(np.arange(100) * 20 + 1000)
    assert len(sensor.selection.apply(events, 1000).events) == 100  # not ready yet
    sensor.write((0x6000, 0x0015_5401))
    selected = sensor.selection.apply(events, 1000)
    assert selected.beyond_rate == 70
    assert np.bincount((selected.events["t"].astype(int) - 1000) // 200).tolist() == [3] * 10


def test_a_reset_forgets_masks_and_rate(sensor):
    sensor.mask(columns=(3,))
    sensor.write((0x0004, ON | KEEP_INSIDE | TAKE_OVER), (0x9100, 1 << 31), (0x40_0004, 1))
    assert sensor.passing().all()
