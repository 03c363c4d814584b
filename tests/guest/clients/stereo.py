"""What the clients that read a stereo pair share: the events of both cameras, from their synchronisation on.

    stereo_*.py --count N --timeout S --output FILE.npz

The left camera's arrays, as `collecting` describes them, go to FILE.npz, the right one's to FILE-right.npz.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from typing import Any

from collecting import Collector

LEFT, RIGHT = "00000346", "00000347"


def collectors(options: argparse.Namespace) -> list[Collector]:
    """One for each camera."""
    right = options.output.with_stem(f"{options.output.stem}-right")
    return [Collector(options), Collector(argparse.Namespace(**vars(options) | {"output": right}))]


def take_both(cameras: Sequence[Any], options: argparse.Namespace) -> None:
    """Take events of both until each has given enough, and report."""
    both = collectors(options)
    while not all(collector.done for collector in both) and all(camera.isRunning() for camera in cameras):
        for camera, collector in zip(cameras, both, strict=True):
            batch = camera.getNextEventBatch()
            if batch is not None:
                events = batch.numpy()
                collector.add(events["timestamp"], events["x"], events["y"], events["polarity"])
        time.sleep(0.001)
    running = [camera.isRunning() for camera in cameras]
    for collector in reversed(both):
        collector.report(running=running)
