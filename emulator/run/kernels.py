"""Compilation of the kernels that a rig needs, ahead of a run, in parts and in parallel processes.

No two parts compile the same kernel. Each one runs the code of a run, most at a small size; types and so the compiled
code are the same for all sizes.

numba caches compiled code on disk, so this is needed once, and again after a change of the program. A file beside the
kernels records that a part is done. Without that file everything works too, and is compiled at its first use.
"""

from __future__ import annotations

import dataclasses
import gc
import multiprocessing
import os
import signal
import time
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache, partial
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import numpy as np
from numba import config

from emulator.light import LightFrame, MachineLacks, Region, SceneError
from emulator.rig.kinds import LINKS, SCENES, usb_model
from emulator.rig.loading import Rig
from emulator.run.link_process import starting_a_process
from emulator.sensor.parameters import NoiseParameters
from emulator.sensor.presets import PRESETS, SensorParameters
from firmware_protocol.compiled import cache_folder, checksum_of
from firmware_protocol.events import Float32s, Int64s

_WIDTH, _HEIGHT = 32, 24
_SCENE_S = 1.5
_LONG_SCENES_S = {"bodies": 18.0, "terrain": 20.0}  # a long part that began last would run alone on its core
_FEW = dataclasses.replace(PRESETS["davis346"], width=_WIDTH, height=_HEIGHT)


@dataclass(frozen=True)
class Part:
    """Kernels that one process compiles.

    Attributes
    ----------
    name : for people.
    seconds : time on one idle core, about.
    compile : compiles it; can be pickled.
    variant : distinguishes parts of one name.
    after : parts whose kernels it uses: they come first.
    """

    name: str
    seconds: float
    compile: Callable[[], None]
    variant: str = ""
    after: tuple[Part, ...] = ()

    @property
    def key(self) -> str:
        """Name of the note on disk that the part is done."""
        return f"{self.name} {self.variant}".strip().replace(" ", "-")


def parts_of(rig: Rig) -> list[Part]:
    """Return the parts that a run of the rig compiles."""
    sensor = dataclasses.replace(rig.camera.sensor, width=_WIDTH, height=_HEIGHT)
    kind = SCENES[rig.scene.kind]
    painter = ""
    if kind.gl:
        from emulator.gl.context import selected_painter

        painter = f"by {selected_painter(rig.run.painter)}"  # GL compiles other kernels
    seconds = _LONG_SCENES_S.get(rig.scene.kind, _SCENE_S)
    parts = [Part(f"scene {rig.scene.kind}", seconds, partial(_draw, rig), painter)] if kind.kernels else []
    if not kind.events:
        parts += [*PIXELS.after, PIXELS, _effects(sensor)]
    kinds = [LINKS[link.kind] for link in rig.links]
    if any(kind.serves == "instrument" for kind in kinds):
        parts.append(CODER)
    cameras = [usb for kind in kinds if kind.serves == "usb" and (usb := usb_model(rig.camera, kind)) is not None]
    if any(link.sends_evt() for link in rig.links) or any(camera.has_evt for camera in cameras):
        parts.append(EVT)
    for camera in cameras:
        parts += [part for kernels in camera.kernels(rig.camera) if (part := Part(*kernels)) not in parts]
    return parts


def _effects(sensor: SensorParameters) -> Part:
    if sensor.noise.grade == "passages":
        sensor = dataclasses.replace(sensor, noise=NoiseParameters())  # its kernels are those of every pixel step
    present = _present(dataclasses.asdict(sensor))
    variant = f"{zlib.crc32(repr(present).encode()):08x}"
    return Part("read-out and effects", 2.5, partial(_read_out, sensor), variant)


def _present(parameters: dict[str, Any]) -> dict[str, Any]:
    """Return what kernels depend on: the words, and which of the numbers are not zero."""
    return {
        name: _present(value) if isinstance(value, dict) else value if isinstance(value, str) else bool(value)
        for name, value in parameters.items()
    }


