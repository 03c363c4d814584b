"""Frames and IMU samples of AEDAT 2.0: bytes by hand, round trips in pieces, rolling shutters, and what is damaged."""

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.recordings.aedat import Aedat2Decoder, frame_words, imu_words, packed
from firmware_protocol.recordings.part import IMU, Frame

SIZE = (5, 4)
VALUES = ["accelerometer_x", "accelerometer_y", "accelerometer_z", "temperature"]
VALUES += ["gyroscope_x", "gyroscope_y", "gyroscope_z"]


def frame_at(t_us, shape=(4, 5), origin=(0, 0), exposure_us=400):
    pixels = np.random.default_rng(t_us).integers(0, 1024, shape, np.uint16)
    return Frame(t_us, t_us, t_us + exposure_us, pixels, origin)


def samples_at(times):
    imu = np.zeros(len(times), IMU)
    imu["t"] = times
    rng = np.random.default_rng(len(times))
    for name in VALUES:
        imu[name] = rng.uniform(-3, 3, len(times)) * (100 if name.startswith("g") else 1)
    return imu


def test_a_frame_is_the_reset_reads_and_the_signal_reads_of_its_pixels_from_the_lower_left():
    frame = Frame(10, 10, 14, np.array([[0, 1], [512, 1023]], np.uint16), (3, 1))
    bits = [(3, 2, 0), (4, 2, 1), (3, 1, 512), (4, 1, 1023)]  # column, row from the bottom, brightness
    reset = b"".join(struct.pack(">Ii", 1 << 31 | y << 22 | x << 12 | 1023, 10) for x, y, _ in bits)
    signal = b"".join(struct.pack(">Ii", 1 << 31 | y << 22 | x << 12 | 1 << 10 | 1023 - v, 14) for x, y, v in bits)
    assert packed(frame_words(frame, 4)) == reset + signal
    (read,) = Aedat2Decoder(SIZE).decode(reset + signal).frames
    assert (read.t_us, read.exposure_begin_us, read.exposure_end_us, read.origin) == (10, 10, 14, (3, 1))
    np.testing.assert_array_equal(read.pixels, frame.pixels)


def test_a_sample_is_seven_records_in_the_units_of_jaer():
    imu = samples_at([7])
    for name, value in zip(VALUES, (1.0, -1.0, 5.0, 36.0, 10.0, -10.0, 0.0), strict=True):
        imu[name] = value
    raw = (8192, -8192, 32767, 340, 655, -655, 0)
    words = [1 << 31 | k << 28 | (value & 0xFFFF) << 12 | 3 << 10 for k, value in enumerate(raw)]
    assert packed([imu_words(imu)]) == b"".join(struct.pack(">Ii", word, 7) for word in words)
    read = Aedat2Decoder(SIZE).decode(packed([imu_words(imu)])).imu
    assert [float(read[name][0]) for name in VALUES] == pytest.approx([1, -1, 4, 36, 10, -10, 0], abs=1e-3)


@pytest.mark.system
@given(st.integers(1, 200), st.integers(0, 6), st.integers(0, 9))
def test_what_was_written_is_read_back_in_any_pieces(piece, n_frames, n_samples):
    frames = [frame_at(1000 * k, (3, 2) if k % 2 else (4, 5), (2, 1) if k % 2 else (0, 0)) for k in range(n_frames)]
    imu = samples_at(np.arange(n_samples) * 650)
    data = packed([imu_words(imu), *(words for frame in frames for words in frame_words(frame, SIZE[1]))])
    decoder = Aedat2Decoder(SIZE)
    parts = [decoder.decode(data[at : at + piece]) for at in range(0, len(data), piece)]
    read = [frame for part in parts for frame in part.frames]
    samples = np.concatenate([imu[:0], *(part.imu for part in parts)])
    assert [(f.t_us, f.exposure_end_us, f.origin) for f in read] == [
        (f.t_us, f.exposure_end_us, f.origin) for f in frames
    ]
    for one, other in zip(read, frames, strict=True):
        np.testing.assert_array_equal(one.pixels, other.pixels)
    assert samples["t"].tolist() == imu["t"].tolist()
    for name in VALUES:
        np.testing.assert_allclose(samples[name], imu[name], atol=0.01)


def test_the_reads_of_a_rolling_shutter_take_turns():
    """Its exposure begins with the first reset read."""
    frame, turns = frame_at(100, exposure_us=0), []
    reset, signal = frame_words(frame, SIZE[1])
    for row in range(5):
        for words, of_row, t in ((reset, row, 100 + 20 * row), (signal, row - 1, 110 + 20 * row)):
            if 0 <= of_row < 4:
                line = words[5 * of_row : 5 * of_row + 5].copy()
                line["t"] = t
                turns.append(line)
    (read,) = Aedat2Decoder(SIZE).decode(packed(turns)).frames
    assert (read.exposure_begin_us, read.exposure_end_us) == (100, 130)
    np.testing.assert_array_equal(read.pixels, frame.pixels)


def test_a_frame_of_which_reads_are_missing_does_not_spoil_those_that_follow_for_long():
    whole = [packed(frame_words(frame_at(1000 * k), SIZE[1])) for k in range(12)]
    decoder = Aedat2Decoder(SIZE)
    frames = decoder.decode(whole[0][80:] + b"".join(whole[1:])).frames  # begins in the middle of a frame
    assert [frame.t_us for frame in frames] == [1000 * k for k in range(1, 12)]
    decoder = Aedat2Decoder(SIZE)
    frames = [f for data in (whole[0], whole[1][:-8], *whole[2:]) for f in decoder.decode(data).frames]
    assert frames[0].t_us == 0
    assert [frame.t_us for frame in frames[1:]] == [1000 * k for k in range(12 - len(frames) + 1, 12)]
    assert len(frames) > 6


def test_saturated_pixels_are_white():
    frame = frame_at(5, (1, 2))
    reset, signal = frame_words(frame, SIZE[1])
    reset["address"][0] -= 1023 - 200  # lower than any sound reset read
    signal["address"][1] &= np.uint32(0xFFFF_FC00)
    (read,) = Aedat2Decoder(SIZE).decode(packed([reset, signal])).frames
    assert read.pixels.tolist() == [[1023, 1023]]
