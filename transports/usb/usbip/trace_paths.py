"""The two files of a USB trace."""

from __future__ import annotations

from itertools import count
from pathlib import Path

__all__ = ["both_files", "trace_paths"]


def both_files(path: Path) -> tuple[Path, Path]:
    """Return PATH.txt and PATH.pcap."""
    return path.with_name(f"{path.name}.txt"), path.with_name(f"{path.name}.pcap")


def trace_paths(path: Path) -> tuple[Path, Path]:
    """Return the files to write: those of `path`, or of PATH-restart1 and so on where they hold something already."""
    for restart in count():
        files = both_files(path if not restart else path.with_name(f"{path.name}-restart{restart}"))
        if not any(file.exists() and file.stat().st_size for file in files):
            return files
    raise AssertionError  # count() does not end
