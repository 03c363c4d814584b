"""Light beside its targets: what it costs to build and to draw, and which events finer facets change.

    python -m laboratory.bench.raster [RIG ...]

built      wall time, without and with the cache of details; the first rig loads compiled kernels too
drawn      processor time of all threads for a light frame with its rate, from 10 s: the median of twelve
facets     events, as by `evstim accuracy rendering`, of the painter with finer facets that differ from those as shipped
"""

from __future__ import annotations

import os
import statistics
import sys
import time
from dataclasses import replace
from functools import partial
from tempfile import TemporaryDirectory

import numpy as np

from emulator.rig.loading import Rig, load_rig
from emulator.run.assembly import build_scene
from emulator.scene.bodies.table import BodiesParameters, BodyTable, Regolith
from laboratory.accuracy.rendering import false_and_missed, looks_of
from laboratory.accuracy.scores import Stream, compare
from laboratory.bench.streams import processor_time_s

RIGS, SIZES = ("eros", "itokawa", "eros-flyover", "rendezvous", "malapert"), ((346, 260), (1280, 720))


def main(*rigs: str) -> None:
    """Print the measurements of each rig; the arguments are those of the command."""
    for rig in map(load_rig, rigs or RIGS):
        with TemporaryDirectory() as folder:
            os.environ["XDG_CACHE_HOME"] = folder
            print(f"{rig.name}: built in {built_s(rig):.2f}, {built_s(rig):.2f} s", flush=True)
            print(f"  drawn in {', '.join(f'{drawn_ms(rig, size):.0f}' for size in SIZES)} ms", flush=True)
            match rig.scene:
                case BodiesParameters(bodies=(BodyTable(detail=Regolith() as ground) as body,)) as scene:
                    as_shipped = events_of(rig)
                    for more in (1, 4):
                        detail = replace(ground, facet_px=ground.facet_px / 2, most_facets=more * ground.most_facets)
                        finer = replace(rig, scene=replace(scene, bodies=(replace(body, detail=detail),)))
                        changed = 100 * sum(false_and_missed(compare(events_of(finer), as_shipped)))
                        print(f"  `facet_px` / 2, `most_facets` x {more}: {changed:.1f} % of the events", flush=True)


def built_s(rig: Rig) -> float:
    """Return the wall time of building the scene."""
    start_s = time.perf_counter()
    build_scene(rig).close()
    return time.perf_counter() - start_s


def drawn_ms(rig: Rig, size: tuple[int, int]) -> float:
    """Return the processor time of a light frame with its rate."""
    light, rate = np.zeros((2, *size[::-1]), np.float32)
    with build_scene(rig, size) as scene:
        frames = (partial(scene.light_and_rate, 10**10 + k * rig.run.step_us * 1000, light, rate) for k in range(15))
        return 1e3 * statistics.median([processor_time_s(frame) for frame in frames][3:])


def events_of(rig: Rig) -> Stream:
    """Return the events of the rig's scene, as `evstim accuracy rendering` draws them."""
    look = next(looks_of([rig], None))
    with build_scene(rig) as scene:
        return look.events(scene, look.step_ns, with_rate=True)[0]


if __name__ == "__main__":
    main(*sys.argv[1:])
