"""Messages of named values: they come back whole, and end where they are cut."""

import numpy as np
import pytest

from transports.guarded_reader import decoded, encoded

ROWS = {"a": np.arange(6.0).reshape(2, 3), "b/c": np.array([True]), "e": np.zeros((0, 4), np.uint16), "text": ["x", 1]}


def reader(content):
    left = memoryview(content)

    def read(n):
        nonlocal left
        taken, left = bytes(left[:n]), left[n:]
        return taken

    return read


def test_messages_come_back():
    read = reader(b"".join(encoded(ROWS)) * 2)
    for _ in range(2):
        back = decoded(read)
        assert list(back) == list(ROWS)
        assert back.pop("text") == ["x", 1]
        for name, values in back.items():
            np.testing.assert_array_equal(values, ROWS[name])
            assert (values.dtype, values.shape) == (ROWS[name].dtype, ROWS[name].shape)
    assert decoded(read) is None


def test_a_message_that_is_cut_anywhere_is_the_end():
    data = b"".join(encoded({"k": 1, "a": np.arange(4)}))
    for end in range(len(data)):
        assert decoded(reader(data[:end])) is None


def test_other_bytes_and_arrays_beyond_the_bound_are_refused():
    with pytest.raises(ValueError, match="something else"):
        decoded(reader(b"\xff" * 40))
    with pytest.raises(ValueError, match="something else"):
        decoded(reader(b"".join(encoded({"a": np.zeros(100)}))), most_bytes=799)
