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
    """Return `events`, (n,) EVENT. A damaged file may end the process: faery panics, which is no Exception."""
    packets = [packet.astype(EVENT) for packet in faery.events_stream_from_file(path)]
    return {"events": np.concatenate(packets) if packets else np.empty(0, EVENT)}
