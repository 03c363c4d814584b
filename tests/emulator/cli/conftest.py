"""The command line in the process of the tests: for all but signals, pipes and what a process leaves behind."""

from types import SimpleNamespace

import pytest

from emulator.cli.app import _main
from tests.read_here import ReadHere


@pytest.fixture
def evstim(capsys):
    """Run a command; return its exit code and what it printed."""

    def run(*arguments):
        capsys.readouterr()
        code = _main([str(argument) for argument in arguments])
        printed = capsys.readouterr()
        return SimpleNamespace(code=code, out=printed.out, err=printed.err)

    return run


@pytest.fixture
def reads_here(monkeypatch):
    """Read recordings in this process, not in a child's."""
    monkeypatch.setattr("transports.recording.files.GuardedReader", ReadHere)
