"""Files are checked before a command's work."""

import os

import pytest

from emulator.cli.checks import check_output
from emulator.cli.output import Failure


def test_a_new_file_does_not_appear_while_it_is_checked(tmp_path, monkeypatch):
    """A script that waits for `--ready-file` would take it for ready."""
    opened, real = [], os.open

    def noting(path, *arguments):
        opened.append(os.fspath(path))
        return real(path, *arguments)

    monkeypatch.setattr(os, "open", noting)
    check_output("--ready-file", tmp_path / "ready")
    assert len(opened) == 1
    assert opened[0] != str(tmp_path / "ready")
    assert list(tmp_path.iterdir()) == []


def test_what_a_file_holds_stays(tmp_path):
    (tmp_path / "there").write_text("old")
    check_output("--record", tmp_path / "there")
    assert (tmp_path / "there").read_text() == "old"


def test_a_file_that_cannot_be_written_is_told(tmp_path):
    for wrong in (tmp_path / "none" / "file", tmp_path, tmp_path / ("x" * 300)):
        with pytest.raises(Failure, match="--record: "):
            check_output("--record", wrong)
