"""Guarded reading: values come back whole, and each way in which a reader fails is one error."""

import os

import numpy as np
import pytest

from tests.transports.foreign_readers import RECORDS
from transports.guarded_reader import ForeignFileError, GuardedReader, Limits, read_guarded

READERS = "tests.transports.foreign_readers"
LIMITS = Limits(memory_bytes=64 << 20, cpu_s=1)


@pytest.fixture
def path(tmp_path):
    (tmp_path / "a.txt").write_text("content")
    return tmp_path / "a.txt"


def test_values_come_back_with_their_types_and_can_be_written(path):
    found = read_guarded(f"{READERS}:mixed", path, 3, "x")
    np.testing.assert_array_equal(found["a"], np.arange(6.0).reshape(2, 3) * 3)
    np.testing.assert_array_equal(found["r"], RECORDS)
    assert (found["r"].dtype, found["none"].shape, found["text"]) == (RECORDS.dtype, (0, 4), "x")
    found["a"][0, 0] = 7


def test_pieces_come_before_the_error(path):
    got = []
    with GuardedReader(f"{READERS}:pieces", path) as reading, pytest.raises(ForeignFileError, match="fourth"):
        got += (values for values in reading.values())
    assert got == [{"k": k, "content": "content"} for k in range(3)]


def test_a_library_that_prints_does_no_harm(path):
    assert read_guarded(f"{READERS}:printing", path) == {"k": 1}


@pytest.mark.parametrize(
    ("reader", "words"),
    [
        ("endless", "took more than 1 s to read"),
        ("hungry", "needs more than 64 MiB"),
        ("killed", "its reader ended by SIGSEGV"),
        ("own_error", "^row 3 has no columns$"),
        ("pieces_of_nothing", "cannot be read: .*pieces_of_nothing"),
    ],
)
def test_each_failure_is_one_error(path, reader, words):
    with pytest.raises(ForeignFileError, match=words) as caught:
        read_guarded(f"{READERS}:{reader}", path, limits=LIMITS)
    assert not caught.value.lacks


def test_a_reader_that_sleeps_is_ended(path, monkeypatch):
    monkeypatch.setattr("transports.guarded_reader._WALL_FACTOR", 1)
    with pytest.raises(ForeignFileError, match="took more than 1 s"):
        read_guarded(f"{READERS}:asleep", path, limits=LIMITS)


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
        read_guarded(f"{READERS}:{reader}", path)
    assert caught.value.lacks


def test_no_file_and_no_regular_file(tmp_path):
    with pytest.raises(ForeignFileError, match="no such file"):
        read_guarded(f"{READERS}:mixed", tmp_path / "gone")
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ForeignFileError, match="no regular file"):
        read_guarded(f"{READERS}:mixed", tmp_path / "pipe")
