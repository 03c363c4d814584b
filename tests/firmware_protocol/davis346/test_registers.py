"""Registers and biases: read-back, what cannot be written, and the words of the bias table."""

import numpy as np
import pytest
from davis_host import Host, steady
from davis_registers import kept
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.davis346.biases import BIASES, CoarseFine, ShiftedSource, Vdac
from firmware_protocol.davis346.device import Davis346, Davis346Settings
from firmware_protocol.davis346.registers import Layout, Statistic, registers
from firmware_protocol.fx3.registers import Access, Module, RegisterFile, SystemInfo

DECLARED = list(registers((346, 260), Layout.UPRIGHT, SystemInfo()))
ABSENT = [(0, 6), (1, 100), (3, 8), (5, 5), (5, 127), (6, 8), (7, 0), (9, 2), (255, 255)]

# Words that three drivers write by default, as logged.
LOGGED_WORDS = {
    0: 411, 1: 405, 2: 480, 3: 449, 4: 469, 8: 23119, 9: 32126, 10: 17023, 11: 24575, 12: 16415, 13: 26895, 14: 9133,
    15: 4365, 16: 16797, 17: 24909, 18: 28095, 19: 20813, 20: 31, 21: 25549, 22: 21279, 23: 26047, 24: 17677, 25: 31117,
    26: 24575, 27: 24575, 34: 24559, 35: 33808, 36: 33808,
}  # fmt: skip

CURRENTS_A = {"DiffBn": 7.41e-9, "OnBn": 387.5e-9, "OffBn": 0.190e-9, "PrBp": 172e-12, "PrSFBp": 5.90e-12,
              "RefrBp": 4.75e-9, "AEPuYBp": 14.8e-6, "PadFollBn": 0.0}  # fmt: skip


@given(
    st.dictionaries(st.sampled_from([*((r.module, r.address) for r in DECLARED), *ABSENT]), st.integers(0, 0xFFFFFFFF))
)
def test_a_register_keeps_the_bits_that_its_part_uses_and_nothing_else_changes(writes):
    """What can only be read keeps its value, and what does not exist is zero."""
    values = RegisterFile(DECLARED)
    for key, value in writes.items():
        values.write(*key, value)
    for register in DECLARED:
        key = register.module, register.address
        is_written = key in writes and register.access is Access.READ_WRITE
        assert values.read(*key) == (kept(*key, writes[key]) if is_written else register.default)
    assert {values.read(*key) for key in ABSENT} == {0}


def test_identity_is_what_all_drivers_accept():
    system = {r.address: r.default for r in DECLARED if r.module is Module.SYSTEM}
    assert system == {0: 18, 1: 5, 2: 1, 3: 104, 4: 30, 5: 80, 6: 1000, 7: 1}


def test_clock_dependent_defaults_scale():
    by_key = {(r.module, r.address): r.default for r in DECLARED}
    assert by_key[9, 1] == 80_000
    assert by_key[2, 12] == 4000 * 30
    assert by_key[4, 5] == 104


def test_counters_are_64_bits_upper_word_first():
    values = RegisterFile(DECLARED)
    values.count(Statistic.DVS_DROPPED, 0x1_0000_0002)
    assert (values.read(1, 85), values.read(1, 86)) == (1, 2)


def test_registers_over_usb_are_big_endian_and_survive_streaming():
    camera = Davis346(Davis346Settings(start_delay_us=0))
    host = Host(camera)
    host.write(2, 12, 0x02345678)
    host.multi_write([(2, 13, 0x0ABBCCDD), (1, 32, 9)])
    camera.offer(steady(10))
    assert host.read(2, 12) == 0x02345678
    assert host.control(0xC0, 0xBF, 2, 13, length=4) == b"\x0a\xbb\xcc\xdd"
    assert host.read(1, 32) == 9


def test_default_bias_words_are_those_that_drivers_write():
    assert {b.address: int(b.default) for b in BIASES} == LOGGED_WORDS


def test_default_currents():
    currents = {b.name: b.default.current_a for b in BIASES if isinstance(b.default, CoarseFine)}
    for name, expected in CURRENTS_A.items():
        assert np.isclose(currents[name], expected, rtol=0.01), name


@pytest.mark.parametrize(("word", "low_nibble"), [(CoarseFine(4, 39), 0xF), (CoarseFine(4, 39, n_type=False), 0xD),
                         (CoarseFine(4, 39, enabled=False), 0xE), (CoarseFine(4, 39, cascode=True), 0xB)])  # fmt: skip
def test_low_nibble_of_coarse_fine_words(word, low_nibble):
    assert int(word) & 0xF == low_nibble


@given(st.integers(0, 0xFFFF))
def test_bias_words_survive_parsing(word):
    assert int(CoarseFine.parse(word)) == word & 0x7FFF
    assert int(Vdac.parse(word)) == word & 0x1FF
    assert int(ShiftedSource.parse(word)) == word


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (CoarseFine(4, 39), "N 4,39 (7.41e-09 A)"),
        (CoarseFine(7, 215, n_type=False, enabled=False, cascode=True, low_current=True), "P 7,215 cascode low (off)"),
        (Vdac(27, 6), "voltage 27, current 6"),
        (ShiftedSource(1, 33), "ref 1, reg 33, mode 0, level 0"),
    ],
)
def test_biases_print_themselves(value, text):
    assert str(value) == text


@pytest.mark.parametrize(
    "make",
    [
        lambda: CoarseFine(8, 0),
        lambda: CoarseFine(0, 256),
        lambda: Vdac(64, 0),
        lambda: Vdac(0, 8),
        lambda: ShiftedSource(64, 0),
        lambda: ShiftedSource(0, 64),
        lambda: ShiftedSource(0, 0, mode=4),
        lambda: ShiftedSource(0, 0, level=4),
    ],
)
def test_bias_values_out_of_range_are_refused(make):
    with pytest.raises(ValueError, match="must be 0 to "):
        make()
