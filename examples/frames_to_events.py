"""Turn your own frames into events: `python frames_to_events.py [FILE]`.

FILE is a video, a folder of images or a .npy array (frames, height, width). Without one, frames of a disc that moves
over a gradient are made here. The events are written to events.npz.
"""

from __future__ import annotations

import sys

import numpy as np
import numpy.typing as npt

import evstim

__all__ = ["disc", "main"]


def disc(count: int = 50, width: int = 120, height: int = 80) -> npt.NDArray[np.float64]:
    """Return frames (count, height, width) of a disc that moves by one pixel a frame, as linear light."""
    y, x = np.mgrid[:height, :width]
    background = 0.1 + 0.3 * x / width
    frames = []
    for k in range(count):
        radius_px = np.hypot(x - 20 - k, y - height / 2)
        cover = np.clip(15.5 - radius_px, 0, 1)  # a soft edge of one pixel, as behind a lens
        frames.append(background * (1 - cover) + 0.9 * cover)
    return np.stack(frames)


def main(path: str | None = None) -> int:
    """Write events.npz; return its number of events."""
    if path:
        events = evstim.events_from_video(path, seed=1)
    else:
        frames = disc()
        events = evstim.events_from_frames(frames, t_us=np.arange(len(frames)) * 1000, sensor="davis346", seed=1)
    np.savez_compressed("events.npz", events=events)
    print(f"{len(events)} events, {events['on'].mean():.0%} of them ON, written to events.npz")
    return len(events)


if __name__ == "__main__":
    main(*sys.argv[1:])
