"""The kernels that a rig needs, in parts that can be compiled at the same time.

No two parts compile the same thing. Each one does at a small size what a run does; types and so the compiled code are
the same for all sizes.
"""

from __future__ import annotations

import dataclasses
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from emulator.rig.link_kinds import LINKS
from emulator.rig.loading import Rig
from emulator.rig.scene_kinds import SCENES
from emulator.sensor.presets import PRESETS, SensorParameters

__all__ = ["CODER", "DECODER", "Part", "parts_of"]

_WIDTH, _HEIGHT = 32, 24
_FEW = dataclasses.replace(PRESETS["davis346"], width=_WIDTH, height=_HEIGHT)
_Float32s = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Part:
    """Kernels that one process compiles.

    Attributes
    ----------
    name
        For people.
    seconds
        Time on one idle core, about.
    compile
        Compiles it; can be pickled.
    variant
        Tells parts of one name apart.
    after
        Parts whose kernels it uses: they come first.
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
    """Return what a run of the rig compiles."""
    sensor = dataclasses.replace(rig.camera.sensor, width=_WIDTH, height=_HEIGHT)
    parts = [Part(f"scene {rig.scene.kind}", 3.0, partial(_draw, rig))]
    if not SCENES[rig.scene.kind].events:
        parts += [*PIXELS.after, PIXELS, _effects(sensor)]
    if any(LINKS[link.kind].serves == "instrument" for link in rig.links):
        parts.append(CODER)
    return parts


def _effects(sensor: SensorParameters) -> Part:
    plain = dataclasses.replace(sensor, readout=PRESETS["davis346"].readout)  # figures that no kernel depends on
    variant = f"{zlib.crc32(repr(plain).encode()):08x}"
    return Part("read-out and effects", 4.0, partial(_read_out, sensor), variant)


def _of_the_step(which: str) -> None:
    """Compile a large part of the pixel step alone."""
    from emulator.sensor.pixels.array import PixelArray

    PixelArray(_FEW, 0).compile_part(which)


def _step() -> None:
    """Move a few pixels over a step in which some fire, and some are refined."""
    from emulator.sensor.pixels.array import PixelArray

    dark, bright = np.zeros((_HEIGHT, _WIDTH), np.float32), np.ones((_HEIGHT, _WIDTH), np.float32)
    pixels = PixelArray(_FEW, 0)
    pixels.reset(dark, 0)
    pixels.step(bright, 1_000_000, dark, _lit)


def _lit(t_ns: int, pixels: npt.NDArray[np.int64]) -> tuple[_Float32s, _Float32s]:
    return np.full(pixels.size, 0.5, np.float32), np.zeros(pixels.size, np.float32)


def _read_out(sensor: SensorParameters) -> None:
    """Let a sensor with these effects read out one event of each pixel."""
    from emulator.sensor.pixels.array import Crossings, PixelArray
    from emulator.sensor.sensor import Sensor

    class OneEvent(PixelArray):
        def step(self, light: _Float32s, t_ns: int, rate: _Float32s | None = None, at: Any = None) -> Crossings:
            self.state.t_ns = t_ns
            pixel = np.arange(light.size, dtype=np.uint32)
            return Crossings(np.full(light.size, t_ns - 1, np.int64), pixel, pixel < pixel.size // 2)

    is_grid = bool(sensor.noise.rms) and sensor.noise.grade == "grid"
    one = Sensor(sensor, 0, PixelArray if is_grid else OneEvent)
    light = np.ones((_HEIGHT, _WIDTH), np.float32)
    one.reset(light, 0)
    for t_ns in (1_000_000, 50_000_000):
        one.expose(light, t_ns, np.zeros_like(light))
    one.finish()


def _draw(rig: Rig) -> None:
    """Draw two pictures of the rig's scene, at a small size; what it cannot do the run says."""
    from emulator.light import MachineLacks, SceneError
    from emulator.run.scene_assembly import build_scene

    light, rate = np.zeros((_HEIGHT, _WIDTH), np.float32), np.zeros((_HEIGHT, _WIDTH), np.float32)
    try:
        with build_scene(rig, (_WIDTH, _HEIGHT)) as scene:
            scene.light(0, light)
            scene.light_and_rate(1_000_000, light, rate)
    except (MachineLacks, SceneError):
        return


def _encode() -> None:
    """Make a telemetry block."""
    from firmware_protocol.events import empty_events
    from firmware_protocol.telemetry.encoder import BlockEncoder

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


_CANDIDATES = Part("pixel candidates", 8.0, partial(_of_the_step, "candidates"))
_BLOCKS = Part("pixel blocks", 4.0, partial(_of_the_step, "blocks"))
PIXELS = Part("pixel step", 4.0, _step, after=(_CANDIDATES, _BLOCKS))
CODER = Part("telemetry coder", 4.0, _encode)
DECODER = Part("telemetry decoder", 3.0, _decode)
