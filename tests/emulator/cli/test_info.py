"""`evstim info`: nothing that the file does not have, and all that its text has; what `convert` says of the rest."""

import json

import h5py
import numpy as np
import pytest

from firmware_protocol.events import EDGE, EVENT
from firmware_protocol.recordings.part import Facts, Part
from tests.transports.recording.samples import SIZE, write
from tests.transports.recording.test_bags import LEFT, RIGHT, bag, events_at  # noqa: F401
from tests.transports.recording.test_evt_files import EVK4
from transports.recording.files import RecordingFile
from transports.recording.format import FORMATS

pytestmark = pytest.mark.usefixtures("reads_here")

DAT = b"% Data file containing CD events.\n% Version 2\n"
DAT_EVENT = b"\x0c\x08" + (100).to_bytes(4, "little") + bytes.fromhex("01400010")
KINDS = [("a.dat", DAT + DAT_EVENT), ("a.csv", b"t,x,y,on\n100,1,1,1\n")]


@pytest.mark.parametrize(("name", "content"), KINDS)
def test_the_size_of_a_file_without_one_is_unknown_and_asked_for(name, content, evstim, tmp_path):
    (tmp_path / name).write_bytes(content)
    assert "unknown pixels; events reach to 2 x 2" in evstim("info", tmp_path / name).out
    for verb, target in (("picture", "a.png"), ("convert", "a.aedat4")):
        done = evstim(verb, tmp_path / name, tmp_path / target)
        assert (done.code, "give --size" in " ".join(done.err.split())) == (2, True)
    assert "64 x 48 pixels" in evstim("info", tmp_path / name, "--size", "64x48").out


@pytest.mark.parametrize(("unix_us", "text", "date"), [
    (51_648_500_652, "at no known date: times count from the camera's start; the file adds 51648500652 us", None),
    (0, "at no known date: times count from the camera's start\n", None),
    (1_700_000_000_000_000, "2023-11-14 22:13:20 UTC (t = 0)", 1_700_000_000_000_000),
])  # fmt: skip
def test_an_offset_of_a_clock_is_no_date_of_1970(unix_us, text, date, evstim, tmp_path):
    write(tmp_path / "a.h5", "dsec", events_at([100, 200, 300]), unix_us=unix_us)
    assert text in evstim("info", tmp_path / "a.h5").out
    info = json.loads(evstim("info", tmp_path / "a.h5", "--json").out)
    assert (info["unix_us"], info["offset_us"]) == (date, unix_us)
    evstim("convert", tmp_path / "a.h5", tmp_path / "b.h5")
    with h5py.File(tmp_path / "b.h5") as file:
        assert file["t_offset"][()] == unix_us


def test_the_busiest_tenth_of_a_second_is_a_count_and_the_rate_is_none_where_time_goes_back(evstim, tmp_path):
    (tmp_path / "a.csv").write_text("t,x,y,on\n100,1,1,1\n300,1,1,1\n400,1,1,1\n150000,1,1,1\n")
    assert "26.68 a second, 3 in the busiest 0.1 s" in evstim("info", tmp_path / "a.csv").out
    np.savez(tmp_path / "a.npz", events=events_at([4000, 100, 200]))
    out = evstim("info", tmp_path / "a.npz").out
    assert "events    3, 0.0% ON, from 100 to 4000 us\n" in out
    assert "the time of events goes back 1 times" in out


def test_the_lines_of_text_of_a_file_are_shown_without_their_control_characters(evstim, tmp_path):
    (tmp_path / "a.raw").write_bytes(EVK4.replace(b"00ca0009", b"00\x1b[2Jca\x9b"))
    out = evstim("info", tmp_path / "a.raw").out
    assert "header    date: 2023-03-29 16:37:46\n" in out
    assert "header    plugin_name: hal_plugin_imx636_evk4\n" in out
    assert "header    serial_number: 00\\x1b[2Jca" in out


@pytest.mark.sampled
def test_the_topics_of_two_cameras_are_named_with_their_counts(bag, evstim, tmp_path, monkeypatch):  # noqa: F811
    monkeypatch.undo()  # a bag that has been read stays open in the process of its reader
    path = bag([(LEFT, events_at([5, 9])), (RIGHT, events_at([7])), (LEFT, events_at([20]))])
    out = evstim("info", path).out
    assert (
        f"topics    {LEFT} (2 messages), {RIGHT} (1 messages); the values are of {LEFT}, --topic selects another" in out
    )
    info = json.loads(evstim("info", path, "--topic", RIGHT, "--json").out)
    assert (info["camera"], info["events"], info["topics"]) == (RIGHT, 1, {LEFT: 2, RIGHT: 1})
    for verb, target in (("convert", "b.csv"), ("picture", "b.png")):
        done = evstim(verb, path, tmp_path / target)
        assert (done.code, f"{RIGHT} (1 messages): choose a topic" in " ".join(done.err.split())) == (2, True)
        assert evstim(verb, path, tmp_path / target, "--topic", LEFT).code == 0
    assert (tmp_path / "b.csv").read_text().splitlines()[1:] == ["0,0,0,0", "4,0,0,0", "15,0,0,0"]


def test_nothing_is_left_out_without_a_count(evstim, tmp_path):
    file = RecordingFile(tmp_path / "a.npz", FORMATS["npz"], Facts(SIZE))
    file.write(Part(np.zeros(1, EVENT), np.array([(5, 2, 0, 0)], EDGE)))
    file.close()
    assert "left out" not in evstim("convert", tmp_path / "a.npz", tmp_path / "a.raw").out
    assert (
        "left out, as CSV cannot hold them: 1 triggers" in evstim("convert", tmp_path / "a.npz", tmp_path / "a.csv").out
    )
