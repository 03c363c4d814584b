"""Faults outside the camera: in the poses of the dynamics, in frames of the bus, in the flight computer.

    KIND@AT[+FOR][=SHARE]      from stream time AT, s, for FOR seconds (to the end where left out)

    nan@12+3          poses whose place is not a number         refused and counted by evstim
    stop@12+3         no poses
    backwards@12+3    poses whose times run back from AT        refused as stale and counted by evstim
    lose@0=0.05       attitudes and commands are lost on the bus, each with this chance
    crash@12          the flight computer ends with an exception
    hang@12           the flight computer runs, and answers no more

Faults of the camera's links are evstim's own: tables of the rig, docs/faults.md.
"""

from __future__ import annotations

import dataclasses
import math
import re
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from firmware_protocol.pose_message import PoseMessage

__all__ = ["Fault", "Faults", "datagram_with_nan"]

KINDS = ("nan", "stop", "backwards", "lose", "crash", "hang")
_TEXT = re.compile(r"(?P<kind>[a-z]+)@(?P<at>[\d.]+)(\+(?P<for>[\d.]+))?(=(?P<share>[\d.]+))?")
_PLACE = 16  # of x in the datagram, docs/rigs.md


@dataclass(frozen=True)
class Fault:
    """One fault: kind, beginning and length in stream time, s, and chance for each where that matters."""

    kind: str
    at_s: float
    for_s: float = math.inf
    share: float = 1.0

    @classmethod
    def parse(cls, text: str) -> Fault:
        """Return the fault of a text as above; raises ValueError."""
        found = _TEXT.fullmatch(text)
        if found is None or found["kind"] not in KINDS:
            raise ValueError(f"{text!r}: a fault is KIND@AT[+FOR][=SHARE], KIND one of {', '.join(KINDS)}")
        return cls(found["kind"], float(found["at"]), float(found["for"] or "inf"), float(found["share"] or 1))

    def on(self, t_s: float) -> bool:
        """Return True while the fault lasts."""
        return self.at_s <= t_s < self.at_s + self.for_s


class Faults:
    """The faults of one flight.

    Parameters
    ----------
    faults : in any order.
    seed : of the frames that are lost.
    """

    def __init__(self, faults: Sequence[Fault] = (), seed: int = 0) -> None:
        self._faults = tuple(faults)
        self._draw = np.random.default_rng([seed, 1])
        self.frames_lost = 0

    def datagram(self, message: PoseMessage, t_s: float) -> bytes | None:
        """Return what is sent in the place of a pose; None for nothing."""
        kinds = {fault.kind: fault for fault in self._faults if fault.on(t_s)}
        if "stop" in kinds:
            return None
        if "backwards" in kinds:
            t_ns = max(round((2 * kinds["backwards"].at_s - t_s) * 1e9), 0)
            message = dataclasses.replace(message, t_ns=t_ns)
        return datagram_with_nan(message) if "nan" in kinds else bytes(message)

    def loses_frame(self, t_s: float) -> bool:
        """Return whether the bus loses the next attitude or command."""
        lost = any(one.kind == "lose" and one.on(t_s) and self._draw.random() < one.share for one in self._faults)
        self.frames_lost += lost
        return lost

    @property
    def of_computer(self) -> list[str]:
        """Arguments of the flight computer that make it fail."""
        return [f"--{one.kind}-at={one.at_s}" for one in self._faults if one.kind in ("crash", "hang")]


def datagram_with_nan(message: PoseMessage) -> bytes:
    """Return a pose's datagram with a place that is not a number and a checksum that fits."""
    data = bytearray(bytes(message))
    struct.pack_into("<d", data, _PLACE, math.nan)
    struct.pack_into("<I", data, len(data) - 4, zlib.crc32(data[:-4]))
    return bytes(data)