def _of_the_step(section: str) -> None:
    """Compile a large part of the pixel step alone."""
    from emulator.sensor.pixels.array import PixelArray

    PixelArray(_FEW, 0).compile_part(section)


def _noise() -> None:
    """Compile the passages of noise, the references at the start and the rates in still light."""
    from emulator.sensor.noise.law import still_hz
    from emulator.sensor.pixels.array import PixelArray

    pixels = PixelArray(_FEW, 0)
    pixels.compile_part("noise")
    pixels.reset(LightFrame(0, np.ones((_HEIGHT, _WIDTH), np.float32)))
    still_hz(_FEW, _FEW.corner_max_hz)


def _step() -> None:
    """Advance a few pixels by a step in which some fire, and some are refined."""
    from emulator.sensor.pixels.array import PixelArray

    dark, bright = np.zeros((_HEIGHT, _WIDTH), np.float32), np.ones((_HEIGHT, _WIDTH), np.float32)
    pixels = PixelArray(_FEW, 0)
    pixels.reset(LightFrame(0, dark))
    everything = Region(0, _HEIGHT, 0, _WIDTH, np.array([[0, _HEIGHT, 0, _WIDTH]]))
    pixels.step(LightFrame(1_000_000, bright, dark, _lit, everything))


def _lit(t_ns: int, pixels: Int64s) -> tuple[Float32s, Float32s]:
    return np.full(pixels.size, 0.5, np.float32), np.zeros(pixels.size, np.float32)


