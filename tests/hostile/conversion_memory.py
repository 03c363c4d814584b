"""Does the memory of `evstim convert` grow with the file? Resident memory, sampled while a generated file is converted.

    python -m tests.hostile.conversion_memory [EVENTS [TARGET ...]]

The source is an EVT3 file in vectors of twelve columns, as cameras with EVT3 write them: whole rows of a 346 x 260
sensor one after another, a fifth of a byte an event, so that 10^9 events are 0.2 GB (10^9 events and .dat are the
defaults). Each TARGET is a suffix that names a format. Printed are events a second, the sizes of both files, and the
most memory that `evstim convert` and the child that reads for it had in each half of the time. Exit code 1 where an
event is missing, or where a process had 16 MiB more in the second half than in the first.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from firmware_protocol.evt.words import evt3_header
from tests.hostile.memory import MIB, resident_bytes

SIZE = (346, 260)
ROW_US = 30  # between rows: 11.5 Mev/s
CONVERT = [sys.executable, "-c", "from emulator.cli import main; main()", "convert"]
MOST_GROWN = 16 * MIB
_PIECE_ROWS = 1 << 14

Resident = list[tuple[int, int]]
"""Bytes of the command and of the child that reads for it, ten times a second."""


def generated(path, events):
    """Write at least `events` events to an EVT3 file; return how many."""
    rows = -(-events // SIZE[0])
    with path.open("wb") as file:
        file.write(evt3_header(SIZE))
        for first in range(0, rows, _PIECE_ROWS):
            file.write(row_words(np.arange(first, min(rows, first + _PIECE_ROWS))).tobytes())
    return rows * SIZE[0]


def row_words(row):
    """Return the words of whole rows, (n, words): time, row, polarity and first column, masks of twelve columns."""
    full, rest = divmod(SIZE[0], 12)
    t_us = row * ROW_US
    words = np.empty((len(row), 4 + full + 1), "<u2")
    words[:, 0] = 0x8000 | (t_us >> 12 & 0xFFF)
    words[:, 1] = 0x6000 | (t_us & 0xFFF)
    words[:, 2] = row % SIZE[1]
    words[:, 3] = 0x3000 | (row & 1) << 11
    words[:, 4:-1] = 0x4FFF
    words[:, -1] = 0x4000 | ((1 << rest) - 1)
    return words


def converted(source, target):
    """Convert; return the command's JSON, the memory of its two processes, and seconds."""
    start_s = time.monotonic()
    convert = subprocess.Popen([*CONVERT, str(source), str(target), "--json"], stdout=subprocess.PIPE, text=True)
    while not (reader := children(convert.pid)):
        time.sleep(0.05)
    resident = []
    try:
        while convert.poll() is None:
            resident.append((resident_bytes(convert.pid), resident_bytes(reader[0])))
            time.sleep(0.1)
    except (FileNotFoundError, StopIteration):  # one of them has ended between two looks
        pass
    out, _ = convert.communicate()
    return json.loads(out.splitlines()[-1]), resident, time.monotonic() - start_s


def peaks(resident):
    """Return the most bytes in each half of the time, (2 halves, 2 processes)."""
    return np.array([half.max(axis=0) for half in np.array_split(np.array(resident), 2)])


def children(pid):
    """Return the numbers of a process's own children."""
    return [int(number) for number in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def measured(source, events, suffix):
    """Convert to one format and print what was seen; return whether it was good."""
    target = source.with_name(f"out{suffix}")
    printed, resident, seconds = converted(source, target)
    most = peaks(resident)
    size = sum(one.stat().st_size for one in target.parent.rglob("out*") if one.is_file())
    rate = printed["events"] / seconds * 1e-6
    say(f"{source.suffix} to {suffix}: {printed['events']} of {events} events in {seconds:.0f} s, {rate:.1f} Mev/s, "
        f"load {os.getloadavg()[0]:.1f}; {source.stat().st_size / MIB:.0f} MiB to {size / MIB:.0f} MiB")  # fmt: skip
    for name, (first, second) in zip(("convert", "reader"), most.T / MIB, strict=True):
        say(f"    {name}: at most {first:.1f} MiB in the first half, {second:.1f} MiB in the second")
    for one in target.parent.glob("out*"):
        subprocess.run(["rm", "-r", str(one)], check=True)
    return printed["events"] == events and not printed["trouble"] and bool((most[1] - most[0] <= MOST_GROWN).all())


def say(text):
    """Print a line at once."""
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


def main(events=1e9, *suffixes):
    """Convert to each format in turn."""
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "generated.raw"
        count = generated(source, int(events))
        good = [measured(source, count, suffix) for suffix in suffixes or (".dat",)]
    return int(not all(good))


if __name__ == "__main__":
    sys.exit(main(*map(float, sys.argv[1:2]), *sys.argv[2:]))
