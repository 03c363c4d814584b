"""The measures of `evstim bench`: names, units, and the functions that measure them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from laboratory.bench import coders as word
from laboratory.bench import links as link
from laboratory.bench import loops as loop
from laboratory.bench import pixels as pixel
from laboratory.bench.coders import (
    COMPILER,
    BlockBits,
    BlockDecoding,
    BlockEncoding,
    CDecoding,
    Evt3Bytes,
    Evt3Decoding,
    Evt3Encoding,
)
from laboratory.bench.links import FAERY, FileEvents
from laboratory.bench.loops import HAS_CAMPAIGNS, RendererImages
from laboratory.bench.pixels import NoiseLoad
from laboratory.bench.scenes import Drawing, ScenesAlike, Workload


@dataclass(frozen=True)
class Measure:
    """One measure. `run` takes seconds and returns a median of several repeats, in `unit`; no target: None."""

    name: str
    unit: str
    better: Literal["higher", "lower"]
    target: float | None
    run: Callable[[], float]


SMALL, LARGE = (346, 260), (1280, 720)

# Only where there is a compiler: without one every bench would fail.
_IN_C = (
    Measure("c_decode_blocks", "Mev/s", "higher", 30, CDecoding("blocks")),
    Measure("c_decode_line", "Mev/s", "higher", 30, CDecoding("line")),
    Measure("c_decode_kiss", "Mev/s", "higher", 30, CDecoding("kiss")),
    Measure("c_decode_csp", "Mev/s", "higher", 30, CDecoding("csp")),
    Measure("c_decode_words", "Mev/s", "higher", None, CDecoding("words")),
)

# Rigs, and their targets in frames a second at both sizes.
_RIGS: tuple[tuple[str, float | None, float | None], ...] = (
    ("checkerboard", 2000, 200),
    ("eros", 150, 60),
    ("itokawa", 150, 60),
    ("eros-flyover", 150, 60),
    ("rendezvous", None, None),
    ("malapert", 60, 25),
    ("stars", 1000, 1500),
)


def _of_a_rig(rig: str, small: float | None, large: float | None) -> tuple[Measure, ...]:
    """Return the measures of a rig: frames per second, and steps with the light's derivative."""
    name = rig.replace("-", "_")
    return tuple(
        Measure(f"{name}_{size[0]}x{size[1]}{end}", unit, "higher", target, Workload(rig, size, with_rate=bool(end)))
        for end, unit in (("", "frames/s"), ("_hermite", "steps/s"))
        for size, target in ((SMALL, None if end else small), (LARGE, None if end else large))
    )