def _read_out(sensor: SensorParameters) -> None:
    """Read out two events of each pixel of a sensor with these effects, or the noise of the grid grade."""
    from emulator.sensor.pixels.array import PixelArray
    from emulator.sensor.pixels.crossings import Crossings
    from emulator.sensor.sensor import Sensor

    ends_ns = 1_000_000, 50_000_000, 5_000_000_000

    class TwoEvents(PixelArray):
        def step(self, frame: LightFrame) -> Crossings:
            middle_ns, self.state.t_ns = (self.state.t_ns + frame.t_ns) // 2, frame.t_ns
            pixel = np.arange(frame.light.size if frame.t_ns in ends_ns[::2] else 0, dtype=np.uint32)
            return Crossings(np.full(pixel.size, middle_ns, np.int64), pixel, pixel < pixel.size // 2)

    if sensor.noise.rms:  # so loud that there are noise events by the end
        noise = dataclasses.replace(sensor.noise, rms=0.3 * sensor.threshold_on)
        small_sensor = Sensor(dataclasses.replace(sensor, noise=noise), 0)
    else:
        small_sensor = Sensor(sensor, 0, TwoEvents)
    light = np.full((_HEIGHT, _WIDTH), 0.02, np.float32)
    small_sensor.reset(LightFrame(0, light))
    for t_ns in ends_ns:
        small_sensor.expose(LightFrame(t_ns, light, np.zeros_like(light)))
    small_sensor.finish()


def _draw(rig: Rig) -> None:
    """Draw three light frames of the rig's scene, and a pixel where it gives one; the run reports errors of it."""
    from emulator.run.assembly import build_scene

    width, height = _size(rig)
    light, rate = np.zeros((height, width), np.float32), np.zeros((height, width), np.float32)
    with suppress(MachineLacks, SceneError), build_scene(rig, (width, height)) as scene:
        scene.light(0, light)
        for t_ns in (1_000_000, 2_000_000):  # at the second one some scenes clear the first
            scene.light_and_rate(t_ns, light, rate)
        if scene.pixel_light is not None:
            scene.pixel_light(0, np.zeros(1, np.int64))


def _size(rig: Rig) -> tuple[int, int]:
    """Return a small width and height; the rig's own for bodies: a run finds their detail in the cache."""
    from emulator.scene.bodies.table import BodiesParameters

    return rig.camera.size if isinstance(rig.scene, BodiesParameters) else (_WIDTH, _HEIGHT)


def _find_truth() -> None:
    """Find the nearest facet of a small surface, its depth and flow; trace the leak's events of a few pixels."""
    from emulator.geometry.camera import Pinhole, Rays, Seen
    from emulator.raster.surfaces import NearestSurface, write_depth_and_flow
    from emulator.run.truth.origins import LeakShare
    from emulator.sensor.pixels.crossings import NO_CROSSINGS

    camera, seen = Pinhole(_WIDTH, _HEIGHT, 20.0), Seen.of(_WIDTH, _HEIGHT)
    rays, inverse_depth = Rays.straight(camera), np.zeros((_HEIGHT, _WIDTH))
    surface = NearestSurface([(np.array([[0, 1, 2]], np.int32), 3, True)], camera, 0.1)
    surface.look(np.array([[-1.0, -1.0, 5.0], [1.0, -1.0, 5.0], [0.0, 1.0, 5.0]]), rays, seen.labels, inverse_depth)
    bent = Rays(rays.columns, rays.rows, np.zeros((_HEIGHT, _WIDTH, 3)))
    write_depth_and_flow(inverse_depth, np.zeros((2, 3, 4)), camera, bent, seen)
    share = LeakShare(np.zeros(seen.labels.size), 0, 0.0)
    share.step(NO_CROSSINGS, np.zeros(seen.labels.size), seen.depth, 1)


def _encode() -> None:
    """Make a telemetry block."""
    from firmware_protocol.events import empty_events
    from firmware_protocol.telemetry.writing import BlockEncoder

    BlockEncoder((_WIDTH, _HEIGHT)).encode(np.zeros_like(empty_events(8)))


def _decode() -> None:
    """Read a telemetry block of one event: all its bits are zero."""
    from firmware_protocol.telemetry.layout import BlockError, Header, Mode, Polarity
    from firmware_protocol.telemetry.reading import read_events

    try:
        header = Header(Mode.FLAT, 1, Polarity.EACH, 1, 0, 0, (_WIDTH, _HEIGHT))
        read_events(header.pack() + bytes(16), header, 0)
    except BlockError:
        return


def _code_evt() -> None:
    """Compile the coders and decoders of EVT3 and EVT2 words."""
    from firmware_protocol.evt.evt2 import Evt2Decoder, Evt2Encoder
    from firmware_protocol.evt.evt3 import Evt3Decoder, Evt3Encoder

    Evt3Encoder(), Evt3Decoder(), Evt2Encoder("evt2"), Evt2Decoder("evt2")


_CANDIDATES = Part("pixel candidates", 12.0, partial(_of_the_step, "candidates"))
_BLOCKS = Part("pixel blocks", 12.0, partial(_of_the_step, "blocks"))
_NOISE = Part("pixel noise", 20.0, _noise)
PIXELS = Part("pixel step", 3.5, _step, after=(_CANDIDATES, _BLOCKS, _NOISE))
CODER = Part("telemetry coder", 6.0, _encode)
TRUTH = Part("truth", 4.0, _find_truth)
DECODER = Part("telemetry decoder", 3.0, _decode)
EVT = Part("EVT coder", 4.0, _code_evt)

_TICK_S = 0.2
_MOST_OF_A_PART = 0.95  # share counted for a part that takes longer than expected


@dataclass(frozen=True)
class Preparation:
    """State of a preparation: parts that have ended, and the share of the work that is done, 0 to 1."""

    ended: tuple[str, ...]
    share: float


@dataclass(frozen=True)
class _Running:
    part: Part
    process: BaseProcess
    began_s: float


def uncompiled(parts: Sequence[Part]) -> list[Part]:
    """Return the parts that have not been compiled on this machine yet; none where code is not stored.

    None in a daemonic process, as of a pool, which may not start others: it compiles what it uses itself.
    """
    if getattr(config, "DISABLE_JIT", 0) or _folder() is None or multiprocessing.current_process().daemon:
        return []
    return [part for part in parts if not _note(part).exists()]


def prepare(parts: Sequence[Part], on_state: Callable[[Preparation], None] = lambda _: None) -> list[str]:
    """Compile the parts, as many at a time as there are cores; return the names of those that failed.

    The longest come first, but none before those that it needs.
    """
    waiting, running = sorted(parts, key=lambda part: -part.seconds), list[_Running]()
    ended, failed = list[str](), list[str]()
    try:
        while waiting or running:
            busy = {part.key for part in (*waiting, *(compiling.part for compiling in running))}
            for part in [part for part in waiting if not busy & {needed.key for needed in part.after}]:
                if len(running) < len(os.sched_getaffinity(0)):
                    waiting.remove(part)
                    running.append(_started(part))
            wait([compiling.process.sentinel for compiling in running], _TICK_S)
            gone = [compiling for compiling in running if not compiling.process.is_alive()]
            running = [compiling for compiling in running if compiling not in gone]
            ended += [compiling.part.name for compiling in gone]
            failed += [compiling.part.name for compiling in gone if compiling.process.exitcode]
            on_state(Preparation(tuple(ended), _share(parts, ended, running)))
    finally:
        for compiling in running:
            compiling.process.terminate()
    return failed


def _share(parts: Sequence[Part], ended: Sequence[str], running: Sequence[_Running]) -> float:
    """Return the share of the work that is done; a part in work counts by its time."""
    done_s = sum(part.seconds for part in parts if part.name in ended)
    now_s = time.monotonic()
    begun_s = sum(min(now_s - compiling.began_s, _MOST_OF_A_PART * compiling.part.seconds) for compiling in running)
    return (done_s + begun_s) / sum(part.seconds for part in parts)


def _started(part: Part) -> _Running:
    context = multiprocessing.get_context("forkserver")  # processes are copies of one server, which alone imports these
    context.set_forkserver_preload([__name__, "numba.np.arraymath"])  # numba imports the second one to compile
    process = context.Process(target=_compile, args=(part,), daemon=True)
    with starting_a_process(part.compile), _safe_path():
        process.start()
    return _Running(part, process, time.monotonic())


@contextmanager
def _safe_path() -> Iterator[None]:
    """Start the server without the working directory among its places of modules.

    In Python 3.11 it ignores our places when it imports modules ahead. In the source folder it would compile the
    sources there, and an installed program would find nothing compiled.
    """
    before = os.environ.get("PYTHONSAFEPATH")
    os.environ["PYTHONSAFEPATH"] = "1"
    try:
        yield
    finally:
        del os.environ["PYTHONSAFEPATH"]
        if before is not None:
            os.environ["PYTHONSAFEPATH"] = before


def _compile(part: Part) -> None:
    """Compile a part and note that it is done."""
    # The parent process ends it, by a signal that was blocked at the start.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})
    gc.disable()  # a compilation makes millions of objects that live until its end
    part.compile()
    with suppress(OSError):  # then numba has nowhere to write either
        _note(part).touch()


def _note(part: Part) -> Path:
    return (_folder() or Path(os.devnull)) / f"evstim-{_version()}-{part.key}.compiled"


@cache
def _folder() -> Path | None:
    from emulator.sensor.pixels.crossings import unpack

    return cache_folder(unpack)


@cache
def _version() -> str:
    """Return the checksum of the sources, numba's version and the processor: compiled code depends on them."""
    import llvmlite.binding
    import numba

    root = Path(__file__).parents[2]
    sources = [checksum_of(root / folder) for folder in ("emulator", "firmware_protocol", "laboratory/methods")]
    words = f"{sources} {numba.__version__} {llvmlite.binding.get_host_cpu_name()}"
    return f"{zlib.crc32(words.encode()):08x}"
