"""The IMU behind its registers: rates, ranges, filters, noise."""

import numpy as np
import pytest
from scipy import signal

from emulator.run.imu import IMU_MOTION, Converter
from firmware_protocol.davis346.registers import imu_settings
from firmware_protocol.fx3.registers import Access, Module, Register, RegisterFile
from firmware_protocol.imu_samples import ImuScale, physical

G = 9.80665


def settings(unit=2, words=True, **values):
    names = {"accelerometer": 2, "gyroscope": 3, "temperature": 4, "divider": 5, "low_pass": 6, "range_g": 7}
    names |= {"gyroscope_low_pass": 9, "range_deg_s": 10}
    file = RegisterFile(
        [Register(Module.IMU, 0, "TYPE", unit, Access.READ_ONLY)]
        + [Register(Module.IMU, address, name, bits=8) for name, address in names.items()]
    )
    defaults = {"accelerometer": 1, "gyroscope": 1, "temperature": 1, "low_pass": 1, "gyroscope_low_pass": 1}
    defaults |= {"range_g": 1, "range_deg_s": 1}
    for name, value in (defaults | values).items():
        file.write(Module.IMU, names[name], value)
    return imu_settings(file, words=words)


def motion(n, force=0.0, rate=0.0, first=1):
    m = np.zeros(n, IMU_MOTION)
    m["index"] = np.arange(first, first + n)
    m["t"], m["force"], m["rate"], m["temperature"] = 1000 * m["index"], force, rate, 28.5
    return m


def test_what_is_steady_comes_out_in_the_units_of_the_registers():
    found = physical(
        Converter().samples(motion(3, force=[0, -G, 0.5 * G], rate=np.radians([100, 0, -250])), settings())
    )
    np.testing.assert_allclose(found["acceleration_g"], np.broadcast_to([0, -1, 0.5], (3, 3)), atol=4 / 65536)
    np.testing.assert_allclose(found["rate_deg_s"], np.broadcast_to([100, 0, -250], (3, 3)), atol=500 / 65536)
    np.testing.assert_allclose(found["temperature_c"], 28.5, atol=0.5 / 333.87)
    assert found["t"].tolist() == [1000, 2000, 3000]


@pytest.mark.parametrize("n", [0, 1, 2, 3])
def test_ranges_set_the_step_and_where_it_saturates(n):
    force, rate = 2.2 * 2**n * G, np.radians(251 * 2**n)
    found = Converter().samples(
        motion(1, force=[force, -force, 0], rate=[rate, -rate, 0]), settings(range_g=n, range_deg_s=n)
    )
    assert found["counts"][0, [0, 1]].tolist() == [32767, -32768]
    assert found["counts"][0, [4, 5]].tolist() == [32767, -32768]
    assert ImuScale.parse(int(found["scale"][0])) == ImuScale(accelerometer_range=n, gyroscope_range=n)
    one_step = Converter().samples(motion(1, force=G * 4 * 2**n / 65536), settings(range_g=n, range_deg_s=n))
    assert one_step["counts"][0, :3].tolist() == [1, 1, 1]


@pytest.mark.parametrize(
    ("values", "expected_hz"),
    [
        ({}, 1000),
        ({"divider": 4}, 200),
        ({"divider": 2}, 333),
        ({"gyroscope_low_pass": 0, "divider": 7}, 1000),
        ({"gyroscope_low_pass": 7, "divider": 15}, 500),
        ({"gyroscope_low_pass": 0, "divider": 0}, 1000),
        ({"unit": 1, "low_pass": 0, "divider": 31}, 250),
        ({"unit": 1, "low_pass": 1, "gyroscope_low_pass": 0, "divider": 1}, 500),
    ],
)
def test_the_sample_rate_is_that_of_the_registers(values, expected_hz):
    assert len(Converter().samples(motion(1000), settings(**values))) == expected_hz


def test_which_samples_are_taken_does_not_depend_on_when_they_come():
    whole = Converter().samples(motion(100), settings(divider=6))
    imu = Converter()
    parts = [imu.samples(motion(k, first=first), settings(divider=6)) for first, k in ((1, 13), (14, 1), (15, 86))]
    assert np.concatenate(parts).tobytes() == whole.tobytes()


def test_run_bits_choose_what_is_there():
    only_gyroscope = settings(accelerometer=0, temperature=0)
    found = Converter().samples(motion(1, force=G, rate=1.0), only_gyroscope)
    assert found["counts"][0, :4].tolist() == [0, 0, 0, 0]
    assert (found["counts"][0, 4:] > 0).all()
    assert not settings(accelerometer=0, temperature=0, gyroscope=0).run
    assert not settings(unit=0).run
    assert not settings(words=False).run


@pytest.mark.parametrize(("low_pass", "hz"), [(1, 218.1), (2, 99), (5, 10.2)])
def test_the_filter_is_scipys_butterworth(low_pass, hz):
    rng = np.random.default_rng(1)
    felt = rng.normal(0, 5, (400, 3))
    imu, asked = Converter(), settings(low_pass=low_pass, range_g=3)
    found = physical(imu.samples(motion(400, force=felt), asked))["acceleration_g"]
    b, a = signal.butter(2, hz, fs=1000)
    expected = signal.lfilter(b, a, felt, axis=0, zi=signal.lfilter_zi(b, a)[:, None] * felt[0])[0] / G
    np.testing.assert_allclose(found, expected, atol=0.51 * 32 / 65536)


def test_an_open_filter_lets_everything_through():
    felt = np.random.default_rng(1).normal(0, 1, (50, 3))
    found = physical(Converter().samples(motion(50, rate=felt), settings(gyroscope_low_pass=7)))["rate_deg_s"]
    np.testing.assert_allclose(found, np.degrees(felt), atol=0.51 * 1000 / 65536)


def test_white_noise_gets_the_correlation_of_the_filter():
    """0.5 to 0.75 from sample to sample, as in recordings: 0.52 and 0.72; 20 000 samples tell it within 0.03."""
    rng = np.random.default_rng(3)
    felt = motion(20_000, force=rng.normal(0, 0.1, (20_000, 3)), rate=rng.normal(0, 0.01, (20_000, 3)))
    counts = Converter().samples(felt, settings(range_g=0, range_deg_s=0))["counts"].astype(float)
    lag_1 = [np.corrcoef(counts[1:, k], counts[:-1, k])[0, 1] for k in (0, 1, 2, 4, 5, 6)]
    np.testing.assert_allclose(lag_1[:3], 0.654, atol=0.03)
    np.testing.assert_allclose(lag_1[3:], 0.724, atol=0.03)


def test_the_noise_behind_the_filter_has_the_density_times_its_bandwidth():
    """Deviation n sqrt(B): B of a Butterworth of two poles at 1 kHz, from scipy, is 188.8 Hz at 184."""
    density = np.radians(0.007)
    white = np.random.default_rng(7).normal(0, density * np.sqrt(500), (20_000, 3))
    found = physical(Converter().samples(motion(20_000, rate=white), settings(range_deg_s=0)))["rate_deg_s"]
    np.testing.assert_allclose(found.std(axis=0), 0.007 * np.sqrt(188.85), rtol=4.5 / np.sqrt(20_000 / 3))


def test_a_change_of_filter_starts_settled():
    imu = Converter()
    imu.samples(motion(1, force=G), settings())
    found = imu.samples(motion(2, force=-G, first=2), settings(low_pass=6))
    assert found["counts"][:, 0].tolist() == [-8192, -8192]
