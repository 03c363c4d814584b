"""What tests of recordings share."""

import pytest

from tests.forked_reader import Fork
from transports import guarded_reader


@pytest.fixture
def forked_readers(monkeypatch):
    """Readers are forks; `test_what_was_written_is_read_back` has those of every format as users have them."""
    monkeypatch.setattr(guarded_reader, "_start", Fork)
