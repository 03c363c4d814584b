"""Recordings beside simulated sensors: files by another library's writer, events by a generator of our own.

Each statistical bound fails a good measurement with a probability of 1e-4 or less; the seeds are fixed.
"""

import dataclasses
import tomllib

import faery
import numpy as np
import pytest

from emulator.sensor.parameters import BackgroundParameters
from emulator.sensor.presets import SensorParameters
from evstim.sensor import sensor_parameters
from firmware_protocol.events import EVENT
from firmware_protocol.recordings.part import Facts, Frame, Part
from laboratory.characterise.recordings import activity, compare, fit, still_pixels, toml, write_comparison
from transports.recording.files import RecordingFile
from transports.recording.format import FORMATS

SIZE = 200, 150
SECONDS = 8.0
PIXELS = SIZE[0] * SIZE[1]
HZ, OFF_SHARE, PAIR_SHARE, PAIR_S, HOT, HOT_HZ = 0.05, 0.8, 0.3, 0.004, 6, 40.0


def background(random):
    """Events of Poisson primaries, some with a second, six hot pixels: numpy alone."""
    first = random.poisson(HZ / (1 + PAIR_SHARE) * SECONDS, PIXELS)
    hot = random.choice(PIXELS, HOT, replace=False)
    first[hot] = random.poisson(HOT_HZ / (1 + PAIR_SHARE) * SECONDS, HOT)
    pixel = np.repeat(np.arange(PIXELS), first)
    t, on = random.uniform(0, SECONDS, pixel.size), random.random(pixel.size) >= OFF_SHARE
    again = random.random(pixel.size) < PAIR_SHARE
    t = np.concatenate([t, t[again] + random.exponential(PAIR_S, again.sum())])
    return stream(t, np.concatenate([pixel, pixel[again]]), np.concatenate([on, ~on[again]]))


def stream(t, pixel, on, size=SIZE):
    events = np.zeros(t.size, EVENT)
    events["t"], events["x"], events["y"], events["on"] = t * 1e6, pixel % size[0], pixel // size[0], on
    return events[np.argsort(events["t"], kind="stable")]


@pytest.fixture(scope="module")
def events():
    return background(np.random.default_rng(5))


@pytest.fixture(params=["background.aedat4", "background.raw"], scope="module")
def recording(request, events, tmp_path_factory):
    path = tmp_path_factory.mktemp("recording") / request.param
    version = {"version": "evt3"} if path.suffix == ".raw" else {}
    faery.events_stream_from_array(events.astype(faery.EVENTS_DTYPE), SIZE).to_file(path, **version)
    return path


SENSOR = SensorParameters(
    width=SIZE[0], height=SIZE[1], threshold_on=0.25, threshold_off=0.25, leak_hz=0.3, leak_spread=0.0
)


def test_the_figures_of_a_stream_are_what_they_are_called():
    """Nine events of three pixels among 200 x 150, counted by hand."""
    t = np.array([0, 0.001, 0.002, 0.003, 1, 2, 3, 4, 5.0])
    found = activity(stream(t, np.array([7, 7, 7, 8, 8, 9, 9, 9, 9]), np.arange(9) % 2 == 0), SIZE, 6.0)
    assert (found.events, found.pixels) == (9, PIXELS)
    assert found.rate_hz == pytest.approx(9 / PIXELS / 6)
    assert found.on_share == pytest.approx(5 / 9)
    assert found.silent_share == pytest.approx(1 - 3 / PIXELS)
    assert found.opposite_share == 1.0
    assert sorted(np.round(found.intervals_s, 6)) == [0.001, 0.001, 0.997, 1, 1, 1]
    assert found.per_ms[:4].tolist() == [1, 1, 1, 1]
    assert found.per_ms.sum() == 9
    assert found.fano == pytest.approx(found.counts.var() / found.counts.mean())


