"""Formats of recordings by name, detection of a file's format, and error texts for people.

A format names its modules by path, so that nothing is imported before a file of its kind is opened. Installed packages
add formats as entry points of the group "evstim.formats"; a built-in one comes first where two have the same signature
or the same suffix.

The format of an existing file is detected by its first bytes; CSV and formats without such a signature by the suffix.
"""

from __future__ import annotations

import errno
import os
import re
import shlex
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from firmware_protocol.recordings.event_table import TableForm, is_table
from firmware_protocol.recordings.part import Facts
from transports.needs import install_command
from transports.recording.part import MOST_PIXELS, LibraryMissing, Reader, RecordingError, Size, Writer
from transports.registry import PluginError, Registry, UnknownName, imported


@dataclass(frozen=True)
class Format:
    """A format of recordings.

    Attributes
    ----------
    name, title : its name in commands, and its name for people.
    suffixes : ends of the names of its files, the usual one first.
    writer, reader : "module:name" of its writer (path, facts) and its reader (path).
    signature : first bytes of all its files; empty: its files are recognised by their suffix.
    holds : streams that are written with it: "events", "edges", "imu", "frames".
    ordered : streams that share one order of time; each of the others has its own packets or list.
    readers : programs that open it, for people.
    needs : the optional package that it needs, of the extra `files`; "" for none. faery writes files, and reads none.
    size_px : largest (width, height) that it can number.
    until_us : first time that it cannot represent.
    is_folder : True if it is a folder of files.
    piece_us : time that is written at once, if events are few.
    live : True if a file that was not closed can be read up to its last whole piece.
    is_evt : True if it has words of EVT: rising and falling edges, and no record for a pulse that a camera reports.
    is_table : True if it is text in columns; its reader has a TableForm as a third parameter.
    has_topics : True if it may hold the events of several cameras; its reader has the topic as a third parameter.
    """

    name: str
    title: str
    suffixes: tuple[str, ...]
    writer: str
    reader: str
    signature: bytes = b""
    holds: tuple[str, ...] = ("events",)
    ordered: tuple[str, ...] = ()
    readers: str = ""
    needs: str = ""
    size_px: tuple[int, int] = (1 << 16, 1 << 16)
    until_us: int = 1 << 62
    is_folder: bool = False
    piece_us: int = 10_000  # the packet length of cameras
    live: bool = True
    is_evt: bool = False
    is_table: bool = False
    has_topics: bool = False

    def open_writer(self, path: Path, facts: Facts) -> Writer:
        """Return a writer of `path`, which is overwritten; raises OSError or RecordingError."""
        if facts.size is None:
            raise RecordingError(
                f"{self.title} needs the size of the sensor, which is not known: give --size, such as 346x260"
            )
        if facts.size[0] > self.size_px[0] or facts.size[1] > self.size_px[1]:
            raise RecordingError(f"{self.title} numbers {self.size_px[0]} x {self.size_px[1]} pixels, not {facts.size}")
        if not path.parent.is_dir():
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(path.parent))
        writer: Writer = self.imported(self.writer)(path, facts)
        return writer

    def open_reader(
        self, path: Path, size: Size | None = None, table: TableForm | None = None, topic: str = ""
    ) -> Reader:
        """Return a reader of `path`; raises as its parts do, and RecordingError for a sensor that cannot be.

        `size` is for files without the size of the sensor, `table` for tables of text, `topic` for bags; empty:
        the first one.
        """
        if topic and not self.has_topics:
            raise RecordingError(f"{self.title} has no topics: leave --topic out")
        if table not in (None, TableForm()) and not self.is_table:
            raise RecordingError(f"{self.title} is no table of text: leave --columns and --time-unit out")
        reader: Reader = self.imported(self.reader)(
            path, size, *([table] if self.is_table else ()), *([topic] if self.has_topics else ())
        )
        width, height = reader.facts.size or (1, 1)
        if min(width, height) < 1 or width * height > MOST_PIXELS:
            raise RecordingError(f"its sensor has {width} x {height} pixels: from 1 to {MOST_PIXELS} are read")
        if size and reader.facts.size not in (None, size):
            raise RecordingError(f"its sensor has {width} x {height} pixels: leave --size {size[0]}x{size[1]} out")
        return reader

    def imported(self, path: str) -> Any:
        """Return the class or function at the path of `writer` or `reader`; raises LibraryMissing."""
        try:
            return imported(path)
        except (ImportError, AttributeError) as error:
            if not self.needs:
                raise RecordingError(f"{self.title} cannot be used: {path}: {error}") from error
            raise LibraryMissing(f"{self.title} needs {self.needs}: {install_command('files')}") from error


