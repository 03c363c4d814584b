"""Events of an external renderer's images beside the truth, by rate of images and by the layers beside light.

    python -m laboratory.accuracy.image_layers [FOLDER]

Our own Itokawa turns 40 times as fast as in its rig, so that its surface moves at up to 280 px/s, and is drawn twice:
as the truth of `evstim accuracy` (point samples, rays for shadows), and as images at 30, 100 and 1000 a second with
their motion, depth or rate, which are joined as those of a renderer. The truth takes minutes; FOLDER stores it.
"""

from __future__ import annotations

import dataclasses
import pickle
import sys
from functools import partial
from pathlib import Path

import numpy as np

from emulator.geometry.camera import Pinhole, Seen
from emulator.light import Light, OtherLight
from emulator.rig.loading import load_rig
from emulator.scene.bodies.raster_bodies import RasterBodies
from emulator.scene.bodies.table import BodiesParameters
from emulator.scene.external.joining import Joined, Pair, TimedImage, front_motion
from laboratory.accuracy.rendering import Look, Stretch, comb_of
from laboratory.accuracy.scores import Stream, compare

STEP_US = 2000
STEPS = 48
RATES_HZ = (30, 100, 1000)
LAYERS = ((), ("rate",), ("motion",), ("motion", "depth"), ("motion", "depth", "rate"))


class Images(OtherLight):
    """The images of bodies every `period_ns` with some layers, joined as those of a renderer."""

    def __init__(self, p: BodiesParameters, pinhole: Pinhole, period_ns: int, layers: tuple[str, ...]) -> None:
        super().__init__(RasterBodies(p, pinhole))
        self._period_ns, self._layers = period_ns, layers
        self._joined, self._drawn = Joined(self.size), dict[int, TimedImage]()

    def light(self, t_ns: int, out: Light) -> None:
        """Write the joined light."""
        self._joined.write(self._pair(t_ns), t_ns, out)

    def light_and_rate(self, t_ns: int, light: Light, rate: Light) -> None:
        """Write the joined light and its derivative."""
        self._joined.write(self._pair(t_ns), t_ns, light, rate)

    def close(self) -> None:
        """Close the scene."""
        super().close()
        self._joined.close()

    def _pair(self, t_ns: int) -> Pair:
        k = t_ns // self._period_ns
        self._drawn = {k + i: self._drawn.get(k + i) or self._draw((k + i) * self._period_ns) for i in (0, 1)}
        return self._drawn[k], self._drawn[k + 1]

    def _draw(self, t_ns: int) -> TimedImage:
        light = np.zeros(self.size[::-1], np.float32)
        rate = np.zeros_like(light)
        seen = Seen.of(*self.size)
        self.scene.light_and_rate(t_ns, light, rate)
        geometry = self.scene.geometry()
        assert geometry is not None
        geometry.look(t_ns, seen)
        depth = seen.depth if "depth" in self._layers else None
        motion = front_motion(np.nan_to_num(seen.flow), depth) if "motion" in self._layers else None
        return TimedImage(t_ns, light, motion, depth, rate if "rate" in self._layers else None)


def fast_look() -> Look:
    """Return the scene and its stretch."""
    rig = load_rig("itokawa")
    assert isinstance(rig.scene, BodiesParameters)
    scene = dataclasses.replace(rig.scene, time_scale=40 * rig.scene.time_scale)
    run = dataclasses.replace(rig.run, step_us=STEP_US)
    return Look(dataclasses.replace(rig, scene=scene, run=run), Stretch(steps=STEPS, samples=8, finer=8))


def truth_of(shown: Look, folder: Path | None) -> Stream:
    """Return the true events, stored in `folder`."""
    if folder is None:
        return shown.truth()
    path = folder / "external-images.pickle"
    if not path.exists():
        path.write_bytes(pickle.dumps(shown.truth()))
    return pickle.loads(path.read_bytes())  # type: ignore[no-any-return]


def row(name: str, stream: Stream, truth: Stream, period_us: float) -> str:
    """Return a row of the table."""
    scores, middle = compare(stream, truth), comb_of(stream.t_us, period_us).middle_share
    times = f"{scores.t50_us / 1000:.3f} | {scores.t95_us / 1000:.2f}"
    return f"| {name} | {scores.wrong_events / 2:.2%} | {times} | {middle:.3f} |"


def main(folder: Path | None = None) -> None:
    """Print the table."""
    shown = fast_look()
    truth = truth_of(shown, folder)
    print(f"{len(truth)} true events; middle share of them at 30, 100, 1000 Hz:", end=" ")
    print(", ".join(f"{comb_of(truth.t_us, 1e6 / hz).middle_share:.3f}" for hz in RATES_HZ))
    print("| images | wrong | t50 ms | t95 ms | middle share |\n|---|---:|---:|---:|---:|")
    with shown.scene(RasterBodies) as scene:
        print(row("our own scene", shown.events(scene, shown.step_ns, with_rate=True)[0], truth, STEP_US))
    for hz in RATES_HZ:
        for layers in LAYERS:
            build = partial(Images, period_ns=round(1e9 / hz), layers=layers)
            with shown.scene(build) as scene:
                stream, _ = shown.events(scene, min(shown.step_ns, round(1e9 / hz)), with_rate=True)
            print(row(f"{hz} Hz, {' and '.join(layers) or 'images alone'}", stream, truth, 1e6 / hz), flush=True)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:2]))
