"""Small files that claim much: sizes and growth are bounded before memory is taken; what cannot be is named."""

import h5py
import numpy as np
import pytest

from firmware_protocol.evt.evt3 import Evt3Encoder
from tests.transports.recording.samples import SIZE, sample_events
from transports.recording import files
from transports.recording.files import OpenRecording, iter_events, read_events, read_messages
from transports.recording.part import RecordingError

pytestmark = pytest.mark.usefixtures("forked_readers")


def hdf5(path, t, chunk=None, **further):
    """Write a file of DSEC's layout; `t` is an array, or the number of times that are never written."""
    with h5py.File(path, "w") as file:
        for name, dtype in {"x": "u2", "y": "u2", "t": "u4", "p": "u1", **further.pop("dtypes", {})}.items():
            if isinstance(t, int):
                file.create_dataset(f"events/{name}", (t,), dtype, chunks=(chunk,), **further)
            else:
                values = further.get(name, t if name == "t" else np.zeros(len(t)))
                file.create_dataset(f"events/{name}", data=np.asarray(values, dtype))
    return path


@pytest.mark.parametrize("chunk", [1 << 32 - 4, 1 << 16])
def test_chunks_that_were_never_written_hold_no_events(chunk, tmp_path):
    path = hdf5(tmp_path / "a.h5", 1 << 32, chunk)
    assert path.stat().st_size < 10_000
    with pytest.raises(RecordingError, match="claims 4294967296 events in 0 bytes"):
        read_events(path, size=SIZE)


@pytest.mark.parametrize(("values", "dtypes", "words"), [
    ({}, {"t": "f8"}, "no integers: t is read in us"),
    ({"t": [1, 2, -3]}, {"t": "i8"}, r"event 2 at -3 us, \(0, 0\), cannot be"),
    ({"x": [1, 2, 65536]}, {"x": "i4"}, r"event 2 at 3 us, \(65536, 0\), cannot be"),
])  # fmt: skip
def test_values_that_no_event_has_are_named(values, dtypes, words, tmp_path):
    path = hdf5(tmp_path / "a.h5", values.pop("t", [1, 2, 3]), dtypes=dtypes, **values)
    read = []
    with pytest.raises(RecordingError, match=words):
        read.extend(iter_events(path))
    assert read == [] if dtypes.get("t") == "f8" else read[0]["t"].tolist() == [1, 2]


def test_no_file_grows_beyond_its_bytes(tmp_path, monkeypatch):
    """The same bound for every format: 64 MiB and a thousand times the bytes of the file."""
    monkeypatch.setattr(files, "_ALWAYS_BYTES", 0)
    monkeypatch.setattr(files, "_MOST_GROWTH", 2)
    path = tmp_path / "a.raw"
    path.write_bytes(b"% geometry 346x260\n% end\n" + Evt3Encoder().encode(sample_events()))
    with pytest.raises(RecordingError, match="would grow to more data than a file of its size can hold"):
        list(read_messages(path, "evt3", None, {}))


@pytest.mark.parametrize("name", ["a.raw", "a.csv", "a.aedat2"])
@pytest.mark.parametrize(("width", "height"), [(65535, 65535), (4097, 4096), (65535, 257)])
def test_a_sensor_larger_than_any_is_refused(name, width, height, tmp_path):
    texts = {
        "a.raw": f"% geometry {width}x{height}\n% end\n",
        "a.csv": f"t,x@{width},y@{height},on\n1,2,3,1\n",
        "a.aedat2": f"#!AER-DAT2.0\r\n# width {width} height {height}\r\n",
    }
    (tmp_path / name).write_text(texts[name], newline="")
    with pytest.raises(RecordingError, match=f"{width} x {height} pixels: from 1 to 16777216 are read"):
        OpenRecording(tmp_path / name)


def test_a_size_that_the_file_contradicts_is_refused(tmp_path):
    (tmp_path / "a.raw").write_bytes(b"% geometry 640x480\n% end\n")
    with pytest.raises(RecordingError, match="its sensor has 640 x 480 pixels: leave --size 346x260 out"):
        OpenRecording(tmp_path / "a.raw", SIZE)
    (tmp_path / "a.csv").write_text("t,x,y,on\n1,2,3,1\n")
    with pytest.raises(RecordingError, match="its sensor has 65535 x 65535 pixels"):
        OpenRecording(tmp_path / "a.csv", (65535, 65535))
