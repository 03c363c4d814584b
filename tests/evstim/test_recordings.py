"""Events read back from every format that is written."""

import numpy as np
import pytest

import evstim
from firmware_protocol.recordings.part import Facts, Part
from tests.made_events import events_at
from transports.recording.files import RecordingFile
from transports.recording.format import FORMATS

COUNT = 100_000  # more than one piece holds


@pytest.fixture(scope="module")
def events():
    return events_at(
        np.arange(COUNT) * 3, x=np.arange(COUNT) % 346, y=np.arange(COUNT) % 260, on=np.arange(COUNT) % 3 == 0
    )


def written(path, form, events):
    file = RecordingFile(path, form, Facts((346, 260)))
    file.write(Part(events))
    file.close()
    return path


@pytest.mark.sampled
@pytest.mark.parametrize("name", FORMATS)
def test_every_format_that_is_written_is_read(name, events, tmp_path):
    path = written(tmp_path / f"recording{FORMATS[name].suffixes[0]}", FORMATS[name], events)
    whole = evstim.read_events(path)
    assert whole.dtype == evstim.EVENT
    assert np.array_equal(np.sort(whole, order=["t", "x", "y"]), events)
    whole["t"] += 1  # it belongs to the caller
    pieces = list(evstim.iter_events(str(path)))
    assert all(len(piece) for piece in pieces)
    assert np.array_equal(np.sort(np.concatenate(pieces), order=["t", "x", "y"]), events)


def test_an_iterator_that_is_closed_ends_its_process(events, tmp_path):
    pieces = evstim.iter_events(written(tmp_path / "a.npz", FORMATS["npz"], events))
    assert 0 < len(next(pieces)) < COUNT
    pieces.close()
    with pytest.raises(StopIteration):
        next(pieces)


def test_events_before_a_damage_come_first(events, tmp_path):
    path = written(tmp_path / "a.csv", FORMATS["csv"], events)
    path.write_bytes(path.read_bytes() + b"3,damaged\n")
    pieces = []
    with pytest.raises(evstim.RecordingError, match=r"a\.csv: "):
        pieces.extend(evstim.iter_events(path))
    assert np.array_equal(np.concatenate(pieces)[:1000], events[:1000])


def test_what_is_no_recording(tmp_path):
    with pytest.raises(FileNotFoundError):
        evstim.read_events(tmp_path / "none.npz")
    (tmp_path / "text.md").write_text("hello")
    with pytest.raises(evstim.RecordingError, match=r"text\.md: it is none of the recordings that are read"):
        evstim.read_events(tmp_path / "text.md")


@pytest.mark.parametrize(("name", "field", "value", "message"), [
    ("npz", "t", 1, r"event 99999 goes back in time, from 299994 to 1 us; .* strict=False returns all"),
    ("npz", "x", 346, r"event 99999 is at \(346, .*\), outside a sensor of 346 x 260 pixels; .*strict=False"),
])  # fmt: skip
def test_events_that_no_camera_sends_are_damage(name, field, value, message, events, tmp_path):
    wrong = events.copy()
    wrong[field][-1] = value
    path = tmp_path / f"a.{name}"
    writer = FORMATS[name].open_writer(path, Facts((346, 260)))
    writer.write(Part(wrong))
    writer.close()
    pieces = []
    with pytest.raises(evstim.RecordingError, match=message):
        pieces.extend(evstim.iter_events(path))
    assert np.array_equal(np.concatenate(pieces), events[:-1])
    assert np.array_equal(evstim.read_events(path, strict=False), wrong)


def test_changed_octets_give_no_wrong_events(events, tmp_path):
    path = written(tmp_path / "a.raw", FORMATS["evt3"], events)
    octets = bytearray(path.read_bytes())
    for place in np.random.default_rng(3).integers(1000, len(octets), 40):
        octets[place] ^= 0x41
    path.write_bytes(octets)
    with pytest.raises(evstim.RecordingError, match=r"goes back in time|outside a sensor"):
        evstim.read_events(path)
    all_events = evstim.read_events(path, strict=False)
    assert (np.diff(all_events["t"].astype(np.int64)) < 0).any() or all_events["x"].max() >= 346
