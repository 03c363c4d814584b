"""The C decoder for firmware, compiled by this machine's own compiler: events a second on one core.

The sparse sky of `sparse_streams` at 1 us, each event counted and summed, and the sum compared; processor time, the
median of the repeats. Where there is no C compiler there is nothing to measure.
"""

from __future__ import annotations

import shutil
import statistics
import struct
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from emulator.bench.failed import BenchFailed
from emulator.bench.sparse_streams import SIZE, stars
from firmware_protocol.c import FOLDER, sources
from firmware_protocol.davis346 import WordEncoder
from firmware_protocol.events import Events
from firmware_protocol.packets.message import Message, MessageKind
from firmware_protocol.packets.profile import Profile
from firmware_protocol.telemetry import BlockEncoder

__all__ = ["COMPILER", "CDecoding"]

COMPILER = shutil.which("cc")
"""The compiler, None if there is none."""

_REPEATS = 9
_MODES = {"blocks": "b", "line": "c", "kiss": "k", "csp": "x", "words": "d"}
_PROFILES = {"line": "ccsds-cobs", "kiss": "ccsds-kiss", "csp": "csp-kiss"}
_PROGRAM = Path(__file__).with_suffix(".c")


@dataclass(frozen=True)
class CDecoding:
    """Mev/s from blocks, from a serial line (ccsds-cobs, ccsds-kiss, csp-kiss), or from DAVIS words to events."""

    form: Literal["blocks", "line", "kiss", "csp", "words"]

    def __call__(self) -> float:
        """Compile and measure; raises BenchFailed where there is no compiler or an event is wrong."""
        if COMPILER is None:
            raise BenchFailed("there is no C compiler (cc)")
        events = stars(0.6)
        with tempfile.TemporaryDirectory() as folder:
            program, data = Path(folder, "c_decoder"), Path(folder, "data")
            files: list[str | Path] = [_PROGRAM, *sources(), "-o", program]
            subprocess.run([COMPILER, "-std=gnu99", "-O2", f"-I{FOLDER}", *files], check=True)
            data.write_bytes(_encoded(events, self.form))
            mode = _MODES[self.form]
            done = subprocess.run([program, mode, data, str(_REPEATS)], check=True, capture_output=True, text=True)
        first, *times_ns = done.stdout.splitlines()
        if first != f"{len(events)} {_sum(events)}":
            raise BenchFailed(f"of {len(events)} events with the sum {_sum(events)} came {first}")
        return len(events) / statistics.median(map(int, times_ns)) * 1e3


def _sum(events: Events) -> int:
    t, x, y, on = (events[name].astype(np.uint64) for name in ("t", "x", "y", "on"))
    return int((t * np.uint64(3) + x * np.uint64(5) + y * np.uint64(7) + on).sum())


def _encoded(events: Events, form: str) -> bytes:
    if form == "words":
        return WordEncoder(SIZE).encode(events).words.tobytes()
    encoder, profile, pieces = BlockEncoder(SIZE), Profile(_PROFILES.get(form, "ccsds-cobs")), []
    while len(events):
        block, taken = encoder.encode(events)
        if form in _PROFILES:
            pieces.append(profile.wrap(Message(MessageKind.EVENTS, block, int(events["t"][0]))))
        else:
            pieces.append(struct.pack("<I", len(block)) + block)
        events = events[taken:]
    return b"".join(pieces)
