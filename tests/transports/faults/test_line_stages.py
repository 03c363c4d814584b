"""What faults do to bytes: as much as they say, and the same however the bytes are cut."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from transports.faults.bus import LostFrames
from transports.faults.faulty_line import FaultyLine
from transports.faults.line import BitFlips, Burst, InsertedBytes, LostBytes, Overrun, Stall, StuckLine, WrongBaud
from transports.faults.script import FaultPlan

BYTES_PER_S = 300_000.0
FAULTS_OF_BYTES = [
    BitFlips(rate=0.01, count=0, for_s=1),
    InsertedBytes(rate=0.05, count=7),
    LostBytes(rate=0.05, count=7),
    Burst(rate=0.02, count=3, length=9),
    Overrun(rate=0.02, count=2, late_us=100, fifo_bytes=5),
    StuckLine(),
    StuckLine(level="high"),
    WrongBaud(ratio=1.7),
    WrongBaud(ratio=0.6),
]
DATA = np.random.default_rng(5).bytes(2000)


def stage(fault, seed=1):
    return fault.stage(np.random.default_rng(seed), BYTES_PER_S)


def through(fault, pieces, seed=1):
    s = stage(fault, seed)
    return b"".join([*(s.change(piece) for piece in pieces), s.finish()]), s


def flipped(a, b):
    return sum((x ^ y).bit_count() for x, y in zip(a, b, strict=True))


@pytest.mark.parametrize("fault", FAULTS_OF_BYTES, ids=lambda f: f"{f.kind}")
@given(cuts=st.lists(st.integers(0, len(DATA)), max_size=12))
def test_the_result_does_not_depend_on_how_the_bytes_are_cut(fault, cuts):
    bounds = [0, *sorted(cuts), len(DATA)]
    whole, of_whole = through(fault, [DATA])
    cut, of_cut = through(fault, [DATA[a:b] for a, b in pairwise(bounds)])
    assert cut == whole
    assert (of_cut.hits, of_cut.touched) == (of_whole.hits, of_whole.touched)


@pytest.mark.parametrize("fault", FAULTS_OF_BYTES[:5], ids=lambda f: f.kind)
def test_another_seed_hits_other_places(fault):
    assert through(fault, [DATA], 1)[0] != through(fault, [DATA], 2)[0]


def test_each_does_as_much_as_it_says():
    out, s = through(FAULTS_OF_BYTES[0], [DATA])
    assert flipped(out, DATA) == s.hits == pytest.approx(160, abs=50)
    out, s = through(FAULTS_OF_BYTES[1], [DATA])
    assert (len(out), s.hits, s.over) == (len(DATA) + 7, 7, True)
    out, s = through(FAULTS_OF_BYTES[2], [DATA])
    assert (len(out), s.hits, s.touched, s.over) == (len(DATA) - 7, 7, 7, True)
    out, s = through(FAULTS_OF_BYTES[3], [DATA])
    assert (len(out), s.hits, s.touched, s.over) == (len(DATA), 3, 27, True)
    assert sum(x != y for x, y in zip(out, DATA, strict=True)) > 20
    out, s = through(FAULTS_OF_BYTES[4], [DATA])
    assert (len(out), s.hits, s.touched) == (len(DATA) - 2 * 25, 2, 50)


def test_by_default_the_next_bit_or_byte_is_hit_once():
    assert flipped(through(BitFlips(), [DATA])[0], DATA) == 1
    assert through(LostBytes(), [DATA])[0] == DATA[1:]
    assert through(InsertedBytes(), [DATA])[0][1:] == DATA


def test_an_overrun_keeps_what_the_fifo_holds():
    out, _ = through(Overrun(late_us=1000, fifo_bytes=16), [DATA])
    assert out == DATA[:16] + DATA[300:]


def test_a_break_is_one_zero_byte_and_a_broken_wire_none():
    assert through(StuckLine(), [DATA[:7], DATA[7:]])[0] == b"\0"
    assert through(StuckLine(level="high"), [DATA])[0] == b""


def test_the_right_baud_rate_reads_what_was_sent():
    assert through(WrongBaud(ratio=1.0), [DATA])[0] == DATA
    assert through(WrongBaud(ratio=1.03), [DATA])[0] == DATA  # a UART tolerates 4 to 5 %


def test_known_garbage_at_a_wrong_baud_rate():
    # Twice as fast: each bit is read twice, so the start bit's second half is the first data bit.
    assert through(WrongBaud(ratio=2.0), [b"\xff"])[0] == b"\xfe"
    assert through(WrongBaud(ratio=2.0), [b"\x00"])[0][0] == 0x00
    # A receiver three times as slow sees of ff only its start bit, too short to be one.
    assert through(WrongBaud(ratio=0.3), [b"\xff"])[0] == b""


@pytest.mark.parametrize("ratio", [0.1, 0.37, 0.5, 2.0, 3.3, 10.0])
def test_every_ratio_comes_to_an_end_with_a_plausible_number_of_bytes(ratio):
    out, _ = through(WrongBaud(ratio=ratio), [DATA])
    assert len(out) <= 2 * ratio * len(DATA) + 1


def test_what_a_line_cannot_have_is_refused():
    with pytest.raises(ValueError, match="no fault of a serial line"):
        FaultyLine(FaultPlan(), "ccsds-cobs", BYTES_PER_S, None).inject(LostFrames())


@pytest.mark.parametrize(
    ("kind", "keys", "told"),
    [
        (BitFlips, {"rate": 0}, "rate must be above 0"),
        (BitFlips, {"count": -1}, "count must be"),
        (BitFlips, {"count": 0}, "set one of them"),
        (BitFlips, {"at_s": -1}, "at_s must be"),
        (BitFlips, {"for_s": float("nan")}, "for_s must be"),
        (Stall, {"for_s": 0}, "for_s must be above 0"),
        (Burst, {"length": 0}, "length must be"),
        (Overrun, {"late_us": 0}, "late_us must be"),
        (Overrun, {"fifo_bytes": 0}, "fifo_bytes must be"),
        (WrongBaud, {"ratio": 11}, "ratio must be"),
    ],
)
def test_a_key_that_makes_no_sense_is_named(kind, keys, told):
    with pytest.raises(ValueError, match=told):
        kind(**keys)
