"""Process that writes a truth file in HDF5 (see `transports.recording.writer_process`).

HDF5 has no journal; in its mode for one writer and many readers (SWMR) a file stays readable up to the last flush if
this process is killed.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn

import h5py

from emulator.run.truth.file import About, create
from transports.guarded_reader import decoded
from transports.recording.writer_process import serve_writer

_FLUSH_S = 0.5


def main(order: Mapping[str, Any]) -> NoReturn:
    """Write the messages on stdin to the file of an order."""
    path = Path(order["path"])
    about = About(tuple(order["size"]), order["names"], order["gives"], order["facts"])
    serve_writer(lambda: create(path, about), lambda file: _write(file, path), lambda file: {})
    os._exit(0)  # without the library's clean-up, which would try to write failed data once more


def _write(file: h5py.File, path: Path) -> None:
    """Write all messages, then the attributes of the last one."""
    attributes = _write_rows(file)
    file.close()
    with h5py.File(path, "r+") as closed:  # attributes cannot change while others may read
        closed.attrs.update(attributes)


def _write_rows(file: h5py.File) -> Mapping[str, Any]:
    """Add all rows; return the attributes of the last message, {} where the run was killed before it."""
    flushed_s = time.monotonic()
    while (rows := decoded(sys.stdin.buffer.read)) is not None:
        if "attributes" in rows:
            return rows["attributes"]  # type: ignore[no-any-return]
        for name, values in rows.items():
            _add(file[name], values)
        if time.monotonic() - flushed_s > _FLUSH_S:
            file.flush()
            flushed_s = time.monotonic()
    return {}


def _add(data: h5py.Dataset, values: Any) -> None:
    before = len(data)
    data.resize(before + len(values), axis=0)
    data[before:] = values