_ALL = ("events", "edges", "imu", "frames")
_PICTURED = ("events", "imu", "frames")
_WORDS = ("events", "edges")  # share one order of time where both are words
_HERE = "transports.recording"
_evt_file = partial(
    Format,
    reader=f"{_HERE}.word_files:EvtReader",
    holds=_WORDS,
    ordered=_WORDS,
    size_px=(1 << 11, 1 << 11),
    is_evt=True,
)
_FORMATS = (
    Format(
        "aedat4", "AEDAT 4.0", (".aedat4",), f"{_HERE}.faery_files:Aedat4Writer", f"{_HERE}.event_files:Aedat4Reader",
        signature=b"#!AER-DAT4.0", holds=_ALL, readers="DV, dv-processing, aedat, faery, jAER", needs="faery",
        size_px=(1 << 15, 1 << 15),
    ),
    Format(
        "aedat2", "AEDAT 2.0", (".aedat2", ".aedat"), f"{_HERE}.word_files:Aedat2Writer",
        f"{_HERE}.word_files:Aedat2Reader", signature=b"#!AER-DAT2", holds=_ALL, ordered=_ALL,
        readers="jAER, tonic, dv", size_px=(1 << 10, 1 << 9),
    ),
    Format(
        "aedat31", "AEDAT 3.1", (".aedat31", ".aedat3"), f"{_HERE}.word_files:Aedat31Writer",
        f"{_HERE}.word_files:Aedat31Reader", signature=b"#!AER-DAT3.1", holds=_ALL, readers="cAER, dv",
        size_px=(1 << 15, 1 << 15),
    ),
    _evt_file(
        "evt3", "EVT3", (".raw",), f"{_HERE}.word_files:Evt3Writer", readers="Metavision, OpenEB, faery, evlib, evt3",
    ),
    _evt_file(
        "evt2", "EVT2", (".evt2.raw", ".evt2"), f"{_HERE}.word_files:Evt2Writer",
        readers="Metavision, OpenEB, faery, evlib, expelliarmus", until_us=1 << 34,
    ),
    _evt_file(
        "evt21", "EVT2.1", (".evt21.raw", ".evt21"), f"{_HERE}.word_files:Evt21Writer",
        readers="Metavision, OpenEB, evlib", until_us=1 << 34,
    ),
    _evt_file(
        "evt21-legacy", "EVT2.1 as of an IMX636", (".evt21-legacy.raw",), f"{_HERE}.word_files:Evt21LegacyWriter",
        readers="Metavision, OpenEB", until_us=1 << 34,
    ),
    Format(
        "dat", "DAT", (".dat",), f"{_HERE}.faery_files:dat_writer", f"{_HERE}.word_files:DatReader",
        readers="Metavision, OpenEB, faery, expelliarmus", needs="faery", size_px=(1 << 14, 1 << 14),
        until_us=1 << 32,
    ),
    Format(
        "es", "Event Stream", (".es",), f"{_HERE}.faery_files:es_writer", f"{_HERE}.word_files:EsReader",
        signature=b"Event Stream", readers="faery, event_stream, Sepia", needs="faery", until_us=1 << 37,
    ),
    Format(
        "csv", "CSV", (".csv",), f"{_HERE}.faery_files:csv_writer", f"{_HERE}.event_files:CsvReader",
        readers="faery, pandas, any table", needs="faery", is_table=True,
    ),
    Format(
        "dsec", "HDF5 as DSEC has it", (".h5", ".hdf5"), f"{_HERE}.dsec:DsecWriter", f"{_HERE}.dsec:DsecReader",
        signature=b"\x89HDF\r\n\x1a\n", readers="h5py, evlib, the DSEC tools", needs="h5py", until_us=1 << 32,
        piece_us=1_000_000,
    ),
    Format(
        "ros1", "ROS 1 bag", (".bag",), f"{_HERE}.rosbag:Ros1Writer", f"{_HERE}.rosbag:BagReader",
        signature=b"#ROSBAG V2.0", holds=_ALL, ordered=_WORDS, readers="event_camera_msgs (evt3)", needs="rosbags",
        size_px=(1 << 11, 1 << 11), live=False, is_evt=True, has_topics=True,
    ),
    Format(
        "ros1-dvs", "ROS 1 bag of dvs_msgs", (".dvs.bag",), f"{_HERE}.rosbag:Ros1DvsWriter",
        f"{_HERE}.rosbag:BagReader", holds=_PICTURED, readers="dvs_msgs: rpg_dvs_ros, rpg_esim", needs="rosbags",
        live=False,
    ),
    Format(
        "ros2", "ROS 2 bag", (".ros2",), f"{_HERE}.rosbag:Ros2Writer", f"{_HERE}.rosbag:BagReader", holds=_ALL,
        ordered=_WORDS, readers="event_camera_msgs (evt3)", needs="rosbags", size_px=(1 << 11, 1 << 11),
        is_folder=True, live=False, is_evt=True, has_topics=True,
    ),
    Format(
        "ros2-dvs", "ROS 2 bag of dvs_msgs", (".dvs.ros2",), f"{_HERE}.rosbag:Ros2DvsWriter",
        f"{_HERE}.rosbag:BagReader", holds=_PICTURED, readers="dvs_msgs", needs="rosbags", is_folder=True, live=False,
    ),
    Format(
        "npz", "NumPy", (".npz",), f"{_HERE}.record:NpzWriter", f"{_HERE}.record:NpzReader", signature=b"PK\x03\x04",
        holds=_ALL, readers="numpy, evstim", live=False,
    ),
)  # fmt: skip
FORMATS: Registry[Format] = Registry("evstim.formats", Format, {form.name: form for form in _FORMATS})
"""Formats by name."""


