"""Events of recordings that faery reads; for a child process, see `foreign_file`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import faery
import numpy as np
import numpy.typing as npt

from firmware_protocol.events import EVENT

__all__ = ["read_recording"]


def read_recording(path: Path) -> dict[str, npt.NDArray[Any]]:
    """Return `events`, (n,) EVENT, and `size`, (2,): width and height.

    A damaged file may end the process: faery panics, which is no Exception.
    """
    stream = faery.events_stream_from_file(path)
    packets = [packet.astype(EVENT) for packet in stream]
    events = np.concatenate(packets) if packets else np.empty(0, EVENT)
    return {"events": events, "size": np.array(stream.dimensions(), np.int64)}
