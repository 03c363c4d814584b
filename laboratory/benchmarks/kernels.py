"""Cold start and rate of what every run needs, in processor time: the word encoder and the sensor's step.

    python -m laboratory.benchmarks.kernels

It needs the base dependencies alone, so it runs on a board, and in QEMU's user mode, where times mean something only
beside those of another processor in QEMU. "First" steps compile, or read the cache that an earlier run has left;
NUMBA_CACHE_DIR names an empty folder for a cold start.
"""

from __future__ import annotations

import dataclasses
import statistics
import sys
import time
from collections.abc import Callable

_STARTED_S = time.process_time()
EVENTS, BATCH = 100_000, 20_000
STEP_NS = 1_000_000
STEPS = 12
REPEATS = 5


def seconds(work: Callable[[], object]) -> float:
    """Return the processor time of one call."""
    start_s = time.process_time()
    work()
    return time.process_time() - start_s


def tell(what: str, value_s: float) -> None:
    """Print one line."""
    sys.stdout.write(f"{what:50s} {1000 * value_s:12.2f} ms\n")
    sys.stdout.flush()


def measure_encoder() -> None:
    """Print what DAVIS346 words of a saturated read-out cost."""
    from firmware_protocol.davis346.words import WordEncoder
    from laboratory.bench.streams import saturated_stream

    events = saturated_stream(EVENTS)

    def encode() -> None:
        encoder = WordEncoder((346, 260))
        for start in range(0, EVENTS, BATCH):
            encoder.encode(events[start : start + BATCH])

    tell("first encoding of 100 000 events", seconds(encode))
    tell("encoding of 100 000 events", statistics.median(seconds(encode) for _ in range(REPEATS)))


def measure_steps(what: str, phase: float) -> None:
    """Print what a step of 346 x 260 pixels costs in a grating that moves by `phase` rad a step."""
    from emulator.light import LightFrame
    from emulator.sensor.parameters import NoiseParameters
    from emulator.sensor.pixels.array import PixelArray
    from emulator.sensor.presets import PRESETS
    from laboratory.bench.pixels import grating

    plain = {"source_follower_hz": 0.0, "parasitic_hz_at_reference": 0.0, "leak_hz": 0.0}
    sensor = dataclasses.replace(PRESETS["davis346"], **plain, noise=NoiseParameters())
    pictures = [grating(sensor, -phase * k, phase) for k in range(STEPS + 1)]
    array, took_s, fired = PixelArray(sensor, 1, 1), [], 0
    array.reset(LightFrame(0, pictures[0][0], pictures[0][1]))
    for k, (light, rate) in enumerate(pictures[1:], 1):
        start_s = time.process_time()
        fired += len(array.step(LightFrame(k * STEP_NS, light, rate)))
        took_s.append(time.process_time() - start_s)
    tell(f"first step, {what}", took_s[0])
    tell(f"step, {what} ({fired / STEPS / sensor.width / sensor.height:.1%} a step)", statistics.median(took_s[1:]))


def main() -> None:
    """Print the times."""
    import numba  # noqa: F401

    tell("import of numpy and numba", time.process_time() - _STARTED_S)
    measure_encoder()
    measure_steps("nothing fires", 1e-4)
    measure_steps("pixels fire", 0.05)


if __name__ == "__main__":
    main()
