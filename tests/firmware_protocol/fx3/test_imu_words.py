"""IMU samples in words and back."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.fx3.blocks import ImuReader, imu_words, is_imu
from firmware_protocol.imu_samples import IMU_SAMPLE, ImuScale, no_samples, physical

COUNTS = st.lists(st.integers(-32768, 32767), min_size=7, max_size=7)


def sample(t=0, scale=0xE5, counts=(0,) * 7):
    return np.array([(t, scale, list(counts))], IMU_SAMPLE)


def masked(scale, counts):
    s = ImuScale.parse(scale)
    there = [s.accelerometer] * 3 + [s.temperature] + [s.gyroscope] * 3
    return [c if here else 0 for c, here in zip(counts, there, strict=True)]


def read(words, t=0, reader=None):
    words = np.asarray(words, np.uint16)
    return (reader or ImuReader()).feed(words, np.full(len(words), t, np.int64))["sample"]


GOLDEN = {
    "all, 4 g and 500 deg/s": (
        sample(9, 0xE5, (1, -1, 8192, 0x1234, -32768, 32767, 0)),
        "0005 53E5 5000 5001 50FF 50FF 5020 5000 5012 5034 5080 5000 507F 50FF 5000 5000 0007",
    ),
    "gyroscope alone, 2000 deg/s": (
        sample(9, 0x43, (0, 0, 0, 0, 258, -2, 3)),
        "0005 5343 5001 5002 50FF 50FE 5000 5003 0007",
    ),
    "temperature alone": (sample(9, 0x20, (0, 0, 0, -1, 0, 0, 0)), "0005 5320 50FF 50FF 0007"),
}


@pytest.mark.parametrize("name", GOLDEN)
def test_golden_vectors(name):
    one, text = GOLDEN[name]
    words = [int(w, 16) for w in text.split()]
    assert imu_words(one).tolist() == words
    assert read(words, 9).tobytes() == one.tobytes()


def test_the_scale_byte_of_the_reference():
    assert int(ImuScale()) == 0xE5
    assert ImuScale.parse(0xE5) == ImuScale()


@given(scale=st.integers(0, 255).map(lambda s: s & 0xEF), counts=COUNTS, cut=st.integers(0, 17))
def test_a_sample_comes_back_from_its_words_however_they_are_cut(scale, counts, cut):
    one = sample(77, scale, masked(scale, counts))
    words, reader = imu_words(one), ImuReader()
    assert is_imu(words).all()
    found = np.concatenate([read(words[:cut], 77, reader), read(words[cut:], 77, reader)])
    assert found.tobytes() == one.tobytes()
    assert reader.broken == 0


@given(st.lists(st.sampled_from([5, 7, 0x53E5, 0x5320, 0x5000, 0x50FF]), max_size=60))
def test_any_words_give_a_result_and_every_start_is_a_sample_or_broken(words):
    reader = ImuReader()
    found = read(words, 0, reader)
    read([1], 0, reader)
    assert len(found) + reader.broken >= words.count(5)


@pytest.mark.parametrize("spoilt", [slice(1, None), slice(None, -2), slice(2, None)])
def test_a_sample_with_a_word_missing_is_counted_not_told(spoilt):
    words, reader = imu_words(sample())[spoilt], ImuReader()
    words = words if words[-1] == 7 else np.append(words, np.uint16(7))
    assert len(read(words, 0, reader)) == 0
    assert reader.broken == 1


def test_physical_values_are_those_of_the_published_formulas():
    one = sample(5, 0xE5, (8192, -8192, 4096, 2504, 1000, -655, 1))
    value = physical(one)[0]
    assert value["acceleration_g"].tolist() == [1.0, -1.0, 0.5]
    assert value["temperature_c"] == pytest.approx(2504 / 333.87 + 21)
    assert value["rate_deg_s"].tolist() == [1000 / 65.536, -655 / 65.536, 1 / 65.536]
    assert physical(one, unit=1)[0]["temperature_c"] == pytest.approx(2504 / 340 + 35)
    assert len(physical(no_samples())) == 0


def test_a_group_that_is_not_there_is_zero():
    one = no_samples(1)
    one["scale"] = int(ImuScale(gyroscope=False, temperature=False))
    assert physical(one)[0]["temperature_c"] == 0.0
    one["scale"] = int(ImuScale())
    assert physical(one)[0]["temperature_c"] == 21.0