def with_addition(path: Path, text: str) -> Path:
    """Return the path with `text` before its suffix, so that its format stays: a.dvs.bag -> a-TEXT.dvs.bag."""
    suffix = next((suffix for suffix, _ in _by_suffix() if path.name.endswith(suffix)), path.suffix)
    stem = path.name[: len(path.name) - len(suffix)] if suffix else path.name
    return path.with_name(f"{stem}-{text}{suffix}")


def format_to_write(path: Path, name: str = "") -> Format:
    """Return the format of that name, or the one of the file's suffix; raises RecordingError."""
    if name:
        try:
            return FORMATS[name]
        except (UnknownName, PluginError) as error:
            raise RecordingError(f"format {error}") from error
    for suffix, form in _by_suffix():
        if path.name.endswith(suffix) and path.name != suffix:
            return form
    ends = ", ".join(suffix for form in FORMATS.usable().values() for suffix in form.suffixes)
    raise RecordingError(f"{path.name!r} has none of the suffixes that are written: {ends}; or give the format")


def _by_suffix() -> list[tuple[str, Format]]:
    """Return each suffix with its format, the longest first."""
    pairs = [(suffix, form) for form in FORMATS.usable().values() for suffix in form.suffixes]
    return sorted(pairs, key=lambda pair: -len(pair[0]))


_HEAD_BYTES = 4096
_OF_ROS2 = (".db3", ".mcap")  # files in the folder of a ROS 2 bag
_REINDEX = "`ros2 bag reindex"


def format_to_read(path: Path) -> Format:
    """Return the format of a file or folder; raises RecordingError for an unknown one, and OSError."""
    if path.is_dir():
        if (path / "metadata.yaml").is_file():
            return FORMATS["ros2"]
        if any(file.suffix in _OF_ROS2 for file in path.iterdir()):
            raise RecordingError(f"a ROS 2 bag without metadata.yaml: {_REINDEX} {shlex.quote(str(path))}` writes it")
        raise RecordingError("it is a folder, and no ROS 2 bag: there is no metadata.yaml in it")
    if path.exists() and not path.is_file():
        raise RecordingError("it is no regular file")
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES)
    if not head:
        raise RecordingError("it is empty")
    for form in FORMATS.usable().values():
        if form.signature and head.startswith(form.signature):
            return form
    return _of_text(head, path)


def is_recording(path: Path) -> bool:
    """Return true if a path is that of a recording by its suffix or by its first bytes."""
    for format_of in (format_to_write, format_to_read):
        with suppress(RecordingError, OSError):
            return bool(format_of(path))
    return False


def _of_percent(head: bytes, path: Path) -> Format:
    """Return the format of a file of Prophesee's: its lines of text begin with a percent sign."""
    if path.suffix == ".dat" and b"% evt" not in head and b"% format" not in head:
        return FORMATS["dat"]
    if re.search(rb"(?mi)^% (evt 2\.1|format EVT2\.?1)", head):
        return FORMATS["evt21-legacy" if re.search(rb"(?mi)^% .*endianness[ =]legacy", head) else "evt21"]
    return FORMATS["evt2" if re.search(rb"(?mi)^% (evt 2\.0|format EVT2\b)", head) else "evt3"]


def _of_text(head: bytes, path: Path) -> Format:
    if head.startswith(b"#!AER-DAT"):
        version = head[9:12].decode("ascii", "replace")
        raise RecordingError(f"it is AEDAT {version}; 2.0, 3.1 and 4.0 are read")
    if head.startswith(b"%"):
        return _of_percent(head, path)
    if path.suffix == ".csv" or is_table(head):
        return FORMATS["csv"]
    if head.startswith((b"SQLite format 3\0", b"\x89MCAP0\r\n")):
        advice = f"name its folder; {_REINDEX} FOLDER` writes a metadata.yaml that is missing there"
        raise RecordingError(f"it is a file of a ROS 2 bag: {advice}")
    plugins = [form for form in FORMATS.usable().values() if form.name not in FORMATS.built_in_names]
    for form in plugins:
        if not form.signature and path.name.endswith(form.suffixes):
            return form
    names = ", ".join(dict.fromkeys(form.title for form in FORMATS.usable().values()))
    raise RecordingError(f"it is none of the recordings that are read: {names}")


_MOST_CHARACTERS = 300


def reason(error: BaseException) -> str:
    """Return the text of an error in one line; of an operating system's error its text, "No space left on device"."""
    if isinstance(error, MemoryError):
        return "it needs more memory than an intact file of its kind does"
    if isinstance(error, OSError) and error.strerror:
        return os.strerror(error.errno) if error.errno else error.strerror  # HDF5 puts a paragraph there
    text = " ".join(str(error).split()) or type(error).__name__
    patterns = r"([A-Z][A-Za-z ,']+) \(os error \d+\)", r"error message = '([^']+)'"  # of Rust, of HDF5
    message = next(filter(None, (re.search(pattern, text) for pattern in patterns)), None)
    return message[1] if message else text[:_MOST_CHARACTERS]
