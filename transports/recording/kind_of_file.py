"""The format of a file that is there, by its first bytes; CSV, which has none of its own, goes by its suffix too."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

from transports.recording.format import FORMATS, Format
from transports.recording.part import RecordingError

__all__ = ["format_to_read"]

_STARTS = (
    (b"#!AER-DAT4.0", "aedat4"),
    (b"#!AER-DAT2", "aedat2"),
    (b"#!AER-DAT3.1", "aedat31"),
    (b"Event Stream", "es"),
    (b"\x89HDF\r\n\x1a\n", "dsec"),
    (b"#ROSBAG V2.0", "ros1"),
    (b"PK\x03\x04", "npz"),
)
_HEAD_BYTES = 4096


def format_to_read(path: Path) -> Format:
    """Return the format of a file or folder; raises RecordingError for what is none, and OSError."""
    if path.is_dir():
        if (path / "metadata.yaml").is_file():
            return FORMATS["ros2"]
        raise RecordingError("it is a folder, and no ROS 2 bag: there is no metadata.yaml in it")
    if path.exists() and not path.is_file():
        raise RecordingError("it is no regular file")
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES)
    if not head:
        raise RecordingError("it is empty")
    for start, name in _STARTS:
        if head.startswith(start):
            return FORMATS[name]
    return _of_text(head, path)


def _of_percent(head: bytes, path: Path) -> Format:
    """Return the format of a file of Prophesee's: its lines of text begin with a percent sign."""
    if path.suffix == ".dat" and b"% evt" not in head and b"% format" not in head:
        return FORMATS["dat"]
    if re.search(rb"(?mi)^% (evt 2\.1|format EVT2\.?1)", head):
        return dataclasses.replace(FORMATS["evt2"], title="EVT2.1", readers="Metavision, OpenEB")
    return FORMATS["evt2" if re.search(rb"(?mi)^% (evt 2\.0|format EVT2\b)", head) else "evt3"]


def _of_text(head: bytes, path: Path) -> Format:
    if head.startswith(b"#!AER-DAT"):
        version = head[9:12].decode("ascii", "replace")
        raise RecordingError(f"it is AEDAT {version}; 2.0, 3.1 and 4.0 are read")
    if head.startswith(b"%"):
        return _of_percent(head, path)
    first = head.splitlines()[0]
    is_line = first[:2] in (b"t,", b"x,") or (first.count(b",") >= 3 and first[:1].isdigit())
    if is_line or path.suffix == ".csv":
        return FORMATS["csv"]
    names = ", ".join(dict.fromkeys(one.title for one in FORMATS.values()))
    raise RecordingError(f"it is none of the recordings that are read: {names}")
