"""The process that writes a truth file: messages in from a pipe, one HDF5 file out, a report at the end.

    stdin   messages (see `messages`), until its end
    stdout  a line of JSON when the file is open, or cannot be; another one when it is closed

It ends with its input, so that the file is finished also when the process that feeds it is killed. HDF5 has no journal;
in its mode for one writer and many readers (SWMR) a file stays readable up to the last flush if this process is killed.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any, NoReturn

import h5py

from emulator.run.truth.file import About, create, decoded
from transports.recording.format import reason

__all__ = ["main"]

_FLUSH_S = 0.5


def main() -> NoReturn:
    """Write the messages on stdin to the file that the first argument describes."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    order = json.loads(sys.argv[1])
    try:
        file = create(Path(order["path"]), About(tuple(order["size"]), order["names"], order["gives"], order["facts"]))
    except BaseException as error:  # noqa: BLE001 a library may raise anything
        _report(error=reason(error))
        _leave()
    _report(opened=True)
    _report(trouble=_written(file, Path(order["path"])))
    _leave()


def _leave() -> NoReturn:
    """Exit without the library's clean-up, which would try to write the failed data once more."""
    sys.stderr.flush()
    os._exit(0)


def _written(file: h5py.File, path: Path) -> str:
    """Write all messages; return the reason why the file is not complete, "" where it is."""
    try:
        facts = _write_all(file)
        file.close()
        with h5py.File(path, "r+") as closed:  # attributes cannot change while others may read
            closed.attrs.update(facts)
    except BaseException as error:  # noqa: BLE001
        trouble = reason(error)
        with suppress(BaseException):  # the first reason is reported
            file.close()
        return trouble
    return ""


def _write_all(file: h5py.File) -> dict[str, Any]:
    """Add all rows; return the attributes of the last message."""
    facts, flushed_s = {}, time.monotonic()
    while (rows := decoded(sys.stdin.buffer.read)) is not None:
        for name, values in rows.items():
            if name.startswith("@"):
                facts[name[1:]] = values[0]
            else:
                _add(file[name], values)
        if time.monotonic() - flushed_s > _FLUSH_S:
            file.flush()
            flushed_s = time.monotonic()
    return facts


def _add(data: h5py.Dataset, values: Any) -> None:
    before = len(data)
    data.resize(before + len(values), axis=0)
    data[before:] = values


def _report(**facts: Any) -> None:
    with suppress(OSError):  # the reader has ended
        os.write(1, json.dumps(facts).encode() + b"\n")


if __name__ == "__main__":
    main()
