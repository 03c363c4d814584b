"""What tests of scenes from files share."""

import pytest

from tests.read_here import read_here


@pytest.fixture
def reads_here(monkeypatch):
    """Read files in this process, not in a child's."""
    monkeypatch.setattr("emulator.scene.files.read_guarded", read_here)