MEASURES = (
    Measure("pixel_quiet", "Mpixel/s", "higher", 1000, pixel.pixel_quiet),
    Measure("pixel_5pct", "Mpixel/s", "higher", 550, pixel.pixel_5pct),
    Measure("pixel_quiet_line", "Mpixel/s", "higher", 1000, pixel.pixel_quiet_line),
    Measure("pixel_5pct_line", "Mpixel/s", "higher", 500, pixel.pixel_5pct_line),
    Measure("pixel_changing", "Mpixel/s", "higher", 1000, pixel.pixel_changing),
    Measure("pixel_still", "Mpixel/s", "higher", 20_000, pixel.pixel_still),
    Measure("pixel_still_compared", "Mpixel/s", "higher", 4000, pixel.pixel_still_compared),
    Measure("two_threads_1pct", "times", "higher", 1.6, pixel.TwoThreads(0.01)),
    Measure("two_threads_15pct", "times", "higher", 1.6, pixel.TwoThreads(0.15)),
    Measure("pixel_edges", "Mev/s", "higher", 10, pixel.pixel_edges),
    Measure("noise_rare", "us/step", "lower", 10, NoiseLoad(0.01)),
    Measure("noise_1hz", "us/step", "lower", 10, NoiseLoad(1.0)),
    Measure("noise_1hz_whole", "times", "lower", 1.3, NoiseLoad(1.0, "factor")),
    Measure("noise_10hz", "us/step", "lower", None, NoiseLoad(10.0)),
    Measure("noise_10hz_read_out", "us/step", "lower", None, NoiseLoad(10.0, "sensor")),
    Measure("scenes_alike_64", "times", "lower", 2, ScenesAlike(64)),
    Measure("scenes_alike_4096", "times", "lower", 2, ScenesAlike(4096)),
    Measure("words_encode", "Mev/s", "higher", 80, word.words_encode),
    Measure("words_encode_streams", "Mev/s", "higher", 40, word.words_encode_streams),
    Measure("words_decode", "Mev/s", "higher", 40, word.words_decode),
    Measure("groups_encode", "Mev/s", "higher", 60, word.groups_encode),
    Measure("groups_decode", "Mev/s", "higher", 40, word.groups_decode),
    Measure("evt3_encode_target", "Mev/s", "higher", 60, Evt3Encoding("target")),
    Measure("evt3_encode_rows", "Mev/s", "higher", 60, Evt3Encoding("rows")),
    Measure("evt3_decode_target", "Mev/s", "higher", 40, Evt3Decoding("target")),
    Measure("evt3_decode_rows", "Mev/s", "higher", 40, Evt3Decoding("rows")),
    Measure("evt3_bytes_target", "bytes/ev", "lower", None, Evt3Bytes("target")),
    Measure("evt3_bytes_rows", "bytes/ev", "lower", None, Evt3Bytes("rows")),
    Measure("blocks_encode_stars", "Mev/s", "higher", 10, BlockEncoding("stars")),
    Measure("blocks_encode_target", "Mev/s", "higher", 10, BlockEncoding("target")),
    Measure("blocks_decode_stars", "Mev/s", "higher", 10, BlockDecoding("stars")),
    Measure("blocks_decode_target", "Mev/s", "higher", 10, BlockDecoding("target")),
    Measure("blocks_stars_1us", "bits/ev", "lower", 24, BlockBits("stars", 1)),
    Measure("blocks_target_1us", "bits/ev", "lower", 18, BlockBits("target", 1)),
    Measure("blocks_stars_100us", "bits/ev", "lower", 16.5, BlockBits("stars", 100)),
    Measure("blocks_target_100us", "bits/ev", "lower", 10.5, BlockBits("target", 100)),
    *(_IN_C if COMPILER else ()),
    *(measure for rig in _RIGS for measure in _of_a_rig(*rig)),
    *(Measure(f"gpu_frame_{w}x{h}", "ms", "lower", None, Drawing((w, h))) for w, h in (SMALL, LARGE)),
    Measure("serial_fill", "%", "higher", 98, link.serial_fill),
    Measure("usbip_events", "Mev/s", "higher", 12, link.usbip_events),
    Measure("latency_p50", "us", "lower", 1000, link.latency_p50),
    Measure("latency_p99", "us", "lower", 3000, link.latency_p99),
    Measure("latency_p999", "us", "lower", 10_000, link.latency_p999),
    Measure("late_steps", "steps", "lower", 0, link.late_steps),
    Measure("evt3_file", "Mev/s", "higher", 10, FileEvents("evt3")),
    *((Measure("aedat4_file", "Mev/s", "higher", 10, FileEvents("aedat4")),) if FAERY else ()),
    Measure("simulation_step", "times", "lower", 1.05, loop.simulation_step),
    Measure("pose_to_bytes", "ms", "lower", None, loop.pose_to_bytes),
    Measure("renderer_shared", "images/s", "higher", None, RendererImages(shared=True)),
    Measure("renderer_tcp", "images/s", "higher", None, RendererImages(shared=False)),
    *((Measure("campaign_run", "ms", "lower", 5, loop.campaign_run),) if HAS_CAMPAIGNS else ()),
)
