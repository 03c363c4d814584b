"""Images a second from an external renderer in another process, 1280 x 720 float32, through both carriers.

    python -m laboratory.benchmarks.external_rate [IMAGES]

The renderer copies a finished image into each slot, and evstim copies it again and checks every number of it. "carrier"
receives and checks; "scene" also writes a light frame for each image, half way between two.
"""

from __future__ import annotations

import multiprocessing
import sys
import time

import numpy as np

from emulator.geometry.camera import Pinhole
from emulator.scene.external.external import External, ImageQueue, compile_kernels
from emulator.scene.external.table import ExternalParameters
from evstim.renderer import Renderer
from firmware_protocol.renderer import Camera
from transports.renderer import RendererServer

SIZE = (1280, 720)
PERIOD_NS = 10_000_000


def draw(port: int, *, shared: bool) -> None:
    """Draw until the end."""
    ready = np.random.default_rng(1).random(SIZE[::-1], np.float32)
    with Renderer(f"127.0.0.1:{port}", shared=shared) as renderer:
        for image in renderer:
            image.light[:] = ready
            image.send()


def images_a_second(count: int, *, shared: bool, lit: bool) -> float:
    """Return the rate of `count` images."""
    p = ExternalParameters(period_ms=PERIOD_NS * 1e-6)
    server = RendererServer("127.0.0.1", 0)
    drawing = multiprocessing.get_context("spawn").Process(
        target=draw, args=(server.address[1],), kwargs={"shared": shared}
    )
    drawing.start()
    connection = server.accept(Camera(SIZE, 1000.0, PERIOD_NS, p.slots, 0), 60.0)
    assert connection is not None
    queue = ImageQueue(connection, p)
    scene, out = External(queue, Pinhole(*SIZE, 1000.0), 1.0), np.zeros(SIZE[::-1], np.float32)
    queue.around(0)
    start_s = time.perf_counter()
    for k in range(1, count + 1):
        if lit:
            scene.light(k * PERIOD_NS - PERIOD_NS // 2, out)
        else:
            queue.around(k * PERIOD_NS)
    spent_s = time.perf_counter() - start_s
    scene.close()
    drawing.join()
    return count / spent_s


def main(count: int) -> None:
    """Print the rates, the median of five."""
    compile_kernels()
    for shared in (True, False):
        for lit in (False, True):
            rates = sorted(images_a_second(count, shared=shared, lit=lit) for _ in range(5))
            what = "shared memory" if shared else "connection"
            print(f"{what}, {'scene' if lit else 'carrier'}: {rates[2]:.0f} images/s")  # noqa: T201


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 500)
