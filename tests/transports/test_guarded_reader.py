"""Guarded reading: values come back whole, and each way in which a reader fails is one error."""

import os
import signal
import time

import numpy as np
import pytest

from transports.guarded_reader import ForeignFileError, GuardedReader, Limits, read_guarded

HERE = "tests.transports.test_guarded_reader"
LIMITS = Limits(memory_bytes=64 << 20, cpu_s=2)
RECORDS = np.array([(1, 2.5), (3, 4.5)], [("a", "<u2"), ("b", "<f4")])


def mixed(path, factor, text):
    return {"a": np.arange(6.0).reshape(2, 3) * factor, "r": RECORDS, "none": np.zeros((0, 4)), "text": text}


def pieces(path):
    for k in range(3):
        yield {"k": k, "content": path.read_text()}
    raise ValueError("the fourth piece is damaged")


def printing(path):
    os.write(1, b"a library prints")
    os.write(2, b"and complains")
    return {"k": 1}


def endless(path):
    while True:
        pass


def asleep(path):
    time.sleep(1000)


def hungry(path):
    return {"a": np.ones(1 << 30)}


def killed(path):
    os.kill(os.getpid(), signal.SIGSEGV)


def without_library(path):
    import faery_that_is_not_installed  # noqa: F401


def raised_anew(path):
    raise ModuleNotFoundError("No module named 'networkx'")


def with_advice(path):
    raise ImportError("missing `pip install pycollada`")


def without_name(path):
    raise ImportError("none of them is here")


def own_error(path):
    raise ForeignFileError("row 3 has no columns")


@pytest.fixture
def path(tmp_path):
    (tmp_path / "a.txt").write_text("content")
    return tmp_path / "a.txt"


def test_values_come_back_with_their_types_and_can_be_written(path):
    found = read_guarded(f"{HERE}:mixed", path, 3, "x")
    np.testing.assert_array_equal(found["a"], np.arange(6.0).reshape(2, 3) * 3)
    np.testing.assert_array_equal(found["r"], RECORDS)
    assert (found["r"].dtype, found["none"].shape, found["text"]) == (RECORDS.dtype, (0, 4), "x")
    found["a"][0, 0] = 7


def test_pieces_come_before_the_error(path):
    got = []
    with GuardedReader(f"{HERE}:pieces", path) as reading, pytest.raises(ForeignFileError, match="fourth"):
        got += (values for values in reading.values())
    assert got == [{"k": k, "content": "content"} for k in range(3)]


def test_a_library_that_prints_does_no_harm(path):
    assert read_guarded(f"{HERE}:printing", path) == {"k": 1}


@pytest.mark.parametrize(
    ("reader", "words"),
    [
        ("endless", "took more than 2 s to read"),
        ("hungry", "needs more than 64 MiB"),
        ("killed", "its reader ended by SIGSEGV"),
        ("own_error", "^row 3 has no columns$"),
        ("pieces_of_nothing", "cannot be read: .*pieces_of_nothing"),
    ],
)
def test_each_failure_is_one_error(path, reader, words):
    with pytest.raises(ForeignFileError, match=words) as caught:
        read_guarded(f"{HERE}:{reader}", path, limits=LIMITS)
    assert not caught.value.lacks


def test_a_reader_that_sleeps_is_ended(path, monkeypatch):
    monkeypatch.setattr("transports.guarded_reader._WALL_FACTOR", 1)
    with pytest.raises(ForeignFileError, match="took more than 2 s"):
        read_guarded(f"{HERE}:asleep", path, limits=LIMITS)


@pytest.mark.parametrize(
    ("reader", "words"),
    [
        ("without_library", "needs faery_that_is_not_installed: pip install faery_that_is_not_installed"),
        ("raised_anew", "needs networkx: pip install networkx"),
        ("with_advice", "needs pycollada: pip install pycollada"),
        ("without_name", r"needs a library that is not installed \(none of them is here\)"),
    ],
)
def test_a_missing_library_is_named_and_distinguished(path, reader, words):
    with pytest.raises(ForeignFileError, match=rf"reading \.txt {words}") as caught:
        read_guarded(f"{HERE}:{reader}", path)
    assert caught.value.lacks


def test_no_file_and_no_regular_file(tmp_path):
    with pytest.raises(ForeignFileError, match="no such file"):
        read_guarded(f"{HERE}:mixed", tmp_path / "gone")
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ForeignFileError, match="no regular file"):
        read_guarded(f"{HERE}:mixed", tmp_path / "pipe")
