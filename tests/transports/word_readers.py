"""Programs of others that read the words of sensors, behind the header of a `.raw` file, and events that need them."""

import evlib
import evt3
import expelliarmus
import faery
import numpy as np

from firmware_protocol.events import EVENT
from firmware_protocol.evt.evt2 import evt2_header
from firmware_protocol.evt.words import evt3_header

SIZE = (346, 260)
MANY = 1_050_000
OCTETS = {"evt2": 4, "evt21": 8, "evt3": 2, "spif": 4}


def rows(count, every_us=40, seed=3):
    """Return (count,) EVENT: rows of 1 to 24 neighbours of one time and polarity, `every_us` apart."""
    rng = np.random.default_rng(seed)
    lengths = rng.integers(1, 25, count // 8)
    of_row = np.repeat(np.arange(len(lengths)), lengths)[:count]
    place = np.arange(len(of_row)) - np.searchsorted(of_row, of_row)
    events = np.zeros(len(of_row), EVENT)
    events["t"] = 1 + of_row * every_us
    events["x"] = rng.integers(0, SIZE[0] - 24, len(lengths))[of_row] + place
    events["y"] = rng.integers(0, SIZE[1], len(lengths))[of_row]
    events["on"] = rng.integers(0, 2, len(lengths))[of_row]
    assert len(events) == count
    return events


def as_events(t, x, y, on):
    events = np.zeros(len(t), EVENT)
    for name, values in zip(EVENT.names, (t, x, y, on), strict=True):
        events[name] = np.asarray(values)
    return events


def by_faery(path, form=""):
    read = np.concatenate(list(faery.events_stream_from_file(path)))
    return as_events(*(read[name] for name in ("t", "x", "y", "on")))


def by_evlib(path, form=""):
    read = evlib.load_events(str(path)).collect()
    t = read["t"].dt.total_microseconds().to_numpy()
    return as_events(t, *(read[name].to_numpy() for name in ("x", "y")), read["polarity"].to_numpy() > 0)


def by_expelliarmus(path, form=""):
    read = expelliarmus.Wizard(encoding=form or ("dat" if path.suffix == ".dat" else "evt2")).read(str(path))
    return as_events(*(read[name] for name in "txyp"))


def by_evt3(path, form=""):
    read = evt3.decode_file(str(path))
    assert read.sensor_size == SIZE
    return as_events(read.t, read.x, read.y, np.asarray(read.p) > 0)


def by_the_document(path, form):
    """Return the events of EVT2.1 words, by the tables of docs.prophesee.ai alone."""
    words = np.frombuffer(path.read_bytes().partition(b"% end\n")[2], "<u8")
    kind, high, last = words >> np.uint64(60), words >> np.uint64(32) & np.uint64(0xFFF_FFFF), np.uint64(0)
    is_high, index = kind == 8, np.arange(len(words))
    last = np.maximum.accumulate(np.where(is_high, index, 0))
    t = high[last] << np.uint64(6) | words >> np.uint64(54) & np.uint64(63)
    chosen = kind <= 1
    words, t, kind = words[chosen], t[chosen], kind[chosen]
    bits = np.unpackbits((words & np.uint64(0xFFFF_FFFF)).astype("<u4").view(np.uint8), bitorder="little")
    word, bit = np.nonzero(bits.reshape(-1, 32))
    x = (words[word] >> np.uint64(43) & np.uint64(0x7FF)) + bit.astype(np.uint64)
    return as_events(t[word], x, words[word] >> np.uint64(32) & np.uint64(0x7FF), kind[word] == 1)


READERS = {
    "evt2": (by_faery, by_evlib, by_expelliarmus),
    "evt21": (by_evlib, by_the_document),
    "evt3": (by_faery, by_evt3, by_evlib),  # expelliarmus 1.1.12 adds 4096 us whenever the low part goes back
}


def spif_events(data):
    """Return [(x, y, on), ...] of AER words, by their document."""
    words = np.frombuffer(data, "<u4")
    assert (words >> 31 == 1).all()
    events = np.zeros(len(words), EVENT)
    events["x"], events["y"], events["on"] = words >> 16 & 0x7FFF, words & 0x7FFF, words >> 15 & 1
    return events


def check_words(form, data, events, folder):
    """Compare the events with those that each reader of the format reads."""
    if form == "spif":
        np.testing.assert_array_equal(spif_events(data)[["x", "y", "on"]], events[["x", "y", "on"]])
        return
    path = folder / f"{form}.raw"
    path.write_bytes((evt3_header(SIZE) if form == "evt3" else evt2_header(SIZE, form)) + data)
    for read in READERS[form]:
        np.testing.assert_array_equal(read(path, form), events, err_msg=read.__name__)