def test_a_recording_is_fitted_and_lies_beside_both_sensors(recording, tmp_path):
    found = compare(recording, ("sensor", SENSOR), 1.0, fitted=True)
    assert list(found.streams) == [recording.name, "sensor", "sensor, fitted"]
    table = found.fitted["background"]
    events_n, hot_n = HZ * SECONDS * PIXELS, HOT * HOT_HZ * SECONDS
    four = 4 * np.sqrt(1 + PAIR_SHARE)
    assert table["hz"] == pytest.approx(HZ, rel=four / np.sqrt(events_n))
    assert table["off_share"] == pytest.approx(OFF_SHARE, abs=0.03)
    assert table["pair_share"] == pytest.approx(PAIR_SHARE, abs=0.03)
    assert table["pair_us"] == pytest.approx(PAIR_S * 1e6, rel=0.15)
    assert round(table["hot_share"] * PIXELS) == HOT
    assert table["hot_hz"] == pytest.approx(HOT_HZ, rel=four / np.sqrt(hot_n))
    rows = {row["statistic"]: row for row in found.rows()}
    assert rows["rate, simulated over recorded"]["sensor, fitted"] == pytest.approx(1, abs=0.05)
    assert abs(rows["silent share, difference"]["sensor, fitted"]) < 0.02
    assert rows["intervals of a pixel, KS"]["sensor, fitted"] < 0.06 < rows["intervals of a pixel, KS"]["sensor"]
    assert rows["counts of the pixels, KS"]["sensor, fitted"] < 0.02 < rows["counts of the pixels, KS"]["sensor"]
    files = {path.name: path for path in write_comparison(found, "sensor", tmp_path)}
    assert {"recording.html", "recording.csv", "recording.json", "fit.toml"} == set(files)
    figures = tomllib.loads(files["fit.toml"].read_text(encoding="utf-8"))["camera"]["sensor"]
    written = dataclasses.asdict(sensor_parameters(SENSOR, **figures).background)
    assert written == pytest.approx(dataclasses.asdict(BackgroundParameters(**table)), rel=1e-5)


def test_a_recording_of_leak_is_fitted_by_leak():
    random = np.random.default_rng(3)
    hz = 0.3 * np.exp(0.5 * random.normal(size=PIXELS) - 0.125)
    counts = random.poisson(hz * SECONDS)
    pixel = np.repeat(np.arange(PIXELS), counts)
    found = fit(activity(stream(random.uniform(0, SECONDS, pixel.size), pixel, pixel >= 0), SIZE, SECONDS))
    assert found["leak_hz"] == pytest.approx(0.3, rel=0.03)
    assert found["leak_spread"] == pytest.approx(0.5, abs=0.05)
    assert found["background"]["hz"] == 0.0
    assert tomllib.loads(toml(found, "a remark"))["camera"]["sensor"]["leak_hz"] == pytest.approx(
        found["leak_hz"], rel=1e-5
    )


def test_still_pixels_are_those_away_from_what_moves(events):
    random = np.random.default_rng(1)
    moving = np.flatnonzero(np.tile(np.arange(SIZE[0]) < 40, SIZE[1]))
    pixel = np.repeat(moving, 40)
    mixed = np.concatenate([events, stream(random.uniform(0, SECONDS, pixel.size), pixel, pixel % 2 == 0)])
    still = still_pixels(mixed, SIZE, SECONDS, 0.3)
    assert not still[:, :38].any()
    assert still[:, 43:].mean() > 0.99
    busy = np.bincount(events["y"].astype(int) * SIZE[0] + events["x"], minlength=PIXELS).argsort()[-HOT:]
    assert still.reshape(-1)[[one for one in busy if one % SIZE[0] > 43]].mean() > 0.8


def test_a_recording_with_frames_is_compared_under_their_light(tmp_path):
    """A dark half and a bright one that leaks ten times as much: seen with the frames' light, not without."""
    size = 64, 48
    random, level = np.random.default_rng(4), np.where(np.arange(size[0]) < 32, 8, 160).astype(np.uint8)
    frames = [
        Frame(50_250 + 40_000 * k, 50_000 + 40_000 * k, 50_500 + 40_000 * k, np.tile(level, (size[1], 1)))
        for k in range(40)
    ]
    phases = random.uniform(0, 1, size[0] * size[1])  # a leak is regular: Poisson's counts would be 0.19 from it
    counts = np.floor(np.tile(np.where(level > 100, 2.0, 0.1), size[1]) * 1.6 + phases).astype(np.int64)
    pixel = np.repeat(np.arange(counts.size), counts)
    events = stream(random.uniform(0, 1.6, pixel.size), pixel, pixel >= 0, size)
    path = tmp_path / "framed.aedat4"
    file = RecordingFile(path, FORMATS["aedat4"], Facts(size=size, streams=frozenset({"frames"})))
    file.write(Part(events, frames=tuple(frames)))
    file.close()
    sensor = SensorParameters(
        width=size[0], height=size[1], threshold_on=0.25, threshold_off=0.25, leak_hz=0.0,
        parasitic_hz_at_reference=1.0, leak_spread=0.0,
    )  # fmt: skip
    framed, uniform = (compare(path, ("sensor", sensor), light) for light in (None, 1.0))
    assert "under the mean of the recording's frames" in framed.reading[0]
    assert "cannot be compared" in uniform.reading[1]
    rates = [found.streams["sensor"].rate_hz for found in (framed, uniform)]
    assert rates[0] == pytest.approx((0.1 + 2.0) / 2, rel=0.1)
    assert rates[1] == pytest.approx(1.0, rel=0.1)
    assert next(row for row in framed.rows() if row["statistic"] == "counts of the pixels, KS")["sensor"] < 0.1
