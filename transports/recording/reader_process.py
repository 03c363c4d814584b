"""The process that reads a recording of unknown origin: the file's parts on stdout, under limits of its own."""

from __future__ import annotations

import json
import math
import os
import resource
import sys
from pathlib import Path
from typing import Any

from transports.recording.format import FORMATS
from transports.recording.part import Part, Reader, RecordingError
from transports.recording.parts_pipe import encoded_end, encoded_facts, encoded_part
from transports.recording.reasons import reason

__all__ = ["main"]

_MOST_EVENTS = 1 << 16  # of a message


def main() -> None:
    """Read the file of the order, the first argument, and write facts, parts and an end to stdout."""
    order = json.loads(sys.argv[1])
    trouble, lacks = "", False
    try:
        size = order["size"]
        reader = _opened(order, None if size is None else (size[0], size[1]))
        _send(encoded_facts(reader.facts))
        for part in reader.parts():
            _send_pieces(part)
    except BrokenPipeError:
        os._exit(0)
    except RecordingError as error:
        trouble, lacks = str(error), "pip install" in str(error)
    except BaseException as error:  # noqa: BLE001 a panic of Rust is no Exception
        trouble = reason(error)
    _send(encoded_end(trouble=trouble, lacks=lacks))


def _opened(order: dict[str, Any], size: tuple[int, int] | None) -> Reader:
    form = FORMATS[order["format"]]
    form.imported(form.reader)  # before the limits: they are for the file
    _limit(order["memory_bytes"], order["cpu_s"])
    return form.open_reader(Path(order["path"]), size)


def _limit(memory_bytes: int, cpu_s: int) -> None:
    used_bytes = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    used_s = math.ceil(sum(os.times()[:2]))
    _lower(resource.RLIMIT_AS, used_bytes + memory_bytes)
    _lower(resource.RLIMIT_CPU, used_s + cpu_s)
    _lower(resource.RLIMIT_CORE, 0)


def _lower(which: int, value: int) -> None:
    _, hard = resource.getrlimit(which)
    wanted = value if hard == resource.RLIM_INFINITY else min(value, hard)
    resource.setrlimit(which, (wanted, hard))


def _send_pieces(part: Part) -> None:
    for start in range(0, max(1, len(part.events)), _MOST_EVENTS):
        events = part.events[start : start + _MOST_EVENTS]
        _send(encoded_part(Part(events) if start else Part(events, part.edges, part.imu, part.frames)))


def _send(messages: list[bytes]) -> None:
    data = memoryview(b"".join(messages))
    while data:
        data = data[os.write(1, data) :]


if __name__ == "__main__":
    main()
